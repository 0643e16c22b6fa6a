"""What the design says of real flight stacks, seen on them: rates, set-points, modes, loss, boot, traffic, a perch."""

import asyncio
import json
import math
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.protocol.dialect import mav
from arm_companion.sim import sitl
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
        assert drift < 4.0
    else:
        assert (mode >> 16) & 0xFF != 6, "it leaves OFFBOARD by COM_OBL_RC_ACT"


def test_a_perch_from_take_off_to_landing(stack: str, tmp_path: Path) -> None:
    config = load("sim.toml", [f'vehicle.autopilot="{stack}"'])
    with sitl.running(stack, sitl.binary(stack, None), config, tmp_path / "log", simulated=True) as running:
        result = run_simulated(fly_simulated(config, print, log=tmp_path / "record.mcap", flown_by=running))
    verdict = judge(result.flight, result.failure)
    assert verdict.success, verdict.reason


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
        if stack == "ardupilot":
            await rig.order(mav.MAV_CMD_DO_SET_MODE, 1.0, float(GUIDED))
        figures["ready_s"] = await rig.arm_when_ready()
        nan = math.nan
        await rig.order(mav.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, nan, nan, nan, rig.config.sim.takeoff_height_m)
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
        await rig.order(mav.MAV_CMD_NAV_LAND, 0.0, 0.0, 0.0, nan, nan, nan, 0.0)
        await rig.until(lambda: not _armed(rig), 60.0, "it does not land")
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
