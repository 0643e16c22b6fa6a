"""A plain ground station over one or more links, for the scenarios' operator and for tests.

It keeps to the rules that a careful ground station keeps: it sends nothing to a component before it has heard the
component's own heartbeat (an autopilot would take the message as its own), it believes an acknowledgement only from
the component that was asked, and it repeats a command that got no answer.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.transport.base import Opener, Transport

Address = tuple[int, int]
"""System and component id."""
AUTOPILOT: Address = (1, 1)
_HEARTBEAT_S = 1.0
_REOPEN_S = 0.5
_RESEND_S = 0.7
_LINK_FRESH_S = 3.0
_SAME_TEXT_S = 1.0


@dataclass(frozen=True, slots=True)
class Text:
    """One STATUSTEXT."""

    t: float  # loop time
    source: Address
    severity: int  # MAV_SEVERITY
    text: str


@dataclass(slots=True)
class _Pending:
    """A command that waits for its acknowledgement."""

    command: int
    target: Address
    acks: "asyncio.Queue[Any]"


class _Link:
    """One open or closed link, with its own parser and sequence numbers."""

    def __init__(self, opener: Opener, address: Address) -> None:
        self.opener = opener
        self.transport: Transport | None = None
        self.heard: dict[Address, float] = {}  # loop time of the last heartbeat
        self.codec = mav.MAVLink(None, *address)
        self.codec.robust_parsing = True

    def send(self, message: Any) -> None:
        """Encode and write; nothing happens while the link is closed."""
        frame = message.pack(self.codec)
        self.codec.seq = (self.codec.seq + 1) % 256
        if self.transport is not None:
            self.transport.write(frame)


class OperatorLink:
    """The ground station.

    Args:
        openers: its links, the preferred one first: of the links on which a component has been heard lately, the
            first carries what is sent to it.
        address: own system and component id.

    Attributes:
        texts: every STATUSTEXT received, oldest first; the same one over two links counts once.
        messages: number of messages received.
    """

    def __init__(self, openers: Sequence[Opener], address: Address = (255, 190)) -> None:
        self._address = address
        self._links = [_Link(opener, address) for opener in openers]
        self._latest: dict[tuple[int, int, str], tuple[float, Any]] = {}
        self._pending: list[_Pending] = []
        self._changed = asyncio.Event()
        self._watchers: list[Callable[[Any], None]] = []
        self.texts: list[Text] = []
        self.messages = 0

    # Running --------------------

    async def run(self) -> None:
        """Keep the links open and send heartbeats, until cancelled."""
        async with asyncio.TaskGroup() as group:
            for link in self._links:
                group.create_task(self._keep_open(link))
            group.create_task(self._beat())

    @contextlib.asynccontextmanager
    async def running(self) -> "AsyncIterator[OperatorLink]":
        """Run in the background of an `async with` block."""
        async with asyncio.TaskGroup() as group:
            task = group.create_task(self.run())
            try:
                yield self
            finally:
                task.cancel()

    async def _keep_open(self, link: _Link) -> None:
        while True:
            try:
                transport = await link.opener(partial(self._receive, link))
            except LinkError:
                await asyncio.sleep(_REOPEN_S)
                continue
            link.transport = transport
            try:
                await transport.wait_closed()
            finally:
                link.transport = None
                transport.close()
            await asyncio.sleep(_REOPEN_S)

    async def _beat(self) -> None:
        heartbeat = partial(
            mav.MAVLink_heartbeat_message, mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3
        )
        while True:
            for link in self._links:
                link.send(heartbeat())
            await asyncio.sleep(_HEARTBEAT_S)

    # What was heard --------------------

    def watch(self, watcher: Callable[[Any], None]) -> None:
        """Call `watcher` with every message that arrives from now on; a text that comes twice counts once."""
        self._watchers.append(watcher)

    def latest(self, name: str, source: Address = AUTOPILOT) -> Any | None:
        """The newest message `name` of a component, None before the first."""
        entry = self._latest.get((*source, name))
        return None if entry is None else entry[1]

    def age(self, name: str, source: Address = AUTOPILOT) -> float:
        """Seconds since the newest message `name` of a component; infinite before the first."""
        entry = self._latest.get((*source, name))
        return float("inf") if entry is None else asyncio.get_running_loop().time() - entry[0]

    async def wait_for(self, predicate: "Callable[[OperatorLink], bool]", timeout: float) -> None:  # noqa: ASYNC109
        """Return as soon as `predicate(self)` holds; it is asked after every message.

        Raises:
            TimeoutError: after `timeout` seconds.
        """
        async with asyncio.timeout(timeout):
            while not predicate(self):
                self._changed.clear()
                await self._changed.wait()

    def _receive(self, link: _Link, data: bytes) -> None:
        now = asyncio.get_running_loop().time()
        for message in link.codec.parse_buffer(data) or ():
            name = message.get_type()
            if name == "BAD_DATA" or name.startswith("UNKNOWN"):
                continue
            source = (message.get_srcSystem(), message.get_srcComponent())
            if source == self._address:
                continue
            self.messages += 1
            self._latest[*source, name] = (now, message)
            if name == "HEARTBEAT":
                link.heard[source] = now
            elif name == "STATUSTEXT":
                if not self._note(Text(now, source, message.severity, message.text)):
                    continue
            elif name == "COMMAND_ACK":
                self._acknowledge(message, source)
            elif name == "TIMESYNC" and message.tc1 == 0:
                link.send(mav.MAVLink_timesync_message(int(now * 1e9), message.ts1))
            for watcher in self._watchers:
                watcher(message)
            self._changed.set()

    def _note(self, text: Text) -> bool:
        """Keep a text; False when it has come over another link already."""
        for known in reversed(self.texts):
            if text.t - known.t > _SAME_TEXT_S:
                break
            if len(self._links) > 1 and (known.source, known.text) == (text.source, text.text):
                return False
        self.texts.append(text)
        return True

    def _acknowledge(self, message: Any, source: Address) -> None:
        if message.target_system not in (0, self._address[0]):
            return
        if message.target_component not in (0, self._address[1]):
            return
        for pending in self._pending:
            if (pending.command, pending.target) == (message.command, source):
                pending.acks.put_nowait(message)

    # What is sent --------------------

    def send(self, message: Any, target: Address = AUTOPILOT) -> None:
        """Send a message on the link that reaches `target`.

        Raises:
            LinkError: when the component has not been heard.
        """
        self._link_to(target).send(message)

    def _link_to(self, target: Address) -> _Link:
        now = asyncio.get_running_loop().time()
        heard = [link for link in self._links if target in link.heard]
        if not heard:
            raise LinkError(f"component {target[0]}/{target[1]} has not been heard")
        fresh = [link for link in heard if now - link.heard[target] < _LINK_FRESH_S]
        return (fresh or heard)[0]

    async def command(
        self,
        command: int,
        parameters: Sequence[float] = (),
        target: Address = AUTOPILOT,
        timeout: float = 10.0,  # noqa: ASYNC109 - covers the wait for the heartbeat, retries and progress
        progress: Callable[[int], None] | None = None,
    ) -> int:
        """Send a COMMAND_LONG until it is answered, and wait for its end.

        Args:
            command: MAV_CMD.
            parameters: param1 and on; the missing ones are NaN, which means 'not given'.
            target: component, whose heartbeat is waited for first.
            timeout: s for all of it; every report of progress starts it again.
            progress: gets the per cent of each IN_PROGRESS (255: unknown).

        Returns:
            The final MAV_RESULT.

        Raises:
            TimeoutError: when the component is not heard or does not answer.
        """
        numbers = [*parameters, *[float("nan")] * (7 - len(parameters))]
        pending = _Pending(command, target, asyncio.Queue())
        where = f"component {target[0]}/{target[1]}"
        try:
            await self.wait_for(lambda _: any(target in link.heard for link in self._links), timeout)
        except TimeoutError:
            raise TimeoutError(f"{where} has not been heard within {timeout:g} s") from None
        self._pending.append(pending)
        deadline = asyncio.get_running_loop().time() + timeout
        confirmation, running = 0, False
        try:
            while (left := deadline - asyncio.get_running_loop().time()) > 0.0:
                if not running:
                    self.send(mav.MAVLink_command_long_message(*target, command, confirmation, *numbers), target)
                    confirmation = min(confirmation + 1, 255)
                try:
                    async with asyncio.timeout(left if running else min(_RESEND_S, left)):
                        ack = await pending.acks.get()
                except TimeoutError:
                    continue
                if ack.result != mav.MAV_RESULT_IN_PROGRESS:
                    return int(ack.result)
                running = True
                deadline = asyncio.get_running_loop().time() + timeout
                if progress is not None:
                    progress(ack.progress)
        finally:
            self._pending.remove(pending)
        raise TimeoutError(f"{where} did not answer command {command} within {timeout:g} s")
