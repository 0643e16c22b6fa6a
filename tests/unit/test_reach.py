"""Sharing the way to a point: laws of the planner, for random points, poses and arms."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.arm import arc
from arm_companion.arm.keep_out import KeepOut
from arm_companion.arm.reach import Arm, Limits, OutOfReach, Split, alone, split
from arm_companion.arm.reaction import mount
from arm_companion.geometry.arrays import Array

LENGTH = 0.25
BELOW = Arm(mount((0.01, -0.02, 0.12), (0.0, 0.0, 0.0)), LENGTH, LENGTH)
ABOVE = Arm(mount((0.0, 0.0, -0.22), (180.0, 0.0, 0.0)), LENGTH, LENGTH)
ASIDE = Arm(mount((0.1, 0.0, 0.0), (0.0, 70.0, 30.0)), LENGTH, LENGTH)
PART = replace(BELOW, at=0.1)
ARMS = (BELOW, ABOVE, ASIDE, PART)
HERE = np.array((2.0, -1.0, -3.0))
FREE = Limits(bend_max=5.5, move_max=100.0, lowest=0.0, clearance=0.0)
STRAIGHT = np.zeros(2)

arms = st.sampled_from(ARMS)
headings = st.floats(-math.pi, math.pi)
weights = st.floats(0.0, 2.9)
steps = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array)
near = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)


def tip_of(plan: Split, arm: Arm, heading: float) -> Array:
    """Forward kinematics, written out once more: the part up to the point is an arc by itself."""
    share = arm.at / arm.length
    p = arm.T_ba.rotation @ arc.tip_position(share * plan.bend, arm.at) + arm.T_ba.position
    c, s = math.cos(heading), math.sin(heading)
    return plan.vehicle + np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))) @ p


def straight_tip(arm: Arm, heading: float) -> Array:
    return tip_of(Split(STRAIGHT, HERE), arm, heading)


def cone(arm: Arm, degrees: float = 60.0) -> KeepOut:
    apex = np.array((0.0, 0.0, math.copysign(0.05, arm.T_ba.position[2])))
    return KeepOut.of(apex, math.radians(degrees), arm.T_ba, LENGTH, 0.02)


@given(arms, headings, weights, steps)
def test_the_point_comes_to_its_target(arm: Arm, heading: float, weight: float, step: Array) -> None:
    target = straight_tip(arm, heading) + step
    plan = split(target, HERE, heading, arm, STRAIGHT, weight, FREE)
    assert np.linalg.norm(tip_of(plan, arm, heading) - target) < 1e-9


@given(arms, headings, weights, steps)
def test_no_other_split_costs_less(arm: Arm, heading: float, weight: float, step: Array) -> None:
    """Against a search over all bends, in all directions and not only in the planner's plane."""
    target = straight_tip(arm, heading) + step
    plan = split(target, HERE, heading, arm, STRAIGHT, weight, FREE)

    def cost(bend: Array) -> float:
        vehicle = target - (tip_of(Split(bend, HERE), arm, heading) - HERE)
        move = float(np.linalg.norm(vehicle - HERE)) / LENGTH
        return weight * (math.sqrt(1.0 + move * move) - 1.0) + 0.5 * float(bend @ bend)

    found = cost(plan.bend)
    for theta, delta in itertools.product(np.linspace(0.0, 5.5, 24), np.linspace(-math.pi, math.pi, 13)):
        assert found <= cost(theta * np.array((math.cos(delta), math.sin(delta)))) + 1e-9
    for nudge in ((1e-3, 0.0), (-1e-3, 0.0), (0.0, 1e-3), (0.0, -1e-3)):
        if np.linalg.norm(plan.bend + nudge) <= FREE.bend_max:
            assert found <= cost(plan.bend + nudge) + 1e-12


