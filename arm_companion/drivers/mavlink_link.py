"""One MAVLink connection: keeps it open, hands messages on, and paces what goes out.

A PX4 autopilot drops frames that come in bursts: of 100 back to back 5 arrive, of 100 sent 5 ms apart all do. So
everything but set-points waits its turn there, and where too much waits the oldest is dropped. Set-points are for
the autopilot itself and do not pass through the buffer that overflows.

Where set-points alone are more than the line takes, a quarter of it stays for everything else (heartbeats, answers),
and a set-point that the line would carry too late is left out: the next is newer.

No autopilot forwards our private messages. Where they have to pass one they travel inside TUNNEL, and what comes
that way is read as if it had come directly.
"""

import asyncio
import enum
import logging
import random
from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Final

from arm_companion.config.schema import LinkConfig, VehicleConfig
from arm_companion.drivers.streams import Streams
from arm_companion.errors import LinkError, ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message, Tap
from arm_companion.protocol.mavlink_frames import SIGNED, Header
from arm_companion.protocol.signing import Signing
from arm_companion.protocol.tunnel import tunnel, unwrap
from arm_companion.transport.base import Opener, Transport

log = logging.getLogger(__name__)

PX4_PACE_S: Final = 0.005
"""Least time between frames to PX4, measured."""

SILENCE_S: Final = 0.05
"""Half a frame that gets no more bytes for this long is noise: a frame comes in one datagram, or in a few at once."""

SILENCES_S: Final = {"serial": 0.3, "tcp": 1.0, "tcpin": 1.0}
"""The same by the kind of link: a telemetry radio that takes turns with the other end cuts frames where its turn ends,
and TCP brings every byte, but sends a lost segment again only after some time."""

MOST_WAIT_S: Final = 0.05
"""A queue waits no longer for set-points, and they no longer (and for one long frame) for the line."""

UNKNOWN_SYSTEM: Final = 1
"""Our system id until the autopilot's is known; the factory setting of both flight stacks."""

OURS: Final = range(64_000, 64_100)
"""Ids of our own messages: the ones that TUNNEL is for."""

_TUNNEL: Final = mav.MAVLINK_MSG_ID_TUNNEL
_BITS_PER_BYTE: Final = 10  # on a serial line, with start and stop bit
_LONGEST_FRAME: Final = 280  # bytes, with signature
_QUEUES_SHARE: Final = 0.25  # of the line that set-points leave to everything else

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
    crowded_out: int = 0  # messages dropped from a full queue, or left out as too late
    late: int = 0  # urgent ones among them, left out because the line was behind
    handler_errors: int = 0
    received_bytes: int = 0
    sent_bytes: int = 0
    tunnelled: int = 0  # frames of ours that came inside TUNNEL
    bad_tunnels: int = 0  # TUNNELs of our type whose content is not what it should be
    forwarded: int = 0  # frames of others that left here


