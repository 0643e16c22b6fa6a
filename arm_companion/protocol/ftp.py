"""MAVLink FTP: what FILE_TRANSFER_PROTOCOL.payload holds.

Bytes: sequence number (2, little-endian), session, opcode, size of data, opcode that is answered, burst complete,
padding, offset (4), data (up to 239).
"""

import enum
import struct
import zlib
from dataclasses import dataclass
from typing import Final

from arm_companion.errors import ProtocolError

PAYLOAD: Final = 251
DATA: Final = 239
"""Most bytes of a file in one message."""

_HEAD: Final = struct.Struct("<HBBBBBxI")


class Opcode(enum.IntEnum):
    """What is asked for, or the kind of an answer."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    ACK = 128
    NAK = 129


class Failure(enum.IntEnum):
    """Why something is refused: the first byte of a NAK's data."""

    FAIL = 1
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


@dataclass(frozen=True, slots=True)
class FtpPayload:
    """One request or answer."""

    sequence: int
    opcode: int
    session: int = 0
    offset: int = 0
    data: bytes = b""
    size: int | None = None
    """The size field where it is not the length of `data`: how much a read asks for."""
    answers: int = Opcode.NONE
    burst_complete: bool = False

    def pack(self) -> bytes:
        """The payload, padded to its full length.

        Raises:
            ProtocolError: the data is too long.
        """
        if len(self.data) > DATA:
            raise ProtocolError(f"{len(self.data)} bytes do not fit into one FTP message")
        size = len(self.data) if self.size is None else self.size
        head = _HEAD.pack(
            self.sequence & 0xFFFF, self.session, self.opcode, size, self.answers, self.burst_complete, self.offset
        )
        return (head + self.data).ljust(PAYLOAD, b"\0")


def unpack(payload: bytes) -> FtpPayload:
    """Read a payload.

    Raises:
        ProtocolError: it is too short, or says that it holds more than it does.
    """
    if len(payload) < _HEAD.size:
        raise ProtocolError("FTP payload is too short")
    sequence, session, opcode, size, answers, complete, offset = _HEAD.unpack_from(payload)
    if size > DATA:
        raise ProtocolError(f"FTP payload of {size} bytes is too long")
    data = payload[_HEAD.size : _HEAD.size + size]
    return FtpPayload(sequence, opcode, session, offset, data, size, answers, bool(complete))


def crc32(data: bytes) -> int:
    """CRC-32 as MAVLink uses it for files: the common one with start value 0 and without the final inversion."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF
