"""What the design says of real flight stacks, seen on them: rates, set-points, modes, loss, boot, traffic, a perch."""

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import run_simulated, ticks
from arm_companion.config import load
from arm_companion.drivers.path_feedforward import PathFeedforward
from arm_companion.mission.facts import Setpoint, Vec3
from arm_companion.protocol.dialect import mav
from arm_companion.sim import sitl
from arm_companion.sim.flight_control import ZERO
from arm_companion.sim.runner import fly_simulated
from arm_companion.sim.sitl_check import Check, Findings
from arm_companion.sim.verdict import judge
from tests.sitl.rig import ARM, AUTOPILOT, GUIDED, Rig, fly, gaps_p99

pytestmark = pytest.mark.sitl


def test_it_connects_tells_its_state_and_flies_set_points(stack: str, tmp_path: Path) -> None:
    async def look(rig: Rig) -> Findings:
        check = Check(rig.ground, stack, print)
        await check.listen()
        await check.fly()
        return check.findings

    found = fly(stack, tmp_path / "log", look, daemon=False)
    print(json.dumps({"stack": stack, **found.__dict__}))
    for name, rate in found.rates_hz.items():
        assert rate > 45.0, name
        assert found.gap_p99_s[name] < 0.05, name
    assert found.ack_s < 0.05
    by_position, with_velocity, with_acceleration = found.circle_rms_m.values()
    assert with_velocity < 0.9 * by_position, "a velocity is flown"
    assert with_acceleration < 0.75 * with_velocity, "an acceleration is flown, not ignored"
    assert found.after_loss is not None
    mode, drift = found.after_loss
    if stack == "ardupilot":
        assert mode == GUIDED, "it brakes after GUID_TIMEOUT and stays in GUIDED"
        assert 3.0 < drift < 20.0, "until then it flies on with the last velocity and acceleration"
    else:
        assert (mode >> 16) & 0xFF != 6, "it leaves OFFBOARD by COM_OBL_RC_ACT"


def test_a_perch_from_take_off_to_landing(stack: str, tmp_path: Path) -> None:
    config = load("sim.toml", [f'vehicle.autopilot="{stack}"'])
    with sitl.running(stack, sitl.binary(stack, None), config, tmp_path / "log", simulated=True) as running:
        result = run_simulated(fly_simulated(config, print, log=tmp_path / "record.mcap", flown_by=running))
    verdict = judge(result.flight, result.failure)
    assert verdict.success, verdict.reason


def test_a_force_on_the_vehicle_is_held_against(stack: str, tmp_path: Path) -> None:
    """2 N on the plant; set-points without a word of it, with it as an acceleration, and as the daemon tells it."""
    push = 2.0

    async def look(rig: Rig) -> dict[str, dict[str, float]]:
        await take_off(rig)
        lean = (-push / rig.config.vehicle.mass_kg, 0.0, 0.0)
        own = PathFeedforward().shaped if stack == "ardupilot" else as_it_is
        found = {}
        for name, wanted, shape in (("none", ZERO, as_it_is), ("acceleration", lean, as_it_is), ("daemon", lean, own)):
            found[name] = await pushed(rig, push, wanted, shape)
        await land(rig)
        return found

    found = fly(stack, tmp_path / "log", look, daemon=False)
    print(json.dumps({"stack": stack, "push_n": push, **found}))
    assert found["daemon"]["most_m"] < 0.5 * found["none"]["most_m"]
    assert found["daemon"]["end_m"] < 0.1
    if stack == "ardupilot":
        assert found["acceleration"]["end_m"] > 0.3, "it takes an acceleration for a path: docs/adr/0025"


def as_it_is(setpoint: Setpoint, _now: float) -> Setpoint:
    return setpoint


