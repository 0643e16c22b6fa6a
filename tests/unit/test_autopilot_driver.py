"""The autopilot driver: what it believes, what it asks for, and what it sends."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import Any

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config.schema import VehicleConfig
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.path_feedforward import PathFeedforward
from arm_companion.errors import ProtocolError
from arm_companion.mission.facts import Control, Setpoint, VehicleState
from arm_companion.protocol.dialect import mav

PX4, ARDUPILOT = mav.MAV_AUTOPILOT_PX4, mav.MAV_AUTOPILOT_ARDUPILOTMEGA
OFFBOARD = 6 << 16
GUIDED = 4
SETPOINT = Setpoint((1.0, 2.0, -3.0), (0.1, 0.2, 0.3), (0.5, 0.6, 0.7), 1.5)
STREAMS = {31: 100.0, 32: 100.0, 83: 50.0, 245: 5.0, 74: 10.0}
Peer = Any


@dataclass
class Rig:
    """The driver on a link, and the autopilot at its far end."""

    autopilot: Autopilot
    peer: Peer
    boot_ms: int = 0

    @property
    def state(self) -> VehicleState:
        return self.autopilot.state(asyncio.get_running_loop().time())

    def asked(self) -> dict[int, float]:
        """Rates asked for since the last look, by message id."""
        commands = self.peer.all("COMMAND_LONG")
        self.peer.received.clear()
        assert {m.command for m in commands} <= {mav.MAV_CMD_SET_MESSAGE_INTERVAL}
        return {round(m.param1): 1e6 / m.param2 for m in commands}

    def attitude(self, *q: float, rates: tuple[float, ...] = (0.1, 0.2, 0.3)) -> None:
        self.peer.send(mav.MAVLink_attitude_quaternion_message(self.boot_ms, *q, *rates))

    def position(self, *values: float) -> None:
        self.peer.send(mav.MAVLink_local_position_ned_message(self.boot_ms, *values))

    def thrust(self, share: float) -> None:
        upright = (1.0, 0.0, 0.0, 0.0)
        self.peer.send(mav.MAVLink_attitude_target_message(self.boot_ms, 0, upright, 0.0, 0.0, 0.0, share))

    async def stream(self, seconds: float, *, position: bool = True, heartbeat: bool = True) -> None:
        """Everything at its rate, as an autopilot does once asked."""
        for i in range(round(seconds * 100)):
            self.boot_ms += 10
            self.attitude(1.0, 0.0, 0.0, 0.0)
            if position:
                self.position(1.0, 2.0, 3.0, 0.0, 0.0, 0.0)
            if i % 2 == 0:
                self.thrust(0.5)
            if i % 20 == 0:
                self.peer.send(mav.MAVLink_extended_sys_state_message(0, mav.MAV_LANDED_STATE_IN_AIR))
            if i % 10 == 0:
                self.peer.send(mav.MAVLink_vfr_hud_message(0.0, 0.0, 0, 47, 0.0, 0.0))
            if heartbeat and i % 100 == 0:
                self.peer.heartbeat(PX4, OFFBOARD)
            await asyncio.sleep(0.01)


@pytest.fixture
def fly(autopilot_peer: Peer) -> Callable[..., None]:
    """Run a test body against the driver in simulated time."""

    @contextlib.asynccontextmanager
    async def running(vehicle: VehicleConfig) -> AsyncIterator[Rig]:
        link = MavlinkLink("autopilot", "autopilot", autopilot_peer.pipe.opener(0), vehicle)
        autopilot = Autopilot(link, vehicle)
        await autopilot_peer.open()
        tasks = [asyncio.create_task(r) for r in (link.run(), autopilot.run())]
        try:
            await asyncio.sleep(0.01)
            yield Rig(autopilot, autopilot_peer)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        assert link.counters.handler_errors == 0

    def run(body: Callable[[Rig], Coroutine[Any, Any, None]], **vehicle: Any) -> None:
        async def main() -> None:
            async with running(VehicleConfig(**vehicle)) as rig:
                await body(rig)

        run_simulated(main())

    return run


# --- state ---


def test_nothing_heard_is_infinitely_old(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        state = rig.state
        assert state.heartbeat_age_s == state.position_age_s == state.attitude_age_s == math.inf
        assert (state.control, state.armed, state.landed) == (Control.UNKNOWN, False, True)

    fly(body)


def test_state_is_what_the_messages_say_and_ages_with_the_loop(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(PX4, OFFBOARD)
        rig.attitude(0.8, 0.0, 0.0, 0.6)
        rig.position(1.0, 2.0, -3.0, 0.1, 0.2, 0.3)
        rig.peer.send(mav.MAVLink_extended_sys_state_message(0, mav.MAV_LANDED_STATE_IN_AIR))
        rig.peer.send(mav.MAVLink_vfr_hud_message(0.0, 0.0, 0, 47, 0.0, 0.0))
        await asyncio.sleep(0.1002)
        state = rig.state
        assert state.attitude_wb == pytest.approx((0.8, 0.0, 0.0, 0.6))
        assert state.rate_b == pytest.approx((0.1, 0.2, 0.3))
        assert state.position_w == pytest.approx((1.0, 2.0, -3.0))
        assert state.velocity_w == pytest.approx((0.1, 0.2, 0.3))
        assert (state.armed, state.landed, state.control, state.mode) == (True, False, Control.EXTERNAL, "OFFBOARD")
        assert (state.throttle, state.throttle_age_s < 0.11) == (0.47, True)
        ages = (state.heartbeat_age_s, state.position_age_s, state.attitude_age_s)
        assert ages == pytest.approx((0.1, 0.1, 0.1), abs=1e-6)

    fly(body)


@pytest.mark.parametrize(
    ("flavour", "kind", "mode", "status", "control", "name"),
    [
        ("px4", PX4, OFFBOARD, 4, Control.EXTERNAL, "OFFBOARD"),
        ("px4", PX4, 3 << 16, 4, Control.PILOT, "POSCTL"),
        ("px4", PX4, 5 << 24 | 4 << 16, 4, Control.PILOT, "AUTO.RTL"),
        ("px4", PX4, GUIDED, 4, Control.PILOT, "mode 0"),
        ("px4", PX4, OFFBOARD, mav.MAV_STATE_CRITICAL, Control.FAILSAFE, "OFFBOARD"),
        ("px4", ARDUPILOT, OFFBOARD, 4, Control.UNKNOWN, "unexpected autopilot 3"),
        ("ardupilot", ARDUPILOT, GUIDED, 4, Control.EXTERNAL, "GUIDED"),
        ("ardupilot", ARDUPILOT, 5, 4, Control.PILOT, "LOITER"),
        ("ardupilot", ARDUPILOT, 99, 4, Control.PILOT, "mode 99"),
        ("ardupilot", ARDUPILOT, GUIDED, mav.MAV_STATE_EMERGENCY, Control.FAILSAFE, "GUIDED"),
        ("ardupilot", PX4, GUIDED, 4, Control.UNKNOWN, "unexpected autopilot 12"),
    ],
)
def test_who_flies_is_read_from_the_heartbeat(
    fly: Callable[..., None], flavour: str, kind: int, mode: int, status: int, control: Control, name: str
) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(kind, mode, status=status)
        await asyncio.sleep(0.01)
        assert (rig.state.control, rig.state.mode) == (control, name)

    fly(body, autopilot=flavour)


def test_other_voices_do_not_count(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.attitude(1.0, 0.0, 0.0, 0.0)  # before any heartbeat
        rig.peer.heartbeat(PX4, 3 << 16)
        await asyncio.sleep(0.01)
        assert rig.state.attitude_age_s == math.inf
        for system, component in ((1, 191), (2, 1), (255, 190)):
            rig.peer.codec._sender.srcSystem, rig.peer.codec._sender.srcComponent = system, component
            rig.peer.heartbeat(PX4, OFFBOARD)
            rig.position(9.0, 9.0, 9.0, 0.0, 0.0, 0.0)
        await asyncio.sleep(0.01)
        assert rig.state.control is Control.PILOT
        assert rig.state.position_age_s == math.inf

    fly(body)


def test_a_new_system_is_believed_only_after_the_old_one_is_silent(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        await rig.stream(0.5)
        rig.peer.heartbeat(PX4, OFFBOARD, armed=False)
        await asyncio.sleep(0.01)
        rig.peer.codec.system_id = 5
        rig.peer.heartbeat(PX4, OFFBOARD)
        await asyncio.sleep(0.01)
        assert rig.autopilot.system_id == 1
        await asyncio.sleep(3.0)
        rig.peer.heartbeat(PX4, OFFBOARD)
        await asyncio.sleep(0.01)
        assert rig.autopilot.system_id == 5
        assert rig.state.position_age_s == math.inf  # the old vehicle's position is not the new one's

    fly(body)


def test_another_vehicle_never_takes_the_place_of_one_that_was_armed(
    fly: Callable[..., None], caplog: pytest.LogCaptureFixture
) -> None:
    async def body(rig: Rig) -> None:
        await rig.stream(0.5)
        rig.peer.codec.system_id = 5
        for _ in range(10):
            await asyncio.sleep(1.0)
            rig.peer.heartbeat(PX4, OFFBOARD)
        await asyncio.sleep(0.01)
        assert rig.autopilot.system_id == 1
        assert rig.state.heartbeat_age_s > 9.0
        assert caplog.text.count("system 5 does not take its place") == 1
        rig.autopilot.send(SETPOINT, 0.0)
        await asyncio.sleep(0.01)
        assert {m.target_system for m in rig.peer.all("SET_POSITION_TARGET_LOCAL_NED")} == {1}
        rig.peer.codec.system_id = 1  # it comes back and disarms: now it may be replaced
        rig.peer.heartbeat(PX4, OFFBOARD, armed=False)
        await asyncio.sleep(3.0)
        rig.peer.codec.system_id = 5
        rig.peer.heartbeat(PX4, OFFBOARD)
        await asyncio.sleep(0.01)
        assert rig.autopilot.system_id == 5

    fly(body)


@pytest.mark.parametrize(
    "bad",
    [
        lambda rig: rig.attitude(math.nan, 0.0, 0.0, 0.0),
        lambda rig: rig.attitude(0.1, 0.0, 0.0, 0.0),
        lambda rig: rig.attitude(1.0, 0.0, 0.0, 0.0, rates=(math.inf, 0.0, 0.0)),
        lambda rig: rig.position(math.nan, 0.0, 0.0, 0.0, 0.0, 0.0),
        lambda rig: rig.position(0.0, 0.0, 0.0, 0.0, 0.0, -math.inf),
    ],
)
def test_impossible_state_is_counted_and_does_not_look_fresh(
    fly: Callable[..., None], bad: Callable[[Rig], None]
) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(PX4, OFFBOARD)
        bad(rig)
        await asyncio.sleep(0.01)
        assert rig.state.attitude_age_s == rig.state.position_age_s == math.inf
        assert rig.autopilot.counters.invalid == 1

    fly(body)


def test_a_late_frame_does_not_turn_back_time(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(PX4, OFFBOARD)
        rig.boot_ms = 5000
        rig.position(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        rig.boot_ms = 4990
        rig.position(0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
        await asyncio.sleep(0.01)
        assert rig.state.position_w[0] == 1.0
        assert rig.autopilot.counters.reboots == 0

    fly(body)


def test_a_frame_that_comes_again_says_nothing_new(fly: Callable[..., None]) -> None:
    """A router, or a second link, that repeats the last frame of an autopilot that has stopped."""

    async def body(rig: Rig) -> None:
        await rig.stream(0.5)
        assert rig.state.position_age_s < 0.02
        rig.asked()
        for _ in range(300):
            rig.attitude(1.0, 0.0, 0.0, 0.0)
            rig.position(1.0, 2.0, 3.0, 0.0, 0.0, 0.0)
            rig.thrust(0.5)
            await asyncio.sleep(0.01)
        assert min(rig.state.position_age_s, rig.state.attitude_age_s) > 2.9
        assert math.isnan(rig.state.thrust)
        assert {31, 32, 83} <= rig.asked().keys(), "nothing flows, so it is asked for again"

    fly(body)


# --- rates ---


def test_rates_are_asked_for_as_soon_as_the_autopilot_is_heard(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        await asyncio.sleep(5.0)
        assert rig.asked() == {}
        rig.peer.heartbeat(PX4, 0)
        await asyncio.sleep(0.1)
        assert rig.asked() == pytest.approx(STREAMS)

    fly(body)


def test_what_does_not_flow_is_asked_for_again_and_what_flows_is_not(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        await rig.stream(2.5, position=False)
        assert set(rig.asked()) == set(STREAMS)
        await rig.stream(5.0, position=False)
        assert set(rig.asked()) == {32}
        await rig.stream(2.0)
        rig.asked()
        before = rig.autopilot.counters.interval_requests
        await rig.stream(10.0)
        assert rig.asked() == {}
        assert rig.autopilot.counters.interval_requests == before

    fly(body)


def test_a_reboot_is_noticed_and_all_is_asked_for_again(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        await rig.stream(5.0)
        rig.asked()
        rig.boot_ms = 0
        rig.attitude(1.0, 0.0, 0.0, 0.0)
        await asyncio.sleep(0.1)
        assert set(rig.asked()) == set(STREAMS)
        assert rig.autopilot.counters.reboots == 1

    fly(body)


def test_an_autopilot_that_was_away_is_asked_again(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        await rig.stream(3.0)
        await asyncio.sleep(5.0)
        rig.asked()
        rig.peer.heartbeat(PX4, OFFBOARD)
        await asyncio.sleep(0.1)
        assert set(rig.asked()) == set(STREAMS)

    fly(body)


def test_a_refused_rate_is_said_once(fly: Callable[..., None], caplog: pytest.LogCaptureFixture) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(PX4, OFFBOARD)
        for _ in range(3):
            rig.peer.send(mav.MAVLink_command_ack_message(511, mav.MAV_RESULT_DENIED, 0, 0, 1, 192))
            rig.peer.send(mav.MAVLink_command_ack_message(511, mav.MAV_RESULT_FAILED, 0, 0, 255, 190))
        await asyncio.sleep(0.1)

    fly(body)
    assert [r.getMessage() for r in caplog.records if "refuses" in r.getMessage()] == [
        "the autopilot refuses a message interval (result 2)"
    ]


# --- set-points ---


@pytest.mark.parametrize(("flavour", "kind"), [("px4", PX4), ("ardupilot", ARDUPILOT)])
def test_a_setpoint_goes_out_whole_and_at_once(fly: Callable[..., None], flavour: str, kind: int) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(kind, 0)
        await asyncio.sleep(0.1)
        now = asyncio.get_running_loop().time()
        rig.autopilot.send(SETPOINT, now)
        await asyncio.sleep(0.0003)
        (m,) = rig.peer.all("SET_POSITION_TARGET_LOCAL_NED")
        assert (m.target_system, m.target_component, m.coordinate_frame) == (1, 1, mav.MAV_FRAME_LOCAL_NED)
        # nothing but the yaw rate is ignored: both flight stacks misread partial set-points
        assert m.type_mask == mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
        assert (m.x, m.y, m.z) == pytest.approx(SETPOINT.position_w)
        assert (m.vx, m.vy, m.vz) == pytest.approx(SETPOINT.velocity_w)
        told = SETPOINT if flavour == "px4" else PathFeedforward().shaped(SETPOINT, now)
        assert (m.afx, m.afy, m.afz) == pytest.approx(told.acceleration_w)
        assert m.yaw == pytest.approx(1.5)
        assert m.time_boot_ms == int(now * 1e3)

    fly(body, autopilot=flavour)


def test_ardupilot_is_told_of_a_force_anew_with_every_entry_into_guided(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        async def accelerations(mode: int) -> list[float]:
            rig.peer.heartbeat(ARDUPILOT, mode)
            await asyncio.sleep(0.05)
            before = len(rig.peer.all("SET_POSITION_TARGET_LOCAL_NED"))
            for _ in range(20):
                rig.autopilot.send(SETPOINT, asyncio.get_running_loop().time())
                await asyncio.sleep(0.01)
            return [m.afx for m in rig.peer.all("SET_POSITION_TARGET_LOCAL_NED")[before:]]

        guided = await accelerations(4)
        assert guided[-1] < 0.9 * guided[0], "the path moves on"
        assert set(await accelerations(5)) == {guided[0]}, "while the pilot flies, it stays at its beginning"
        assert (await accelerations(4))[-1] == pytest.approx(guided[-1], abs=0.05), "and begins anew"

    fly(body, autopilot="ardupilot")


@pytest.mark.parametrize(("mode", "armed"), [(5, True), (4, False)], ids=["the pilot had it", "it was disarmed"])
def test_a_force_that_ardupilot_held_is_forgotten_though_nothing_was_sent_meanwhile(
    fly: Callable[..., None], mode: int, armed: bool
) -> None:
    """Set-points stop when the pilot takes over, so the driver has to see by itself that GUIDED begins anew."""
    force = Setpoint((1.0, 2.0, -3.0), (0.0, 0.0, 0.0), (1.5, 0.0, 0.5), 0.0)
    still = Setpoint((1.0, 2.0, -3.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)

    async def body(rig: Rig) -> None:
        async def send(setpoint: Setpoint, seconds: float) -> Any:
            for i in range(round(seconds * 100)):
                if i % 100 == 0:
                    rig.peer.heartbeat(ARDUPILOT, GUIDED)
                    await asyncio.sleep(0.001)
                rig.autopilot.send(setpoint, asyncio.get_running_loop().time())
                await asyncio.sleep(0.009)
            return rig.peer.all("SET_POSITION_TARGET_LOCAL_NED")[-1]

        await send(force, 6.0)
        for _ in range(10):
            rig.peer.heartbeat(ARDUPILOT, mode, armed=armed)
            await asyncio.sleep(1.0)
        told = await send(still, 1.0)
        assert (told.x, told.y, told.z) == pytest.approx(still.position_w)
        assert (told.afx, told.afy, told.afz) == (0.0, 0.0, 0.0)

    fly(body, autopilot="ardupilot")


def test_a_setpoint_for_nobody_is_counted(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.autopilot.send(SETPOINT, 0.0)
        await asyncio.sleep(0.1)
        assert rig.peer.received == []
        assert rig.autopilot.counters.setpoints_unsent == 1

    fly(body)


@pytest.mark.parametrize(
    "bad",
    [
        Setpoint((math.nan, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, 0.0),
        Setpoint((0.0,) * 3, (0.0, math.inf, 0.0), (0.0,) * 3, 0.0),
        Setpoint((0.0,) * 3, (0.0,) * 3, (0.0,) * 3, math.nan),
    ],
)
def test_a_setpoint_that_is_no_number_never_leaves(fly: Callable[..., None], bad: Setpoint) -> None:
    async def body(rig: Rig) -> None:
        rig.peer.heartbeat(PX4, OFFBOARD)
        await asyncio.sleep(0.01)
        with pytest.raises(ProtocolError, match="not finite"):
            rig.autopilot.send(bad, 1.0)
        await asyncio.sleep(0.1)
        assert rig.peer.all("SET_POSITION_TARGET_LOCAL_NED") == []

    fly(body)


def test_thrust_is_told_while_it_is_young_and_is_a_share(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        assert math.isnan(rig.state.thrust)
        await rig.stream(0.1)
        assert rig.state.thrust == 0.5
        for impossible in (math.nan, -0.1, 1.5, math.inf):
            rig.boot_ms += 10
            rig.thrust(impossible)
        await asyncio.sleep(0.01)
        assert rig.state.thrust == 0.5
        assert rig.autopilot.counters.invalid == 4
        await asyncio.sleep(0.5)
        assert math.isnan(rig.state.thrust), "an old share is none"

    fly(body)