@given(arms, headings, headings, weights, steps)
def test_it_turns_with_the_world(arm: Arm, heading: float, turn: float, weight: float, step: Array) -> None:
    target = straight_tip(arm, heading) + step
    c, s = math.cos(turn), math.sin(turn)
    R = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    plan = split(target, HERE, heading, arm, STRAIGHT, weight, FREE)
    turned = split(R @ target, R @ HERE, heading + turn, arm, STRAIGHT, weight, FREE)
    assert turned.bend == pytest.approx(plan.bend, abs=1e-6)
    assert turned.vehicle == pytest.approx(R @ plan.vehicle, abs=1e-6)


@given(arms, headings, weights, steps, near)
def test_it_moves_on_continuously_with_the_target(
    arm: Arm, heading: float, weight: float, step: Array, way: Array
) -> None:
    """Also through the axis of the arm, where a polar bend has no direction."""
    target = straight_tip(arm, heading) + step
    small = 1e-3 * way
    plan = split(target, HERE, heading, arm, STRAIGHT, weight, FREE)
    moved = split(target + small, HERE, heading, arm, STRAIGHT, weight, FREE)
    # the cost's curvature is 1 - w / 3 at least, and the slope changes by w / 2 for a length of the arm at most
    steepest = weight / 2.0 / (1.0 - weight / 3.0) / LENGTH
    assert np.linalg.norm(moved.bend - plan.bend) <= steepest * np.linalg.norm(small) + 1e-9


@given(arms, headings, steps)
def test_a_vehicle_that_is_free_to_move_does_all(arm: Arm, heading: float, step: Array) -> None:
    plan = split(straight_tip(arm, heading) + step, HERE, heading, arm, STRAIGHT, 0.0, FREE)
    assert (plan.bend == 0.0).all()
    assert plan.vehicle == pytest.approx(HERE + step, abs=1e-12)


@given(arms, headings, st.floats(0.0, 2.8))
def test_the_more_the_vehicle_weighs_the_less_it_moves(arm: Arm, heading: float, weight: float) -> None:
    target = straight_tip(arm, heading) + np.array((0.1, 0.05, 0.0))
    light, heavy = (split(target, HERE, heading, arm, STRAIGHT, w, FREE) for w in (weight, weight + 0.1))
    assert np.linalg.norm(heavy.vehicle - HERE) < np.linalg.norm(light.vehicle - HERE)


@given(arms, headings, st.floats(0.0, 4.0), st.floats(-math.pi, math.pi))
def test_an_arm_alone_does_all_that_lies_on_its_surface(arm: Arm, heading: float, theta: float, delta: float) -> None:
    bend = theta * np.array((math.cos(delta), math.sin(delta)))
    target = tip_of(Split(bend, HERE), arm, heading)
    plan = alone(target, HERE, heading, arm, STRAIGHT, FREE, 1e-4)
    assert (plan.vehicle == HERE).all()
    assert np.linalg.norm(tip_of(plan, arm, heading) - target) < 1e-4
    assert plan.miss < 1e-4


def test_an_arm_alone_refuses_what_lies_off_its_surface() -> None:
    target = straight_tip(BELOW, 0.0) + np.array((0.0, 0.0, 0.03))
    with pytest.raises(OutOfReach, match=r"3\.0 cm away"):
        alone(target, HERE, 0.0, BELOW, STRAIGHT, FREE, 0.02)
    assert alone(target, HERE, 0.0, BELOW, STRAIGHT, FREE, 0.04).miss == pytest.approx(0.03)
    with pytest.raises(OutOfReach):
        alone(np.full(3, np.nan), HERE, 0.0, BELOW, STRAIGHT, FREE, 0.02)


