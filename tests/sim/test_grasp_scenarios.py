"""Whole flights with an object, in simulated time: taken, weighed, carried, put back, dropped, left to the pilot."""

import math
from collections.abc import Callable

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.mission import beside, grasp
from arm_companion.mission.facts import ArmFault
from arm_companion.record.recorder import Record
from arm_companion.sim.grasp_verdict import GraspVerdict, judge_grasp
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.scenario import Operator
from arm_companion.sim.trials import draw
from arm_companion.sim.world import World

CONFIG = load("sim_grasp.toml")
AT_HEIGHT_M = 0.3
SOON_S = 0.1


def fly(
    prepare: Callable[[World], None] = lambda _: None, *, twice: bool = False, settings: tuple[str, ...] = ()
) -> tuple[Result, GraspVerdict]:
    config = load("sim_grasp.toml", settings)
    script = Operator.fly_grasp if twice else Operator.fly_grasp_once
    result = run_simulated(fly_simulated(config, lambda _: None, prepare, fly=script))
    return result, judge_grasp(result.flight, result.failure, config)


def fly_drawn(world: int) -> tuple[Result, GraspVerdict]:
    """One grasp in the world that is drawn from a seed."""
    drawn = draw(CONFIG, world)
    script = Operator.fly_grasp_once
    result = run_simulated(fly_simulated(drawn.controller, lambda _: None, world=drawn.world, fly=script))
    return result, judge_grasp(result.flight, result.failure, drawn.world)


def when_carried(happens: Callable[[World], None]) -> Callable[[World], None]:
    """Let something happen to the world once the object is well off its cradles."""

    def look(world: World) -> None:
        place = world.plant.truth().object_position_w
        if place is not None and CONFIG.sim.object.position_m[2] - place[2] > AT_HEIGHT_M:
            happens(world)
        else:
            world.at(world.plant.time + SOON_S, look)

    return look


def phases(result: Result) -> list[str]:
    seen = [record.state.phase.name for record in result.records]
    return [name for i, name in enumerate(seen) if i == 0 or seen[i - 1] != name]


def in_phase(result: Result, name: str) -> list[Record]:
    return [record for record in result.records if record.state.phase.name == name]


@pytest.mark.scenario
def test_an_object_is_picked_up_weighed_carried_and_put_back_twice() -> None:
    result, verdict = fly(twice=True)
    assert verdict.success, verdict.reason
    once = ["CLOSE", "VERIFY", "LIFT", "CARRY", "PLACE", "RELEASE", "DEPART", "STOWING", "STOWED"]
    passed = iter(phases(result))
    assert all(name in passed for name in (*once, *once))
    assert abs(verdict.mass_error) < 0.1
    assert abs(verdict.weighed_kg - verdict.mass_kg) < 3.0 * verdict.weighed_sigma_kg
    without, compensated = verdict.pick_ups
    assert compensated.seconds < without.seconds
    assert compensated.error_m < 0.3 * without.error_m
    wrench = {error.span: error for error in verdict.wrench}["carried"]
    assert wrench.force_error_n < 0.2 * wrench.true_force_n
    assert max(max(s.truth.tension) for s in result.flight.samples) < CONFIG.limits.tension_max_n


@pytest.mark.scenario
@pytest.mark.parametrize("world", [500, 4014, 4021])
def test_a_heavy_object_that_wind_has_it_meet_beside_its_middle_is_put_back(world: int) -> None:
    """Held 3 cm beside that, 297 g and 275 g leaned the vehicle, met their cradles with one end, and were lost."""
    result, verdict = fly_drawn(world)
    assert verdict.success, verdict.reason
    (lift,) = [span for span in result.flight.spans() if span[0] == "LIFT"]
    asked = [(s, place) for s in result.flight.within(*lift[1:]) if (place := result.flight.asked_at(s.t)) is not None]
    assert max(math.dist(s.state.position_w[:2], place[:2]) for s, place in asked) < 0.08
    if world == 4021:  # 30 degrees askew: one end met its cradle 6 cm early, and jammed
        assert any("may hang askew" in text for _, text in result.flight.texts)


@pytest.mark.scenario
@pytest.mark.parametrize("judges", [True, False])
def test_an_object_held_beside_its_middle_is_tried_again_or_if_it_is_lifted_all_the_same_not_lost(
    monkeypatch: pytest.MonkeyPatch, judges: bool
) -> None:
    """A gust carried the vehicle 2.7 cm aside as the arm closed: 297 g hung 45 degrees askew, and fell as they met."""
    monkeypatch.setattr(beside, "waits", lambda _: False)
    if not judges:
        monkeypatch.setattr(grasp, "_HELD_ASIDE_M", math.inf)
    result, verdict = fly_drawn(4021)
    if judges:
        assert verdict.success, verdict.reason
        assert any("beside the middle; another try" in text for _, text in result.flight.texts)
        return
    assert any("PLACE -> LIFT: the load met something" in text for _, text in result.flight.texts)
    assert "fell" not in verdict.reason
    assert result.flight.samples[-1].truth.contact_force_n > 0.0, "held to the end"


@pytest.mark.scenario
@pytest.mark.parametrize("patient", [True, False])
def test_an_object_that_wind_has_it_meet_too_closely_does_not_leave_it_rocking(
    monkeypatch: pytest.MonkeyPatch, patient: bool
) -> None:
    """Closed 2.4 cm too near, the arm threw the vehicle about: it rocked by 15 degrees, and struck something."""
    if not patient:
        monkeypatch.setattr(beside, "_NEARER_M", math.inf)
    result, verdict = fly_drawn(3085)
    assert verdict.success, verdict.reason
    assert [name for name, _, _ in result.flight.spans()].count("VERIFY") == (1 if patient else 2), "tries"


@pytest.mark.scenario
def test_a_load_that_slips_out_is_told_within_three_tenths_of_a_second() -> None:
    lost: list[float] = []

    def lose(world: World) -> None:
        world.plant.lose_object()
        lost.append(world.samples[-1].t)

    result, verdict = fly(lambda world: world.at(30.0, when_carried(lose)))
    assert not verdict.success
    held = in_phase(result, "HOLDING")
    assert 0.0 < held[0].t - lost[0] < 0.3
    assert any("load lost" in text for _, text in result.flight.texts)
    assert any(record.commands.status.error_bits & ArmFault.CONTACT_LOST for record in held)
    after = result.flight.within(lost[0], lost[0] + 3.0)
    asked = [(s, place) for s in after if (place := result.flight.asked_at(s.t)) is not None]
    assert max(abs(s.state.position_w[2] - place[2]) for s, place in asked) < 0.15
    assert "did not land" not in verdict.reason


@pytest.mark.scenario
def test_the_pilot_takes_the_vehicle_while_it_carries_and_the_arm_holds_on() -> None:
    result, verdict = fly(lambda world: world.at(30.0, when_carried(lambda w: w.autopilot.take_over("POSCTL"))))
    assert not verdict.success, "nobody has asked for set-points again"
    after = [r for r in result.records if r.facts.vehicle.mode == "POSCTL"]
    assert all(record.commands.setpoint is None for record in after)
    flown = [r for r in in_phase(result, "CARRY") if r.facts.vehicle.mode == "POSCTL"]
    assert flown
    assert "LIFT" not in {record.state.phase.name for record in after[1:]}
