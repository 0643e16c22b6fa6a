"""Dynamixel Protocol 2.0: frames to bytes and back, without any input or output.

A frame on the wire is `FF FF FD 00 | id | length | instruction | parameters | CRC`, the length counting from
the instruction to the CRC. Where instruction and parameters contain `FF FF FD`, another `FD` is stuffed in
behind, so that a header never occurs inside a frame. The CRC covers everything before it, stuffing included.

`Parser` is fed whatever bytes arrive, in whatever pieces, and finds the frames in them again after garbage,
lost bytes and damage; what it threw away it counts.
"""

import enum
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from fastcrc import crc16 as _fastcrc

from arm_companion.errors import ProtocolError

crc16 = _fastcrc.umts
"""CRC-16 with polynomial 0x8005, initial value 0, most significant bit first."""

HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 0xFE
MAX_ID = 0xFC
MAX_LENGTH = 1024
"""Longest length field taken for real; a greater one is damage."""

STATUS_OVERHEAD = 11
"""Bytes of a status frame besides its data."""

_PATTERN = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"
_PREFIX = 7  # header, id and length
_LEAST_LENGTH = 3  # instruction and CRC
CLEAR_TURNS = b"\x01\x44\x58\x4c\x22"
"""Parameters of a Clear: option 1 and four fixed bytes."""


class Instruction(enum.IntEnum):
    """What a frame asks for, or that it is an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


class StatusError(enum.IntEnum):
    """Why a servo did not do what it was told: bits 0 to 6 of a status frame's error byte."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80
"""Bit of the error byte: register 70 holds a hardware error."""


class Packet(NamedTuple):
    """One frame without its framing.

    Attributes:
        id: servo, or `BROADCAST_ID`.
        instruction: an `Instruction`, or any other byte that came.
        error: error byte of a status frame, 0 of any other.
        parameters: what follows, unstuffed; raw in the one answer of a Fast Sync Read.
    """

    id: int
    instruction: int
    error: int
    parameters: bytes


