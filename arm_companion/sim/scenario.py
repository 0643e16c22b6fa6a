"""What the operator on the ground does in a scenario: a script of MAVLink commands and waits, nothing else.

It sees what a ground station sees; the plant's truth is for the verdict alone.
"""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from arm_companion.config.schema import Config
from arm_companion.ground.texts import SEVERITIES, Sentences
from arm_companion.protocol.dialect import mav
from arm_companion.sim.flight import CARRIED, WITH, WITHOUT, Flight, Mark, PayloadSeen, TendonsSeen, Vec3, WrenchSeen
from arm_companion.sim.operator_link import Address, OperatorLink
from arm_companion.sim.sitl_px4 import HOME

Say = Callable[[str], None]

_PULL_M = 0.010
_HOLD_S = 3.0
_PULL_S = 4.0
_HANG_S = 15.0
_STANDS_S = 8.0
_STREAM_S = 3.0  # a heartbeat tells of the arming within a second, and PX4 wants a second of stream
_FORCE = 21196.0  # param2 of a disarming that asks for no landing
_CARRY_S = 4.0
_TOLD_S = 0.3  # until a state that has just been left is not told any more
_OFFBOARD = 6
_GUIDED = 4
_WARNINGS = SEVERITIES[: mav.MAV_SEVERITY_WARNING + 1]
_CUSTOM_MODE = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


class ScenarioFailed(Exception):
    """The script cannot go on; the reason is for people."""


