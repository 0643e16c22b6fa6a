"""Whole flights with a gripper, in simulated time: taken from above, carried, set down; nothing there, denied, mute."""

from collections.abc import Callable

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.mission.facts import ArmFault, ArmFlag
from arm_companion.mission.gripper_facts import GripperAction
from arm_companion.protocol.dialect import mav
from arm_companion.record.recorder import Record
from arm_companion.sim.grasp_verdict import GraspVerdict, judge_grasp
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.scenario import Operator
from arm_companion.sim.world import World
from tests.sim.test_grasp_scenarios import in_phase, phases, when_carried

ONCE = ["APPROACH", "REACH", "CONTACT", "CLOSE", "VERIFY", "LIFT", "CARRY", "PLACE", "RELEASE", "DEPART"]
OUTPUT = ("gripper.by=autopilot",)


def fly(
    prepare: Callable[[World], None] = lambda _: None, *settings: str, twice: bool = False
) -> tuple[Result, GraspVerdict]:
    config = load("sim_gripper.toml", settings)
    script = Operator.fly_grasp if twice else Operator.fly_grasp_once
    result = run_simulated(fly_simulated(config, lambda _: None, prepare, fly=script))
    return result, judge_grasp(result.flight, result.failure, config)


def orders(result: Result) -> list[GripperAction]:
    """What the gripper was told, in order."""
    told = [record.commands.gripper for record in result.records]
    return [order.action for i, order in enumerate(told) if order is not None and (i == 0 or told[i - 1] != order)]


def actions_in(records: list[Record]) -> set[GripperAction | None]:
    return {None if r.commands.gripper is None else r.commands.gripper.action for r in records}


@pytest.mark.scenario
def test_a_fifth_servo_takes_an_object_carries_it_and_puts_it_back_twice() -> None:
    result, verdict = fly(twice=True)
    assert verdict.success, verdict.reason
    passed = iter(phases(result))
    assert all(name in passed for name in (*ONCE, *ONCE))
    assert orders(result) == [GripperAction.OPEN, GripperAction.CLOSE, GripperAction.OPEN] * 2
    assert abs(verdict.mass_error) < 0.1
    wrench = {error.span: error for error in verdict.wrench}["carried"]
    assert wrench.force_error_n < 0.2 * wrench.true_force_n
    carried = in_phase(result, "CARRY")
    assert all(record.commands.status.flags & ArmFlag.GRIPPER_CLOSED for record in carried)
    tightest = max(max(s.truth.tension) for s in result.flight.samples)
    assert tightest < load("sim_gripper.toml").limits.tension_max_n


@pytest.mark.scenario
def test_the_autopilots_gripper_does_the_same_by_do_gripper() -> None:
    result, verdict = fly(lambda _: None, *OUTPUT)
    assert verdict.success, verdict.reason
    assert orders(result) == [GripperAction.OPEN, GripperAction.CLOSE, GripperAction.OPEN]
    assert all(record.facts.gripper is not None and record.facts.gripper.jaws is None for record in result.records)
    assert len([record for record in result.records if record.facts.requests]) <= 5, "no order of ours came back to us"


@pytest.mark.scenario
def test_jaws_that_close_on_nothing_let_the_vehicle_go_back() -> None:
    result, verdict = fly(lambda _: None, "grasp.object_position_m=[3.0, 0.5, -1.5]")
    assert "never carried" in verdict.reason
    assert "did not land" not in verdict.reason
    assert phases(result)[4:10] == ["APPROACH", "REACH", "CONTACT", "CLOSE", "UNLOAD", "RELEASE"]
    assert any("the gripper closed on nothing" in text for _, text in result.flight.texts)
    closing = in_phase(result, "CLOSE")
    assert not any(record.commands.status.flags & ArmFlag.GRIPPER_CLOSED for record in closing)


@pytest.mark.scenario
def test_a_denied_do_gripper_keeps_the_vehicle_above_the_object() -> None:
    def deny(world: World) -> None:
        world.autopilot.gripper.result = int(mav.MAV_RESULT_DENIED)

    result, verdict = fly(deny, *OUTPUT)
    assert "never carried" in verdict.reason
    assert "did not land" not in verdict.reason
    assert "CONTACT" not in phases(result)
    assert any("DO_GRIPPER: denied" in text for _, text in result.flight.texts)
    assert any(record.commands.status.error_bits & ArmFault.GRIP_TEST_FAILED for record in in_phase(result, "DEPART"))


@pytest.mark.scenario
def test_a_servo_that_falls_silent_while_it_carries_is_told_and_never_opened() -> None:
    silenced: list[float] = []

    def silence(world: World) -> None:
        world.servos.servos[-1].silenced = True
        silenced.append(world.samples[-1].t)
        world.at(world.plant.time + 6.0, lambda w: setattr(w.servos.servos[-1], "silenced", False))

    result, verdict = fly(lambda world: world.at(30.0, when_carried(silence)))
    dumb = [r for r in result.records if r.facts.gripper and r.facts.gripper.jaws and r.facts.gripper.jaws.silent]
    dumb = [r for r in dumb if r.t > silenced[0]]
    assert {r.state.phase.name for r in dumb} <= {"LIFT", "CARRY"}
    assert actions_in(dumb) == {GripperAction.CLOSE}
    assert all(r.commands.status.error_bits & ArmFault.SERVO_SILENT for r in dumb)
    assert any("gripper: servo does not answer" in text for _, text in result.flight.texts)
    assert verdict.success, verdict.reason