async def pushed(
    rig: Rig, push: float, lean: Vec3, shape: Callable[[Setpoint, float], Setpoint], seconds: float = 10.0
) -> dict[str, float]:
    """How far the vehicle is from where it was while it is pushed north; it is let go and waited for after that."""
    place = rig.ground.latest("LOCAL_POSITION_NED")
    hold = (place.x, place.y, place.z)  # type: ignore[union-attr]  # it flies
    x0 = rig.world.plant.state().position_w[0]
    away = []
    async for i, now in clockwork(rig, seconds):
        share = min(i * 0.01 / 0.3, 1.0)
        rig.world.plant.push((push * share, 0.0, 0.0))
        wanted: Vec3 = (lean[0] * share, lean[1] * share, lean[2] * share)
        send(rig, shape(Setpoint(hold, ZERO, wanted, 0.0), now))
        away.append(rig.world.plant.state().position_w[0] - x0)
    rig.world.plant.push(ZERO)
    async for _, now in clockwork(rig, 12.0):
        send(rig, shape(Setpoint(hold, ZERO, ZERO, 0.0), now))
    return {"most_m": max(map(abs, away)), "end_m": abs(away[-1])}


async def clockwork(rig: Rig, seconds: float) -> AsyncIterator[tuple[int, float]]:
    """Number and time of the daemon's cycles."""
    i = 0
    async for tick in ticks(1.0 / rig.config.vehicle.state_rate_hz):
        if i * 0.01 >= seconds:
            return
        yield i, tick.now
        i += 1


def send(rig: Rig, setpoint: Setpoint) -> None:
    numbers = (*setpoint.position_w, *setpoint.velocity_w, *setpoint.acceleration_w, setpoint.yaw, 0.0)
    mask = mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    rig.ground.send(mav.MAVLink_set_position_target_local_ned_message(0, *AUTOPILOT, 1, mask, *numbers))


async def take_off(rig: Rig) -> None:
    """In the air, under external control, with a stream of set-points behind it."""
    await rig.until(lambda: rig.ground.latest("HEARTBEAT") is not None, 60.0, "no heartbeat")
    interval = [float(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED), 20_000.0]
    await rig.order(mav.MAV_CMD_SET_MESSAGE_INTERVAL, *interval)
    await rig.arm_when_ready()
    await climb(rig)
    await rig.until(lambda: rig.height() > 0.8 * rig.config.sim.takeoff_height_m, 40.0, "it does not climb")
    await asyncio.sleep(5.0)
    place = rig.ground.latest("LOCAL_POSITION_NED")
    hold = (place.x, place.y, place.z)  # type: ignore[union-attr]  # it flies
    async for i, _ in clockwork(rig, 8.0):
        send(rig, Setpoint(hold, ZERO, ZERO, 0.0))
        if i == 150 and rig.stack == "px4":
            mode = mav.MAVLink_command_long_message(*AUTOPILOT, mav.MAV_CMD_DO_SET_MODE, 0, 1.0, 6.0, *[0.0] * 5)
            rig.ground.send(mode)
    assert rig.external()


async def climb(rig: Rig) -> None:
    """ArduPilot is put into GUIDED when it is armed: before, its radio's switch has the last word."""
    if rig.stack == "ardupilot":
        assert await rig.order(mav.MAV_CMD_DO_SET_MODE, 1.0, float(GUIDED)) == mav.MAV_RESULT_ACCEPTED
    height = rig.config.sim.takeoff_height_m
    where = (math.nan, math.nan, math.nan, height)
    assert await rig.order(mav.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, *where) == mav.MAV_RESULT_ACCEPTED


async def land(rig: Rig) -> None:
    nan = math.nan
    await rig.order(mav.MAV_CMD_NAV_LAND, 0.0, 0.0, 0.0, nan, nan, nan, 0.0)
    await rig.until(lambda: not _armed(rig), 60.0, "it does not land")


