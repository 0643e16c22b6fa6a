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
from arm_companion.mission.facts import Control, Setpoint, Vec3
from arm_companion.mission.state import MOVES_VEHICLE
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.tunnel import tunnel
from arm_companion.sim import sitl
from arm_companion.sim.flight import WITH, WITHOUT
from arm_companion.sim.flight_control import ZERO
from arm_companion.sim.grasp_verdict import GraspVerdict
from arm_companion.sim.judges import SCENARIOS
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.sitl_check import Check, Findings
from arm_companion.sim.sitl_px4 import HOME
from arm_companion.sim.verdict import Verdict
from tests.sitl.rig import ARM, AUTOPILOT, GUIDED, Rig, fly, gaps_p99

pytestmark = pytest.mark.sitl

NAV_SCRIPT_TIME = 42702  # ArduPilot's own
ARDUPILOT_SCRIPT = Path(__file__).parents[2] / "configs" / "ardupilot" / "arm_companion.lua"


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


def scenario(name: str, file: str, stack: str, directory: Path) -> tuple[Result, Verdict]:
    """A whole flight, and the verdict on it."""
    config, script = load(file, [f'vehicle.autopilot="{stack}"']), SCENARIOS[name]
    log = directory / "record.mcap"
    with sitl.running(stack, sitl.binary(stack, None), config, directory / "log", simulated=True) as running:
        result = run_simulated(fly_simulated(config, print, log=log, fly=script.fly, flown_by=running))
    return result, script.judge(result.flight, result.failure, config)


def test_a_perch_from_take_off_to_landing_with_and_without_compensation(stack: str, tmp_path: Path) -> None:
    result, verdict = scenario("perch", "sim.toml", stack, tmp_path)
    error = {move.name: move.error_m for move in verdict.moves}
    print(json.dumps({"stack": stack, **error, "excursion_m": verdict.excursion_m}))
    assert verdict.success, verdict.reason
    assert error["pull x"] <= 0.5 * error["pull x, not compensated"]
    assert verdict.excursion_m < 0.3
    held = [(start, end) for name, start, end in result.flight.spans() if name not in ("STARTUP", "STOWED", "READYING")]
    flown = [r for r in result.records if held[0][0] <= r.t <= held[-1][1] and r.state.phase in MOVES_VEHICLE]
    assert all(r.facts.vehicle.control is Control.EXTERNAL for r in flown), "external control is lost"
    assert gaps_p99([r.t for r in flown if r.commands.setpoint is not None]) < 0.03


def test_an_object_is_picked_up_weighed_carried_and_put_back(stack: str, tmp_path: Path) -> None:
    _, verdict = scenario("grasp", "sim_grasp.toml", stack, tmp_path)
    assert isinstance(verdict, GraspVerdict)
    error = {pick_up.name: pick_up.error_m for pick_up in verdict.pick_ups}
    print(json.dumps({"stack": stack, **error, "weighed_kg": verdict.weighed_kg, "placed_m": verdict.placed_m}))
    assert verdict.success, verdict.reason
    assert error[WITH] <= 0.6 * error[WITHOUT]
    assert abs(verdict.weighed_kg - verdict.mass_kg) < 3.0 * verdict.weighed_sigma_kg


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
    # PX4 takes it for a height over the sea, and has a default of its own
    height = rig.config.sim.takeoff_height_m if rig.stack == "ardupilot" else math.nan
    where = (math.nan, math.nan, math.nan, height)
    assert await rig.order(mav.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, *where) == mav.MAV_RESULT_ACCEPTED


async def land(rig: Rig) -> None:
    nan = math.nan
    await rig.order(mav.MAV_CMD_NAV_LAND, 0.0, 0.0, 0.0, nan, nan, nan, 0.0)
    await rig.until(lambda: not _armed(rig), 60.0, "it does not land")


def test_traffic_to_the_ground_passes_the_autopilot_all_three_ways(stack: str, tmp_path: Path) -> None:
    heard: dict[str, int] = {}
    values: dict[str, float] = {}

    async def look(rig: Rig) -> None:
        def count(message: Any) -> None:
            if (message.get_srcSystem(), message.get_srcComponent()) == ARM:
                heard[message.get_type()] = heard.get(message.get_type(), 0) + 1
                if message.get_type() == "PARAM_VALUE":
                    values[message.param_id] = message.param_value

        rig.ground.watch(count)
        await rig.until(lambda: rig.ground.latest("HEARTBEAT", ARM) is not None, 60.0, "the arm is not heard")
        await asyncio.sleep(5.0)
        # commands and their answers
        assert await rig.order(mav.MAV_CMD_REQUEST_MESSAGE, 396.0, target=ARM) == mav.MAV_RESULT_ACCEPTED
        # parameters, there and back
        rig.ground.send(mav.MAVLink_param_request_list_message(*ARM), ARM)
        await rig.until(lambda: heard.get("PARAM_VALUE", 0) > 5, 10.0, "no parameters")
        number = mav.MAV_PARAM_TYPE_REAL32
        rig.ground.send(mav.MAVLink_param_set_message(*ARM, b"RATE_MIRRORS", 2.5, number), ARM)
        await rig.until(lambda: values.get("RATE_MIRRORS") == 2.5, 10.0, "a parameter cannot be set")
        # a target, as a frame of the dialect inside TUNNEL, to the arm
        axis, nan = (0.0, 1.0, 0.0), math.nan
        bar = mav.MAVLink_arm_target_message(*ARM, 0, 0, 1, (4.0, 1.0, -2.5), axis, [nan] * 4, 0.04, [nan] * 6, nan)
        rig.ground.send(tunnel(MavlinkCodec(255, 190).encode(bar), *ARM), ARM)
        await rig.until(lambda: (4.0, 1.0, -2.5) in targets(rig), 5.0, "no target arrives inside TUNNEL")
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