class MavlinkLink:
    """A MAVLink connection that is opened again whenever it is lost.

    Args:
        name: its name in the configuration, for logs.
        role: who is at the other end: "autopilot", "ground" or "peer".
        opener: opens its transport.
        vehicle: our ids, and the flight stack, which decides the pacing.
        config: its section of the configuration; without one the defaults of the role.
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
        config: LinkConfig | None = None,
        jitter: Callable[[], float] | None = None,
    ) -> None:
        self.name = name
        self.role = role
        self.config = LinkConfig("", role) if config is None else config
        self.counters = LinkCounters()
        self.streams = Streams()
        """What is sent on this link periodically."""
        self._opener = opener
        system = vehicle.system_id or UNKNOWN_SYSTEM
        self._codec = MavlinkCodec(system, vehicle.component_id, wanted=(_TUNNEL,))
        # What is inside of TUNNEL has sequence numbers of its own, so that losses can be told on both levels.
        self._inner = MavlinkCodec(system, vehicle.component_id, wanted=())
        self._identified = role != "autopilot" or vehicle.system_id != 0
        to_px4 = role == "autopilot" and vehicle.autopilot == "px4"
        self._pace_s = self.config.pace_s or (PX4_PACE_S if to_px4 else 0.0)
        self._silence_s = SILENCES_S.get(self.config.url.partition(":")[0], SILENCE_S)
        self._bandwidth = _bandwidth(self.config)
        self.tunnels = _decide(self.config.tunnel, auto=role == "autopilot")
        """Whether our own messages leave inside TUNNEL."""
        self.mirrors = _decide(self.config.mirrors, auto=role == "autopilot")
        """Whether the essentials leave as messages that everybody knows, too."""
        self._signing: Signing | None = None
        self._jitter = jitter or random.Random(name).random  # noqa: S311 - spreads retries, guards nothing
        self._handlers: dict[int | None, list[MessageHandler]] = {}
        self._open_handlers: list[OpenHandler] = []
        self._transport: Transport | None = None
        self._queues: dict[int, deque[Message | bytes]] = {p: deque() for p in _QUEUE_LENGTHS}
        self._ready_at = float("-inf")  # loop time at which the line has carried all that was sent
        self._turn_at = float("-inf")  # loop time from which a frame of a queue may leave even if it has not
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
        self._codec.system_id = self._inner.system_id = value
        self._identified = True

    @property
    def component_id(self) -> int:
        """Our component id on this link."""
        return self._codec.component_id

    @property
    def connected(self) -> bool:
        """Whether the transport is open (not: whether anybody listens)."""
        return self._transport is not None

    @property
    def bandwidth(self) -> float:
        """Bytes per second that the link takes; 0: as many as come."""
        return self._bandwidth

    @property
    def waiting(self) -> int:
        """Messages that wait for their turn."""
        return sum(map(len, self._queues.values()))

    @property
    def dropped(self) -> int:
        """Chunks that the open transport could not get rid of."""
        return 0 if self._transport is None else self._transport.dropped

    # --- who may speak here ---

    def secure(self, signing: Signing, unix: Callable[[], float]) -> None:
        """Sign what leaves, and let in what is signed; the configuration says what becomes of the rest.

        Args:
            signing: key and time stamps.
            unix: Unix time now, s.
        """
        self._signing = signing

        def let_in(frame: bytes, head: Header) -> bool:
            if head.flags & SIGNED:
                return signing.accept(frame, head, unix())
            # a telemetry radio reports itself and has no key
            return self.config.unsigned != "refuse" or head.id == mav.MAVLINK_MSG_ID_RADIO_STATUS

        self._codec.guard = let_in
        self._codec.seal = lambda frame: signing.sign(frame, unix())

    @property
    def signing(self) -> Signing | None:
        """Key and time stamps; None where nothing is signed."""
        return self._signing

    def trusts(self, *, signed: bool) -> bool:
        """Whether the sender of a frame that was let in may ask for something: it is signed, or need not be."""
        return self._signing is None or self.config.unsigned == "accept" or signed

    # --- in and out ---

    def listen_in(self, tap: Tap) -> None:
        """Give every good frame that comes in to `tap`, whoever it is for."""
        self._codec.tap = tap

    def subscribe(self, handler: MessageHandler, ids: Collection[int] | None = None) -> None:
        """Call `handler(message, link)` for each message with one of `ids`; None is every known message."""
        for id_ in (None,) if ids is None else ids:
            self._handlers.setdefault(id_, []).append(handler)
        wanted = self._codec.wanted
        self._codec.wanted = None if ids is None or wanted is None else wanted | frozenset(ids)
        self._inner.wanted = frozenset(OURS) if self._codec.wanted is None else self._codec.wanted & frozenset(OURS)

    def subscribe_open(self, handler: OpenHandler) -> None:
        """Call `handler(link)` each time that the transport has been opened."""
        self._open_handlers.append(handler)

    def send(self, message: Message, priority: Priority = Priority.NORMAL) -> None:
        """Send a message, at once or in its turn; on a link that is not ready it is counted and forgotten.

        Raises:
            ProtocolError: a field does not fit its type (only where it is sent at once; else it is logged).
        """
        self._submit(message, priority)

    def pass_on(self, frame: bytes) -> None:
        """Send somebody else's frame as it is, when nothing of ours waits."""
        self.counters.forwarded += 1
        self._submit(frame, Priority.BULK)

    def _submit(self, item: Message | bytes, priority: Priority) -> None:
        if self._transport is None or not self._identified:
            self.counters.unsent += 1
        elif priority is Priority.NOW and self._is_behind():
            self.counters.late += 1
            self.counters.crowded_out += 1
        elif priority is Priority.NOW or not (self._pace_s or self._bandwidth):
            self._write(item)
        else:
            queue = self._queues[priority]
            if len(queue) >= _QUEUE_LENGTHS[priority]:
                queue.popleft()
                self.counters.crowded_out += 1
            queue.append(item)
            if self._drain_timer is None:
                self._turn_at = max(self._turn_at, asyncio.get_running_loop().time() + MOST_WAIT_S)
                self._drain()

    def _is_behind(self) -> bool:
        """Whether the line will be busy for longer than an urgent message may wait, and than a long frame takes."""
        busy_s = self._ready_at - asyncio.get_running_loop().time()
        return self._bandwidth > 0.0 and busy_s > MOST_WAIT_S + _LONGEST_FRAME / self._bandwidth

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
        self._ready_at = self._turn_at = float("-inf")
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
        self.counters.received_bytes += len(data)
        if self._silence_timer is not None:
            self._silence_timer.cancel()
            self._silence_timer = None
        self._dispatch(self._codec.feed(data))
        if self._codec.pending:
            self._silence_timer = asyncio.get_running_loop().call_later(self._silence_s, self._flush)

    def _flush(self) -> None:
        self._silence_timer = None
        self._dispatch(self._codec.flush())

    def _dispatch(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self._hand_out(message)
            if message.get_msgId() == _TUNNEL:
                self._take_out(message)

    def _hand_out(self, message: Message) -> None:
        for handler in (*self._handlers.get(message.get_msgId(), ()), *self._handlers.get(None, ())):
            try:
                handler(message, self)
            except Exception:  # one reader's bug must not silence the others
                self.counters.handler_errors += 1
                log.exception("link %s: handler of %s failed", self.name, message.get_type())

    def _take_out(self, carrier: Message) -> None:
        """Hand out what a TUNNEL for us carries. Its sender must be the carrier's: nobody speaks for another."""
        if carrier.target_system not in (0, self.system_id) or carrier.target_component not in (0, self.component_id):
            return
        frame = unwrap(carrier.payload_type, bytes(carrier.payload[: carrier.payload_length]))
        if frame is None:
            return
        self._inner.reset()
        for message in self._inner.feed(frame):
            if (message.get_srcSystem(), message.get_srcComponent()) == (
                carrier.get_srcSystem(),
                carrier.get_srcComponent(),
            ):
                message._signed = carrier.get_signed()  # noqa: SLF001 - the carrier's signature covers what it carries
                self.counters.tunnelled += 1
                self._hand_out(message)
            else:
                self.counters.bad_tunnels += 1
        self.counters.bad_tunnels += self._inner.pending

    def _encode(self, message: Message) -> bytes:
        if self.tunnels and message.get_msgId() in OURS:
            message = tunnel(self._inner.encode(message), 0, 0)
        return self._codec.encode(message)

    def _write(self, item: Message | bytes) -> int:
        """Send it now; how many bytes it has."""
        data = item if isinstance(item, bytes) else self._encode(item)
        self.counters.sent_bytes += len(data)
        if self._bandwidth:
            now = asyncio.get_running_loop().time()
            self._ready_at = max(self._ready_at, now) + len(data) / self._bandwidth
        if self._transport is not None:
            self._transport.write(data)
        return len(data)

    def _drain(self) -> None:
        """Send the most urgent message that waits, if the line is free or it is its turn, and come again."""
        self._drain_timer = None
        queue = next((q for q in self._queues.values() if q), None)
        if queue is None:
            return
        loop = asyncio.get_running_loop()
        if loop.time() >= min(self._ready_at, self._turn_at):
            size = 0
            try:
                size = self._write(queue.popleft())
            except ProtocolError:
                log.exception("link %s: message dropped", self.name)
            share_s = size / (_QUEUES_SHARE * self._bandwidth) if self._bandwidth else 0.0
            self._ready_at = max(self._ready_at, loop.time() + self._pace_s)
            self._turn_at = loop.time() + max(self._pace_s, share_s)
        self._drain_timer = loop.call_at(min(self._ready_at, self._turn_at), self._drain)


def _decide(choice: str, *, auto: bool) -> bool:
    return auto if choice == "auto" else choice == "on"


def _bandwidth(config: LinkConfig) -> float:
    """Bytes per second that the link takes; 0: as many as come."""
    if config.bandwidth_bytes_per_s or not config.url.startswith("serial:"):
        return config.bandwidth_bytes_per_s
    return int(config.url.rpartition(":")[2]) / _BITS_PER_BYTE