def test_traffic_to_the_ground_passes_the_autopilot_all_three_ways(stack: str, tmp_path: Path) -> None:
    heard: dict[str, int] = {}

    async def look(rig: Rig) -> None:
        def count(message: Any) -> None:
            if (message.get_srcSystem(), message.get_srcComponent()) == ARM:
                heard[message.get_type()] = heard.get(message.get_type(), 0) + 1

        rig.ground.watch(count)
        await rig.until(lambda: rig.ground.latest("HEARTBEAT", ARM) is not None, 60.0, "the arm is not heard")
        await asyncio.sleep(5.0)
        # commands and their answers
        assert await rig.order(mav.MAV_CMD_REQUEST_MESSAGE, 396.0, target=ARM) == mav.MAV_RESULT_ACCEPTED
        # parameters, there and back
        rig.ground.send(mav.MAVLink_param_request_list_message(*ARM), ARM)
        await rig.until(lambda: heard.get("PARAM_VALUE", 0) > 5, 10.0, "no parameters")
        # and the autopilot's own are its own
        rig.ground.send(
            mav.MAVLink_param_request_read_message(*AUTOPILOT, b"MAV_SYS_ID" if stack == "px4" else b"FRAME_CLASS", -1)
        )
        await rig.until(
            lambda: rig.ground.latest("PARAM_VALUE", AUTOPILOT) is not None, 10.0, "no parameter of its own"
        )
        await rig.until(
            lambda: rig.ground.latest("COMPONENT_INFORMATION_BASIC", ARM) is not None or stack == "ardupilot",
            5.0,
            "not forwarded",
        )

    fly(stack, tmp_path / "log", look)
    print(json.dumps({"stack": stack, "heard": heard}))
    assert heard["TUNNEL"] > 20, "the dialect, inside TUNNEL"
    assert heard["NAMED_VALUE_FLOAT"] > 20, "the mirrors"
    assert not any(name.startswith("ARM_") for name in heard), "private ids pass no stock autopilot"


def test_external_control_stays_until_the_pilot_takes_it_or_the_autopilot_boots(stack: str, tmp_path: Path) -> None:
    async def look(rig: Rig) -> dict[str, float]:
        figures: dict[str, float] = {}
        loop = asyncio.get_running_loop()
        await rig.until(lambda: rig.ground.latest("HEARTBEAT", ARM) is not None, 60.0, "the arm is not heard")
        await rig.until(lambda: _phase(rig) == "STOWED", 30.0, "the arm does not find itself stowed")
        assert await rig.order(mav.MAV_CMD_ARM_READY, target=ARM) == mav.MAV_RESULT_ACCEPTED
        figures["ready_s"] = await rig.arm_when_ready()
        await climb(rig)
        await rig.until(lambda: rig.height() > 0.8 * rig.config.sim.takeoff_height_m, 40.0, "it does not climb")
        await asyncio.sleep(4.0)
        if stack == "px4":
            await rig.order(mav.MAV_CMD_DO_SET_MODE, 1.0, 6.0)
            await rig.until(rig.external, 5.0, "OFFBOARD is not taken")
        since = loop.time()
        await asyncio.sleep(10.0)
        assert rig.external(), "lost by our own doing"
        setpoints = rig.companion.times("SET_POSITION_TARGET_LOCAL_NED", ARM, since)
        figures["setpoint_hz"] = len(setpoints) / 10.0
        figures["setpoint_gap_p99_s"] = gaps_p99(setpoints)
        # the pilot
        pilot = 5.0 if stack == "ardupilot" else 3.0  # LOITER; POSCTL
        await rig.order(
            mav.MAV_CMD_DO_SET_MODE, 1.0, pilot if stack == "ardupilot" else 4.0, 0.0 if stack == "ardupilot" else 3.0
        )
        await rig.until(lambda: not rig.external(), 5.0, "the pilot does not get it")
        await asyncio.sleep(5.0)
        assert not rig.external(), "the daemon takes control back from the pilot"
        await land(rig)
        # the autopilot boots again
        before = len(rig.companion.times("HEARTBEAT", AUTOPILOT))
        assert await rig.order(mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0) == mav.MAV_RESULT_ACCEPTED
        await asyncio.sleep(15.0)
        assert len(rig.companion.times("HEARTBEAT", AUTOPILOT)) > before, "it does not come back"
        await rig.until(lambda: rig.ground.age("HEARTBEAT", ARM) < 3.0, 30.0, "the arm is not heard behind it again")
        positions = len(rig.companion.times("LOCAL_POSITION_NED", AUTOPILOT))
        await rig.until(
            lambda: len(rig.companion.times("LOCAL_POSITION_NED", AUTOPILOT)) > positions + 200,
            90.0,
            "the daemon does not ask again for what it needs",
        )
        return figures

    figures = fly(stack, tmp_path / "log", look)
    print(json.dumps({"stack": stack, **figures}))
    assert figures["setpoint_gap_p99_s"] < 0.03


def _phase(rig: Rig) -> str:
    return rig.recorder.records[-1].state.phase.name if rig.recorder.records else ""


def _armed(rig: Rig) -> bool:
    heartbeat = rig.ground.latest("HEARTBEAT")
    return heartbeat is not None and bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
