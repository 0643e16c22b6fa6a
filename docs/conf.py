"""`make docs`: this folder as a site."""

from arm_companion import __version__

project = "arm_companion"
author = "the authors of arm_companion"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
root_doc = "index"
exclude_patterns = ["README.md"]  # the index includes it
myst_heading_anchors = 3
html_theme = "alabaster"
html_theme_options = {"description": "a continuum arm on a drone", "page_width": "70rem", "fixed_sidebar": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
suppress_warnings = ["misc.highlighting_failure"]  # Mermaid diagrams stay as text
