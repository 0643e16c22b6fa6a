"""References move smoothly, within their bounds, and arrive."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_companion.mission.motion import (
    ZERO,
    Reference,
    add,
    arrived,
    follow,
    low_pass,
    low_pass_vec,
    norm,
    rotate,
    scale,
    sub,
    unrotate,
    wrap_angle,
    yaw_of,
)

DT = 0.02
metres = st.floats(-5.0, 5.0)
points = st.tuples(metres, metres, metres)
angles = st.floats(-math.pi, math.pi)


@settings(max_examples=40, deadline=None)
@given(points, points, angles, angles, st.floats(0.02, 2.0), st.floats(0.1, 3.0))
def test_a_reference_arrives_without_breaking_a_bound(
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    yaw: float,
    goal_yaw: float,
    speed: float,
    acceleration: float,
) -> None:
    reference = Reference(start, ZERO, yaw)
    distance = norm(sub(goal, start))
    most = (
        math.ceil((distance / speed + 2 * speed / acceleration + 2.0 * math.sqrt(distance / acceleration)) / DT) + 800
    )
    overshoot = 0.0
    for _ in range(most):
        before = reference
        reference = follow(reference, goal, goal_yaw, speed=speed, acceleration=acceleration, yaw_rate=1.0, dt=DT)
        assert norm(reference.velocity) <= speed + 1e-9
        assert norm(sub(reference.velocity, before.velocity)) <= acceleration * DT * (1 + 1e-9) + 1e-12
        assert abs(wrap_angle(reference.yaw - before.yaw)) <= 1.0 * DT + 1e-9
        travelled = norm(sub(reference.position, start))
        overshoot = max(overshoot, travelled - distance)
        if arrived(reference, goal) and abs(wrap_angle(reference.yaw - goal_yaw)) < 1e-9:
            break
    assert arrived(reference, goal)
    assert overshoot <= 1e-6 + acceleration * DT * DT


@settings(max_examples=30, deadline=None)
@given(points, points, points)
def test_a_reference_that_is_already_moving_still_arrives(
    start: tuple[float, float, float], velocity: tuple[float, float, float], goal: tuple[float, float, float]
) -> None:
    reference = Reference(start, velocity, 0.0)
    for _ in range(20_000):
        reference = follow(reference, goal, 0.0, speed=0.5, acceleration=1.0, yaw_rate=1.0, dt=DT)
        if arrived(reference, goal):
            break
    assert arrived(reference, goal)


@settings(max_examples=40, deadline=None)
@given(points, points, points, st.floats(0.02, 2.0), st.floats(0.1, 3.0))
def test_position_velocity_and_acceleration_of_a_reference_belong_to_each_other(
    start: tuple[float, float, float],
    velocity: tuple[float, float, float],
    goal: tuple[float, float, float],
    speed: float,
    acceleration: float,
) -> None:
    """Whoever follows a set-point takes each for the slope of the one before; and it ends with the way."""
    reference = Reference(start, velocity)
    for _ in range(2_000):
        before = reference
        reference = follow(reference, goal, 0.0, speed=speed, acceleration=acceleration, yaw_rate=1.0, dt=DT)
        assert norm(reference.acceleration) <= acceleration * (1.0 + 1e-9)
        if arrived(reference, goal):
            break
        assert add(before.velocity, scale(reference.acceleration, DT)) == pytest.approx(reference.velocity, abs=1e-9)
        assert add(before.position, scale(reference.velocity, DT)) == pytest.approx(reference.position, abs=1e-9)
    still = follow(reference, goal, 0.0, speed=speed, acceleration=acceleration, yaw_rate=1.0, dt=DT)
    if arrived(reference, goal):
        assert still.acceleration == ZERO
    assert reference.still == Reference(reference.position, ZERO, reference.yaw)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1), points)
def test_turning_there_and_back_changes_nothing(
    q: tuple[float, float, float, float], v: tuple[float, float, float]
) -> None:
    length = math.hypot(*q)
    unit = (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
    assert unrotate(unit, rotate(unit, v)) == pytest.approx(v, abs=1e-9)
    assert norm(rotate(unit, v)) == pytest.approx(norm(v), abs=1e-9)


@given(angles)
def test_heading_of_a_level_attitude(yaw: float) -> None:
    q = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    assert abs(wrap_angle(yaw_of(q) - yaw)) < 1e-9
    assert rotate(q, (1.0, 0.0, 0.0)) == pytest.approx((math.cos(yaw), math.sin(yaw), 0.0), abs=1e-9)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(1e-3, 10.0), st.floats(1e-2, 10.0))
def test_a_low_pass_goes_towards_the_new_value_and_never_past_it(
    old: float, new: float, dt: float, lag_s: float
) -> None:
    after = low_pass(old, new, dt, lag_s)
    assert min(old, new) - 1e-9 <= after <= max(old, new) + 1e-9
    assert abs(new - after) <= abs(new - old) * lag_s / (lag_s + dt) + 1e-9
    assert low_pass_vec((old, new, 0.0), (new, old, 0.0), dt, lag_s) == (after, low_pass(new, old, dt, lag_s), 0.0)
