"""One MAVLink connection: keeps it open, hands messages on, and paces what goes out.

A PX4 autopilot drops frames that come in bursts: of 100 back to back 5 arrive, of 100 sent 5 ms apart all do. So
everything but set-points waits its turn there, and where too much waits the oldest is dropped.
"""

import asyncio
import enum
import logging
import random
from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Final

from arm_companion.config.schema import VehicleConfig
from arm_companion.drivers.streams import Streams
from arm_companion.errors import LinkError, ProtocolError
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.transport.base import Opener, Transport

log = logging.getLogger(__name__)

PX4_PACE_S: Final = 0.005
"""Least time between frames to PX4, measured."""

SILENCE_S: Final = 0.05
"""Half a frame that gets no more bytes for this long is noise: the bytes of one frame never pause so."""

UNKNOWN_SYSTEM: Final = 1
"""Our system id until the autopilot's is known; the factory setting of both flight stacks."""

_FIRST_DELAY_S: Final = 0.2
_LONGEST_DELAY_S: Final = 5.0
_QUEUE_LENGTHS: Final = {1: 64, 2: 32}


class Priority(enum.IntEnum):
    """How urgent a message is on a paced link."""

    NOW = 0  # set-points: never wait
    NORMAL = 1  # heartbeats, answers, notices
    BULK = 2  # telemetry


MessageHandler = Callable[[Message, "MavlinkLink"], None]
OpenHandler = Callable[["MavlinkLink"], None]


@dataclass(slots=True)
class LinkCounters:
    """What happened to a link since its start."""

    opened: int = 0
    failed: int = 0  # times that it could not be opened
    unsent: int = 0  # messages for a link that was not open, or not yet identified
    crowded_out: int = 0  # messages dropped from a full queue
    handler_errors: int = 0


