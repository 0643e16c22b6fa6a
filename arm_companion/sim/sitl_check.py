"""What can be seen of a flight stack over MAVLink alone: connection, rates, acknowledgements, arming, set-points.

For one that runs elsewhere (Gazebo, SIH, a bench autopilot), where there is no plant of ours and no arm. Without
leave to fly nothing is armed and nothing moves.
"""

import asyncio
import itertools
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from arm_companion.clock import ticks
from arm_companion.errors import ArmError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.flight_control import ZERO
from arm_companion.sim.operator_link import AUTOPILOT, OperatorLink
from arm_companion.sim.ports import Vec3

Say = Callable[[str], None]

RATE_HZ = 100.0
"""Asked of position and attitude, as the daemon asks."""
_STATE = {"LOCAL_POSITION_NED": 32, "ATTITUDE_QUATERNION": 31}
_AUTOPILOTS = {"ardupilot": mav.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mav.MAV_AUTOPILOT_PX4}
_EXTERNAL = {"ardupilot": 4.0, "px4": 6.0}  # GUIDED; OFFBOARD
_LISTEN_S = 5.0
_ASKED = 20  # acknowledgements
_HEIGHT_M = 3.0
_RADIUS_M, _TURN_S = 2.0, 8.0  # of the circle: 1.6 m/s, 1.2 m/s^2
_SETPOINT_S = 0.02
_LOST_S = 5.0

_NO_VELOCITY, _NO_ACCELERATION, _NO_YAW_RATE = 0b111 << 3, 0b111 << 6, 1 << 11  # POSITION_TARGET_TYPEMASK
_IGNORED = {
    "position": _NO_VELOCITY | _NO_ACCELERATION | _NO_YAW_RATE,
    "position, velocity": _NO_ACCELERATION | _NO_YAW_RATE,
    "position, velocity, acceleration": _NO_YAW_RATE,
}


class CheckFailed(ArmError):
    """The flight stack does not do what it must; the reason is for people."""


@dataclass
class Findings:
    """What was measured.

    Attributes:
        rates_hz: of each state message.
        gap_p99_s: of each state message, between arrivals.
        ack_s: median time from a command to its acknowledgement.
        ready_s: from the first order to arm until it armed.
        circle_rms_m: error while flying a circle, by what the set-points carried.
        after_loss: custom mode some seconds after the set-points stopped, and how far it had drifted, m.
    """

    rates_hz: dict[str, float] = field(default_factory=dict)
    gap_p99_s: dict[str, float] = field(default_factory=dict)
    ack_s: float = math.nan
    ready_s: float = math.nan
    circle_rms_m: dict[str, float] = field(default_factory=dict)
    after_loss: tuple[int, float] | None = None

    def lines(self) -> list[tuple[str, str]]:
        """Name and value of each, for people."""
        rows = [
            (name, f"{rate:.1f} Hz, p99 of the gaps {self.gap_p99_s[name] * 1e3:.1f} ms")
            for name, rate in self.rates_hz.items()
        ]
        if not math.isnan(self.ack_s):
            rows.append(("command to acknowledgement", f"{self.ack_s * 1e3:.1f} ms (median)"))
        if not math.isnan(self.ready_s):
            rows.append(("armed after", f"{self.ready_s:.1f} s"))
        rows += [(f"circle, {what}", f"{error * 1e3:.0f} mm RMS") for what, error in self.circle_rms_m.items()]
        if self.after_loss is not None:
            mode, drift = self.after_loss
            rows.append((f"set-points gone for {_LOST_S:g} s", f"mode {mode:#x}, {drift:.2f} m away"))
        return rows


