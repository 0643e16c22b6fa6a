"""What counts as a hazard, and what is only not known."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.mission import hazards
from arm_companion.mission.facts import Facts
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, Vigil
from tests.unit.mission_rig import T0, memory, tendon, vehicle

Hovering = Callable[..., Facts]


def test_the_motors_of_an_autopilot_that_has_never_been_heard_are_not_said_to_stand(
    parameters: Parameters, hovering: Hovering
) -> None:
    for age, told in ((0.3, True), (9.0, True), (math.inf, False)):
        facts = vehicle(armed=False, heartbeat_age_s=age)(hovering())
        s = Situation(memory(Phase.PERCHED), facts, T0, parameters)
        assert (hazards.disarmed(s) is not None) is told
        assert (hazards.motors_stopped(s) is not None) is told
        stood = Situation(memory(Phase.PERCHED, armed=False), facts, T0, parameters)
        assert hazards.motors_stopped(stood) is None, "it does not stop twice"


def test_a_slack_tendon_is_named(parameters: Parameters, hovering: Hovering) -> None:
    facts = tendon(2, tension=-9.0)(hovering())
    s = Situation(memory(Phase.READY, vigil=Vigil(slack_s=2.0)), facts, T0, parameters)
    assert hazards.slack(s) == "tendon 3 slack: -9.0 N"


@pytest.mark.parametrize(
    ("share", "for_s", "told"),
    [(1.0, 9.0, False), (1.01, 0.09, False), (1.01, 0.11, True), (1.14, 0.0, False), (1.16, 0.0, True)],
)
def test_a_tendon_may_carry_its_limit_and_more_for_a_jerk_but_never_much_more(
    parameters: Parameters, hovering: Hovering, share: float, for_s: float, told: bool
) -> None:
    facts = tendon(1, tension=share * parameters.config.limits.tension_max_n)(hovering())
    s = Situation(memory(Phase.PERCHED, vigil=Vigil(tight_s=for_s)), facts, T0, parameters)
    assert (hazards.overstressed(s) is not None) is told


def test_a_ground_station_is_lost_only_after_it_was_heard(parameters: Parameters, hovering: Hovering) -> None:
    for age, told in ((4.9, False), (5.1, True), (math.inf, False)):
        facts = dataclasses.replace(hovering(), ground_age_s=age)
        assert (hazards.ground_lost(Situation(memory(Phase.READY), facts, T0, parameters)) is not None) is told


def test_the_hottest_servo_is_named(parameters: Parameters, hovering: Hovering) -> None:
    s = Situation(memory(Phase.READY, vigil=Vigil(hot_s=2.0)), tendon(2, temperature=71.0)(hovering()), T0, parameters)
    assert str(hazards.hot(s)).startswith("tendon 3: servo at 71 degC")
