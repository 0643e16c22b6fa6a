"""Raw bytes for the record: openers whose pipes tell a recorder what passes, keys excepted."""

from typing import Final

from arm_companion.record.recorder import Frame, Recorder
from arm_companion.transport.base import Opener
from arm_companion.transport.trace import observed

_MAGIC: Final = 0xFD
_SETUP_SIGNING: Final = b"\x00\x01\x00"  # message id 256, little-endian; MAVLink 1 has no such id
_ID_AT: Final = 7
_HEADER: Final = 10
_REST_S: Final = 0.2
_JOIN_S: Final = 0.05


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


class Taps:
    """Hands the bytes of pipes to a recorder now and then: what happens for every chunk has to cost next to nothing.

    Args:
        recorder: takes the bytes.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._waiting: list[tuple[str, bool, list[bytes], KeyGuard]] = []
        self._next = float("-inf")

    def tapped(self, opener: Opener, pipe: str) -> Opener:
        """An opener of the same pipe whose bytes go to the recorder, as bytes of the pipe of this name."""
        if not self._recorder.raw:
            return opener
        received: list[bytes] = []
        sent: list[bytes] = []
        self._waiting += [(pipe, False, received, KeyGuard()), (pipe, True, sent, KeyGuard())]

        def note(data: bytes, outward: bool) -> None:
            (sent if outward else received).append(bytes(data))

        return observed(opener, note)

    def hand_over(self, t: float) -> None:
        """Everything since the last time, as of loop time `t`, s, if that is long enough ago."""
        if t < self._next:
            return
        self._next = t + _JOIN_S
        for pipe, sent, chunks, guard in self._waiting:
            if chunks:
                data = b"".join(chunks)
                chunks.clear()
                if guard.passes(t, data):
                    self._recorder.frame(Frame(t, pipe, sent, data))
