"""Jogging: what is followed, what is refused, and that a stream which ends leaves the arm where it is."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.mission.facts import ArmSetpoint, Facts, Order, Request, Result, SetpointKind
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase, State
from tests.unit.mission_rig import run

Hovering = Callable[..., Facts]
NOWHERE = (math.nan, math.nan, math.nan)


def streaming(facts: Facts, theta: float, delta: float = 0.0) -> Facts:
    return dataclasses.replace(
        facts, arm_setpoint=ArmSetpoint(SetpointKind.BEND, theta, delta, NOWHERE, age_s=0.0, timeout_s=0.5)
    )


def tip(facts: Facts, x: float, y: float, z: float) -> Facts:
    return dataclasses.replace(
        facts, arm_setpoint=ArmSetpoint(SetpointKind.TIP, math.nan, math.nan, (x, y, z), age_s=0.0, timeout_s=0.5)
    )


def ready(**memory: object) -> State:
    return dataclasses.replace(State(), phase=Phase.READY, since=99.0, t=100.0, streaming=True, **memory)  # type: ignore[arg-type]


def test_a_ready_arm_follows_a_stream_at_its_own_speed(parameters: Parameters, hovering: Hovering) -> None:
    facts = streaming(hovering(), 0.6, math.pi / 2)
    state, said = run(ready(), facts, parameters, 0.2)
    speed = parameters.config.perch.bend_speed_rad_per_s
    assert math.hypot(*state.bend) == pytest.approx(0.2 * speed)
    state, said = run(state, facts, parameters, 1.0)
    assert state.bend == pytest.approx((0.0, 0.6), abs=1e-9)
    assert said[-1].pulls is not None


def test_a_stream_that_ends_leaves_the_arm_where_it_is(parameters: Parameters, hovering: Hovering) -> None:
    state, _ = run(ready(), streaming(hovering(), 1.0), parameters, 0.3)
    before = state.bend
    assert 0.0 < before[0] < 1.0
    state, _ = run(state, hovering(), parameters, 1.0)
    assert state.bend == pytest.approx(before, abs=0.02)


def test_a_single_jog_goes_on_without_a_stream(parameters: Parameters, hovering: Hovering) -> None:
    facts = dataclasses.replace(hovering(), requests=(Request(1, Order.JOG, (1.0, 0.5, 0.0)),))
    state, _ = run(ready(), facts, parameters, 1.5)
    assert state.bend == pytest.approx((0.5, 0.0))


@pytest.mark.parametrize("phase", [Phase.STOWED, Phase.PERCHED, Phase.APPROACH, Phase.HOLDING])
def test_no_other_state_follows_a_stream(parameters: Parameters, hovering: Hovering, phase: Phase) -> None:
    still = dataclasses.replace(ready(), phase=phase)
    state, _ = run(still, streaming(hovering(), 1.0), parameters, 0.1)
    assert state.bend_goal == (0.0, 0.0)
    assert not state.streamed


def test_what_is_out_of_reach_is_ignored_and_told_once(parameters: Parameters, hovering: Hovering) -> None:
    too_far = parameters.config.limits.bend_max_rad + 0.1
    state, said = run(ready(), streaming(hovering(), too_far), parameters, 0.5)
    texts = [notice.text for commands in said for notice in commands.notices]
    assert state.bend == (0.0, 0.0)
    assert sum("set-point ignored" in text for text in texts) == 1


def test_a_streamed_tip_is_reached_by_the_bend_of_its_arc(parameters: Parameters, hovering: Hovering) -> None:
    length, theta = parameters.config.arm.length_m, 0.8
    x, z = length * (1 - math.cos(theta)) / theta, length * math.sin(theta) / theta
    state, _ = run(ready(), tip(hovering(), x, 0.0, z), parameters, 1.5)
    assert state.bend == pytest.approx((theta, 0.0), abs=1e-3)
    state, said = run(ready(), tip(hovering(), 0.0, 0.0, 2.0 * length), parameters, 0.1)
    assert state.bend == (0.0, 0.0)
    assert any("out of reach" in notice.text for commands in said for notice in commands.notices)


def test_a_jog_to_a_tip_out_of_reach_is_rejected(parameters: Parameters, hovering: Hovering) -> None:
    facts = dataclasses.replace(hovering(), requests=(Request(1, Order.JOG, (2.0, 0.0, 0.0, 5.0)),))
    _, said = run(ready(), facts, parameters)
    (answer,) = said[0].answers
    assert answer.result is Result.TEMPORARILY_REJECTED
    assert "out of reach" in answer.reason
