"""docs/options.md, from the schema.

python -m arm_companion.config.document > docs/options.md
"""

import itertools
import json
import sys
from typing import Any

from arm_companion.config.describe import Described, every

_HEAD = """\
# All options

Generated from the schema by `python -m arm_companion.config.document`; a test compares. How to set them, and where a
value comes from: [configuration.md](configuration.md). `arm-companion config explain KEY` says the same of one option,
with the value that your own files give it. `NAME` is a name of your choice, and `[[...]]` a table that may stand more
than once.
"""


def document() -> str:
    """The whole page, in Markdown."""
    parts = [_HEAD]
    for section, options in itertools.groupby(every(), key=lambda o: o.key.rpartition(".")[0]):
        parts.append(_section(section, list(options)))
    return "\n".join(parts)


def _section(section: str, options: list[Described]) -> str:
    title = f"[[{section.removesuffix('[]')}]]" if section.endswith("[]") else f"[{section.replace('[]', '')}]"
    text = options[0].section.partition("] ")[2] or options[0].section
    rows = [
        f"| `{option.key.rpartition('.')[2]}` | {_cell(option.option.doc)} | {_range(option)} | {_default(option)} |"
        for option in options
    ]
    return "\n".join(
        [f"## `{title}`", "", text, "", "| key | meaning | values | default |", "| --- | --- | --- | --- |", *rows, ""]
    )


def _range(option: Described) -> str:
    kind, allowed = option.kind, option.allowed
    if option.option.choices:
        return ", ".join(f"`{choice}`" for choice in option.option.choices)
    return _cell(f"{kind}, {allowed}" if allowed else kind)


def _default(option: Described) -> str:
    if option.required:
        return "must be given"
    return "" if option.default in ("", (), None) or option.default == {} else f"`{_cell(_literal(option.default))}`"


def _literal(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, float):
        return f"{value:.10g}"
    return json.dumps(list(value) if isinstance(value, tuple) else value)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(document())
