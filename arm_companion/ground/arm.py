"""The arm as a ground station sees it: one object that listens, and orders with retries and plain errors."""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import AsyncIterator
from typing import Any, Final, TypeVar, overload

from arm_companion.ground.channel import SILENT_S, Address, ArmSilent, Channel
from arm_companion.ground.commands import Commander, Progress
from arm_companion.ground.parameters import ParameterClient
from arm_companion.ground.reports import REPORTS, Kind, Payload, Report, Status, Tendons, Vector, Wrench
from arm_companion.ground.texts import Sentences, Text
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

DEFAULT_URL: Final = "udpin://127.0.0.1:14560"
"""Where `arm-companion sim world` sends the arm's messages."""
OUR_ADDRESS: Final[Address] = (245, 190)
"""MAVSDK's usual ids of a ground station."""

_KEPT: Final = 200
_GOALS: Final = {
    mav.MAV_CMD_ARM_READY: ("READY",),
    mav.MAV_CMD_ARM_STOW: ("STOWED",),
    mav.MAV_CMD_ARM_PERCH: ("PERCHED", "HANGING"),
    mav.MAV_CMD_ARM_GRASP: ("CARRY",),
    mav.MAV_CMD_ARM_RELEASE: ("STOWED",),
    mav.MAV_CMD_ARM_REACH: ("TIP_HOLD",),
}
"""States that end a command; ARM_STATUS tells of them when the final answer gets lost."""

T = TypeVar("T", bound=Report | Text)
_UNKNOWN: Final = math.nan
_CARRIED_S: Final = 3.0  # three times the period of ARM_PAYLOAD