class MavlinkLink:
    """A MAVLink connection that is opened again whenever it is lost.

    Args:
        name: its name in the configuration, for logs.
        role: who is at the other end: "autopilot" or "ground".
        opener: opens its transport.
        vehicle: our ids, and the flight stack, which decides the pacing.
        jitter: numbers from 0 to 1 that spread the attempts to reconnect. By default a sequence of the
            link's own, the same in each run.
    """

    def __init__(
        self,
        name: str,
        role: str,
        opener: Opener,
        vehicle: VehicleConfig,
        *,
        jitter: Callable[[], float] | None = None,
    ) -> None:
        self.name = name
        self.role = role
        self.counters = LinkCounters()
        self.streams = Streams()
        """What is sent on this link periodically."""
        self._opener = opener
        self._codec = MavlinkCodec(vehicle.system_id or UNKNOWN_SYSTEM, vehicle.component_id, wanted=())
        self._identified = role != "autopilot" or vehicle.system_id != 0
        self._pace_s = PX4_PACE_S if role == "autopilot" and vehicle.autopilot == "px4" else 0.0
        self._jitter = jitter or random.Random(name).random  # noqa: S311 - spreads retries, guards nothing
        self._handlers: dict[int | None, list[MessageHandler]] = {}
        self._open_handlers: list[OpenHandler] = []
        self._transport: Transport | None = None
        self._queues: dict[int, deque[Message]] = {p: deque() for p in _QUEUE_LENGTHS}
        self._last_write = float("-inf")
        self._drain_timer: asyncio.TimerHandle | None = None
        self._silence_timer: asyncio.TimerHandle | None = None
        self._heard = False

    @property
    def codec(self) -> MavlinkCodec:
        """The codec, with its ids and counters."""
        return self._codec

    @property
    def system_id(self) -> int:
        """Our system id on this link; an autopilot is sent nothing before it has been set or configured."""
        return self._codec.system_id

    @system_id.setter
    def system_id(self, value: int) -> None:
        self._codec.system_id = value
        self._identified = True

    @property
    def component_id(self) -> int:
        """Our component id on this link."""
        return self._codec.component_id

    @property
    def connected(self) -> bool:
        """Whether the transport is open (not: whether anybody listens)."""
        return self._transport is not None

    def subscribe(self, handler: MessageHandler, ids: Collection[int] | None = None) -> None:
        """Call `handler(message, link)` for each message with one of `ids`; None is every known message."""
        for id_ in (None,) if ids is None else ids:
            self._handlers.setdefault(id_, []).append(handler)
        wanted = self._codec.wanted
        self._codec.wanted = None if ids is None or wanted is None else wanted | frozenset(ids)

    def subscribe_open(self, handler: OpenHandler) -> None:
        """Call `handler(link)` each time that the transport has been opened."""
        self._open_handlers.append(handler)

    def send(self, message: Message, priority: Priority = Priority.NORMAL) -> None:
        """Send a message, at once or in its turn; on a link that is not ready it is counted and forgotten.

        Raises:
            ProtocolError: a field does not fit its type (only where it is sent at once; else it is logged).
        """
        if self._transport is None or not self._identified:
            self.counters.unsent += 1
        elif priority is Priority.NOW or not self._pace_s:
            self._write(message)
        else:
            queue = self._queues[priority]
            if len(queue) >= _QUEUE_LENGTHS[priority]:
                queue.popleft()
                self.counters.crowded_out += 1
            queue.append(message)
            if self._drain_timer is None:
                self._drain()

    async def run(self) -> None:
        """Open the link, and open it again whenever it is lost, until cancelled."""
        loop = asyncio.get_running_loop()
        delay = _FIRST_DELAY_S
        complaint = ""
        while True:
            self._heard = False
            self._codec.reset()
            try:
                self._transport = transport = await self._opener(self._receive)
            except LinkError as error:
                self.counters.failed += 1
                log.log(
                    logging.DEBUG if str(error) == complaint else logging.WARNING,
                    "link %s: %s",
                    self.name,
                    error,
                )
                complaint = str(error)
            else:
                log.info("link %s: open", self.name)
                self.counters.opened += 1
                complaint = ""
                start = loop.time()
                try:
                    self._notify_open()
                    await transport.wait_closed()
                finally:
                    self.close()
                log.warning("link %s: lost", self.name)
                if self._heard or loop.time() - start > _LONGEST_DELAY_S:
                    delay = _FIRST_DELAY_S
            await asyncio.sleep(delay * (0.5 + 0.5 * self._jitter()))
            delay = min(2.0 * delay, _LONGEST_DELAY_S)

    def close(self) -> None:
        """Release the transport and forget what waits to be sent."""
        for timer in (self._drain_timer, self._silence_timer):
            if timer is not None:
                timer.cancel()
        self._drain_timer = self._silence_timer = None
        for queue in self._queues.values():
            queue.clear()
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _notify_open(self) -> None:
        for handler in self._open_handlers:
            try:
                handler(self)
            except Exception:
                self.counters.handler_errors += 1
                log.exception("link %s: handler failed", self.name)

    def _receive(self, data: bytes) -> None:
        self._heard = True
        if self._silence_timer is not None:
            self._silence_timer.cancel()
            self._silence_timer = None
        self._dispatch(self._codec.feed(data))
        if self._codec.pending:
            self._silence_timer = asyncio.get_running_loop().call_later(SILENCE_S, self._flush)

    def _flush(self) -> None:
        self._silence_timer = None
        self._dispatch(self._codec.flush())

    def _dispatch(self, messages: Iterable[Message]) -> None:
        for message in messages:
            for handler in (*self._handlers.get(message.get_msgId(), ()), *self._handlers.get(None, ())):
                try:
                    handler(message, self)
                except Exception:  # one reader's bug must not silence the others
                    self.counters.handler_errors += 1
                    log.exception("link %s: handler of %s failed", self.name, message.get_type())

    def _write(self, message: Message) -> None:
        data = self._codec.encode(message)
        self._last_write = asyncio.get_running_loop().time()
        if self._transport is not None:
            self._transport.write(data)

    def _drain(self) -> None:
        """Send the most urgent message that waits, if the last frame is old enough, and come again."""
        self._drain_timer = None
        queue = next((q for q in self._queues.values() if q), None)
        if queue is None:
            return
        loop = asyncio.get_running_loop()
        wait = self._last_write + self._pace_s - loop.time()
        if wait <= 0.0:
            try:
                self._write(queue.popleft())
            except ProtocolError:
                log.exception("link %s: message dropped", self.name)
            wait = self._pace_s
        self._drain_timer = loop.call_later(wait, self._drain)
