"""ArduPilot's outer loops in the stand-in, and how the daemon makes them hold against a force."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from arm_companion.drivers.path_feedforward import PathFeedforward
from arm_companion.mission.facts import Setpoint
from arm_companion.sim.ardupilot_control import ArdupilotController, square_root_control
from arm_companion.sim.flight_control import Airframe, Estimate, FlightController, MotionSetpoint
from arm_companion.sim.ports import Vec3
from tests.sim.rigid_body import RigidBody

MASS, DT = 1.8, 0.004
FORCE_N = 2.0
LEAN = FORCE_N / MASS
HOME = (0.0, 0.0, -2.0)
STILL = (0.0, 0.0, 0.0)
BEGINS_S, RISES_S = 4.0, 0.3

Shape = Callable[[Setpoint, float], Setpoint]


def plain(setpoint: Setpoint, _now: float) -> Setpoint:
    return setpoint


def without(setpoint: Setpoint, _now: float) -> Setpoint:
    return Setpoint(setpoint.position_w, setpoint.velocity_w, STILL, setpoint.yaw)


def held(axis: int, shape: Shape, seconds: float = 12.0) -> np.ndarray:
    """Where a body goes along an axis that is pushed there and told to stay, m from its place."""
    body = RigidBody(position=np.array(HOME))
    controller = ArdupilotController(Airframe(MASS, thrust_scale=1.03))
    way = np.eye(3)[axis]
    places = []
    for i in range(round(seconds / DT)):
        t = i * DT
        push = FORCE_N * min(max((t - BEGINS_S) / RISES_S, 0.0), 1.0) * way
        body.force = partial(lambda force, _p, _v: force, push)
        lean: Vec3 = tuple((-push / MASS).tolist())
        wanted = shape(Setpoint(HOME, STILL, lean, 0.0), t)
        fly(controller, body, MotionSetpoint(wanted.position_w, wanted.velocity_w, wanted.acceleration_w, 0.0))
        if t >= BEGINS_S:
            places.append(body.position[axis] - HOME[axis])
    return np.array(places)


def fly(controller: FlightController, body: RigidBody, setpoint: MotionSetpoint) -> None:
    s = body.state()
    estimate = Estimate(s.position_w, s.velocity_w, s.attitude_wb, s.rate_b, s.specific_force_b)
    body.step(controller.update(estimate, setpoint, DT), DT)


def test_a_force_pushes_it_away_until_the_integrator_has_it() -> None:
    places = held(0, without)
    assert 0.3 < np.max(np.abs(places)) < 0.5, "0.45 m were measured on a SITL for 2 N"
    assert abs(places[-1]) < 0.02


def test_an_acceleration_set_point_moves_the_end_of_the_path_and_holds_against_nothing() -> None:
    places = held(0, plain)
    assert places[-1] == pytest.approx(-LEAN / 2.0, abs=0.02), "a / (k_a k_v) = a / 2, for ever"


def test_an_acceleration_downward_beyond_the_path_s_own_runs_away() -> None:
    assert held(2, plain)[-1] < -3.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_same_force_told_as_a_path_is_held_against(axis: int) -> None:
    """A stand-in with other words for the same law: an eighth of the error is the rotors' and attitude's own delay."""
    compensated, alone = held(axis, PathFeedforward().shaped), held(axis, without)
    assert np.max(np.abs(compensated)) < 0.25 * np.max(np.abs(alone))
    assert abs(compensated[-1]) < 0.01


def test_each_part_of_a_set_point_makes_a_circle_rounder() -> None:
    errors = [circle(parts) for parts in (1, 2, 3)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.4 * errors[1]


def circle(parts: int) -> float:
    """RMS error on a circle of 2 m in 8 s by position, with velocity, with acceleration."""
    body = RigidBody(position=np.array((2.0, 0.0, -2.0)))
    controller = ArdupilotController(Airframe(MASS))
    rate, squares = 2.0 * math.pi / 8.0, []
    for i in range(round(24.0 / DT)):
        t = i * DT
        c, s = 2.0 * math.cos(rate * t), 2.0 * math.sin(rate * t)
        velocity = (-rate * s, rate * c, 0.0) if parts > 1 else STILL
        acceleration = (-(rate**2) * c, -(rate**2) * s, 0.0) if parts > 2 else STILL
        fly(controller, body, MotionSetpoint((c, s, -2.0), velocity, acceleration, 0.0))
        if t > 16.0:
            squares.append((body.position[0] - c) ** 2 + (body.position[1] - s) ** 2)
    return math.sqrt(float(np.mean(squares)))


def test_square_root_control_is_a_line_near_and_brakes_far() -> None:
    assert square_root_control(0.1, 1.0, 1.0) == pytest.approx(0.1)
    assert square_root_control(-50.0, 1.0, 1.0) == pytest.approx(-math.sqrt(99.0))
    near = 1.0
    assert square_root_control(near * (1 - 1e-9), 1.0, 1.0) == pytest.approx(
        square_root_control(near * (1 + 1e-9), 1.0, 1.0)
    )


def test_what_it_asks_for_reaches_the_motors_smoothed_and_is_told_before() -> None:
    """2 Hz, a constant of AC_PosControl: two thirds of a step after 80 ms."""
    body = RigidBody(position=np.array(HOME))
    controller = ArdupilotController(Airframe(MASS, motor_lag=1e-4))
    for _ in range(500):
        fly(controller, body, MotionSetpoint(HOME, STILL, STILL, 0.0))
    asked, made = [], []
    for _ in range(100):
        up = (HOME[0], HOME[1], HOME[2] - 5.0)
        s = body.state()
        estimate = Estimate(s.position_w, s.velocity_w, s.attitude_wb, s.rate_b, s.specific_force_b)
        rotors = controller.update(estimate, MotionSetpoint(up, (0.0, 0.0, -1.0), STILL, 0.0), DT)
        asked.append(controller.thrust)
        made.append(rotors.thrust_n / (MASS * 9.80665))
        body.step(rotors, DT)
    assert max(asked) > 1.05
    smooth = made[0]
    for told, pushed in zip(asked[1:], made[1:], strict=True):
        smooth += (1.0 - math.exp(-DT / 0.08)) * (told - smooth)
        assert pushed == pytest.approx(smooth, abs=0.01)
