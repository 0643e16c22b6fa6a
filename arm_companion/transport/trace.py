"""A record of everything that passed over a byte pipe, with times, and a pipe that plays such a record.

The file is text, one chunk a line: seconds since the record began, `>` for what was sent or `<` for what came,
and the bytes in hexadecimal. Lines that begin with `#` are remarks.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple, TextIO, TypeAlias

from arm_companion.errors import ProtocolError
from arm_companion.transport.base import Opener, Receiver, Transport

FIRST_LINE = "# bus trace 1: seconds, > sent or < received, bytes"


class Chunk(NamedTuple):
    """Bytes that passed at once."""

    t: float  # s since the record began
    sent: bool
    data: bytes


Note: TypeAlias = Callable[[bytes, bool], None]
"""Told of every chunk, and whether it was sent."""


class _Observed:
    """A transport that tells what passes."""

    def __init__(self, inner: Transport, note: Note) -> None:
        self._inner = inner
        self._note = note

    @property
    def dropped(self) -> int:
        """Chunks that were not sent because the peer did not take them."""
        return self._inner.dropped

    def write(self, data: bytes) -> None:
        """Send and tell."""
        self._note(data, True)
        self._inner.write(data)

    def close(self) -> None:
        """Release what is below."""
        self._inner.close()

    async def wait_closed(self) -> None:
        """Return when what is below is gone."""
        await self._inner.wait_closed()


class _Notes:
    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._began: float | None = None
        stream.write(FIRST_LINE + "\n")

    def add(self, data: bytes, sent: bool) -> None:
        now = asyncio.get_running_loop().time()
        if self._began is None:
            self._began = now
        self._stream.write(f"{now - self._began:.6f} {'>' if sent else '<'} {data.hex()}\n")


def recorded(opener: Opener, stream: TextIO) -> Opener:
    """An `Opener` of the same pipe that writes all that passes to `stream`, also over several openings."""
    return observed(opener, _Notes(stream).add)


def observed(opener: Opener, note: Note) -> Opener:
    """An `Opener` of the same pipe that tells `note` of all that passes."""

    async def open_observed(receiver: Receiver) -> Transport:
        def receive(data: bytes) -> None:
            note(data, False)
            receiver(data)

        return _Observed(await opener(receive), note)

    return open_observed


def read_trace(lines: Iterable[str]) -> list[Chunk]:
    """The chunks of a record.

    Raises:
        ProtocolError: naming the line that is none.
    """
    chunks: list[Chunk] = []
    for number, line in enumerate(lines, 1):
        if line.startswith("#") or not line.strip():
            continue
        try:
            t, direction, data = line.split()
            chunk = Chunk(float(t), {">": True, "<": False}[direction], bytes.fromhex(data))
        except (ValueError, KeyError):
            raise ProtocolError(f"line {number} is no chunk of a bus trace: {line.strip()[:60]!r}") from None
        if chunks and chunk.t < chunks[-1].t:
            raise ProtocolError(f"line {number} of the bus trace is older than the one before it")
        chunks.append(chunk)
    return chunks


class ReplayedPipe:
    """The far end of a pipe as a record has it: what was sent then is answered as it was then.

    A request takes the answers, with their delays, that the same bytes had when they were sent the first time,
    then the second time, and so on. So a replay stays in step though timers fall a little otherwise than then.

    Attributes:
        unmatched: chunks sent now that the record does not have, or not so often; nothing answers them.
        dropped: none are.
    """

    def __init__(self, chunks: Iterable[Chunk], receiver: Receiver) -> None:
        self.unmatched = 0
        self.dropped = 0
        self._receiver = receiver
        self._exchanges: dict[bytes, deque[list[tuple[float, bytes]]]] = {}
        sent_at = 0.0
        answers: list[tuple[float, bytes]] = []
        for chunk in chunks:
            if chunk.sent:
                sent_at, answers = chunk.t, []
                self._exchanges.setdefault(chunk.data, deque()).append(answers)
            else:
                answers.append((chunk.t - sent_at, chunk.data))
        self._gone = asyncio.Event()

    def write(self, data: bytes) -> None:
        """Let the answers come that `data` had then."""
        times = self._exchanges.get(data)
        if not times:
            self.unmatched += 1
            return
        for delay, answer in times.popleft():
            asyncio.get_running_loop().call_later(delay, self._deliver, answer)

    @property
    def left(self) -> int:
        """How many of the chunks that were sent then have not been sent yet."""
        return sum(len(times) for times in self._exchanges.values())

    def close(self) -> None:
        """Hang up."""
        self._gone.set()

    async def wait_closed(self) -> None:
        """Return once it is closed."""
        await self._gone.wait()

    def _deliver(self, data: bytes) -> None:
        if not self._gone.is_set():
            self._receiver(data)


def replayed(chunks: Iterable[Chunk]) -> Opener:
    """An `Opener` of a `ReplayedPipe`."""

    async def open_replay(receiver: Receiver) -> ReplayedPipe:
        return ReplayedPipe(chunks, receiver)

    return open_replay