class Check:
    """The checks over one link.

    Args:
        link: to the flight stack, running.
        stack: `ardupilot` or `px4`.
        say: told what happens.

    Attributes:
        findings: so far.
    """

    def __init__(self, link: OperatorLink, stack: str, say: Say) -> None:
        self._link = link
        self._stack = stack
        self._say = say
        self._arrivals: dict[str, list[float]] = {name: [] for name in _STATE}
        self.findings = Findings()
        link.watch(self._see)

    def _see(self, message: Any) -> None:
        name = message.get_type()
        if name in self._arrivals and message.get_srcComponent() == AUTOPILOT[1]:
            self._arrivals[name].append(asyncio.get_running_loop().time())

    async def listen(self) -> None:
        """Connection, rates and acknowledgements; nothing is armed.

        Raises:
            CheckFailed: no heartbeat, another flight stack, or no answer.
        """
        self._say("waiting for a heartbeat")
        await self._until(lambda: self._heartbeat() is not None, 30.0, "no heartbeat")
        kind = self._heartbeat().autopilot
        if kind != _AUTOPILOTS[self._stack]:
            name = mav.enums["MAV_AUTOPILOT"][kind].name if kind in mav.enums["MAV_AUTOPILOT"] else kind
            raise CheckFailed(f"the heartbeat is that of {name}, not of {self._stack}")
        loop = asyncio.get_running_loop()
        delays = []
        for _ in range(_ASKED):
            start = loop.time()
            version = float(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            await self._command(mav.MAV_CMD_REQUEST_MESSAGE, [version], "AUTOPILOT_VERSION")
            delays.append(loop.time() - start)
        self.findings.ack_s = statistics.median(delays)
        for number in _STATE.values():
            await self._command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, [float(number), 1e6 / RATE_HZ], "message interval")
        self._say("waiting for a position, which an estimator may take 40 s to find")
        await self._until(lambda: bool(self._arrivals["LOCAL_POSITION_NED"]), 90.0, "no LOCAL_POSITION_NED")
        self._say("measuring rates")
        await asyncio.sleep(1.0)
        for arrivals in self._arrivals.values():
            arrivals.clear()
        await asyncio.sleep(_LISTEN_S)
        for name, arrivals in self._arrivals.items():
            if len(arrivals) < 2:
                raise CheckFailed(f"no {name}")
            gaps = sorted(b - a for a, b in itertools.pairwise(arrivals))
            self.findings.rates_hz[name] = len(gaps) / sum(gaps)
            self.findings.gap_p99_s[name] = gaps[math.ceil(0.99 * len(gaps)) - 1]

    async def fly(self) -> None:
        """Arm, take off, fly circles with more and more of the set-point, let the stream stop, land.

        Raises:
            CheckFailed: one of these does not happen. It is told to land before that.
        """
        try:
            await self._take_off()
            for what, mask in _IGNORED.items():
                self._say(f"a circle by {what}")
                self.findings.circle_rms_m[what] = await self._circle(mask)
            self._say("set-points stop")
            before = self._position()
            await asyncio.sleep(_LOST_S)
            drift = math.dist(before, self._position())
            self.findings.after_loss = (int(self._heartbeat().custom_mode), drift)
        finally:
            self._say("landing")
            land = [0.0, 0.0, 0.0, math.nan, math.nan, math.nan, 0.0]
            await self._link.command(mav.MAV_CMD_NAV_LAND, land, timeout=5.0)
        await self._until(lambda: not self._armed(), 90.0, "it does not land and disarm")

    async def _take_off(self) -> None:
        loop = asyncio.get_running_loop()
        start = loop.time()
        self._say("arming")
        while True:
            result = await self._link.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, [1.0, 0.0], timeout=5.0)
            if result == mav.MAV_RESULT_ACCEPTED:
                break
            if loop.time() - start > 90.0:
                why = self._link.texts[-1].text if self._link.texts else ""
                raise CheckFailed(f"arming: {mav.enums['MAV_RESULT'][result].name} {why}".strip())
            await asyncio.sleep(1.0)
        self.findings.ready_s = loop.time() - start
        if self._stack == "ardupilot":  # armed first: until then its radio's mode switch has the last word
            await self._take_external_control()
        height = _HEIGHT_M
        if self._stack == "px4":  # a height over the sea, from where it stands
            place = self._link.latest("GLOBAL_POSITION_INT")
            height += place.alt / 1e3 if place is not None else 0.0
        where = [0.0, 0.0, 0.0, math.nan, math.nan, math.nan, height]
        await self._command(mav.MAV_CMD_NAV_TAKEOFF, where, "take-off")
        await self._until(lambda: self._position()[2] < -0.6 * _HEIGHT_M, 40.0, "it does not climb")
        await asyncio.sleep(5.0)
        if self._stack == "px4":
            await self._take_external_control()

    async def _circle(self, mask: int) -> float:
        """RMS error in the plane over the second of two turns, against where it should be at that moment."""
        loop = asyncio.get_running_loop()
        x, y, z = self._position()
        rate, begun = 2.0 * math.pi / _TURN_S, loop.time()
        errors: list[float] = []
        async for tick in ticks(_SETPOINT_S):
            t = tick.now - begun
            if t >= 2.0 * _TURN_S:
                break
            c, s = math.cos(rate * t), math.sin(rate * t)
            goal = (x - _RADIUS_M + _RADIUS_M * c, y + _RADIUS_M * s)
            speed, pull = _RADIUS_M * rate, _RADIUS_M * rate**2
            self._send(mask, (*goal, z), (-speed * s, speed * c, 0.0), (-pull * c, -pull * s, 0.0))
            if t > _TURN_S:
                errors.append(math.dist(self._position()[:2], goal))
        return math.sqrt(statistics.fmean(error**2 for error in errors))

    def _send(self, mask: int, position: Vec3, velocity: Vec3 = ZERO, acceleration: Vec3 = ZERO) -> None:
        """A set-point with the nose to the north."""
        parts = (*position, *velocity, *acceleration)
        frame = mav.MAV_FRAME_LOCAL_NED
        self._link.send(mav.MAVLink_set_position_target_local_ned_message(0, *AUTOPILOT, frame, mask, *parts, 0.0, 0.0))

    async def _take_external_control(self) -> None:
        """GUIDED, or OFFBOARD, which wants a second of set-points before it is entered."""
        place = self._position()

        async def stream() -> None:
            async for _ in ticks(_SETPOINT_S):
                self._send(_IGNORED["position"], place)

        task = asyncio.create_task(stream()) if self._stack == "px4" else None
        try:
            await asyncio.sleep(1.5 if task is not None else 0.0)
            mode = [float(mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), _EXTERNAL[self._stack]]
            await self._command(mav.MAV_CMD_DO_SET_MODE, mode, "external set-points")
        finally:
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

    async def _command(self, command: int, parameters: list[float], what: str) -> None:
        whole = [*parameters, *[0.0] * (7 - len(parameters))]  # ArduPilot denies an interval with what is not a number
        try:
            result = await self._link.command(command, whole, timeout=5.0)
        except TimeoutError as error:
            raise CheckFailed(f"{what}: {error}") from None
        if result != mav.MAV_RESULT_ACCEPTED:
            raise CheckFailed(f"{what}: {mav.enums['MAV_RESULT'][result].name}")

    async def _until(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        try:
            await self._link.wait_for(lambda _: condition(), timeout_s)
        except TimeoutError:
            raise CheckFailed(otherwise) from None

    def _heartbeat(self) -> Any:
        return self._link.latest("HEARTBEAT")

    def _armed(self) -> bool:
        heartbeat = self._heartbeat()
        return heartbeat is not None and bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)

    def _position(self) -> Vec3:
        place = self._link.latest("LOCAL_POSITION_NED")
        return (place.x, place.y, place.z) if place is not None else ZERO
