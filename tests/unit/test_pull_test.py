"""The pull test tells a grip that holds from one that gives, at its limit and along its own direction only."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission import pull_test, wrench
from arm_companion.mission.facts import Facts, Order, Vec3
from arm_companion.mission.held_arm import holding_lean
from arm_companion.mission.motion import dot, scale
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.pull_test import pull_test_failed, pull_test_passed, pull_test_share, stretch_share
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import PerchKind, Phase
from tests.unit.mission_rig import BENT, PLACE, T0, memory

Hovering = Callable[..., Facts]
Pulled = Callable[..., Situation]
HEADING = 0.5


@pytest.fixture
def pulled(parameters: Parameters, hovering: Hovering) -> Pulled:
    """A maker of vehicles that gave so much of the asked move, m to the side, after so many seconds of the test."""

    def make(share: float, *, aside: float = 0.0, seconds: float = 3.5, **fields: object) -> Situation:
        move = share * parameters.config.perch.verify_pull_m
        c, s = math.cos(HEADING), math.sin(HEADING)
        position: Vec3 = (PLACE[0] - move * c - aside * s, PLACE[1] - move * s + aside * c, PLACE[2])
        state = memory(Phase.VERIFY, heading=HEADING, position=position, since=T0 - seconds, **fields)
        return Situation(state, hovering((3.0, 0.0)), T0, parameters)

    return make


def test_the_share_is_what_the_vehicle_moved_away_from_the_bar_of_what_it_was_asked(pulled: Pulled) -> None:
    assert pull_test_share(pulled(0.4)) == pytest.approx(0.4)
    assert pull_test_share(pulled(-0.4)) == pytest.approx(-0.4)
    assert pull_test_share(pulled(0.0, aside=0.1)) == pytest.approx(0.0, abs=1e-9)


def test_every_share_either_passes_or_fails_and_the_limit_divides_them(parameters: Parameters, pulled: Pulled) -> None:
    limit = parameters.config.perch.verify_give_share
    for share, good in ((limit - 0.01, True), (limit + 0.01, False)):
        assert (pull_test_passed(pulled(share)) is not None) is good
        assert (pull_test_failed(pulled(share)) is not None) is not good
    half = dataclasses.replace(parameters.config.perch, verify_give_share=0.5, verify_pull_m=0.5)
    exact = dataclasses.replace(parameters, config=dataclasses.replace(parameters.config, perch=half))
    state = memory(Phase.VERIFY, heading=0.0, position=(PLACE[0] - 0.25, *PLACE[1:]), since=T0 - 3.5)
    s = Situation(state, pulled(0.0).facts, T0, exact)
    assert pull_test_share(s) == 0.5
    assert pull_test_passed(s) is None, "a grip that gives as much as is allowed has failed"
    assert pull_test_failed(s) is not None


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_nothing_is_judged_before_the_vehicle_had_its_time_or_when_an_object_is_held(
    pulled: Pulled, share: float
) -> None:
    for early in (pulled(share, seconds=2.9), pulled(share, task=Order.GRASP)):
        assert pull_test_passed(early) is None
        assert pull_test_failed(early) is None
    assert (pull_test_passed(pulled(share, seconds=3.1)) or pull_test_failed(pulled(share, seconds=3.1))) is not None


def test_only_a_hang_that_was_asked_for_hangs_by_a_good_grip(pulled: Pulled) -> None:
    passed = "pull test passed: gave 10% of the asked move, the arm's stretch 0%"
    assert pull_test.tested_to_hang(pulled(0.1, kind=PerchKind.HANG)) == passed
    assert pull_test.tested_to_hang(pulled(0.1, kind=PerchKind.ANCHOR)) is None
    assert pull_test.tested_to_hang(pulled(0.9, kind=PerchKind.HANG)) is None


Pull = Callable[[Situation, float], Situation]
NORTH = (-1.0, 0.0, 0.0)  # away from the bar, with no heading


def leaning(facts: Facts, acceleration: float) -> Facts:
    """The same with the thrust tilted, so that it accelerates the vehicle by so much away from the bar, m/s^2."""
    half = 0.5 * math.atan2(acceleration, GRAVITY)
    vehicle = dataclasses.replace(facts.vehicle, attitude_wb=(math.cos(half), 0.0, math.sin(half), 0.0))
    return dataclasses.replace(facts, vehicle=vehicle)


@pytest.fixture
def held(parameters: Parameters, hovering: Hovering) -> Callable[..., Situation]:
    """A maker of tests near their end: what the vehicle gave, its lean at the grip and now, m/s^2."""

    def make(share: float, *, before: float = 0.0, now: float = 0.0) -> Situation:
        at_grip = Situation(
            memory(Phase.VERIFY, heading=0.0, since=T0), leaning(hovering(BENT), before), T0, parameters
        )
        anchor = wrench.grip(at_grip)
        gripped = dataclasses.replace(at_grip.state, anchor=anchor, prediction=None)
        prediction = wrench.predict(Situation(gripped, at_grip.facts, T0, parameters))
        move = share * parameters.config.perch.verify_pull_m
        place: Vec3 = (PLACE[0] - move, *PLACE[1:])
        state = dataclasses.replace(gripped, prediction=prediction, position=place, since=T0 - 3.5)
        return Situation(state, leaning(hovering(BENT), now), T0, parameters)

    return make


def test_the_stretch_is_what_the_model_gives_to_the_pull(held: Callable[..., Situation]) -> None:
    s = held(0.0)
    assert s.state.prediction is not None
    anchored = s.state.prediction.anchored
    assert anchored is not None
    asked = s.config.perch.verify_pull_m
    for share in (0.05, 0.1, 0.2):
        lean = dot(holding_lean(s, anchored, scale(NORTH, share * asked)), NORTH)
        stiffness = s.config.vehicle.mass_kg * lean / (share * asked)
        assert 50.0 < stiffness < 500.0  # N/m; 190 in flight
        assert stretch_share(held(0.0, now=lean)) == pytest.approx(share, rel=0.1)


def test_wind_that_was_there_before_the_pull_stretches_nothing(held: Callable[..., Situation]) -> None:
    assert stretch_share(held(0.0, before=0.5, now=0.5)) == pytest.approx(0.0, abs=0.01)
    pulled_by = stretch_share(held(0.0, before=0.3, now=0.8))
    assert pulled_by == pytest.approx(stretch_share(held(0.0, now=0.5)), rel=0.05)
    assert stretch_share(held(0.0, now=-1.0)) == 0.0


def test_no_more_is_explained_than_may_be_given_without(held: Callable[..., Situation]) -> None:
    limit = held(0.0).config.perch.verify_give_share
    assert stretch_share(held(0.0, now=5.0)) == limit
    assert pull_test_failed(held(2.0 * limit, now=5.0)) is not None, "whatever pulls: that is no grip"


def test_a_good_grip_passes_however_hard_it_is_pulled_and_a_loose_one_does_not(held: Callable[..., Situation]) -> None:
    s = held(0.0)
    assert s.state.prediction is not None
    stretched = 0.32  # of the asked move: what ArduPilot makes of it by a good grip
    lean = dot(
        holding_lean(s, s.state.prediction.anchored, scale(NORTH, stretched * s.config.perch.verify_pull_m)), NORTH
    )
    assert pull_test_passed(held(stretched, now=lean)) is not None
    assert pull_test_failed(held(stretched, now=0.0)) is not None, "it gave as much to no pull at all"
