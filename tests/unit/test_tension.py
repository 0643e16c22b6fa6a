"""Tension from load, from statics, and from both; and tendons whose load contradicts the statics."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.arm.tension import LoadCurve, fuse, statics_sigma
from arm_companion.config.schema import LimitsConfig
from arm_companion.mission.facts import Facts, TendonState
from arm_companion.mission.mission import _tensions
from arm_companion.mission.tendon_watch import Expected, TendonWatch, watch
from tests.unit.conftest import HOVER

CURVE = LoadCurve(140.0, 12.0, 0.02, 0.01, 5.0, 0.4, 0.01)
LIMITS = LimitsConfig()
TENDON = TendonState(0.0, 0.0, 4.0, 4.0, 0.0, 30.0, 12.0, 0, silent=False, age_s=0.0, torque=True, tension_bias=3.0)


def test_friction_is_against_the_motion_and_its_sigma_is_uniform_at_rest() -> None:
    load = 0.1
    motor = 140.0 * (load - 0.01)
    inwards, still, outwards = (CURVE.tension(load, d, 12.0) for d in (1, 0, -1))
    assert (inwards.value, still.value, outwards.value) == pytest.approx((motor - 5.0, motor, motor + 5.0))
    assert still.bias == pytest.approx(math.hypot(5.0 / math.sqrt(3.0), 0.02 * motor))
    assert inwards.bias == outwards.bias == pytest.approx(math.hypot(0.4, 0.02 * motor))
    assert inwards.sigma == pytest.approx(math.hypot(inwards.bias, 1.4))


def test_a_lower_supply_makes_the_same_load_a_lower_torque() -> None:
    assert CURVE.tension(0.3, 1, 9.0).value + 5.0 == pytest.approx(0.75 * (CURVE.tension(0.3, 1, 12.0).value + 5.0))
    assert CURVE.tension(0.3, 0, 0.0) == CURVE.tension(0.3, 0, 12.0), "without a reading, the curve's own"


positive = st.floats(0.01, 50.0)


@given(st.floats(0.0, 50.0), positive, st.floats(0.0, 50.0), positive)
def test_fusion_lies_between_is_surer_than_either_and_does_not_care_for_the_order(
    a: float, s: float, b: float, t: float
) -> None:
    value, sigma = fuse((a, s), (b, t))
    assert min(a, b) - 1e-9 <= value <= max(a, b) + 1e-9
    assert sigma <= min(s, t) * (1 + 1e-12)
    assert 1.0 / sigma**2 == pytest.approx(1.0 / s**2 + 1.0 / t**2)
    assert fuse((b, t), (a, s)) == pytest.approx((value, sigma))


def test_an_estimate_without_any_knowledge_does_not_count() -> None:
    assert fuse((3.0, 1.0), (9.0, math.inf)) == fuse((9.0, math.inf), (3.0, 1.0)) == (3.0, 1.0)
    assert statics_sigma(10.0, 3000.0, 0.001, 0.05) == pytest.approx(math.hypot(3.0, 0.5))


def test_statics_are_not_trusted_on_a_tendon_whose_servo_is_silent() -> None:
    """It may have lost its power and let go."""
    says = Expected(12.0, 1.0, exact=True)
    silent = dataclasses.replace(TENDON, silent=True, tension_sigma=math.inf)
    prediction: Any = SimpleNamespace(tensions=(says, says))
    state: Any = SimpleNamespace(watch=(TendonWatch(), TendonWatch()))
    heard, unheard = _tensions(Facts(HOVER, (TENDON, silent)), state, prediction)
    assert heard.sigma < 1.0
    assert unheard.sigma == math.inf


# The watch.


def run(tension: float, expected: float, seconds: float, *, exact: bool = True, **tendon: object) -> TendonWatch:
    state = dataclasses.replace(TENDON, tension=tension, **tendon)
    says = Expected(expected, 1.0, exact=exact)
    suspicion: tuple[TendonWatch, ...] = ()
    for _ in range(round(seconds / 0.01)):
        suspicion = watch(suspicion, (state,), (says,), 0.01, LIMITS)
    return suspicion[0]


def test_a_tendon_that_carries_nothing_is_broken_after_a_while_and_not_at_once() -> None:
    assert not run(0.5, 18.0, 0.4).fault
    assert "tendon 1 broken" in run(0.5, 18.0, 2.0).broken


def test_what_friction_at_rest_can_hide_is_no_fault() -> None:
    assert not run(0.0, 8.0, 30.0).fault


def test_a_moving_servo_shows_more() -> None:
    assert run(0.0, 8.0, 3.0, tension_bias=1.0).broken


def test_a_noisy_load_needs_a_greater_difference() -> None:
    assert not run(0.0, 8.0, 3.0, tension_bias=1.0, tension_sigma=60.0).fault


def test_a_tendon_that_is_too_tight_counts_only_where_nothing_else_can_pull_it() -> None:
    assert "tendon 1 jumped" in run(25.0, 4.0, 3.0).jumped
    assert not run(25.0, 4.0, 3.0, exact=False).fault


def test_a_fault_stays_until_somebody_looks() -> None:
    broken = (run(0.5, 18.0, 2.0),)
    for expected in ((Expected(0.5, 1.0, exact=True),), ()):
        after = watch(broken, (TENDON,), expected, 0.01, LIMITS)
        assert after[0].broken == broken[0].broken


@pytest.mark.parametrize("state", [{"torque": False}, {"ready": False}, {"homed": False}, {"silent": True}])
def test_a_servo_that_does_not_hold_proves_nothing(state: dict[str, bool]) -> None:
    assert run(0.0, 40.0, 5.0, **state) == TendonWatch()


@given(st.lists(st.floats(-3.0, 3.0), min_size=50, max_size=300))
def test_noise_about_the_right_tension_is_no_fault(noise: list[float]) -> None:
    suspicion: tuple[TendonWatch, ...] = ()
    for error in noise:
        state = dataclasses.replace(TENDON, tension=10.0 + 3.0 * error)
        suspicion = watch(suspicion, (state,), (Expected(10.0, 1.0, exact=True),), 0.01, LIMITS)
    assert not suspicion[0].fault