def frame(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Bytes of one frame.

    Raises:
        ProtocolError: when the frame would be longer than `MAX_LENGTH`.
    """
    body = bytes((instruction,)) + parameters
    if _PATTERN in body:
        body = body.replace(_PATTERN, _STUFFED)
    length = len(body) + 2
    if length > MAX_LENGTH:
        raise ProtocolError(f"frame of length {length} is longer than {MAX_LENGTH}")
    head = b"%b%c%c%c%b" % (HEADER, servo, length & 0xFF, length >> 8, body)
    return head + crc16(head).to_bytes(2, "little")


def status(servo: int, error: int = 0, data: bytes = b"") -> bytes:
    """A servo's answer."""
    return frame(servo, Instruction.STATUS, bytes((error,)) + data)


def ping(servo: int) -> bytes:
    """Ask for model number and firmware; with `BROADCAST_ID` every servo answers."""
    return frame(servo, Instruction.PING)


def read(servo: int, address: int, size: int) -> bytes:
    """Ask for `size` bytes of the control table."""
    return frame(servo, Instruction.READ, _address(address) + _address(size))


def write(servo: int, address: int, data: bytes) -> bytes:
    """Write to the control table."""
    return frame(servo, Instruction.WRITE, _address(address) + data)


def reg_write(servo: int, address: int, data: bytes) -> bytes:
    """Write to the control table when `action` comes."""
    return frame(servo, Instruction.REG_WRITE, _address(address) + data)


def action(servo: int) -> bytes:
    """Do what `reg_write` announced."""
    return frame(servo, Instruction.ACTION)


def reboot(servo: int) -> bytes:
    """Restart a servo; the only way out of a shutdown, and the end of its multi-turn position."""
    return frame(servo, Instruction.REBOOT)


def clear_turns(servo: int) -> bytes:
    """Reduce the present position to one turn; refused while the servo moves."""
    return frame(servo, Instruction.CLEAR, CLEAR_TURNS)


def sync_read(servos: Iterable[int], address: int, size: int, *, fast: bool = False) -> bytes:
    """Ask several servos for the same registers; they answer in the order given, `fast` in one frame."""
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return frame(BROADCAST_ID, instruction, _address(address) + _address(size) + bytes(servos))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Write the same registers of several servos at once; no servo answers.

    Args:
        address: first register.
        data: bytes for each servo id, all of one length.

    Raises:
        ProtocolError: when the data are none or differ in length.
    """
    sizes = {len(item) for item in data.values()}
    if len(sizes) != 1:
        raise ProtocolError(f"Sync Write needs data of one length, not {sorted(sizes)}")
    each = b"".join(bytes((servo,)) + item for servo, item in data.items())
    return frame(BROADCAST_ID, Instruction.SYNC_WRITE, _address(address) + _address(sizes.pop()) + each)


def fast_sync_answer(replies: Iterable[tuple[int, int, bytes]]) -> bytes:
    """The one frame in which servos answer a Fast Sync Read.

    After the instruction byte follow, for each servo, error, id, data and a CRC over everything so far; the
    last of these is the frame's own. Nothing is stuffed.

    Args:
        replies: id, error and data of each servo.
    """
    items = list(replies)
    length = 1 + sum(4 + len(data) for _, _, data in items)
    out = b"%b%c%c%c%c" % (HEADER, BROADCAST_ID, length & 0xFF, length >> 8, Instruction.STATUS)
    for servo, error, data in items:
        out += bytes((error, servo)) + data
        out += crc16(out).to_bytes(2, "little")
    return out


def fast_sync_size(servos: int, size: int) -> int:
    """Bytes of the one frame in which so many servos answer a Fast Sync Read of `size` bytes."""
    return _PREFIX + 1 + servos * (size + 4)


def split_fast_sync_answer(packet: Packet, size: int) -> list[Packet]:
    """The answers of the single servos in the answer to a Fast Sync Read of `size` bytes.

    Raises:
        ProtocolError: when the frame does not hold whole answers of that size.
    """
    raw = bytes((packet.error,)) + packet.parameters
    step = size + 4
    if (len(raw) + 2) % step:  # the last CRC is the frame's own and already gone
        raise ProtocolError(f"Fast Sync Read answer of {len(raw)} bytes does not hold items of {size} bytes")
    return [Packet(raw[i + 1], Instruction.STATUS, raw[i], raw[i + 2 : i + 2 + size]) for i in range(0, len(raw), step)]


class Parser:
    """Finds frames in a stream of bytes.

    Attributes:
        frames: frames found.
        garbage: bytes that belonged to no good frame.
        crc_errors: frames that came whole and were damaged.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.garbage = 0
        self.crc_errors = 0
        self._buffer = b""

    def reset(self) -> None:
        """Forget a frame that has begun; its bytes count as garbage."""
        self.garbage += len(self._buffer)
        self._buffer = b""

    def feed(self, data: bytes) -> list[Packet]:
        """Take in `data`; return the frames that are complete now."""
        buffer = self._buffer + data if self._buffer else bytes(data)
        packets: list[Packet] = []
        start = 0
        while True:
            start = self._find_header(buffer, start)
            rest = len(buffer) - start
            if rest < _PREFIX:
                break
            servo = buffer[start + 4]
            length = buffer[start + 5] | buffer[start + 6] << 8
            if not _LEAST_LENGTH <= length <= MAX_LENGTH or (servo > MAX_ID and servo != BROADCAST_ID):
                start = self._skip_header(start)
                continue
            end = start + _PREFIX + length
            if end > len(buffer):
                inner = -1 if _unstuffed(buffer, start, servo) else buffer.find(HEADER, start + _PREFIX)
                if inner < 0:
                    break
                self.garbage += inner - start  # stuffing keeps headers out of frames: this one broke off
                start = inner
                continue
            if crc16(buffer[start : end - 2]) != buffer[end - 2] | buffer[end - 1] << 8:
                self.crc_errors += 1
                start = self._skip_header(start)
                continue
            packets.append(_unpack(buffer, start, end, servo))
            start = end
        self._buffer = buffer[start:]
        self.frames += len(packets)
        return packets

    def _find_header(self, buffer: bytes, start: int) -> int:
        """Start of the next header, or of what may become one at the buffer's end."""
        if buffer.startswith(HEADER, start):
            return start
        found = buffer.find(HEADER, start)
        if found < 0:
            found = len(buffer)
            for tail in range(min(len(HEADER) - 1, found - start), 0, -1):
                if buffer.endswith(HEADER[:tail]):
                    found -= tail
                    break
        self.garbage += found - start
        return found

    def _skip_header(self, start: int) -> int:
        self.garbage += len(HEADER)
        return start + len(HEADER)


def _unstuffed(buffer: bytes, start: int, servo: int) -> bool:
    """Whether this is the answer to a Fast Sync Read, whose data may look like a header."""
    at = start + _PREFIX
    return servo == BROADCAST_ID and (at == len(buffer) or buffer[at] == Instruction.STATUS)


def _unpack(buffer: bytes, start: int, end: int, servo: int) -> Packet:
    instruction = buffer[start + _PREFIX]
    body = buffer[start + _PREFIX + 1 : end - 2]
    if instruction != Instruction.STATUS:
        return Packet(servo, instruction, 0, _unstuff(bytes((instruction,)) + body)[1:])
    if servo != BROADCAST_ID:
        body = _unstuff(body)
    return Packet(servo, instruction, body[0] if body else 0, body[1:])


def _unstuff(body: bytes) -> bytes:
    return body.replace(_STUFFED, _PATTERN) if _STUFFED in body else body


def _address(value: int) -> bytes:
    return value.to_bytes(2, "little")
