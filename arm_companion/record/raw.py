"""Raw bytes for the record: an opener whose pipe tells a recorder what passes, keys excepted."""

from collections.abc import Callable
from typing import Final

from arm_companion.record.recorder import Frame, Recorder
from arm_companion.transport.base import Opener
from arm_companion.transport.trace import observed

_MAGIC: Final = 0xFD
_SETUP_SIGNING: Final = b"\x00\x01\x00"  # message id 256, little-endian; MAVLink 1 has no such id
_ID_AT: Final = 7
_HEADER: Final = 10
_REST_S: Final = 0.2


class KeyGuard:
    """Keeps SETUP_SIGNING, which carries the signing key, out of what is written down."""

    def __init__(self) -> None:
        self._tail = b""
        self._silent_until = float("-inf")

    def passes(self, t: float, data: bytes) -> bool:
        """Whether bytes may be written; with a key's header in them neither they nor what follows at once may."""
        joined = self._tail + data
        self._tail = joined[-(_HEADER - 1) :]
        at = joined.find(_SETUP_SIGNING, _ID_AT)  # rarer than the magic byte
        while at >= 0:
            if joined[at - _ID_AT] == _MAGIC:
                self._silent_until = t + _REST_S
                break
            at = joined.find(_SETUP_SIGNING, at + 1)
        return t >= self._silent_until


def tapped(opener: Opener, pipe: str, recorder: Recorder, now: Callable[[], float]) -> Opener:
    """An opener of the same pipe whose bytes the recorder is given.

    Args:
        opener: of the pipe.
        pipe: its name in the record.
        recorder: takes the bytes.
        now: loop time, s.
    """
    guards = {True: KeyGuard(), False: KeyGuard()}

    def note(data: bytes, sent: bool) -> None:
        t = now()
        if guards[sent].passes(t, data):
            recorder.frame(Frame(t, pipe, sent, bytes(data)))

    return observed(opener, note)