def targets(rig: Rig) -> set[Vec3]:
    """Where the daemon has been told that the bar is."""
    return {record.facts.bar.point_w for record in rig.recorder.records[-500:] if record.facts.bar is not None}


def test_an_item_of_the_autopilots_mission_commands_the_arm(stack: str, tmp_path: Path) -> None:
    """PX4 passes its gripper's item on; ArduPilot's script orders READY and holds the mission until that is done."""

    async def look(rig: Rig) -> None:
        await rig.until(lambda: rig.ground.latest("HEARTBEAT", ARM) is not None, 60.0, "the arm is not heard")
        await rig.until(lambda: _phase(rig) == "STOWED", 30.0, "the arm does not find itself stowed")
        item = (mav.MAV_CMD_DO_GRIPPER, float(ARM[1]), 1.0)
        if stack == "ardupilot":
            item = (NAV_SCRIPT_TIME, 1.0, 100.0)
        await rig.arm_when_ready()
        await climb(rig)
        await rig.until(lambda: rig.height() > 0.8 * rig.config.sim.takeoff_height_m, 40.0, "it does not climb")
        await asyncio.sleep(4.0)
        await upload(rig, (mav.MAV_CMD_NAV_WAYPOINT, 0.0, 0.0), item, (mav.MAV_CMD_NAV_LOITER_UNLIM, 0.0, 0.0))
        auto = (3.0, 0.0) if stack == "ardupilot" else (4.0, 4.0)
        assert await rig.order(mav.MAV_CMD_DO_SET_MODE, 1.0, *auto) == mav.MAV_RESULT_ACCEPTED
        if stack == "ardupilot":
            await rig.until(lambda: _phase(rig) == "READY", 120.0, "the script's order does not arrive")
            await rig.until(lambda: _reached(rig) >= 3, 60.0, "the script does not end its item")
        else:
            await rig.until(lambda: any(ours(rig, mav.MAV_CMD_DO_GRIPPER)), 30.0, "the arm does not answer the item")
            # it is stowed: an order to grab cannot be carried out, and the mission goes on
            assert any("PERCH" in text.text for text in rig.ground.texts if text.source == ARM)
        await land(rig)

    scripts = [ARDUPILOT_SCRIPT] if stack == "ardupilot" else []
    fly(stack, tmp_path / "log", look, scripts=scripts)


def ours(rig: Rig, command: int) -> list[Any]:
    """What the arm has answered to the autopilot's own commands."""
    acks = [m for _, m in rig.companion.heard if m.get_type() == "COMMAND_ACK" and m.command == command]
    return [m for m in acks if (m.get_srcSystem(), m.get_srcComponent()) == ARM]


def _reached(rig: Rig) -> int:
    current = rig.ground.latest("MISSION_CURRENT")
    return -1 if current is None else int(current.seq)


async def upload(rig: Rig, *items: tuple[int, float, float]) -> None:
    """A mission over its own start; of each item the command and its first two parameters.

    ArduPilot keeps the place of its home in item 0.
    """
    await rig.order(mav.MAV_CMD_SET_MESSAGE_INTERVAL, float(mav.MAVLINK_MSG_ID_MISSION_CURRENT), 200_000.0)
    latitude, longitude, _ = HOME
    whole = [(mav.MAV_CMD_NAV_WAYPOINT, 0.0, 0.0), *items] if rig.stack == "ardupilot" else list(items)
    asked: list[int] = []
    ended: list[int] = []

    def see(message: Any) -> None:
        if message.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
            asked.append(message.seq)
            command, first, second = whole[message.seq]
            where = (round(latitude * 1e7), round(longitude * 1e7), rig.config.sim.takeoff_height_m)
            goes = command in (mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_CMD_NAV_LOITER_UNLIM)
            frame = mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT if goes else mav.MAV_FRAME_MISSION
            numbers = (first, second, 0.0, math.nan if command != NAV_SCRIPT_TIME else 0.0)
            one = mav.MAVLink_mission_item_int_message(
                *AUTOPILOT, message.seq, frame, command, 0, 1, *numbers, *where, mav.MAV_MISSION_TYPE_MISSION
            )
            rig.ground.send(one)
        elif message.get_type() == "MISSION_ACK":
            ended.append(message.type)

    rig.ground.watch(see)
    rig.ground.send(mav.MAVLink_mission_count_message(*AUTOPILOT, len(whole), mav.MAV_MISSION_TYPE_MISSION))
    await rig.until(lambda: bool(ended), 10.0, f"the mission is not taken: {asked}")
    assert ended[0] == mav.MAV_MISSION_ACCEPTED
    await asyncio.sleep(3.0)  # PX4 looks through it before it may be flown


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
        if stack == "px4":  # ArduPilot holds by itself, and is sent none while the arm is only ready
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
        if stack == "px4":
            return figures  # its SITL denies PREFLIGHT_REBOOT_SHUTDOWN
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
    assert figures.get("setpoint_gap_p99_s", 0.0) < 0.03


def _phase(rig: Rig) -> str:
    return rig.recorder.records[-1].state.phase.name if rig.recorder.records else ""


def _armed(rig: Rig) -> bool:
    heartbeat = rig.ground.latest("HEARTBEAT")
    return heartbeat is not None and bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
