"""From base wrench to airframe: frames, inertia counted once, spread, validity; contact and external force."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_companion.arm import arc, contact, external, friction
from arm_companion.arm.model import HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.reaction import (
    GRAVITY,
    BodyMotion,
    Spread,
    Validity,
    gravity_in_base,
    inertial,
    mount,
    reaction,
    swing,
)
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import ArmConfig
from arm_companion.errors import ConfigError
from arm_companion.geometry import so3, wrench
from arm_companion.geometry.se3 import Pose

P = ArmParameters.of(ArmConfig())
MODEL = RodModel(P)
DOWN = np.array((0.0, 0.0, GRAVITY))
BELOW = mount((0.05, 0.0, 0.08), (0.0, 0.0, 0.0))
three = st.lists(st.floats(-2, 2), min_size=3, max_size=3).map(np.array)


def hanging(gravity=DOWN, **kwargs):
    return MODEL.free(MODEL.pull_for_bend((0.6, 0.3)), gravity, **kwargs)


def test_a_straight_arm_below_pulls_the_airframe_down():
    solution = MODEL.free(MODEL.pull_for_bend((0.0, 0.0)), DOWN)
    result = reaction(solution, mount((0.0, 0.0, 0.08), (0.0, 0.0, 0.0)), DOWN)
    assert np.allclose(result.wrench, (0, 0, P.mass * GRAVITY, 0, 0, 0), atol=1e-9)
    assert result.valid
    assert math.isnan(result.taut_margin)


def test_an_arm_mounted_ahead_pitches_the_nose_down():
    solution = MODEL.free(MODEL.pull_for_bend((0.0, 0.0)), DOWN)
    result = reaction(solution, mount((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)), DOWN)
    assert result.wrench[4] == pytest.approx(-0.1 * P.mass * GRAVITY)  # FRD: nose down is negative pitch


def test_an_arm_mounted_upside_down_feels_gravity_along_minus_z():
    above = mount((0.0, 0.0, -0.05), (180.0, 0.0, 0.0))
    g = gravity_in_base(np.eye(3), above)
    assert np.allclose(g, -DOWN, atol=1e-12)
    result = reaction(MODEL.free(MODEL.pull_for_bend((0.4, 0.0)), g), above, g)
    assert np.allclose(result.wrench[:3], P.mass * DOWN, atol=1e-9)


def test_a_pitched_vehicle_tilts_gravity_in_the_base():
    R_wb = so3.from_rpy(0.0, 0.2, 0.7)
    g = gravity_in_base(R_wb, BELOW)
    assert np.allclose(g, GRAVITY * np.array((-math.sin(0.2), 0.0, math.cos(0.2))))


@settings(max_examples=30)
@given(three, three, three)
def test_inertia_is_that_of_its_point_masses(acceleration, rate, change):
    T_ba = mount((0.05, -0.02, 0.08), (10.0, 20.0, -30.0))
    solution = hanging(payload=Payload(0.05, np.array((0.0, 0.01, 0.02))))
    motion = BodyMotion(acceleration, rate, change)
    rod = solution.detail.rod
    state = solution.detail.solved.state
    tip, R = solution.tip_position, solution.tip_rotation
    points = np.vstack(((state.tip[:, None] - state.P).T, tip, tip + R @ (0.0, 0.01, 0.02)))
    masses = np.concatenate((rod.node_mass, (rod.end_mass, 0.05)))
    total = np.zeros(6)
    for m, x in zip(masses, points, strict=True):
        at = T_ba @ x
        a = acceleration + np.cross(change, at) + np.cross(rate, np.cross(rate, at))
        total += wrench.at_point(np.concatenate((-m * a, np.zeros(3))), at)
    assert np.allclose(wrench.transformed(inertial(solution, T_ba, DOWN, motion), T_ba), total, atol=1e-10)


def test_inertia_counts_once_whatever_field_the_solution_was_found_in():
    """A stiff arm solved in the accelerated frame, or in plain gravity with the inertia added, weighs the same."""
    acceleration = np.array((3.0, -1.0, 2.0))
    stiff = RodModel(P.scaled(EI=1e4, GJ=1e4, k_T=10.0))
    pull = stiff.pull_for_tension((0.0, 0.0), np.full(4, 4.0))
    motion = BodyMotion(acceleration=acceleration)
    a = reaction(stiff.free(pull, DOWN), BELOW, DOWN, motion)
    b = reaction(stiff.free(pull, DOWN - acceleration), BELOW, DOWN, motion)
    assert np.allclose(a.wrench, b.wrench, atol=1e-4)
    assert np.allclose(b.wrench[:3], P.mass * (DOWN - acceleration), atol=1e-9)


def test_in_free_fall_the_arm_weighs_nothing():
    assert np.allclose(reaction(hanging(), BELOW, DOWN, BodyMotion(acceleration=DOWN)).wrench[:3], 0, atol=1e-12)


def test_a_swinging_arm_pushes_back_with_its_momentum():
    u, v, a = np.array((0.5, 0.1)), np.array((2.0, -1.0)), np.array((10.0, 5.0))
    h = 1e-4

    def momentum(t):
        """Of the arc at time t, about the base, base at rest."""
        b, rate = u + v * t + 0.5 * a * t * t, v + a * t
        s, total = P.segments[0], np.zeros(6)
        for x, m in [((k + 0.5) / 400, s.line_mass * s.L / 400) for k in range(400)] + [(1.0, s.end_mass)]:
            speed = arc.jacobian(x * b, x * s.L)[:3] @ (x * rate)
            at = arc.tip_position(x * b, x * s.L)
            total += np.concatenate((m * speed, np.cross(at, m * speed)))
        return total

    expected = -(momentum(h) - momentum(-h)) / (2 * h)
    assert np.allclose(swing(P, u, v, a, np.zeros(3)), expected, atol=1e-5)
    turning = swing(P, u, v, np.zeros(2), np.array((0, 0, 1.0))) - swing(P, u, v, np.zeros(2), np.zeros(3))
    assert np.abs(turning[:3]).max() > 1e-3  # Coriolis


def test_sigma_is_what_random_parameters_scatter():
    rng = np.random.default_rng(3)
    spread = Spread(0.05, 0.1, 0.1, 0.1, 0.0, 2e-4, 1e-3, 0.01, 0.01, 0.0, 1e-3, 0.01)
    pull = MODEL.pull_for_bend((0.5, 0.2))
    hold = MODEL.free(pull, DOWN).hold(0.25, HoldKind.CLAMPED)
    hold = hold.seen_from(Pose(np.eye(3), np.array((-0.008, 0.0, 0.0))))
    solution = MODEL.held(pull, hold, DOWN)
    predicted = reaction(solution, BELOW, DOWN, spread=spread)
    samples = []
    for _ in range(200):
        names = ("EI", "GJ", "k_T", "T0")
        factors = {n: 1 + getattr(spread, n) * rng.normal() for n in names}
        model = RodModel(P.scaled(**factors), tolerance=1e-3)
        twist = np.concatenate((spread.hold_position * rng.normal(size=3), spread.hold_rotation * rng.normal(size=3)))
        moved = type(hold)(hold.arc_length, hold.pose.moved(twist), hold.kind, None, hold.pivot, hold.beyond)
        g = so3.exp(spread.gravity_direction * rng.normal(size=3)) @ DOWN
        found = model.held(pull + spread.pull * rng.normal(size=4), moved, g, start=solution)
        turn = so3.exp(spread.mount_rotation * rng.normal(size=3))
        shift = spread.mount_position * rng.normal(size=3)
        samples.append(reaction(found, Pose(turn @ BELOW.rotation, BELOW.position + shift), g).wrench)
    scatter = np.std(samples, axis=0)
    assert np.all(predicted.sigma > 0.75 * scatter)
    assert np.all(predicted.sigma < 1.33 * scatter)


@pytest.mark.parametrize("held", [False, True])
def test_sigma_of_the_mass_counts_how_the_arm_gives_way_to_it(held):
    nothing = dict.fromkeys((f.name for f in fields(Spread)), 0.0)
    spread = Spread(**{**nothing, "mass": 0.03})
    gravity = np.array((5.0, 0.0, -8.0))
    pull = MODEL.pull_for_bend((-1.2, 0.0))
    hold = MODEL.free(pull, gravity).hold(0.25, HoldKind.CLAMPED)
    hold = hold.seen_from(Pose(np.eye(3), np.array((0.005, 0.0, -0.01))))

    def solved(factor):
        segments = tuple(replace(s, line_mass=s.line_mass * factor, end_mass=s.end_mass * factor) for s in P.segments)
        model = RodModel(replace(P, segments=segments))
        return model.held(pull, hold, gravity) if held else model.free(pull, gravity, payload=Payload(0.15 * factor))

    at_base = Pose(np.eye(3), np.zeros(3))
    told = reaction(solved(1.0), at_base, gravity, spread=spread).sigma
    change = np.abs(solved(1.03).base_wrench - solved(0.97).base_wrench) / 2
    assert np.allclose(told, change, rtol=0.02, atol=1e-5)


def test_what_may_not_be_acted_upon_says_why():
    pull = MODEL.pull_for_bend((math.radians(30), 0.0))
    hold = MODEL.free(pull, DOWN).hold(0.25, HoldKind.CLAMPED)
    taut = MODEL.held(pull, hold.seen_from(Pose(np.eye(3), np.array((0.008, 0.0, 0.0)))), DOWN)
    assert "taut" in reaction(taut, BELOW, DOWN, validity=Validity(taut_margin=2e-3)).reason
    assert "old" in reaction(hanging(), BELOW, DOWN, age=0.4).reason
    assert "sigma" in reaction(taut, BELOW, DOWN, validity=Validity(taut_margin=0.0, force_sigma=0.5)).reason
    assert "residual" in reaction(hanging(), BELOW, DOWN, validity=Validity(residual=0.0)).reason
    assert not reaction(hanging(), BELOW, DOWN, age=math.nan).valid


def test_contact_follows_the_vehicle_through_the_world():
    T_wb = Pose(so3.from_rpy(0.1, -0.05, 0.8), np.array((2.0, 1.0, -3.0)))
    T_wa = T_wb @ BELOW
    pull = MODEL.pull_for_bend((0.5, 0.0))
    field = T_wa.rotation.T @ DOWN
    touch = contact.Contact(MODEL.free(pull, field).hold(0.25, HoldKind.CLAMPED), T_wa)
    here = touch.solve(MODEL, pull, T_wa, DOWN)
    assert np.allclose(here.base_wrench[:3], P.mass * field, atol=1e-6)
    back = 0.008 * T_wa.rotation[:, 0]
    moved = touch.solve(MODEL, pull, Pose(T_wa.rotation, T_wa.position + back), DOWN, start=here)
    assert moved.base_wrench[0] < -0.5
    held_at = T_wa @ touch.hold.pose
    assert np.allclose(Pose(T_wa.rotation, T_wa.position + back) @ moved.tip_position, held_at.position, atol=1e-8)


def test_tendons_tell_of_contact_on_a_free_arm_and_not_of_pretension():
    solution = hanging()
    pushed = hanging(tip_wrench=(0.3, 0.0, 0.0, 0.0, 0.0, 0.0))
    residual = contact.tendon_residual(P, pushed.tension, np.full(4, 0.05), solution)
    assert residual.norm > 0.02
    assert residual.significance > 3
    common = contact.tendon_residual(P, solution.tension + 2.0, np.full(4, 0.05), solution)
    assert common.norm < 1e-9


def test_a_hovering_airframe_feels_what_its_thrust_carries_beyond_its_weight():
    mass, arm_weight = 1.5, 0.4
    hover = np.array((0.0, 0.0, -GRAVITY))
    thrust = np.array((0.0, 0.0, -mass * GRAVITY - arm_weight))
    assert np.allclose(contact.airframe_force(mass, hover, thrust), (0, 0, arm_weight))
    residual = contact.force_residual((0, 0, 1.0), (0.3, 0.3, 0.3), (0, 0, 0.2), (0.4, 0.4, 0.4))
    assert residual.significance == pytest.approx(0.8 / 0.5 / math.sqrt(3))


@pytest.mark.parametrize("sigma", [0.02, 0.3])
def test_estimated_tip_force_is_as_wrong_as_it_says(sigma):
    rng = np.random.default_rng(5)
    pull = MODEL.pull_for_bend((0.5, 0.2))
    errors = []
    for _ in range(40):
        force = 0.3 * rng.normal(size=3)
        true = MODEL.free(pull, DOWN, (*force, 0, 0, 0))
        read = true.tension + sigma * rng.normal(size=4)
        estimate = external.estimate_tip_force(MODEL, pull, DOWN, read, np.full(4, sigma), prior=0.3)
        off = estimate.force - force
        errors.append(off @ np.linalg.solve(estimate.covariance, off))
        assert np.allclose(estimate.covariance, estimate.covariance.T)
    # Squared errors in units of the covariance: three of them on average.
    assert 1.8 < np.mean(errors) < 4.5


def test_a_force_along_the_arm_stays_dark_and_an_imu_sees_more():
    pull = MODEL.pull_for_bend((0.5, 0.2))
    true = MODEL.free(pull, DOWN, (0.2, -0.1, 0.3, 0, 0, 0))
    blind = external.estimate_tip_force(MODEL, pull, DOWN, true.tension, np.full(4, 0.3), prior=0.5)
    assert blind.seen[0] > 0.9
    assert blind.seen[2] < 0.1
    along = true.tip_position / np.linalg.norm(true.tip_position)
    assert abs(blind.axes[2] @ along) > 0.9
    helped = external.estimate_tip_force(
        MODEL, pull, DOWN, true.tension, np.full(4, 0.3), prior=0.5, tip_rotation=true.tip_rotation, rotation_sigma=5e-3
    )
    assert np.linalg.det(helped.covariance) < 0.7 * np.linalg.det(blind.covariance)


def test_friction_makes_a_loop_that_closes_and_vanishes_with_its_coefficient():
    pull = MODEL.pull_for_bend((0.5, 0.0))
    ramp = [*np.linspace(0, 0.6, 7), *np.linspace(0.5, 0, 6), *np.linspace(0.1, 0.6, 6)]
    loads = [(f, 0, 0, 0, 0, 0) for f in ramp]
    plain = np.array([MODEL.free(pull, DOWN, w).tip_position[0] for w in loads])
    smooth = np.array([s.tip_position[0] for s in friction.cycle(MODEL, 0.0, pull, DOWN, loads)])
    assert np.allclose(smooth, plain, atol=1e-6)
    rough = np.array([s.tip_position[0] for s in friction.cycle(MODEL, 0.15, pull, DOWN, loads)])
    up, down = rough[3], rough[9]  # the same 0.3 N on the way up and down
    assert down - up > 2e-4
    assert rough[3] < plain[3] < rough[9]
    assert rough[-1] == pytest.approx(rough[6], abs=2e-5)
    wide = np.array([s.tip_position[0] for s in friction.cycle(MODEL, 0.3, pull, DOWN, loads)])
    assert wide[9] - wide[3] > 1.1 * (down - up)


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.6])
def test_friction_belongs_to_the_equilibrium_it_is_returned_with(mu):
    """Drag by the capstan law at this solution, not the one before; else it depends on how loads are stepped."""
    pull = MODEL.pull_for_bend((0.5, 0.2))
    solution = MODEL.free(pull, DOWN)
    grip = friction.Grip.relaxed(solution)
    for force in (0.2, 0.4, 0.8, 0.9, 0.5, 0.1, 0.3):
        solution, grip = friction.step(MODEL, mu, grip, pull, DOWN, (force, 0, 0, 0, 0, 0), start=solution)
        stretch = np.maximum(P.T0 / P.k_T + pull + grip.path, 0.0)
        drag = grip.z * friction.loss(mu, solution.detail.turning()) * stretch
        assert np.allclose(pull - solution.pull, drag, rtol=0, atol=1e-9)
        assert np.allclose(grip.path, -solution.detail.path_beyond(0.0), atol=1e-12)


def test_a_sliding_branch_does_not_depend_on_the_steps_that_led_there():
    pull = MODEL.pull_for_bend((0.5, 0.0))

    def last(count):
        loads = [(f, 0, 0, 0, 0, 0) for f in np.linspace(0.0, 0.9, count)]
        return friction.cycle(MODEL, 0.3, pull, DOWN, loads)[-1].tip_position

    assert np.allclose(last(4), last(19), atol=2e-5)


@pytest.mark.parametrize("x", [0.0, 1e-6, 9.9e-4, 1.01e-3, 0.5])
def test_loss_is_the_mean_of_the_capstan_law(x):
    s = (np.arange(2000) + 0.5) / 2000
    assert friction.loss(1.0, x) == pytest.approx(1 - np.exp(-x * s).mean(), abs=1e-8)


def test_the_arc_model_has_one_segment():
    from arm_companion.arm.arc_model import ArcModel
    from arm_companion.arm.parameters import Tendon

    two = ArmParameters(
        (P.segments[0], P.segments[0]), (*P.tendons, *(Tendon(t.angle, 1e3, 1.0, segment=1) for t in P.tendons))
    )
    with pytest.raises(ConfigError, match="one segment"):
        ArcModel(two)
