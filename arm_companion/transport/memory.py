"""In-memory byte pipes for simulated time: what one end writes, the other end receives on the next loop turn."""

import asyncio
from collections import deque
from collections.abc import Callable

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

Fault = Callable[[bytes], bytes]
"""Changes a chunk on its way: drops (returns b''), corrupts or passes it on."""


class MemoryTransport:
    """One end of a `MemoryPipe`."""

    def __init__(self, pipe: "MemoryPipe", side: int, receiver: Receiver) -> None:
        self._pipe = pipe
        self._side = side
        self.receiver = receiver
        self.dropped = 0
        self._arriving: deque[tuple[float, bytes]] = deque()
        self._closed = asyncio.Event()

    def write(self, data: bytes) -> None:
        """Deliver `data` to the other end after the pipe's latency."""
        if self._closed.is_set() or not data:
            return
        peer = self._pipe.ends[1 - self._side]
        if peer is None:
            self.dropped += 1
            return
        data = self._pipe.fault(data)
        if data:
            peer.arrive(data, self._pipe.latency_s)

    def arrive(self, data: bytes, latency_s: float) -> None:
        """Take `data` that will have come in `latency_s` seconds.

        Timers that are due at the same instant run in any order; the bytes keep theirs. What was written at one
        instant comes as one chunk.
        """
        loop = asyncio.get_running_loop()
        due = loop.time() + latency_s
        if not self._arriving:
            loop.call_at(due, self._deliver)
        self._arriving.append((due, data))

    def _deliver(self) -> None:
        """Hand what is due to the receiver unless this end has closed meanwhile."""
        arriving = self._arriving
        loop = asyncio.get_running_loop()
        chunk = [arriving.popleft()[1]]
        while arriving and arriving[0][0] <= loop.time():
            chunk.append(arriving.popleft()[1])
        if arriving:
            loop.call_at(arriving[0][0], self._deliver)
        if not self._closed.is_set():
            self.receiver(b"".join(chunk))

    def close(self) -> None:
        """Leave the pipe."""
        if self._pipe.ends[self._side] is self:
            self._pipe.ends[self._side] = None
        self._closed.set()

    async def wait_closed(self) -> None:
        """Return once this end is closed."""
        await self._closed.wait()


class MemoryPipe:
    """A pipe with two ends, with latency and an optional fault on what passes."""

    def __init__(self, latency_s: float = 0.0002, fault: Fault = lambda data: data) -> None:
        self.latency_s = latency_s
        self.fault = fault
        self.ends: list[MemoryTransport | None] = [None, None]

    def opener(self, side: int) -> Opener:
        """An `Opener` for end 0 or 1."""

        async def open_end(receiver: Receiver) -> MemoryTransport:
            if self.ends[side] is not None:
                raise LinkError(f"end {side} of this memory pipe is open already")
            end = MemoryTransport(self, side, receiver)
            self.ends[side] = end
            return end

        return open_end

    def cut(self) -> None:
        """Close both ends at once, as an unplugged cable does."""
        for end in list(self.ends):
            if end is not None:
                end.close()