class Arm:
    """An arm on a vehicle, heard over one connection. Made by `Arm.connect`.

    Streams and orders may run side by side. Cancelling a task that waits for an order stops nothing on the vehicle:
    that is what `abort` is for.

    Args:
        channel: to the component.
    """

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self.parameters = ParameterClient(channel)
        """Reads and writes the component's parameters."""
        self.texts: deque[Text] = deque(maxlen=_KEPT)
        """The newest sentences, the oldest first."""
        self._latest: dict[type[Any], tuple[float, Any]] = {}
        self._tendons: dict[int, Tendons] = {}
        self._streams: list[tuple[tuple[type[Any], ...], asyncio.Queue[Any]]] = []
        self._sentences = Sentences()
        self._commander = Commander(channel, self._state)
        channel.watch(self._take)

    @classmethod
    @contextlib.asynccontextmanager
    async def connect(
        cls,
        url: str = DEFAULT_URL,
        *,
        timeout: float = 10.0,  # noqa: ASYNC109 - the message names the seconds
        system: int = 0,
        component: int = 192,
        address: Address = OUR_ADDRESS,
    ) -> "AsyncIterator[Arm]":
        """Open a connection and wait for the arm's own heartbeat; for an `async with` block.

        Args:
            url: as MAVSDK has them: `udpin://0.0.0.0:14550`, `udpout://HOST:PORT`, `tcpout://HOST:PORT`,
                `serial:///dev/ttyUSB0:57600`. Direct to the companion or through the autopilot, which is noticed.
            timeout: s to wait for the heartbeat.
            system: system id of the vehicle, 0: the first that has the component.
            component: component id of the arm.
            address: our own system and component id.

        Raises:
            LinkError: the URL cannot be opened.
            ArmSilent: no heartbeat of the component in time. Nothing has been sent to it.
        """
        from arm_companion.ground.station import Station  # noqa: PLC0415 - only a connection needs MAVSDK

        channels: list[Channel] = []

        def deliver(message: Message) -> None:
            for channel in channels:
                channel.receive(message)

        async with Station.open(url, address, deliver) as station:
            channel = Channel(station.send, address, component, system)
            arm = cls(channel)
            channels.append(channel)
            try:
                await channel.wait_heard(timeout)
            except ArmSilent as silent:
                raise ArmSilent(f"{silent} on {url}") from None
            yield arm

    # What it tells --------------------

    @property
    def system(self) -> int:
        """System id of the vehicle."""
        return self.channel.system

    @property
    def silence(self) -> float:
        """Seconds since the arm's last heartbeat."""
        return self.channel.silence

    @property
    def way(self) -> str:
        """`direct`, or `tunnel` when the arm's messages come inside TUNNEL, through an autopilot."""
        return "tunnel" if self.channel.tunnelled else "direct"

    @property
    def status(self) -> Status | None:
        """The newest ARM_STATUS."""
        return self._newest(Status)

    @property
    def wrench(self) -> Wrench | None:
        """The newest ARM_REACTION_WRENCH."""
        return self._newest(Wrench)

    @property
    def tendons(self) -> Tendons | None:
        """The newest state of all tendons, put together when the arm has more than four."""
        groups = [self._tendons[first] for first in sorted(self._tendons)]
        if not groups:
            return None
        return Tendons(max(g.time for g in groups), tuple(tendon for g in groups for tendon in g.tendons))

    @property
    def payload(self) -> Payload | None:
        """The newest ARM_PAYLOAD, None when none has come lately: it is sent while something is carried."""
        return self._newest(Payload) if self.age(Payload) <= _CARRIED_S else None

    def age(self, kind: Kind) -> float:
        """Seconds since the newest report of a kind, infinite before the first."""
        entry = self._latest.get(kind)
        return math.inf if entry is None else asyncio.get_running_loop().time() - entry[0]

    async def first(self, kind: type[T], timeout: float = 5.0) -> T:  # noqa: ASYNC109 - the message names the seconds
        """The next report of a kind, or the newest if there is one.

        Raises:
            ArmSilent: none within `timeout` seconds.
        """
        await self.channel.wait_for(
            lambda: kind in self._latest, timeout, f"no {kind.__name__.lower()} of the arm within {timeout:g} s"
        )
        found: T = self._latest[kind][1]
        return found

    @overload
    def stream(self, *, depth: int = 1000, patient: bool = False) -> AsyncIterator[Report | Text]: ...

    @overload
    def stream(self, *kinds: type[T], depth: int = 1000, patient: bool = False) -> AsyncIterator[T]: ...

    async def stream(self, *kinds: type[Any], depth: int = 1000, patient: bool = False) -> AsyncIterator[Any]:
        """Every report from now on, of `Status`, `Wrench`, `Tendons`, `Payload` or `Text`; all when none is named.

        Ends with the connection's `async with` block at the latest.

        Args:
            kinds: which.
            depth: reports that wait for a slow reader; then the oldest are dropped.
            patient: wait on when the arm falls silent; it may come back.

        Raises:
            ArmSilent: no heartbeat for five seconds, unless `patient`.
        """
        queue: asyncio.Queue[Any] = asyncio.Queue(depth)
        entry = (kinds or (Status, Wrench, Tendons, Payload, Text), queue)
        self._streams.append(entry)
        try:
            while True:
                try:
                    async with asyncio.timeout(SILENT_S):
                        report = await queue.get()
                except TimeoutError:
                    if self.silence > SILENT_S and not patient:
                        raise ArmSilent(f"the arm has not been heard for {self.silence:.0f} s") from None
                    continue
                yield report
        finally:
            self._streams.remove(entry)

    # What it is told --------------------

    async def ready(self, progress: Progress | None = None, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Torque on, pretension, straight. For all orders: progress, time-out and errors as `order`."""
        await self.order(mav.MAV_CMD_ARM_READY, progress=progress, timeout=timeout)

    async def stow(self, progress: Progress | None = None, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Straighten the arm; refused while it holds something."""
        await self.order(mav.MAV_CMD_ARM_STOW, progress=progress, timeout=timeout)

    async def perch(
        self,
        kind: int = mav.ARM_PERCH_KIND_ANCHOR,
        progress: Progress | None = None,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> None:
        """Perch on the bar; ends when the grip is verified, or with ARM_PERCH_KIND_HANG when the vehicle hangs."""
        await self.order(mav.MAV_CMD_ARM_PERCH, kind, progress=progress, timeout=timeout)

    async def grasp(self, progress: Progress | None = None, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Grasp the object that `target_object` told of, or the configured one; ends when it is carried."""
        await self.order(mav.MAV_CMD_ARM_GRASP, progress=progress, timeout=timeout)

    async def release(self, progress: Progress | None = None, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Bring the load to zero, let go, clear what was held."""
        await self.order(mav.MAV_CMD_ARM_RELEASE, progress=progress, timeout=timeout)

    async def calibrate(self, progress: Progress | None = None, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Find the tendons' zeros, which are stored and used at once; takes minutes.

        Calling it is the word that nothing and nobody touches the arm, which hangs free and bends by 60 degrees to each
        side. Refused unless the arm is stowed and the vehicle disarmed, on the ground.
        """
        step, sure = mav.ARM_CALIBRATION_STEP_TENDONS, 1
        await self.order(mav.MAV_CMD_ARM_CALIBRATE, step, sure, progress=progress, timeout=timeout)

    async def abort(self, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Leave whatever runs on its shortest safe way. Legal at any time."""
        await self.order(mav.MAV_CMD_ARM_ABORT, timeout=timeout)

    async def jog_bend(self, theta: float, delta: float) -> None:
        """Bend the free arm once: theta rad, in the plane at delta rad about base z."""
        await self.order(mav.MAV_CMD_ARM_JOG, mav.ARM_JOG_KIND_BEND, theta, delta)

    async def jog_vehicle(self, north: float, east: float, down: float) -> None:
        """Move the anchored vehicle: offset in m, world NED, from where it was at the grip."""
        await self.order(mav.MAV_CMD_ARM_JOG, mav.ARM_JOG_KIND_VEHICLE, north, east, down)

    async def reach(
        self,
        north: float,
        east: float,
        down: float,
        *,
        arm_only: bool = False,
        progress: Progress | None = None,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> None:
        """Bring the tip to a point and keep it there; ends when the tip is at the point.

        Args:
            north: of the point, m, the autopilot's local NED.
            east: of the point, m.
            down: of the point, m.
            arm_only: the vehicle stays where it is, and the arm does it alone or refuses.
            progress: as `order`, in per cent of the tip's way.
            timeout: as `order`.
        """
        kind = mav.ARM_REACH_KIND_ARM if arm_only else mav.ARM_REACH_KIND_TOGETHER
        await self.order(mav.MAV_CMD_ARM_REACH, kind, north, east, down, progress=progress, timeout=timeout)

    async def take_control(self, *, force: bool = False) -> None:
        """Take primary control: other stations may then only stow and abort.

        Args:
            force: also from a station that holds it and is heard.

        Raises:
            CommandFailed: another station holds it.
            ArmSilent: not heard, or no answer.
        """
        await self.order(mav.MAV_CMD_ARM_CONTROL, mav.ARM_CONTROL_TAKE_OVER if force else mav.ARM_CONTROL_TAKE)

    async def release_control(self) -> None:
        """Give primary control up; errors as `take_control`."""
        await self.order(mav.MAV_CMD_ARM_CONTROL, mav.ARM_CONTROL_RELEASE)

    async def order(
        self,
        command: int,
        *parameters: float,
        progress: Progress | None = None,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> None:
        """Any command of the dialect, followed to its end.

        Args:
            command: MAV_CMD.
            parameters: param1 and on; the rest are 0.
            progress: told of each report of progress: per cent, or None when it is not known.
            timeout: s until the final answer; None waits as long as the arm is heard.

        Raises:
            ArmSilent: not heard, or no answer.
            CommandFailed: refused, failed or cancelled, with the arm's reason.
            CommandUnfinished: under way, but not finished after `timeout`.
        """
        goals = _GOALS.get(command, ())
        await self._commander.run(command, parameters, goals=goals, progress=progress, timeout=timeout)

    async def set_rate(self, report: Kind, hertz: float) -> None:
        """Ask for another rate of a report on this connection; 0 stops it.

        Raises:
            CommandFailed: the arm does not take the rate.
            ArmSilent: not heard, or no answer.
        """
        id_ = getattr(mav, f"MAVLINK_MSG_ID_{report.MESSAGE}")
        await self.order(mav.MAV_CMD_SET_MESSAGE_INTERVAL, id_, 1e6 / hertz if hertz > 0.0 else -1.0)

    async def send_set_point(self, theta: float, delta: float, timeout_s: float = 0.5) -> None:
        """One ARM_SETPOINT; send them in a stream. The arm holds when none has come for `timeout_s`.

        There is no acknowledgement: `status` shows the goal that the arm took.

        Args:
            theta: bend, rad.
            delta: bending plane about base z, rad.
            timeout_s: the arm's watchdog.

        Raises:
            ArmSilent: the arm has not been heard.
        """
        tip = [math.nan] * 3
        await self.channel.send(
            mav.MAVLink_arm_setpoint_message, self._stamp(), mav.ARM_SETPOINT_KIND_BEND, theta, delta, tip, timeout_s
        )

    async def target_bar(self, position: Vector, axis: Vector, radius: float) -> None:
        """Tell where the bar is (ARM_TARGET). No acknowledgement; a refusal comes as a text.

        Args:
            position: a point on the bar's axis, m, the autopilot's local NED.
            axis: its direction; the length does not matter.
            radius: m.

        Raises:
            ArmSilent: the arm has not been heard.
        """
        kind, frame = mav.ARM_TARGET_KIND_BAR, mav.MAV_FRAME_LOCAL_NED
        unknown = [_UNKNOWN] * 4, [_UNKNOWN] * 6
        await self.channel.send(
            mav.MAVLink_arm_target_message,
            *(self._stamp(), kind, frame, list(position), list(axis), unknown[0], radius, unknown[1], _UNKNOWN),
        )

    async def target_object(self, position: Vector, axis_rad: float, radius: float) -> None:
        """Tell where the object is (ARM_TARGET). No acknowledgement; a refusal comes as a text.

        Args:
            position: middle of the part to wrap, m, the autopilot's local NED.
            axis_rad: heading of its axis, clockwise from north; it is level.
            radius: to wrap around, m.

        Raises:
            ArmSilent: the arm has not been heard.
        """
        kind, frame = mav.ARM_TARGET_KIND_OBJECT, mav.MAV_FRAME_LOCAL_NED
        q = [math.cos(axis_rad / 2.0), 0.0, 0.0, math.sin(axis_rad / 2.0)]  # its x axis is the one to wrap around
        await self.channel.send(
            mav.MAVLink_arm_target_message,
            *(self._stamp(), kind, frame, list(position), [_UNKNOWN] * 3, q, radius, [_UNKNOWN] * 6, _UNKNOWN),
        )

    # Inside --------------------

    def _take(self, message: Message) -> None:
        name = message.get_type()
        if name == "STATUSTEXT":
            for text in self._sentences.take(message):
                self.texts.append(text)
                self._keep(text)
        elif name in REPORTS:
            report: Report = REPORTS[name].of(message)
            if isinstance(report, Tendons) and report.tendons:
                self._tendons[report.tendons[0].index] = report
            self._keep(report)

    def _keep(self, report: Report | Text) -> None:
        self._latest[type(report)] = (asyncio.get_running_loop().time(), report)
        for kinds, queue in self._streams:
            if isinstance(report, kinds):
                if queue.full():
                    queue.get_nowait()
                queue.put_nowait(report)

    def _newest(self, kind: type[T]) -> T | None:
        entry = self._latest.get(kind)
        return None if entry is None else entry[1]

    def _state(self) -> tuple[str, float]:
        return (self.status.state if self.status else "", self.age(Status))

    def _stamp(self) -> int:
        """Now in the arm's own clock, us, late by the link's latency; 0 before its first status.

        Our own clock would not do: the arm refuses what is too old, and neither machine need know the time.
        """
        return 0 if self.status is None else round((self.status.time + self.age(Status)) * 1e6)
