"""What the bytes of a MAVLink frame say: where it ends, whose it is, whom it is for, and whether its checksum fits."""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from arm_companion.protocol.dialect import mav

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
MAGICS: Final = frozenset({MAGIC_V1, MAGIC_V2})
SIGNED: Final = 0x01
SIGNATURE_LENGTH: Final = 13

_CRC_INIT: Final = 0xFFFF
_ANY_MAGIC: Final = re.compile(b"[\xfd\xfe]")
_HEADER_V2: Final = struct.Struct("<xBBxBBBHB")  # length, flags, sequence, system, component, id (low, high)
_HEADER_V1: Final = struct.Struct("<xBBBBB")  # length, sequence, system, component, id


def _slow_crc(data: bytes, crc: int) -> int:
    """CRC-16/MCRF4XX in plain Python, where the compiled one is missing."""
    for byte in data:
        x = byte ^ (crc & 0xFF)
        x = (x ^ (x << 4)) & 0xFF
        crc = (crc >> 8) ^ (x << 8) ^ (x << 3) ^ (x >> 4)
    return crc


_compiled_crc: Callable[[bytes, int], int] | None = getattr(mav, "mcrf4xx", None)
_crc = _slow_crc if _compiled_crc is None else _compiled_crc

_SIZES: Final = {
    "char": 1, "uint8_t": 1, "int8_t": 1, "uint16_t": 2, "int16_t": 2, "uint32_t": 4, "int32_t": 4, "float": 4,
    "uint64_t": 8, "int64_t": 8, "double": 8,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Layout:
    """How to read one message: precomputed from the generated class."""

    make: Callable[..., Any]
    extra: bytes  # CRC_EXTRA
    size: int  # bytes of the whole payload
    unpack: Callable[[bytes], tuple[Any, ...]]
    slots: tuple[tuple[int, int], ...]  # per constructor argument: index in the unpacked tuple, entries (0: scalar)
    target: tuple[int, int]  # where target_system and target_component stand in the payload; -1: nowhere


def _layout(cls: Any) -> Layout:
    starts: list[int] = []
    at = 0
    for length in cls.lengths:  # unpacked entries of each field, in wire order
        starts.append(at)
        at += length
    slots = tuple((starts[order], cls.array_lengths[order] if cls.lengths[order] > 1 else 0) for order in cls.orders)
    target = (place_of(cls, "target_system"), place_of(cls, "target_component"))
    return Layout(cls, bytes([cls.crc_extra]), cls.unpacker.size, cls.unpacker.unpack, slots, target)


def place_of(cls: Any, name: str) -> int:
    """Offset of a field in the payload of a generated message class; -1 when it has none of that name."""
    at = 0
    for field_name, entries in zip(cls.ordered_fieldnames, cls.array_lengths, strict=True):
        if field_name == name:
            return at
        kind = cls.fieldtypes[cls.fieldnames.index(field_name)]
        at += _SIZES[kind] * max(entries, 1)
    return -1


LAYOUTS: Final[dict[int, Layout]] = {id_: _layout(cls) for id_, cls in mav.mavlink_map.items()}
"""Of every message of the dialect, by id."""


def next_magic(data: bytes, at: int) -> int:
    """Where the next frame may start; the end of the data when nowhere."""
    if data[at] in MAGICS:
        return at
    found = _ANY_MAGIC.search(data, at)
    return len(data) if found is None else found.start()


def are_frames(data: bytes) -> bool:
    """Whether the data are whole good frames with known ids, and nothing else."""
    at, size = 0, len(data)
    while at < size and data[at] in MAGICS and (end := frame_end(data, at)) <= size:
        head = header_at(data, at)
        layout = LAYOUTS.get(head.id)
        if head.flags & ~SIGNED or layout is None or not checksum_fits(data, head, layout):
            return False
        at = end
    return at == size > 0


def frame_end(data: bytes, at: int) -> int:
    """Where the candidate at `at` ends; past the data when too little is known."""
    header = 10 if data[at] == MAGIC_V2 else 6
    if len(data) < at + header:
        return at + header + 2
    end = at + header + data[at + 1] + 2
    return end + SIGNATURE_LENGTH if header == 10 and data[at + 2] & SIGNED else end


class Header(NamedTuple):
    """What a frame says of itself, and where its parts stand in the data that it came in."""

    flags: int
    sequence: int
    system: int
    component: int
    id: int
    # positions in the data
    magic: int
    payload: int
    crc: int


def header_at(data: bytes, at: int) -> Header:
    """The header of the candidate at `at`, which must be whole."""
    if data[at] == MAGIC_V2:
        length, flags, sequence, system, component, low, high = _HEADER_V2.unpack_from(data, at)
        return Header(flags, sequence, system, component, low | high << 16, at, at + 10, at + 10 + length)
    length, sequence, system, component, id_ = _HEADER_V1.unpack_from(data, at)
    return Header(0, sequence, system, component, id_, at, at + 6, at + 6 + length)


def addressee(frame: bytes, head: Header) -> tuple[int, int]:
    """System and component that a frame is for; 0 is everybody, also where the message has no address.

    Args:
        frame: the whole frame.
        head: its header, with positions in the data that the frame was cut from.
    """
    layout = LAYOUTS.get(head.id)
    if layout is None:
        return 0, 0
    start, length = head.payload - head.magic, head.crc - head.payload
    system, component = (
        frame[start + place] if 0 <= place < length else 0 for place in layout.target
    )  # MAVLink 2 cuts trailing zeros
    return system, component


def crc_extra(message_id: int) -> int | None:
    """CRC_EXTRA of a message; None for one that the dialect lacks."""
    layout = LAYOUTS.get(message_id)
    return None if layout is None else layout.extra[0]


def checksum(frame: bytes, extra: int) -> int:
    """CRC of a frame from behind its magic to the end of its payload, with CRC_EXTRA.

    Args:
        frame: magic, header and payload, without checksum.
        extra: CRC_EXTRA of its message.
    """
    return _crc(bytes((extra,)), _crc(frame[1:], _CRC_INIT))


def checksum_fits(data: bytes, head: Header, layout: Layout) -> bool:
    """Whether the checksum in the data is that of the frame with this header."""
    end = head.crc
    return _crc(layout.extra, _crc(data[head.magic + 1 : end], _CRC_INIT)) == data[end] | data[end + 1] << 8


def find_frame(data: bytes, start: int, end: int) -> tuple[int, int]:
    """Start and end of the first good frame with a known id that stands whole between two places; -1 twice: none."""
    for found in _ANY_MAGIC.finditer(data, start, end):
        at = found.start()
        until = frame_end(data, at)
        if until <= end:
            head = header_at(data, at)
            layout = LAYOUTS.get(head.id)
            if layout is not None and checksum_fits(data, head, layout):
                return at, until
    return -1, -1


def decode(layout: Layout, payload: bytes) -> Any:
    """The message with this payload, without its header.

    MAVLink 2 cuts trailing zeros; a longer payload comes from a newer definition with more extensions.

    Raises:
        TypeError, ValueError, struct.error: its content cannot be read.
    """
    values = layout.unpack(payload[: layout.size].ljust(layout.size, b"\0"))
    arguments = [values[i : i + n] if n else values[i] for i, n in layout.slots]
    return layout.make(*(a.rstrip(b"\0") if isinstance(a, bytes) else a for a in arguments))
