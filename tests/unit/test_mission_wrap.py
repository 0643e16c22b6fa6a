"""How a wrap is closed: no farther than tension allows, no faster than servos and vehicle follow."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.mission.facts import Facts
from arm_companion.mission.motion import Reference, add
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase, State
from tests.unit.mission_rig import PLACE, changed, memory, run, tendon, vehicle

Hovering = Callable[..., Facts]


def bending(phase: Phase, bend: float, goal: float, **fields: object) -> State:
    return memory(phase, bend=(bend, 0.0), bend_goal=(goal, 0.0), **fields)


def test_a_wrap_that_is_tight_before_its_full_bend_ends_there_and_is_tested(
    parameters: Parameters, hovering: Hovering
) -> None:
    facts = hovering((4.0, 0.0))
    moving = [tendon(0, tension=40.0, speed=0.01)]
    state, _ = run(
        bending(Phase.WRAP, 4.0, 4.9, tension=(40.0, 4.0, 1.0, 4.0)), changed(facts, moving), parameters, 0.05
    )
    assert math.hypot(*state.bend) == pytest.approx(4.0, abs=0.02)
    assert state.phase is Phase.VERIFY


@pytest.mark.parametrize("tension", [10.0, 30.0])
def test_a_wrap_that_is_not_tight_goes_on(parameters: Parameters, hovering: Hovering, tension: float) -> None:
    facts = hovering((3.0, 0.0))
    begun = bending(Phase.WRAP, 3.0, 4.9, tension=(tension, 4.0, 1.0, 4.0))
    place = run(begun, facts, parameters)[0].reference
    assert place is not None
    state, _ = run(begun, changed(facts, [vehicle(position_w=place.position)]), parameters, 0.1)
    assert math.hypot(*state.bend) == pytest.approx(3.1, abs=0.02)


def test_a_full_wrap_that_is_loose_bends_on_to_the_limit_and_no_farther(
    parameters: Parameters, hovering: Hovering
) -> None:
    full, limit = parameters.config.perch.wrap_bend_rad, parameters.config.limits.bend_max_rad
    state, facts = bending(Phase.WRAP, full, full, tension=(15.0, 4.0, 1.0, 4.0)), hovering((full, 0.0))
    for _ in range(150):
        facts = hovering((math.hypot(*state.bend), 0.0))
        state, _said = run(state, facts, parameters)
        assert state.phase is Phase.WRAP
        assert full - 1e-9 <= math.hypot(*state.bend) <= limit + 1e-9
    assert math.hypot(*state.bend) == pytest.approx(limit)
    state, _said = run(dataclasses.replace(state, since=state.t - 20.0), facts, parameters)
    assert state.phase is Phase.UNLOAD


def test_what_a_grip_needs_beyond_the_full_wrap_is_more_by_what_a_free_arm_gains(
    parameters: Parameters, hovering: Hovering
) -> None:
    limit, perch = parameters.config.limits.bend_max_rad, parameters.config.perch
    arm = parameters.model.parameters
    free_arm_gains = (limit - perch.wrap_bend_rad) * arm.EI / (arm.r * arm.L)
    assert free_arm_gains > 1.0
    tension = perch.grip_tension_n + free_arm_gains
    facts = hovering((limit, 0.0))
    state, _ = run(bending(Phase.WRAP, limit, limit, tension=(tension - 0.1, 4.0, 1.0, 4.0)), facts, parameters)
    assert state.phase is Phase.WRAP
    state, _ = run(bending(Phase.WRAP, limit, limit, tension=(tension + 0.1, 4.0, 1.0, 4.0)), facts, parameters)
    assert state.phase is Phase.VERIFY


@pytest.mark.parametrize("phase", [Phase.WRAP, Phase.RELEASE])
def test_the_curl_waits_for_servos_that_turn_late(parameters: Parameters, hovering: Hovering, phase: Phase) -> None:
    goal = 4.9 if phase is Phase.WRAP else 0.0
    late = hovering((2.5, 0.0))
    state, _ = run(bending(phase, 3.0, goal), late, parameters, 0.3)
    assert math.hypot(*state.bend) == pytest.approx(3.0)


def test_a_wrap_waits_for_the_vehicle_and_a_release_does_not(parameters: Parameters, hovering: Hovering) -> None:
    facts = hovering((3.0, 0.0))
    away = changed(facts, [vehicle(position_w=add(PLACE, (0.0, 0.5, 0.0)))])
    state, _ = run(bending(Phase.WRAP, 3.0, 4.9), away, parameters, 0.1)
    assert math.hypot(*state.bend) == pytest.approx(3.0)
    state, _ = run(bending(Phase.RELEASE, 3.0, 0.0, reference=Reference(PLACE)), away, parameters, 0.1)
    assert math.hypot(*state.bend) == pytest.approx(2.9, abs=0.02)


def test_a_wrap_that_never_gets_on_is_given_up(parameters: Parameters, hovering: Hovering) -> None:
    facts = hovering((3.0, 0.0), position_w=add(PLACE, (0.0, 0.5, 0.0)))
    state, said = run(bending(Phase.WRAP, 3.0, 4.9), facts, parameters, parameters.config.perch.state_timeout_s + 0.5)
    assert state.phase in {Phase.UNLOAD, Phase.RELEASE}
    texts = [notice.text for commands in said for notice in commands.notices]
    assert any("WRAP -> UNLOAD: wrap took more than" in text for text in texts), texts
    assert state.anchor is None
