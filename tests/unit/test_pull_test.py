"""The pull test tells a grip that holds from one that gives, at its limit and along its own direction only."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.mission import pull_test
from arm_companion.mission.facts import Facts, Order, Vec3
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.pull_test import pull_test_failed, pull_test_passed, pull_test_share
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import PerchKind, Phase
from tests.unit.mission_rig import PLACE, T0, memory

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
    assert pull_test.tested_to_hang(pulled(0.1, kind=PerchKind.HANG)) == "pull test passed: gave 10% of the asked move"
    assert pull_test.tested_to_hang(pulled(0.1, kind=PerchKind.ANCHOR)) is None
    assert pull_test.tested_to_hang(pulled(0.9, kind=PerchKind.HANG)) is None
