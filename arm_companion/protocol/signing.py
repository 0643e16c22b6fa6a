"""MAVLink 2 message signing: who has the key may speak, and no frame counts twice.

A signed frame ends in 13 bytes: link id, a time stamp of 48 bits that grows with each frame of a sender on a link
(10 us since 2015), and the first 48 bits of SHA-256 over key, frame and the seven bytes before. The rules for the time
stamp are those of the MAVLink guide.
"""

import hashlib
import hmac
from typing import Final

from arm_companion.errors import ProtocolError
from arm_companion.protocol.mavlink_frames import SIGNATURE_LENGTH, SIGNED, Header, checksum, crc_extra

KEY_LENGTH: Final = 32
EPOCH_S: Final = 1_420_070_400
"""Unix time of 2015-01-01, at which the time stamps begin."""
UNITS_PER_S: Final = 100_000
OLDEST_S: Final = 60.0
"""A sender that is new to us may be so far behind our own time stamp."""

MOST_STREAMS: Final = 256
"""Senders whose time stamps are remembered; only holders of the key can fill this."""

_STAMP_MAX: Final = (1 << 48) - 1
_HASH_LENGTH: Final = 6


def stamp_at(unix_s: float) -> int:
    """The time stamp that belongs to a Unix time."""
    return min(max(int((unix_s - EPOCH_S) * UNITS_PER_S), 0), _STAMP_MAX)


Streams = dict[tuple[int, int, int], int]
"""Newest time stamp by system, component and the sender's link id."""


class Signing:
    """Key, time stamp and what was heard on one link.

    Args:
        key: 32 bytes, shared by all who may speak.
        link_id: number of the link in what we sign.
        stamp: time stamp to start from, as kept since the last run; 0: none.
        streams: what was heard by all who share it. Links with one key do: a frame counts once, on whichever it comes.

    Raises:
        ProtocolError: the key has another length.
    """

    def __init__(self, key: bytes, link_id: int = 0, stamp: int = 0, streams: Streams | None = None) -> None:
        if len(key) != KEY_LENGTH:
            raise ProtocolError(f"a signing key has {KEY_LENGTH} bytes, not {len(key)}")
        self.stamp = stamp
        """Newest time stamp, ours or accepted: what has to be kept over a restart."""
        self._key = key
        self._link_id = link_id & 0xFF
        self._streams: Streams = {} if streams is None else streams

    def sign(self, frame: bytes, unix_s: float) -> bytes:
        """The frame with its signature.

        Args:
            frame: a whole unsigned MAVLink 2 frame with an id that the dialect knows.
            unix_s: now.

        Raises:
            ProtocolError: its id is unknown, so that its checksum cannot be made anew.
        """
        extra = crc_extra(int.from_bytes(frame[7:10], "little"))
        if extra is None:
            raise ProtocolError("a frame with an unknown id cannot be signed")
        body = frame[:2] + bytes((frame[2] | SIGNED,)) + frame[3:-2]
        body += checksum(body, extra).to_bytes(2, "little")
        self.stamp = min(max(self.stamp + 1, stamp_at(unix_s)), _STAMP_MAX)
        body += bytes((self._link_id,)) + self.stamp.to_bytes(6, "little")
        return body + self._hash(body)

    def accept(self, frame: bytes, head: Header, unix_s: float) -> bool:
        """Whether a frame is signed by who has the key, and is newer than all before from that sender.

        Args:
            frame: a whole frame with a good checksum.
            head: its header.
            unix_s: now.
        """
        if not head.flags & SIGNED or len(frame) < SIGNATURE_LENGTH:
            return False
        signed, given = frame[:-_HASH_LENGTH], frame[-_HASH_LENGTH:]
        if not hmac.compare_digest(self._hash(signed), given):
            return False
        stamp = int.from_bytes(signed[-6:], "little")
        stream = (head.system, head.component, signed[-7])
        last = self._streams.get(stream)
        now = max(self.stamp, stamp_at(unix_s))
        if stamp <= last if last is not None else stamp + OLDEST_S * UNITS_PER_S < now:
            return False
        if last is None and len(self._streams) >= MOST_STREAMS:
            return False
        self._streams[stream] = stamp
        self.stamp = max(self.stamp, stamp)
        return True

    def _hash(self, signed: bytes) -> bytes:
        return hashlib.sha256(self._key + signed).digest()[:_HASH_LENGTH]
