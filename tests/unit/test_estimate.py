"""The force observer: what it feels, and how it learns what it would feel anyway."""

import math
from collections.abc import Callable

import pytest

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.estimate import OBSERVER_LAG_S, ForceObserver, observe_force, tare
from arm_companion.mission.facts import Facts
from arm_companion.mission.motion import Reference
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import DRAG_PER_S
from arm_companion.mission.state import Phase
from tests.unit.mission_rig import DT, MET, Run, memory

Hovering = Callable[..., Facts]
MASS = 1.8


def leaning(north: float) -> tuple[float, float, float, float]:
    """Attitude of a vehicle whose thrust accelerates it to the north, m/s^2."""
    half = -0.5 * math.atan(north / GRAVITY)
    return (math.cos(half), 0.0, math.sin(half), 0.0)


def felt(hovering: Hovering, seconds: float, lean: float, speed: float = 0.0) -> ForceObserver:
    observer = ForceObserver()
    for _ in range(round(seconds / DT)):
        vehicle = hovering(attitude_wb=leaning(lean), velocity_w=(speed, 0.0, 0.0)).vehicle
        observer = observe_force(observer, vehicle, MASS, DT)
    return observer


def test_a_vehicle_that_leans_and_stays_is_pushed_back(hovering: Hovering) -> None:
    assert felt(hovering, 2.0, 0.5).force == pytest.approx((-0.5 * MASS, 0.0), abs=1e-3)


def test_the_lag_is_what_it_is_said_to_be(hovering: Hovering) -> None:
    """Of a step, the area that is missing is the step by the lag."""
    missing = sum(1.0 + felt(hovering, n * DT, 0.5).force[0] / (0.5 * MASS) for n in range(1, 101)) * DT
    assert missing == pytest.approx(OBSERVER_LAG_S, abs=0.02)


def test_what_the_air_drags_is_no_force_of_an_arm(hovering: Hovering) -> None:
    assert felt(hovering, 3.0, DRAG_PER_S * 0.3, 0.3).force == pytest.approx((0.0, 0.0), abs=1e-3)
    assert felt(hovering, 3.0, 0.0, 0.3).force[0] == pytest.approx(MASS * DRAG_PER_S * 0.3, rel=0.01)


def test_a_bias_is_known_after_a_second_and_gets_better_with_more(hovering: Hovering) -> None:
    steady = felt(hovering, 2.0, 0.1)
    observer = ForceObserver(velocity=steady.velocity, force=steady.force)
    for _ in range(95):
        observer = tare(observer, DT)
    assert observer.residual == (0.0, 0.0)
    assert math.isinf(observer.bias_age_s)
    for _ in range(10):
        observer = tare(observer, DT)
    assert observer.bias == pytest.approx(steady.force)
    assert observer.bias_age_s == 0.0
    observer = observe_force(observer, hovering(attitude_wb=leaning(0.1)).vehicle, MASS, DT)
    assert observer.bias_age_s == pytest.approx(DT)


@pytest.mark.parametrize(("short", "seconds"), [(0.4, 1.6), (0.1, 1.0)], ids=["far", "near"])
def test_the_bias_is_learnt_for_as_long_as_the_arm_cannot_touch_the_bar(
    short: float, seconds: float, parameters: Parameters, hovering: Hovering
) -> None:
    """A bar that pushes would be taken for the wind; a second is needed in any case."""
    here = (MET[0] - short, MET[1], MET[2])
    force = ForceObserver(velocity=(0.0, 0.0))
    run = Run(memory(Phase.REACH, force=force, reference=Reference(here)), parameters)
    run.cycles(hovering(position_w=here), 1.6)
    assert run.state.phase is Phase.REACH
    assert run.state.force.tared_s == pytest.approx(seconds, abs=2.0 * DT)
    assert run.state.force.bias_age_s == pytest.approx(1.6 - seconds, abs=3.0 * DT)
