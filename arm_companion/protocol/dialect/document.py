"""`python -m arm_companion.protocol.dialect.document > docs/dialect.md`: the dialect's XML as a page for people."""

import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from typing import Final

from arm_companion.protocol.dialect import XML, mav
from arm_companion.protocol.mavlink_frames import place_of

_OURS: Final = range(64_000, 64_100)

_HEAD: Final = """\
# The dialect, message by message

Made from `arm_companion/protocol/dialect/arm_companion.xml` by
`python -m arm_companion.protocol.dialect.document`; a test holds this page against it. How the messages are used is
told in [mavlink.md](mavlink.md).

All numbers are little-endian. Fields stand here in the order in which libraries name them; *at* is where a field stands
on the wire, in bytes from the payload's start, and *CRC* is the message's CRC_EXTRA. MAVLink 2 cuts zero bytes from a
payload's end. A field whose value does not apply holds what *none* says.
"""


def document(xml: str) -> str:
    """The page.

    Args:
        xml: the dialect's definition.
    """
    root = ET.fromstring(xml)  # noqa: S314 - our own file
    messages = [m for m in root.iter("message") if int(m.get("id", 0)) in _OURS]
    others = [m for m in root.iter("message") if int(m.get("id", 0)) not in _OURS]
    parts = [_HEAD, "## Messages\n"]
    parts += ["\n".join(_message(message)) for message in messages]
    parts += ["## Commands\n", "\n".join(_commands(root)), "## Enums\n"]
    parts += ["\n".join(_enum(enum)) for enum in root.iter("enum") if (enum.get("name") or "").startswith("ARM_")]
    parts += ["## Standard messages that the XML adds\n", "\n".join(_standard(others))]
    return "\n".join(parts)


def _message(message: ET.Element) -> Iterator[str]:
    number, name = int(message.get("id", 0)), message.get("name")
    cls = mav.mavlink_map[number]
    yield f"### {name} ({number})\n"
    yield f"{_text(message)} {cls.unpacker.size} bytes, CRC {cls.crc_extra}.\n"
    yield "| field | type | at | unit | none | meaning |"
    yield "| --- | --- | --- | --- | --- | --- |"
    extension = False
    for field in message:
        extension = extension or field.tag == "extensions"
        if field.tag != "field":
            continue
        meaning = (field.text or "").strip()
        if enum := field.get("enum"):
            meaning += f" [{enum}](#{enum.lower()})" if enum.startswith("ARM_") else f" {enum}"
        meaning += " (extension)" if extension else ""
        own = field.get("name", "")
        none = f"`{field.get('invalid')}`" if field.get("invalid") else ""
        yield f"| {own} | {field.get('type')} | {place_of(cls, own)} | {field.get('units', '')} | {none} | {meaning} |"
    yield ""


def _commands(root: ET.Element) -> Iterator[str]:
    yield "| command | number | parameters | meaning |"
    yield "| --- | --- | --- | --- |"
    for entry in root.iterfind(".//enum[@name='MAV_CMD']/entry"):
        parameters = "; ".join(f"{p.get('index')}: {_parameter(p)}" for p in entry.iter("param"))
        yield f"| {entry.get('name')} | {entry.get('value')} | {parameters or '-'} | {_text(entry)} |"
    yield ""


def _parameter(param: ET.Element) -> str:
    enum = param.get("enum")
    link = f" ([{enum}](#{enum.lower()}))" if enum else ""
    return f"{param.get('label')}: {(param.text or '').strip()}{link}"


def _enum(enum: ET.Element) -> Iterator[str]:
    kind = " Bits." if enum.get("bitmask") else ""
    yield f"### {enum.get('name')}\n"
    yield f"{_text(enum)}{kind}\n"
    yield "| value | name | meaning |"
    yield "| --- | --- | --- |"
    for entry in enum.iter("entry"):
        yield f"| {entry.get('value')} | {entry.get('name')} | {_text(entry)} |"
    yield ""


def _standard(messages: Iterable[ET.Element]) -> Iterator[str]:
    yield "With the standard's ids and fields; a build leaves out what its includes already have.\n"
    yield "| message | id | meaning |"
    yield "| --- | --- | --- |"
    for message in messages:
        yield f"| {message.get('name')} | {message.get('id')} | {_text(message)} |"
    yield ""


def _text(element: ET.Element) -> str:
    return " ".join((element.findtext("description") or "").split())


if __name__ == "__main__":
    sys.stdout.write(document(XML.read_text(encoding="utf-8")))
