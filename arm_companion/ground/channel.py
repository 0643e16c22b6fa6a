"""What is heard of one component, and the way back to it: directly, or through an autopilot that knows only TUNNEL.

The rules of a careful ground station are kept here: nothing is sent to the component before its own heartbeat has been
heard, because until then an autopilot takes what is addressed to the component as its own.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any, Final, TypeAlias

from arm_companion.errors import LinkError
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import tunnel, unwrap

Address: TypeAlias = tuple[int, int]
"""System and component id."""

Watcher: TypeAlias = Callable[[Message], None]

SILENT_S: Final = 5.0
"""Without a heartbeat for this long the component counts as gone: it beats once a second."""

_FIRST_PRIVATE: Final = 50_000
_DIRECT_S: Final = 3.0
_LEARN_S: Final = 1.5
"""How long after its first heartbeat the component's telemetry is given to show by which way it comes."""
_AUTOPILOT: Final = 1


class ArmSilent(LinkError):
    """The arm's component is not heard, or does not answer."""


class Channel:
    """One component of a vehicle.

    Args:
        send: sends a message to its `target_system`.
        address: our own system and component id.
        component: component id of the arm.
        system: its system id, 0: that of the first one heard with this component.
    """

    def __init__(
        self, send: Callable[[Message], Awaitable[None]], address: Address, component: int = 192, system: int = 0
    ) -> None:
        self.address = address
        self.component = component
        self.system = system
        self.counters: dict[str, int] = {}
        """Messages heard from the component, by name."""
        self._send = send
        self._codec = MavlinkCodec(*address)
        self._watchers: list[Watcher] = []
        self._beat_at = float("-inf")
        self._first_beat_at = float("inf")
        self._direct_at = float("-inf")
        self.behind_autopilot = False
        """Whether an autopilot's heartbeat comes over this connection."""
        self._tunnelled = False
        self._changed = asyncio.Event()

    # What is heard --------------------

    @property
    def heard(self) -> bool:
        """Whether the component's heartbeat has been heard at all."""
        return self._beat_at > float("-inf")

    @property
    def silence(self) -> float:
        """Seconds since its last heartbeat, infinite before the first."""
        return asyncio.get_running_loop().time() - self._beat_at

    @property
    def tunnelled(self) -> bool:
        """Whether our private messages come, and so have to go, inside TUNNEL."""
        now = asyncio.get_running_loop().time()
        return now - self._direct_at > _DIRECT_S and (self._tunnelled or self.behind_autopilot)

    def watch(self, watcher: Watcher) -> Callable[[], None]:
        """Call `watcher` with every message of the component; returns what ends that."""
        self._watchers.append(watcher)

        def end() -> None:
            if watcher in self._watchers:
                self._watchers.remove(watcher)

        return end

    def receive(self, message: Message) -> None:
        """Take a message of anybody; those of the component that are for us or for all reach the watchers."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        name = message.get_type()
        if name == "HEARTBEAT" and component == _AUTOPILOT and self.system in (0, system):
            self.behind_autopilot = True
        if component != self.component or self.system not in (0, system):
            return
        if name == "HEARTBEAT":
            self.system = system
            self._beat_at = asyncio.get_running_loop().time()
            self._first_beat_at = min(self._first_beat_at, self._beat_at)
        if not self.system or not self._for_us(message):
            return
        if name == "TUNNEL":
            for inner in self._inner(message):
                self._tunnelled = True
                self._pass_on(inner)
        else:
            if message.get_msgId() >= _FIRST_PRIVATE:
                self._direct_at = asyncio.get_running_loop().time()
            self._pass_on(message)

    def _for_us(self, message: Message) -> bool:
        ours = (0, self.address[0]), (0, self.address[1])
        return getattr(message, "target_system", 0) in ours[0] and getattr(message, "target_component", 0) in ours[1]

    def _inner(self, message: Message) -> list[Message]:
        """Our message in a TUNNEL, if there is one and the component itself sent it."""
        frame = unwrap(message.payload_type, bytes(message.payload[: message.payload_length]))
        if frame is None:
            return []
        self._codec.reset()  # what a damaged frame left over is no beginning of this one
        return [
            inner
            for inner in self._codec.feed(frame)
            if (inner.get_srcSystem(), inner.get_srcComponent()) == (self.system, self.component)
        ]

    def _pass_on(self, message: Message) -> None:
        name = message.get_type()
        self.counters[name] = self.counters.get(name, 0) + 1
        for watcher in list(self._watchers):
            watcher(message)
        self._changed.set()

    # Waiting --------------------

    async def wait_heard(self, timeout: float) -> None:  # noqa: ASYNC109 - the message names the seconds
        """Wait for the component's first heartbeat.

        Raises:
            ArmSilent: none within `timeout` seconds.
        """
        await self.wait_for(
            lambda: self.heard,
            timeout,
            f"no heartbeat of component {self.component}"
            f"{f' of system {self.system}' if self.system else ''} within {timeout:g} s",
        )

    async def wait_for(self, holds: Callable[[], bool], timeout: float, otherwise: str) -> None:  # noqa: ASYNC109
        """Return as soon as `holds()`; it is asked after every message of the component.

        Raises:
            ArmSilent: with `otherwise`, after `timeout` seconds.
        """
        try:
            async with asyncio.timeout(timeout):
                while not holds():
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            raise ArmSilent(otherwise) from None

    # The way back --------------------

    async def send(self, message_of: Callable[..., Message], *arguments: Any) -> None:
        """Send a message with an address to the component; private ones in TUNNEL where they would not pass.

        Args:
            message_of: class of the dialect whose first arguments are target_system and target_component.
            arguments: the rest of its fields.

        Raises:
            ArmSilent: the component has not been heard: an autopilot might take the message as its own.
            LinkError: it cannot be sent.
            ProtocolError: a field does not fit.
        """
        if not self.heard:
            raise ArmSilent(f"component {self.component} has not been heard, so nothing is sent to it")
        message = message_of(self.system, self.component, *arguments)
        if message.id >= _FIRST_PRIVATE:
            await self._learn_the_way()
        if message.id >= _FIRST_PRIVATE and self.tunnelled:
            message = tunnel(self._codec.encode(message), self.system, self.component)
        await self._send(message)

    async def _learn_the_way(self) -> None:
        """Wait for telemetry, if the component has just been found: a private message on the wrong way gets lost."""
        left = self._first_beat_at + _LEARN_S - asyncio.get_running_loop().time()
        if left > 0.0:
            with contextlib.suppress(ArmSilent):
                await self.wait_for(lambda: self._tunnelled or self._direct_at > float("-inf"), left, "")
