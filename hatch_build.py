"""Build hook: generates the Python codec of the dialect with pymavlink's own generator.

It runs for wheels and for editable installs. The result carries a digest of everything that it was made from,
so that a second build changes nothing.
"""

import contextlib
import hashlib
import io
import os
import py_compile
import shutil
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

DIALECT = Path("arm_companion/protocol/dialect")
STANDARD = ("minimal.xml", "standard.xml", "common.xml")


class DialectHook(BuildHookInterface):  # type: ignore[type-arg]
    """Makes `generated.py` beside the XML before the files of the wheel are collected."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002 - hatchling's signature
        """Generate if an input changed; hatchling calls this before each build."""
        if self.target_name == "wheel":
            generate(Path(self.root) / DIALECT)


def generate(folder: Path) -> bool:
    """Write `folder/generated.py` from `folder/arm_companion.xml` and the standard XML files of pymavlink.

    Returns:
        Whether it was written; False when it is up to date.

    Raises:
        RuntimeError: when the generator refuses the XML, with what it said.
    """
    import pymavlink.dialects.v20  # noqa: PLC0415 - a build requirement, absent when only metadata is asked for
    from pymavlink.generator import mavgen_python  # noqa: PLC0415

    source = folder / "arm_companion.xml"
    target = folder / "generated.py"
    shipped = Path(pymavlink.dialects.v20.__file__).parent
    inputs = [source, *(shipped / name for name in STANDARD), Path(mavgen_python.__file__), Path(__file__)]
    digest = hashlib.sha256(b"".join(hashlib.sha256(path.read_bytes()).digest() for path in inputs)).hexdigest()
    mark = f"# made by hatch_build.py, inputs {digest}\n"
    if target.exists():
        with target.open(encoding="utf-8") as file:
            if file.readline() == mark:
                return False
    with tempfile.TemporaryDirectory() as scratch_name:
        scratch = Path(scratch_name)
        for name in STANDARD:
            shutil.copy(shipped / name, scratch / name)
        _without_known(source, scratch).write(scratch / source.name, encoding="utf-8", xml_declaration=True)
        code = mark + _run_generator(scratch / source.name)
    part = target.with_suffix(f".{os.getpid()}.part")
    try:
        part.write_text(code, encoding="utf-8")
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    # Compiling takes longer than the daemon has to its first heartbeat, so that it is done here.
    py_compile.compile(str(target), doraise=True)
    return True


def _known(standard: Path) -> set[tuple[str | None, str | None]]:
    """What the includes define: (None, message id) and (enum name, entry value)."""
    known: set[tuple[str | None, str | None]] = set()
    for name in STANDARD:
        included = ET.parse(standard / name)  # noqa: S314 - pymavlink's own file, no foreign input
        known |= {(None, message.get("id")) for message in included.iter("message")}
        for enum in included.iter("enum"):
            known |= {(enum.get("name"), entry.get("value")) for entry in enum.findall("entry")}
    return known


def _without_known(source: Path, standard: Path) -> "ET.ElementTree[ET.Element]":
    """Our XML without what the installed pymavlink already defines (newer ones have more of the standard)."""
    known = _known(standard)
    tree = ET.parse(source)  # noqa: S314 - our own file
    for messages in tree.iter("messages"):
        for message in messages.findall("message"):
            if (None, message.get("id")) in known:
                messages.remove(message)
    for enums in tree.iter("enums"):
        for enum in enums.findall("enum"):
            for entry in enum.findall("entry"):
                if (enum.get("name"), entry.get("value")) in known:
                    enum.remove(entry)
            if enum.find("entry") is None:
                enums.remove(enum)
    return tree


def _run_generator(xml: Path) -> str:
    """Python code for `xml`; what the generator prints appears only when it fails."""
    from pymavlink.generator import mavgen, mavparse  # noqa: PLC0415

    output = xml.with_suffix(".py")
    options = mavgen.Opts(str(output), wire_protocol=mavparse.PROTOCOL_2_0, language="Python3", validate=False)
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            made = mavgen.mavgen(options, [str(xml)])
        except SystemExit:
            made = False
    if not made or not output.exists():
        raise RuntimeError(f"pymavlink's generator refused {xml.name}:\n{said.getvalue()}")
    return output.read_text(encoding="utf-8").lstrip()
