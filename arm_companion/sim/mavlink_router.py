"""The stand-in's ports, and what passes from one to the other: the MAVLink routing rules with their traps.

As measured on stock autopilots: private message ids never pass; a route to a component exists only after its
first heartbeat, and until then the autopilot takes what is addressed to the component as its own; PX4 drops
bursts, because its forward buffer holds few frames.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from arm_companion.protocol.dialect import mav
from arm_companion.sim.autopilot_flavours import Flavour
from arm_companion.sim.autopilot_streams import StreamTable
from arm_companion.transport.base import Transport

SYSTEM, COMPONENT = 1, 1
_FIRST_PRIVATE_ID = 50_000


@dataclass(slots=True)
class RouterCounters:
    """What the router saw, over all ports."""

    received: int = 0
    bad: int = 0  # garbage, wrong checksums and ids that are not in the dialect
    forwarded: int = 0
    private_dropped: int = 0
    burst_dropped: int = 0


class Port:
    """One link of the autopilot: its parser, sequence numbers, streams, and whom it has heard there."""

    def __init__(self, name: str, streams: StreamTable) -> None:
        self.name = name
        self.streams = streams
        self._transport: Transport | None = None
        self.routes: set[tuple[int, int]] = set()
        self.buffer_empty_at = 0.0  # loop time at which the forward buffer will have drained
        self._forwarded: deque[bytes] = deque()
        self._codec = mav.MAVLink(None, SYSTEM, COMPONENT)
        self._codec.robust_parsing = True

    def connect(self, transport: Transport) -> None:
        """The link is up."""
        self._transport = transport

    def disconnect(self) -> None:
        """The link is down: what is sent is lost."""
        self._transport = None

    def parse(self, data: bytes) -> list[Any]:
        """Messages in `data`, with `BAD_DATA` for what is none."""
        messages: list[Any] = self._codec.parse_buffer(data) or []
        return messages

    def send(self, message: Any) -> None:
        """Send one of the autopilot's own messages."""
        frame = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        self.pass_on(frame)

    def pass_on(self, frame: bytes) -> None:
        """Send a frame as it is."""
        if self._transport is not None:
            self._transport.write(frame)

    def pass_on_later(self, frame: bytes, delay_s: float) -> None:
        """Send a frame as it is in `delay_s`; frames keep their order, which timers of one instant do not."""
        self._forwarded.append(frame)
        asyncio.get_running_loop().call_later(delay_s, lambda: self.pass_on(self._forwarded.popleft()))

    def reaches(self, system: int, component: int) -> bool:
        """Whether the addressee (component 0: any of the system) has been heard here."""
        if component:
            return (system, component) in self.routes
        return any(heard == system for heard, _ in self.routes)


class Router:
    """Takes received bytes apart, hands the autopilot what is its own and forwards the rest.

    Args:
        flavour: decides delays, buffers and exceptions.
        ports: all of them.
        deliver: gets each message for the autopilot itself, with the port that it came from.
        forwarding: whether the parameters allow forwarding now.
    """

    def __init__(
        self,
        flavour: Flavour,
        ports: tuple[Port, ...],
        deliver: Callable[[Any, Port], None],
        forwarding: Callable[[], bool],
    ) -> None:
        self.counters = RouterCounters()
        self._flavour = flavour
        self._ports = ports
        self._deliver = deliver
        self._forwarding = forwarding

    def receive(self, port: Port, data: bytes) -> None:
        """Bytes came in on `port`."""
        for message in port.parse(data):
            if message.get_type() == "BAD_DATA" or message.get_msgId() not in mav.mavlink_map:
                self.counters.bad += 1
            else:
                self.counters.received += 1
                self._route(message, port)

    def _route(self, message: Any, port: Port) -> None:
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (SYSTEM, COMPONENT):
            return  # an echo of our own
        if message.get_msgId() >= _FIRST_PRIVATE_ID:
            self.counters.private_dropped += 1
            return
        if message.get_msgId() == mav.MAVLINK_MSG_ID_HEARTBEAT:
            port.routes.add(source)
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        if system == 0:
            self._deliver(message, port)
            self._forward(message, [other for other in self._ports if other is not port])
        elif system == SYSTEM and component == COMPONENT:
            self._deliver(message, port)
        else:
            known = [other for other in self._ports if other.reaches(system, component)]
            # An unknown component of our own system: the autopilot answers in its place.
            if system == SYSTEM and (component == 0 or not known):
                self._deliver(message, port)
            self._forward(message, [other for other in known if other is not port])

    def _forward(self, message: Any, ports: list[Port]) -> None:
        if message.get_msgId() in self._flavour.not_forwarded or not self._forwarding():
            return
        loop = asyncio.get_running_loop()
        frame = bytes(message.get_msgbuf())
        for port in ports:
            delay = self._flavour.forward_delay_s
            if self._flavour.burst is not None:
                places, service_s = self._flavour.burst
                waiting = max(port.buffer_empty_at - loop.time(), 0.0)
                if waiting > (places - 1) * service_s + 1e-9:
                    self.counters.burst_dropped += 1
                    continue
                port.buffer_empty_at = loop.time() + waiting + service_s
                delay += waiting
            self.counters.forwarded += 1
            port.pass_on_later(frame, delay)