class Operator:
    """Flies one vehicle with one arm from the ground."""

    def __init__(self, link: OperatorLink, config: Config, flight: Flight, say: Say) -> None:
        self._link = link
        self.config = config
        self._flight = flight
        self.say = say
        self._arm = (1, config.vehicle.component_id)
        self._autopilot = (1, 1)
        self._sentences: dict[Address, Sentences] = {}  # of each who speaks
        self._warned = ""
        link.watch(self._see)

    # --- what is seen ---

    def _see(self, message: Any) -> None:
        t = asyncio.get_running_loop().time()
        flight = self._flight
        match message.get_type():
            case "ARM_STATUS":
                if not flight.states or flight.states[-1][1] != message.state_name:
                    flight.states.append((t, message.state_name))
                    self.say(f"state {message.state_name}")
            case "ARM_REACTION_WRENCH":
                flight.wrenches.append(
                    WrenchSeen(
                        t,
                        _vec3(message.force),
                        _vec3(message.torque),
                        _vec3(message.force_sigma),
                        bool(message.validity),
                        message.source,
                    )
                )
            case "ARM_TENDONS":
                flight.tendons.append(TendonsSeen(t, tuple(message.tension)))
            case "ARM_PAYLOAD":
                flight.payloads.append(PayloadSeen(t, message.mass, message.mass_sigma, bool(message.valid)))
            case "STATUSTEXT":
                speaker = (message.get_srcSystem(), message.get_srcComponent())
                for sentence in self._sentences.setdefault(speaker, Sentences()).take(message):
                    flight.texts.append((t, sentence.text))
                    # an autopilot that is asked once a second says no in the same words each time
                    if sentence.severity in _WARNINGS and sentence.text != self._warned:
                        self._warned = sentence.text
                        self.say(f"“{sentence.text}”")

    @property
    def state(self) -> str:
        """The arm's, as last told; empty before the first."""
        return self._flight.states[-1][1] if self._flight.states else ""

    # --- what is done ---

    async def fly_perch(self) -> str:
        """The whole flight. Returns why it failed, or an empty string."""
        return await self.fly(self.perch, self._pull, self.release)

    async def fly_hang(self) -> str:
        """The same with a hang perch: the vehicle hangs for a while, takes its load back and leaves."""
        return await self.fly(self._hang, self.release)

    async def fly_hang_disarmed(self) -> str:
        """A person disarms the hanging vehicle, arms it again, gives it back and has it leave."""
        return await self.fly(self._hang, self._disarm_and_arm, self.release)

    async def fly_grasp(self) -> str:
        """An object is picked up twice, without and with the feed-forward, and put back each time.

        A gripper takes it with the feed-forward alone.
        """
        first = self._grasp if self.config.gripper_by else self._grasp_uncompensated
        return await self.fly(first, self.ready, self._grasp)

    async def fly_grasp_once(self) -> str:
        """The same with the feed-forward alone, for trials."""
        return await self.fly(self._grasp)

    async def fly(self, *acts: Callable[[], Coroutine[Any, Any, None]]) -> str:
        """Take off, do one act after the other until one fails, and come home whatever came before.

        Returns:
            Why it failed, or an empty string.
        """
        failure = ""
        try:
            await self._prepare()
            await self._take_off()
            for act in acts:
                await act()
        except (ScenarioFailed, TimeoutError) as error:
            failure = str(error) or "the operator waited too long"
            self.say(f"failed: {failure}")
            await asyncio.sleep(_TOLD_S)
        try:
            await self._come_home()
        except (ScenarioFailed, TimeoutError) as error:
            failure = "; ".join(filter(None, (failure, f"no safe end: {error}")))
        self._flight.end = asyncio.get_running_loop().time()
        return failure

    async def _prepare(self) -> None:
        self.say("waiting for autopilot and arm")
        await self.wait(lambda: self._heard(self._autopilot), 30.0, "no heartbeat from the autopilot")
        await self.wait(lambda: self._heard(self._arm), 15.0, "no heartbeat from the arm")
        await self.wait(lambda: self.state == "STOWED", 10.0, "the arm is not stowed")

    async def _take_off(self) -> None:
        self.say("arm made ready, vehicle takes off")
        await self.order(mav.MAV_CMD_ARM_READY, "READY", 20.0)
        await self._vehicle(mav.MAV_CMD_COMPONENT_ARM_DISARM, [1.0], "arming", retry_s=60.0, before=self._tell_origin)
        height = self.config.sim.takeoff_height_m
        if self._ardupilot:
            # it takes off by command in GUIDED only, PX4 in any mode but OFFBOARD; and it tells only what is asked
            await self._take_external_control()
            for message in (mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE):
                asked = [float(message), 100_000.0]
                await self._vehicle(mav.MAV_CMD_SET_MESSAGE_INTERVAL, asked, "state messages")
        nan = float("nan")
        over_home = (
            height if self._ardupilot else nan
        )  # PX4 takes it for one over the sea, and has a default of its own
        await self._vehicle(mav.MAV_CMD_NAV_TAKEOFF, [0, 0, 0, nan, nan, nan, over_home], "take-off")
        await self.wait(lambda: abs(self._height() - height) < 0.15, 30.0, "the vehicle does not reach its height")
        await asyncio.sleep(2.0)
        if not self._ardupilot:
            await self._take_external_control()

    def _tell_origin(self) -> None:
        """Where on earth the origin is: without satellites nobody else tells, and PX4's HOLD asks for it."""
        if self.config.sim.sitl_position == "capture":
            latitude, longitude, height = (round(v * scale) for v, scale in zip(HOME, (1e7, 1e7, 1e3), strict=True))
            origin = mav.MAVLink_set_gps_global_origin_message(self._autopilot[0], latitude, longitude, height)
            self._link.send(origin, self._autopilot)

    async def _take_external_control(self) -> None:
        self.say("external set-points on")
        await self._vehicle(mav.MAV_CMD_DO_SET_MODE, [_CUSTOM_MODE, self._external_mode()], "mode change")
        await self.wait(self._is_external, 5.0, "the autopilot does not take external set-points")
        # each port has heartbeats of its own, a second apart: the arm may know of it later than the ground
        await self.wait(self._arm_may_fly, 5.0, "the arm does not see that it may fly the vehicle")

    async def perch(self) -> None:
        """Order an anchor perch, and wait until the arm has perched."""
        self.say("PERCH")
        await self.order(mav.MAV_CMD_ARM_PERCH, "PERCH", 120.0)

    async def _hang(self) -> None:
        self.say("PERCH, to hang")
        await self.order(mav.MAV_CMD_ARM_PERCH, "PERCH", 180.0, float(mav.ARM_PERCH_KIND_HANG))
        start = asyncio.get_running_loop().time()
        await asyncio.sleep(_HANG_S)
        self._flight.marks.append(Mark("hang", start, asyncio.get_running_loop().time(), (0.0, 0.0, 0.0)))
        if self.state != "HANGING":
            raise ScenarioFailed(f"the hanging ended by itself in {self.state}")

    async def _disarm_and_arm(self) -> None:
        self.say("disarmed by force")
        await self._vehicle(mav.MAV_CMD_COMPONENT_ARM_DISARM, [0.0, _FORCE], "disarming")
        await self.wait(lambda: self.state == "HANG_HOLD", 5.0, "the arm does not notice that the motors stand")
        await asyncio.sleep(_STANDS_S)
        await self._vehicle(mav.MAV_CMD_COMPONENT_ARM_DISARM, [1.0], "arming")
        await self.order(mav.MAV_CMD_ARM_READY, "READY", 5.0)
        if self._ardupilot:  # it ignores set-points until it has been told to take off
            await self._take_external_control()
            await self._vehicle(mav.MAV_CMD_NAV_TAKEOFF, [0.0] * 6 + [self._height() + 0.3], "take-off")
            await self.wait(lambda: not self._landed(), 5.0, "the autopilot does not take off")
        else:
            await asyncio.sleep(_STREAM_S)
            await self._take_external_control()

    async def _pull(self) -> None:
        """Hold, then the paper's benchmark: 10 mm towards the bar in x, then in z, then x without compensation."""
        await asyncio.sleep(2.0)
        await self._measure("hold", (0.0, 0.0, 0.0), _HOLD_S)
        x, z = (_PULL_M, 0.0, 0.0), (0.0, 0.0, _PULL_M)
        await self._pull_to("pull x", x)
        await self._pull_to("pull z", z)
        await self._compensate(on=False)
        await self._pull_to("pull x, not compensated", x)
        await self._compensate(on=True)
        if self.state != "PERCHED":
            raise ScenarioFailed(f"the perch ended by itself in {self.state}")

    async def _pull_to(self, name: str, move: Vec3) -> None:
        """One move away from where the vehicle rests, and back."""
        self.say(f"{name}: 10 mm")
        await self._jog(move)
        await asyncio.sleep(_PULL_S)
        await self._measure(name, move, _HOLD_S)
        await self._jog((0.0, 0.0, 0.0))
        await asyncio.sleep(_PULL_S)

    async def _grasp(self) -> None:
        """Take the object, carry it for a while, and put it back."""
        self.say("GRASP")
        await self._pick_and_place(WITH)

    async def _grasp_uncompensated(self) -> None:
        self.say("GRASP, not compensated")
        await self._compensate(on=False)
        await self._pick_and_place(WITHOUT)
        await self._compensate(on=True)

    async def ready(self) -> None:
        """Order the arm to get ready, and wait until it is."""
        await self.order(mav.MAV_CMD_ARM_READY, "READY", 20.0)

    async def _pick_and_place(self, name: str) -> None:
        start = asyncio.get_running_loop().time()
        await self.order(mav.MAV_CMD_ARM_GRASP, "GRASP", 150.0)
        self.mark(name, start)
        await asyncio.sleep(1.0)
        await self._measure(CARRIED, (0.0, 0.0, 0.0), _CARRY_S)
        if self.state != "CARRY":
            raise ScenarioFailed(f"the carrying ended by itself in {self.state}")
        await self.release()

    async def release(self) -> None:
        """Order a release, and wait until the arm is stowed."""
        self.say("RELEASE")
        await self.order(mav.MAV_CMD_ARM_RELEASE, "RELEASE", 150.0)

    async def _come_home(self) -> None:
        """Stow and land, whatever came before; a failed perch must end on the ground as well."""
        if not self._heard(self._autopilot):
            raise ScenarioFailed("the autopilot is gone")
        quiet = ("STOWED", "READY", "TIP_HOLD", "HOLDING", "CARRY", "HANGING", "HANG_HOLD", "")
        await self.wait(lambda: self.state in quiet, 150.0, f"the arm stays in {self.state}")
        if self.state in ("HOLDING", "CARRY", "HANGING", "HANG_HOLD"):
            await self.order(mav.MAV_CMD_ARM_RELEASE, "RELEASE", 150.0)
        if self.state in ("READY", "TIP_HOLD"):
            await self.order(mav.MAV_CMD_ARM_STOW, "STOW", 30.0)
        self.say("landing")
        if self.config.gripper_by:  # it hovers above the object
            await self._vehicle(mav.MAV_CMD_NAV_RETURN_TO_LAUNCH, [], "return")
        else:
            await self._vehicle(mav.MAV_CMD_NAV_LAND, [0, 0, 0, float("nan"), float("nan"), float("nan"), 0], "landing")
        await self.wait(lambda: not self._armed(), 60.0, "the vehicle does not land and disarm")

    # --- small things ---

    async def order(self, command: int, name: str, timeout_s: float, *parameters: float) -> None:
        """A command to the arm, until it is carried out.

        Args:
            command: MAV_CMD.
            name: for people.
            timeout_s: until the next sign of progress.
            parameters: the first ones; the others are zero.

        Raises:
            ScenarioFailed: it was not carried out.
        """
        padded = [*parameters, *[0.0] * (7 - len(parameters))]
        result = await self._link.command(command, padded, target=self._arm, timeout=timeout_s)
        if result != mav.MAV_RESULT_ACCEPTED:
            raise ScenarioFailed(f"{name}: {self._why(result)}")

    def _why(self, result: int) -> str:
        warnings = [text for _, text in self._flight.texts[-3:] if "->" in text or "rejected" in text]
        name = mav.enums["MAV_RESULT"][result].name.removeprefix("MAV_RESULT_").lower()
        return f"{name} ({warnings[-1]})" if warnings else name

    async def _jog(self, move_w: Vec3) -> None:
        await self.order(mav.MAV_CMD_ARM_JOG, "JOG", 5.0, float(mav.ARM_JOG_KIND_VEHICLE), *move_w)

    async def _compensate(self, *, on: bool) -> None:
        await self.order(mav.MAV_CMD_ARM_FEEDFORWARD, "FEEDFORWARD", 5.0, float(on))

    async def _vehicle(
        self,
        command: int,
        parameters: list[float],
        what: str,
        retry_s: float = 0.0,
        before: Callable[[], None] = lambda: None,
    ) -> None:
        """A command to the autopilot, repeated for `retry_s` while it is not ready yet; `before` is done each time."""
        loop = asyncio.get_running_loop()
        until = loop.time() + retry_s
        padded = [*parameters, *[0.0] * (7 - len(parameters))]
        while True:
            before()
            result = await self._link.command(command, padded, target=self._autopilot, timeout=5.0)
            if result == mav.MAV_RESULT_ACCEPTED:
                return
            if loop.time() >= until:
                raise ScenarioFailed(f"{what}: {self._why(result)}")
            await asyncio.sleep(1.0)

    async def _measure(self, name: str, asked_w: Vec3, seconds: float) -> None:
        start = asyncio.get_running_loop().time()
        await asyncio.sleep(seconds)
        self.mark(name, start, asked_w)

    def mark(self, name: str, start: float, asked_w: Vec3 = (0.0, 0.0, 0.0)) -> None:
        """Note what was asked from loop time `start` until now."""
        self._flight.marks.append(Mark(name, start, asyncio.get_running_loop().time(), asked_w))

    async def wait(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Wait until something holds.

        Raises:
            ScenarioFailed: with `otherwise`, when it did not within `timeout_s`.
        """
        try:
            async with asyncio.timeout(timeout_s):
                while not condition():
                    await asyncio.sleep(0.05)
        except TimeoutError:
            raise ScenarioFailed(otherwise) from None

    def _heard(self, who: Address) -> bool:
        return self._link.latest("HEARTBEAT", who) is not None

    def _height(self) -> float:
        position = self._link.latest("LOCAL_POSITION_NED", self._autopilot)
        return -position.z if position is not None else 0.0

    def _landed(self) -> bool:
        state = self._link.latest("EXTENDED_SYS_STATE", self._autopilot)
        return state is not None and state.landed_state == mav.MAV_LANDED_STATE_ON_GROUND

    def _heartbeat(self) -> Any:
        return self._link.latest("HEARTBEAT", self._autopilot)

    def _armed(self) -> bool:
        heartbeat = self._heartbeat()
        return heartbeat is not None and bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def _ardupilot(self) -> bool:
        return self.config.vehicle.autopilot == "ardupilot"

    def _external_mode(self) -> float:
        return float(_GUIDED if self._ardupilot else _OFFBOARD)

    def _is_external(self) -> bool:
        heartbeat = self._heartbeat()
        if heartbeat is None:
            return False
        if self._ardupilot:
            return bool(heartbeat.custom_mode == int(self._external_mode()))
        return bool((heartbeat.custom_mode >> 16) & 0xFF == _OFFBOARD)

    def _arm_may_fly(self) -> bool:
        status = self._link.latest("ARM_STATUS", self._arm)
        return status is not None and bool(status.flags & mav.ARM_FLAG_EXTERNAL_CONTROL)


def _vec3(values: Any) -> Vec3:
    x, y, z = values
    return (x, y, z)
