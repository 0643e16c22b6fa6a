"""The arc: kinematics through straight, statics, allocation, stiffness, and the paper's own coordinates."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.arm import allocation, arc, paper, statics, stiffness
from arm_companion.arm.arc_model import ArcModel
from arm_companion.arm.model import HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides, Segment, Tendon
from arm_companion.config.schema import ArmConfig
from arm_companion.errors import ConfigError, LimitViolated
from arm_companion.geometry import so3
from arm_companion.geometry.se3 import Pose

L = 0.25
P = ArmParameters.of(ArmConfig(), Guides.CONTINUOUS)
angles = st.floats(-math.pi, math.pi)
bends = st.one_of(st.sampled_from([0.0, 1e-13, 1e-6, 0.0499, 0.0501, 0.141, 0.142]), st.floats(0.0, 3.0))


def arm(count, first=0.3, T0=4.0, guides=Guides.CONTINUOUS):
    """The reference arm with another number of tendons."""
    tendons = tuple(Tendon(first + 2 * math.pi * k / count, 3000.0, T0) for k in range(count))
    return ArmParameters(P.segments, tendons, guides)


@given(bends, angles)
def test_jacobian_is_the_derivative(theta, delta):
    u, h = paper.bend_of(theta, delta), 1e-6
    for j, step in enumerate(h * np.eye(2)):
        up, down = u + step, u - step
        slope = (arc.tip_position(up, L) - arc.tip_position(down, L)) / (2 * h)
        turn = so3.log(arc.tip_rotation(up) @ arc.tip_rotation(down).T) / (2 * h)
        assert np.allclose(arc.jacobian(u, L)[:, j], np.concatenate((slope, turn)), atol=2e-9)


@given(bends, angles, st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_turning_of_a_dead_load_is_the_derivative(theta, delta, load):
    u, w, h = paper.bend_of(theta, delta), np.array(load), 1e-5
    slope = [(arc.jacobian(u + d, L).T @ w - arc.jacobian(u - d, L).T @ w) / (2 * h) for d in h * np.eye(2)]
    assert np.allclose(arc.twist_jacobians(u, w, L), np.array(slope).T, atol=2e-8)


@given(bends, angles)
def test_the_series_meet_the_closed_forms(theta, delta):
    u = paper.bend_of(theta, delta)
    R = arc.tip_rotation(u)
    axis = np.array((-math.sin(delta), math.cos(delta), 0.0))
    assert np.allclose(R, so3.exp(theta * axis), atol=1e-13)
    rho = L * (1 - math.cos(theta)) / theta if theta > 1e-4 else L * theta / 2
    assert np.allclose(arc.tip_position(u, L)[:2], (rho * math.cos(delta), rho * math.sin(delta)), atol=1e-12)


@given(bends, angles)
def test_inverse_of_the_tip(theta, delta):
    u = paper.bend_of(theta, delta)
    assert np.allclose(arc.bend_for_tip(arc.tip_position(u, L), L, 1e-6), u, atol=1e-7)


@pytest.mark.parametrize("target", [(0.0, 0.0, 0.3), (0.0, 0.0, 0.1), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)])
def test_what_the_tip_cannot_reach_is_refused(target):
    with pytest.raises(LimitViolated, match="tip distance"):
        arc.bend_for_tip(target, L, 1e-3)


@given(st.floats(0.0, 2.5), angles, st.floats(-1, 1), st.floats(-1, 1))
def test_acceleration_of_a_moving_tip(theta, delta, v, a):
    u, velocity, change, h = paper.bend_of(theta, delta), np.array((v, 0.4)), np.array((a, -0.3)), 1e-4
    where = [arc.tip_position(u + t * velocity + 0.5 * t * t * change, L) for t in (-h, 0, h)]
    assert np.allclose(arc.acceleration(u, velocity, change, L), (where[0] - 2 * where[1] + where[2]) / h**2, atol=1e-6)


@given(bends, angles)
def test_psi_jacobians_are_the_papers(theta, delta):
    c, s = math.cos(delta), math.sin(delta)
    J = paper.task_jacobian(P, theta, delta)
    if theta > 1e-3:
        slope = (theta * math.sin(theta) + math.cos(theta) - 1) / theta**2
        rise = (theta * math.cos(theta) - math.sin(theta)) / theta**2
        side = (1 - math.cos(theta)) / theta
        assert np.allclose(J[:3], L * np.array(((c * slope, -s * side), (s * slope, c * side), (rise, 0))), atol=1e-10)
    turning = ((-s, -c * math.sin(theta)), (c, -s * math.sin(theta)), (0, 1 - math.cos(theta)))
    assert np.allclose(J[3:], turning, atol=1e-12)
    h = 1e-6
    q = [(paper.joint(P, theta + h, delta) - paper.joint(P, theta - h, delta)) / (2 * h)]
    q.append((paper.joint(P, theta, delta + h) - paper.joint(P, theta, delta - h)) / (2 * h))
    assert np.allclose(paper.joint_jacobian(P, theta, delta), np.array(q).T, atol=1e-9)


def test_tendons_are_numbered_as_in_the_paper():
    theta, delta, beta = 0.7, 0.4, math.pi / 2
    printed = [P.r * math.cos(delta + k * beta) * theta for k in range(4)]
    assert np.allclose(paper.joint(P, theta, delta), printed)
    assert np.allclose(P.H @ paper.bend_of(theta, delta), printed)


@given(st.floats(0.05, 2.5), angles)
def test_corrected_stiffness_is_the_second_derivative_of_the_energy(theta, delta):
    u = paper.bend_of(theta, delta)
    pull = statics.pull_for_bend(P, u, 30.0)

    def potential(psi):
        b = paper.bend_of(*psi)
        tau = statics.stretch_tension(P, b, pull)
        return paper.energy(P, psi[0]) + 0.5 * float((tau**2 / P.k_T).sum())

    h, psi = 1e-4, np.array((theta, delta))
    steps = h * np.eye(2)
    numeric = [
        [
            potential(psi + a + b) - potential(psi + a - b) - potential(psi - a + b) + potential(psi - a - b)
            for b in steps
        ]
        for a in steps
    ]
    tau = statics.stretch_tension(P, u, pull)
    K = paper.configuration_stiffness(P, theta, delta, tau)
    assert np.allclose(K, np.array(numeric) / (4 * h * h), atol=2e-5)
    printed = paper.configuration_stiffness(P, theta, delta, tau, printed=True)
    assert printed[0, 0] < 0 < K[0, 0]


@given(st.floats(0.0, 2.0), angles, st.integers(3, 6), st.sampled_from(list(Guides)))
def test_goals_for_a_bend_lead_to_it_and_back(theta, delta, count, guides):
    parameters = arm(count, guides=guides)
    u = paper.bend_of(theta, delta)
    pull = statics.pull_for_bend(parameters, u, 25.0)
    assert np.allclose(statics.bend_for_pull(parameters, pull), u, atol=1e-8)
    tau = statics.stretch_tension(parameters, u, pull)
    assert np.allclose(statics.pull_for_tension(parameters, u, tau), pull, atol=1e-12)


@given(st.lists(st.floats(-0.05, 0.05), min_size=4, max_size=4))
def test_any_goals_have_an_unloaded_bend_in_equilibrium(pull):
    u = statics.bend_for_pull(P, pull)
    tau = statics.stretch_tension(P, u, pull)
    assert (tau >= 0).all()
    assert np.allclose(statics.bending_moment(P, u, tau), 0, atol=1e-9 * (1 + tau.max()))


@given(st.floats(0.0, 2.0), angles, st.integers(3, 7), st.floats(0.0, 2.0), st.floats(0.0, 10.0))
def test_allocation_holds_the_moment_inside_its_limits(theta, delta, count, least, more):
    parameters = arm(count)
    u = paper.bend_of(theta, delta)
    w = np.array((0.1, -0.2, 0.3, 0.01, 0.0, 0.0))
    tau = allocation.allocate(parameters, u, wrench=w, preferred=least + more, tension_min=least)
    assert tau.min() >= least - 1e-12
    held = parameters.H.T @ tau + arc.jacobian(u, L).T @ w
    assert np.allclose(held, parameters.bending * u, atol=1e-8)


def test_least_tension_of_opposite_pairs_has_a_closed_form():
    u = paper.bend_of(0.8, 0.3)
    pull = P.EI / L * u / P.r  # what the x and the y pair must make
    expected = 0.5 + np.array((max(pull[0], 0), max(-pull[1], 0), max(-pull[0], 0), max(pull[1], 0)))
    assert np.allclose(allocation.allocate(P, u, tension_min=0.5), expected)


def test_allocation_is_the_nearest_to_what_is_preferred():
    # Beyond the limits' reach the solution is the symmetric drive of the paper.
    u = paper.bend_of(0.8, 0.3)
    expected = 4 + 0.8 * P.EI / (2 * P.r * L) * np.cos(P.angles - 0.3)
    assert np.allclose(allocation.allocate(P, u, preferred=4.0), expected)
    assert np.allclose(statics.symmetric_tension(P, u, 4.0), expected)


def test_a_bend_beyond_the_greatest_tension_is_refused_with_what_it_takes():
    with pytest.raises(LimitViolated) as refusal:
        allocation.allocate(P, (9.0, 0.0), tension_min=0.5, tension_max=20.0)
    assert refusal.value.value == pytest.approx(0.5 + 9 * P.EI / L / P.r)


@given(bends, angles)
def test_arc_compliance_is_symmetric_and_of_rank_two(theta, delta):
    u = paper.bend_of(theta, delta)
    C = stiffness.tip_compliance(P, u, np.full(4, 4.0))
    assert np.allclose(C, C.T, atol=1e-12)
    assert np.linalg.matrix_rank(C, tol=1e-10) == 2
    straight = stiffness.stiffness_along(stiffness.tip_compliance(P, (0, 0), np.full(4, 4.0)), (0, 0, 1))
    assert straight == math.inf


def test_arc_model_under_load_is_in_equilibrium_and_its_derivatives_are_slopes():
    model = ArcModel(ArmParameters.of(ArmConfig()))
    pull = model.pull_for_bend((0.5, 0.2))
    w = np.array((0.1, 0.2, 0.0, 0.0, 0.01, 0.0))
    solution = model.free(pull, (1.0, 0.0, 9.0), w, Payload(0.05))
    assert solution.residual < 1e-10
    moved = model.free(pull, (1.0, 0.0, 9.0), w + 1e-4 * np.eye(6)[0], Payload(0.05))
    turn = so3.log(moved.tip_rotation @ solution.tip_rotation.T)
    change = np.concatenate((moved.tip_position - solution.tip_position, turn)) / 1e-4
    assert np.allclose(change, solution.compliance[:, 0], atol=1e-4)


def test_arc_model_takes_a_load_that_turns_with_the_tip_as_the_dead_one_that_it_ends_as():
    model = ArcModel(ArmParameters.of(ArmConfig()))
    pull, gravity = model.pull_for_bend((0.5, 0.2)), (1.0, 0.0, 9.0)
    dead, follower = np.array((0.1, 0, 0, 0, 0, 0.01)), np.array((1.5, -0.8, 0.3, 0.02, 0.05, 0.01))
    solution = model.free(pull, gravity, dead, follower_wrench=follower)
    R = solution.tip_rotation
    turned = np.concatenate((R @ follower[:3], R @ follower[3:]))
    assert np.allclose(solution.tip_wrench, dead + turned)
    same = model.free(pull, gravity, dead + turned)
    assert np.allclose(solution.bend, same.bend, atol=1e-9)
    assert solution.iterations < 8  # quadratic: the stiffness knows that the load turns
    h, force = 1e-5, np.eye(6)[0]
    a, b = (model.free(pull, gravity, dead + k * h * force, follower_wrench=follower) for k in (1, -1))
    change = (a.tip_position - b.tip_position) / (2 * h)
    assert np.allclose(change, solution.compliance[:3, 0], atol=1e-6)


def test_arc_model_held_where_it_is_exerts_nothing_and_resists_when_moved():
    model = ArcModel(P)
    pull = model.pull_for_bend((0.5, 0.2))
    free = model.free(pull, (0.0, 0.0, 0.0))
    hold = free.hold(0.15, HoldKind.CLAMPED)
    at_once = model.held(pull, hold, (0.0, 0.0, 0.0))
    assert np.allclose(at_once.base_wrench, 0, atol=1e-9)
    assert np.allclose(at_once.tension, free.tension)
    moved = model.held(pull, hold.seen_from(Pose(np.eye(3), np.array((-0.002, 0.0, 0.0)))), (0.0, 0.0, 0.0))
    assert moved.base_wrench[0] < -0.1
    anchored = model.anchor(hold, pull, free.tension, (0.0, 0.0, 0.0))
    assert np.allclose(anchored.beyond, hold.beyond, atol=1e-9)


def test_an_arm_that_cannot_bend_every_way_is_refused():
    segment = P.segments[0]
    with pytest.raises(ConfigError, match="every way"):
        ArmParameters((segment,), tuple(Tendon(a, 1.0, 1.0) for a in (0.0, 0.5, 1.0)))
    with pytest.raises(ConfigError, match="every way"):
        ArmParameters((segment, segment), P.tendons)
    with pytest.raises(ConfigError, match="does not exist"):
        ArmParameters((segment,), (*P.tendons, Tendon(0.0, 1.0, 1.0, segment=1)))
    with pytest.raises(ConfigError, match="positive"):
        Segment(L=0.0, r=0.02, disks=10, EI=1.0, GJ=1.0, line_mass=0.0, end_mass=0.0)


def test_parameters_of_the_configuration():
    assert pytest.approx(0.019301945263655692) == P.EI
    assert pytest.approx(0.014512740799741122) == P.GJ
    assert P.k_T == pytest.approx(np.full(4, 3231.352443692358), rel=1e-5)
    assert P.segments[0].line_mass == pytest.approx(0.12296849447401867)
    assert P.mass == pytest.approx(0.036742123618504666)
    soft = ArmConfig(tendons=type(ArmConfig().tendons)(servo_stiffness_n_per_m=3231.352443692358))
    assert ArmParameters.of(soft).k_T[0] == pytest.approx(0.5 * 3231.352443692358)


def test_part_of_an_arm_keeps_line_mass_and_disk_spacing():
    part = P.up_to(0.1)
    assert part.L == 0.1
    assert part.segments[0].L / part.segments[0].disks == pytest.approx(L / 10)
    assert part.mass == pytest.approx(0.1 * P.segments[0].line_mass)
    assert P.up_to(0.3) is P


@given(st.integers(3, 8), st.integers(0, 10_000), st.sampled_from([0.0, 0.5, 2.0]), st.sampled_from([20.0, 60.0]))
def test_allocation_refuses_only_what_cannot_be(count, seed, least, most):
    """Against a linear programme that only asks whether there are tensions at all."""
    from scipy.optimize import linprog

    rng = np.random.default_rng(seed)
    H = rng.uniform(0.005, 0.03) * np.column_stack(
        [f(2 * math.pi * (np.arange(count) + rng.uniform(-0.15, 0.15, count)) / count) for f in (np.cos, np.sin)]
    )
    b = rng.normal(size=2) * rng.choice((0.0, 1e-6, 0.1, 1.0))
    tau = allocation.hold_moment(H, b, np.full(count, max(least, 4.0)), least, most)
    possible = linprog(np.ones(count), A_eq=H.T, b_eq=b, bounds=[(least, most)] * count).status == 0
    assert (tau is not None) == possible
    if tau is not None:
        assert np.allclose(H.T @ tau, b, atol=1e-7)
        assert tau.min() >= least
        assert tau.max() <= most