@given(
    arms,
    headings,
    weights,
    steps,
    st.floats(0.3, 5.5),
    st.floats(0.1, 2.0),
    st.floats(-3.5, -2.5),
    st.floats(0.05, 0.5),
    st.booleans(),
)
def test_no_limit_is_broken_anywhere_on_the_way(
    arm: Arm,
    heading: float,
    weight: float,
    step: Array,
    bend_max: float,
    move_max: float,
    lowest: float,
    clearance: float,
    fenced: bool,
) -> None:
    keep_out = cone(arm) if fenced else None
    limits = Limits(bend_max, move_max, lowest, clearance, keep_out)
    target = straight_tip(arm, heading) + step
    now = np.array((0.2, -0.1))
    try:
        plan = split(target, HERE, heading, arm, now, weight, limits)
    except OutOfReach:
        return
    assert np.linalg.norm(tip_of(plan, arm, heading) - target) < 1e-9
    assert np.linalg.norm(plan.bend) <= bend_max + 1e-9
    assert np.linalg.norm(plan.vehicle - HERE) <= move_max + 1e-9
    start = np.linalg.norm(target - HERE)
    for share in np.linspace(0.0, 1.0, 41):
        vehicle = HERE + share * (plan.vehicle - HERE)
        bend = now + share * (plan.bend - now)
        assert vehicle[2] <= max(lowest, HERE[2]) + 1e-9
        assert np.linalg.norm(target - vehicle) >= min(clearance, start) - 1e-6
        if keep_out is not None:
            c, s = math.cos(heading), math.sin(heading)
            level = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0))) @ (target - vehicle)
            assert keep_out.distance(arm.T_ba.rotation.T @ (level - arm.T_ba.position)) >= -0.002
            assert keep_out.clearance(bend) >= min(0.004, keep_out.clearance(now) - 1e-4)


def test_a_low_point_is_reached_by_a_vehicle_that_stays_high() -> None:
    """An arm above, and a floor: the arm bends more than is best, so that the vehicle stays higher."""
    target = straight_tip(ABOVE, 0.0) + np.array((0.3, 0.0, 0.12))
    free = split(target, HERE, 0.0, ABOVE, STRAIGHT, 1.0, FREE)
    low = replace(FREE, lowest=float(free.vehicle[2]) - 0.05)
    plan = split(target, HERE, 0.0, ABOVE, STRAIGHT, 1.0, low)
    assert plan.vehicle[2] == pytest.approx(low.lowest, abs=1e-6)
    assert np.linalg.norm(plan.bend) > np.linalg.norm(free.bend)
    assert np.linalg.norm(tip_of(plan, ABOVE, 0.0) - target) < 1e-9


@pytest.mark.parametrize(
    ("step", "limits", "words"),
    [
        ((5.0, 0.0, 0.0), replace(FREE, move_max=3.0), r"would move 4\.\d+ m; at most 3 m"),
        ((0.0, 0.0, 2.9), replace(FREE, lowest=-0.5), r"come down to 0\.\d+ m; it stays above 0\.5 m"),
        ((0.0, 0.0, -0.9), replace(FREE, clearance=0.3), r"within 0\.\d+ m of the point; 0\.3 m are kept"),
        ((0.2, 0.0, -1.0), replace(FREE, keep_out=cone(BELOW)), "the point is in the vehicle's keep-out cone"),
    ],
)
def test_a_refusal_says_which_limit_is_in_the_way(step: tuple[float, ...], limits: Limits, words: str) -> None:
    with pytest.raises(OutOfReach, match=words):
        split(straight_tip(BELOW, 0.0) + np.array(step), HERE, 0.0, BELOW, STRAIGHT, 1.0, limits)


def test_the_arm_does_not_reach_into_the_cone() -> None:
    keep_out = KeepOut.of(np.array((0.0, 0.0, 0.1)), math.radians(60.0), BELOW.T_ba, LENGTH, 0.02)
    target = tip_of(Split(np.array((4.5, 0.0)), HERE), BELOW, 0.0)
    with pytest.raises(OutOfReach, match="too near to the keep-out cone"):
        alone(target, HERE, 0.0, BELOW, STRAIGHT, replace(FREE, keep_out=keep_out), 0.02)


@pytest.mark.parametrize("weight", [-0.1, 3.0, math.nan])
def test_a_weight_that_would_have_several_best_splits_is_refused(weight: float) -> None:
    with pytest.raises(ValueError, match="weight"):
        split(straight_tip(BELOW, 0.0), HERE, 0.0, BELOW, STRAIGHT, weight, FREE)
