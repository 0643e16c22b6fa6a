"""A servo fails while the arm holds the bar: through HOLDING to the ground, and up to another perch."""

import asyncio
import math
from itertools import pairwise
from pathlib import Path

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.mission.state import Phase
from arm_companion.protocol import control_table as ct
from arm_companion.protocol.control_table import HardwareError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.runner import fly_simulated
from arm_companion.sim.scenario import Operator, ScenarioFailed
from arm_companion.sim.world import World
from tests.sim.on_the_ground import OnTheGround

CONFIG = load("sim.toml")
OUTER = 2
"""Index of the servo whose tendon is let out around the bar, by a turn and a half."""
_HELD_S = 2.0
_OFF_S = 3.0
_BOOTED_S = 1.0
_TAUT_S = 1.0


async def _clear_errors(operator: Operator) -> None:
    await operator.order(mav.MAV_CMD_ARM_CLEAR_ERRORS, "CLEAR_ERRORS", 10.0)


async def _land(operator: Operator) -> None:
    nan = math.nan
    await operator._vehicle(mav.MAV_CMD_NAV_LAND, [0, 0, 0, nan, nan, nan, 0], "landing")
    with pytest.raises(ScenarioFailed, match=r"the vehicle is armed: .* land, disarm, then CLEAR_ERRORS"):
        await _clear_errors(operator)
    await operator.wait(lambda: not operator._armed(), 60.0, "the vehicle does not land and disarm")


@pytest.mark.scenario
def test_a_servo_that_fails_on_the_bar_is_power_cycled_on_the_ground_and_the_arm_perches_again() -> None:
    """Its tendon hangs slack beside the straight arm; where it stood before the loss of power tells by how much."""
    worlds: list[World] = []

    async def story(operator: Operator) -> str:
        servos = worlds[0].servos
        await operator._prepare()
        await operator._take_off()
        await operator.perch()
        await asyncio.sleep(_HELD_S)
        servos.servos[OUTER].trip(HardwareError.OVERLOAD)
        await asyncio.sleep(_HELD_S)
        with pytest.raises(ScenarioFailed):
            await operator.release()
        await _land(operator)
        servos.set_power(on=False)
        await asyncio.sleep(_OFF_S)
        with pytest.raises(ScenarioFailed, match=r"READY is not possible in state HOLDING: .* CLEAR_ERRORS"):
            await operator.ready()
        servos.set_power(on=True)
        await asyncio.sleep(_BOOTED_S)
        await _clear_errors(operator)
        await operator.ready()
        await asyncio.sleep(_TAUT_S)
        assert min(worlds[0].plant.tensions()) > CONFIG.limits.tension_min_n, "a turn nearer to its zero it hangs slack"
        await operator.order(mav.MAV_CMD_ARM_STOW, "STOW", 20.0)
        await operator.wait(lambda: operator.state == "STOWED", 1.0, "the arm is not stowed")
        return await operator.fly(operator.perch, operator.release)

    result = run_simulated(fly_simulated(CONFIG, lambda _: None, worlds.append, fly=story))
    assert result.failure == ""
    phases = [record.state.phase for record in result.records]
    entered = [after for before, after in pairwise(phases) if before is not after]
    first, second = (i for i, phase in enumerate(entered) if phase is Phase.PERCHED)
    assert entered[first : first + 7] == [
        Phase.PERCHED,
        Phase.UNLOAD,
        Phase.RELEASE,
        Phase.DEPART,
        Phase.STOWING,
        Phase.HOLDING,
        Phase.STOWED,
    ]
    assert Phase.HOLDING not in entered[second:]
    perched = [r for r in result.records if r.state.phase is Phase.PERCHED]
    held = result.flight.within(perched[-1].t - 1.0, perched[-1].t)
    assert min(sample.truth.contact_force_n for sample in held) > 1.0
    assert max(max(sample.truth.tension) for sample in result.flight.samples) < CONFIG.limits.tension_max_n


def test_a_vehicle_that_came_down_on_its_bent_arm_gets_ready_again_without_a_restart(tmp_path: Path) -> None:
    """A daemon that finds an arm above bent under torque takes the vehicle to hang by it, on the ground too."""
    rig = OnTheGround(tmp_path, "mount.rpy_deg=[180.0, 0.0, 0.0]", "limits.keep_out.half_angle_deg=0.0")
    for servo, bent in zip(rig.arm.servos.servos, (1500.0, 0.0, -1500.0, 0.0), strict=True):
        servo.motor.position += bent
        servo._hold()
        servo.poke(ct.TORQUE_ENABLE, 1)

    async def script() -> None:
        assert rig.state == "HANG_HOLD"
        assert await rig.order(command=mav.MAV_CMD_ARM_RELEASE) == mav.MAV_RESULT_TEMPORARILY_REJECTED
        assert "on the ground take the servos' power away, then CLEAR_ERRORS" in rig.text
        assert await rig.order(command=mav.MAV_CMD_ARM_CLEAR_ERRORS) == mav.MAV_RESULT_TEMPORARILY_REJECTED
        assert "tendon 1 holds, or may hold: on the ground take the servos' power away" in rig.text
        assert rig.torque == [1] * 4
        rig.arm.servos.set_power(on=False)
        await asyncio.sleep(_OFF_S)
        assert await rig.order(command=mav.MAV_CMD_ARM_CLEAR_ERRORS) == mav.MAV_RESULT_TEMPORARILY_REJECTED
        assert "does not answer: see to the power and the cable" in rig.text
        rig.arm.servos.set_power(on=True)
        await asyncio.sleep(_BOOTED_S)
        assert await rig.order(command=mav.MAV_CMD_ARM_CLEAR_ERRORS) == mav.MAV_RESULT_ACCEPTED
        assert rig.torque == [0] * 4, "nothing moves until told"
        assert await rig.order(command=mav.MAV_CMD_ARM_READY) == mav.MAV_RESULT_ACCEPTED
        await rig.until(lambda: rig.state == "READY", 5.0)

    assert rig.run(script).failures == 0
