"""Laws of the rod model: against shooting, symmetry, invariance, kinks, holds, derivatives, refusals."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_companion.arm.model import Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides, Segment, Tendon
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import ArmConfig
from arm_companion.errors import ConfigError, LimitViolated, ModelError, NoSolution
from arm_companion.geometry import so3
from arm_companion.geometry.se3 import Pose
from tests.unit.shooting import shoot

REFERENCE = ArmParameters.of(ArmConfig())
MODEL = RodModel(REFERENCE)
DOWN = np.array((0.0, 0.0, 9.81))
NOTHING = np.zeros(3)
KINDS = list(HoldKind)


def random_arm(rng):
    """Another arm: length, radius, tendon count and angles, stiffness, pretension, masses, guides."""
    count = int(rng.integers(3, 7))
    EI = 10 ** rng.uniform(-2.2, -1.0)
    segment = Segment(
        L=rng.uniform(0.12, 0.5),
        r=rng.uniform(0.006, 0.03),
        disks=int(rng.integers(8, 20)),
        EI=EI,
        GJ=EI / rng.uniform(1.2, 1.5),
        line_mass=rng.uniform(0.05, 0.3),
        end_mass=rng.uniform(0.0, 0.02),
    )
    k_T, T0 = 10 ** rng.uniform(2.8, 4.0), rng.choice((0.3, 1.0, 4.0))
    first = rng.uniform(0, math.pi)
    tendons = tuple(Tendon(first - 2 * math.pi * k / count, k_T, T0) for k in range(count))
    return ArmParameters((segment,), tendons, Guides.DISKS if rng.random() < 0.5 else Guides.CONTINUOUS)


def test_random_arms_and_loads_are_solved_as_shooting_solves_them_or_refused():
    """Nothing wrong and silent: whatever comes back must hold in a solver that shares no code with it."""
    rng = np.random.default_rng(7)
    outcomes = {"solved": 0, "refused": 0}
    for i in range(48):
        P = random_arm(rng)
        model = RodModel(P)
        g = rng.normal(size=3)
        g *= 9.81 / np.linalg.norm(g)
        bend, delta = rng.uniform(0, 1.8), rng.uniform(-math.pi, math.pi)
        pull = model.pull_for_bend(bend * np.array((math.cos(delta), math.sin(delta))))
        load = Payload(rng.uniform(0, 0.05), rng.normal(size=3) * 0.02)
        force = rng.normal(size=3) * P.EI / P.L**2
        beyond = np.zeros(P.n)
        try:
            if i % 2:
                solution = model.free(pull, g, np.concatenate((force, 0.1 * P.L * force[::-1])), load)
            else:
                free = model.free(pull, g)
                s = P.L * (1.0 if i % 4 else rng.uniform(0.5, 0.9))
                kind = KINDS[i // 2 % 3]
                hold = free.hold(s, kind, axis=rng.normal(size=3) if kind is HoldKind.BAR else None)
                step = rng.normal(size=3) * 0.01 * s - 0.015 * hold.pose.position
                hold = hold.seen_from(Pose(so3.exp(rng.normal(size=3) * 0.05), step))
                beyond = hold.beyond
                solution, load = model.held(pull, hold, g), None
                assert np.allclose(solution.tip_position, hold.pose.position, atol=1e-7)
        except ModelError:
            outcomes["refused"] += 1
            continue
        # Where the arm is taut, shooting itself multiplies every error by exp(L sqrt(N / EI)).
        stretch = math.sqrt(np.linalg.norm(solution.base_wrench[:3]) / P.EI) * solution.arc_length
        if stretch > 6:
            continue
        outcomes["solved"] += 1
        p, R, w, longer = shoot(P, solution, load, rtol=1e-8)
        slack = 1e-4 * math.exp(stretch)
        assert np.linalg.norm(p - solution.tip_position) < slack * P.L
        assert np.linalg.norm(so3.log(R @ solution.tip_rotation.T)) < slack
        scale = P.EI / P.L**2 + np.linalg.norm(solution.base_wrench[:3])
        assert np.linalg.norm(w[:3] - solution.tip_wrench[:3]) < slack * scale
        assert np.linalg.norm(w[3:] - solution.tip_wrench[3:]) < slack * scale * P.L
        tau = np.maximum(0.0, P.T0 + P.k_T * (pull + longer - beyond))
        assert np.abs(tau - solution.tension).max() < slack * (1 + solution.tension.max())
    assert outcomes["solved"] > 32
    assert outcomes["refused"] < 10


def s_shape():
    """Two segments; the second's tendons run through the first, turned against its own."""
    first = REFERENCE.segments[0]
    segments = (replace(first, L=0.15, disks=6), replace(first, L=0.12, disks=5, EI=0.7 * first.EI, r=0.017))
    distal = tuple(Tendon(t.angle + 0.4, 2500.0, 6.0, segment=1) for t in REFERENCE.tendons)
    return ArmParameters(segments, (*(replace(t, T0=8.0) for t in REFERENCE.tendons), *distal))


def test_two_segments_make_the_papers_s():
    model = RodModel(s_shape())
    u = np.array((0.7, 0.2, -0.9, 0.1))
    pull = model.pull_for_bend(u)
    solution = model.free(pull, NOTHING)
    assert np.allclose(solution.bend, u, atol=1e-8)
    middle, tip = solution.section(0.15), solution.section(0.27)
    assert np.allclose(tip.position, solution.tip_position, atol=1e-9)
    assert middle.rotation[0, 2] > 0.3 > solution.tip_rotation[0, 2]
    with pytest.raises(ConfigError, match="one segment"):
        model.bend_for_tip(solution.tip_position)


@pytest.mark.parametrize("s", [0.27, 0.2, 0.12])
def test_two_segments_agree_with_shooting(s):
    P, load = s_shape(), Payload(0.03, np.array((0.01, 0.0, 0.02)))
    model, g = RodModel(P), np.array((1.0, 2.0, 9.0))
    pull = model.pull_for_bend((0.7, 0.2, -0.9, 0.1))
    free = model.free(pull, g, (0.2, 0.1, -0.1, 0.01, 0, 0.01), load)
    hold = free.hold(s, HoldKind.CLAMPED).seen_from(Pose(np.eye(3), np.array((-0.002, 0.002, -0.001))))
    held = model.held(pull, hold, g)
    for solution, payload, beyond in ((free, load, 0.0), (held, None, hold.beyond)):
        p, R, w, longer = shoot(P, solution, payload)
        assert np.allclose(p, solution.tip_position, atol=1e-6)
        assert np.allclose(R, solution.tip_rotation, atol=1e-5)
        assert np.allclose(w, solution.tip_wrench, atol=1e-5)
        tau = np.maximum(0.0, P.T0 + P.k_T * (pull + longer - beyond))
        assert np.allclose(tau, solution.tension, atol=1e-4)


@settings(max_examples=25)
@given(st.floats(0.0, 1.5), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
def test_turning_everything_about_z_turns_the_answer(theta, delta, turn):
    Rz = so3.exp((0.0, 0.0, turn))
    turned = replace(REFERENCE, tendons=tuple(replace(t, angle=t.angle + turn) for t in REFERENCE.tendons))
    u = theta * np.array((math.cos(delta), math.sin(delta)))
    w = np.array((0.2, -0.1, 0.1, 0.01, 0.0, 0.005))
    w_turned = np.concatenate((Rz @ w[:3], Rz @ w[3:]))
    g = np.array((2.0, 1.0, 9.0))
    a = MODEL.free(MODEL.pull_for_bend(u), g, w)
    b = RodModel(turned).free(MODEL.pull_for_bend(u), Rz @ g, w_turned)
    assert np.allclose(Rz @ a.tip_position, b.tip_position, atol=1e-9)
    assert np.allclose(Rz @ a.base_wrench[3:], b.base_wrench[3:], atol=1e-9)
    assert np.allclose(a.tension, b.tension, atol=1e-7)


@pytest.mark.parametrize("order", list(itertools.permutations(range(4)))[::5])
def test_renumbering_tendons_renumbers_the_answer(order):
    other = RodModel(replace(REFERENCE, tendons=tuple(REFERENCE.tendons[i] for i in order)))
    pull = MODEL.pull_for_bend((0.6, -0.3))
    a = MODEL.free(pull, DOWN, (0.2, 0.3, 0, 0, 0, 0))
    b = other.free(pull[list(order)], DOWN, (0.2, 0.3, 0, 0, 0, 0))
    assert np.allclose(a.base_wrench, b.base_wrench, atol=1e-12)
    assert np.allclose(a.tension[list(order)], b.tension, atol=1e-10)


def test_continuity_through_straight():
    w = (0.2, 0.1, -0.1, 0.0, 0.01, 0.0)
    bends = [-1e-3, -1e-6, -1e-12, 0.0, 1e-12, 1e-6, 1e-3]
    tips = [MODEL.free(MODEL.pull_for_bend((b, 0.0)), DOWN, w).tip_position for b in bends]
    slope = (tips[-1] - tips[0]) / 2e-3
    for bend, tip in zip(bends, tips, strict=True):
        assert np.allclose(tip, tips[3] + slope * bend, atol=1e-7)


def test_continuity_through_a_slack_kink():
    """Tension of the outer tendon falls to zero and stays there; deflection has a kink there and no jump."""
    soft = RodModel(REFERENCE.scaled(T0=0.25))
    pull = soft.pull_for_bend((0.3, 0.0))
    forces = np.linspace(0.0, 0.6, 61)
    cold = [soft.free(pull, NOTHING, (f, 0, 0, 0, 0, 0)) for f in forces]
    slack = [s.tension.min() == 0.0 for s in cold]
    assert slack[0] != slack[-1]
    assert sum(a != b for a, b in itertools.pairwise(slack)) <= 2
    steps = np.diff([s.tip_position[0] for s in cold])
    assert (steps > 0).all()
    assert np.abs(np.diff(steps)).max() < 0.35 * steps.max()
    warm = None
    for f, reference in zip(forces[::-1], cold[::-1], strict=True):
        warm = soft.free(pull, NOTHING, (f, 0, 0, 0, 0, 0), start=warm)
        assert np.allclose(warm.tip_position, reference.tip_position, atol=1e-8)


def test_energy_balances_work_around_a_closed_path():
    """A dead force carried around a loop: the tip returns, and the work along the way cancels."""
    pull = MODEL.pull_for_bend((0.5, 0.0))
    loop = [0.3 * np.array((math.cos(a), math.sin(a), 0.5 * math.sin(2 * a))) for a in np.linspace(0, 2 * math.pi, 81)]
    solution, path = None, []
    for f in loop:
        solution = MODEL.free(pull, DOWN, (*f, 0, 0, 0), start=solution)
        path.append(solution.tip_position)
    work = sum(0.5 * (a + b) @ (q - p) for a, b, p, q in zip(loop, loop[1:], path, path[1:], strict=False))
    assert np.allclose(path[0], path[-1], atol=1e-9)
    assert abs(work) < 2e-4 * sum(np.linalg.norm(q - p) * 0.3 for p, q in itertools.pairwise(path))


def slopes(function, size, step):
    """Central differences (rows of the result, size)."""
    return np.column_stack([(function(d) - function(-d)) / (2 * step) for d in step * np.eye(size)])


@pytest.mark.parametrize("follower", [None, np.array((0.1, 0.2, 0.05, 0.01, -0.02, 0.01))])
def test_derivatives_of_a_free_arm(follower):
    pull, g = MODEL.pull_for_bend((0.7, 0.3)), np.array((1.0, -2.0, 9.0))
    w, load = np.array((0.2, 0.1, -0.3, 0.01, 0.02, 0.005)), Payload(0.05, np.array((0.01, 0.02, 0.03)))

    def solve(pull=pull, g=g, w=w, model=MODEL):
        return model.free(pull, g, w, load, follower_wrench=follower)

    here = solve()
    d = here.derivatives

    def twist(w):
        s = solve(w=w)
        return np.concatenate((s.tip_position, so3.log(s.tip_rotation @ here.tip_rotation.T)))

    assert np.allclose(slopes(lambda x: solve(pull=pull + x).base_wrench, 4, 1e-5), d.pull, atol=1e-4)
    assert np.allclose(slopes(lambda x: solve(g=g + x).base_wrench, 3, 1e-3), d.gravity, atol=1e-6)
    assert np.allclose(slopes(lambda x: solve(w=w + x).base_wrench, 6, 1e-5), d.tip_wrench, atol=1e-5)
    assert np.allclose(slopes(lambda x: solve(w=w + x).tension, 6, 1e-5), d.tension, atol=1e-4)
    assert np.allclose(slopes(lambda x: twist(w + x), 6, 1e-5), d.compliance, atol=1e-5)
    for name, slope in d.parameters.items():
        numeric = slopes(
            lambda x, n=name: solve(model=RodModel(REFERENCE.scaled(**{n: 1 + x[0]}))).base_wrench, 1, 1e-5
        )
        assert np.allclose(numeric[:, 0], slope, atol=1e-7), name


@pytest.mark.parametrize(
    ("kind", "s", "pivot"),
    [
        (HoldKind.CLAMPED, 0.25, (0.0, 0.0, 0.0)),
        (HoldKind.CLAMPED, 0.13, (0.0, 0.03, 0.01)),
        (HoldKind.PINNED, 0.25, (0.0, 0.0, 0.0)),
        (HoldKind.BAR, 0.25, (0.03, 0.01, 0.02)),
        (HoldKind.BAR, 0.15, (0.0, 0.0, 0.0)),
    ],
)
def test_derivatives_of_a_held_arm(kind, s, pivot):
    pull, g = MODEL.pull_for_bend((0.7, 0.3)), np.array((1.0, -2.0, 9.0))
    axis = (0.2, 1.0, 0.3) if kind is HoldKind.BAR else None
    hold = MODEL.free(pull, g).hold(s, kind, axis=axis, pivot=pivot)
    hold = hold.seen_from(Pose(so3.exp((0.0, 0.02, 0.01)), np.array((-0.003, 0.001, -0.004 * s / 0.25))))
    here = MODEL.held(pull, hold, g)
    d = here.derivatives

    def moved(twist):
        T = Pose(so3.exp(twist[3:]), twist[:3]).inverse()  # the old base from the new one
        return MODEL.held(pull, hold.seen_from(T), T.rotation @ g, start=here).base_wrench

    scale = np.abs(d.hold).max()
    assert np.allclose(slopes(moved, 6, 2e-6), here.base_stiffness, atol=2e-4 * scale)
    by_pull = slopes(lambda x: MODEL.held(pull + x, hold, g, start=here).base_wrench, 4, 2e-6)
    assert np.allclose(by_pull, d.pull, atol=2e-4 * scale)
    by_gravity = slopes(lambda x: MODEL.held(pull, hold, g + x, start=here).base_wrench, 3, 0.5)
    assert np.allclose(by_gravity, d.gravity, atol=2e-4)
    for name, slope in d.parameters.items():
        up, down = (RodModel(REFERENCE.scaled(**{name: f})).held(pull, hold, g).base_wrench for f in (1.0001, 0.9999))
        assert np.allclose((up - down) / 2e-4, slope, atol=1e-4 * np.abs(slope).max() + 1e-6), name


def test_compliance_is_symmetric_without_load_and_blind_along_a_straight_arm():
    C = MODEL.free(MODEL.pull_for_bend((0.0, 0.0)), NOTHING).compliance
    assert np.allclose(C, C.T, atol=1e-12)
    assert np.allclose(C[2], 0, atol=1e-12)
    assert np.linalg.eigvalsh(C).min() > -1e-12


@pytest.mark.parametrize("s", [0.25, 0.17, 0.1])
@pytest.mark.parametrize("gravity", [NOTHING, np.array((3.0, 0.0, 9.0))], ids=["weightless", "tilted"])
def test_gripping_the_arm_changes_nothing_at_once(s, gravity):
    """The part beyond keeps its shape, so base wrench and tensions stay; the clamp takes over what was beyond it."""
    pull = MODEL.pull_for_bend((0.8, -0.4))
    free = MODEL.free(pull, gravity)
    held = MODEL.held(pull, free.hold(s, HoldKind.CLAMPED), gravity)
    assert np.allclose(held.tension, free.tension, atol=1e-4)
    assert np.allclose(held.base_wrench, free.base_wrench, atol=1e-4)
    shape, _ = free.detail.sections(np.array((s,)))
    assert np.allclose(held.tip_rotation, shape[0], atol=1e-7)
    taken = (free.moments.mass - held.moments.mass) * gravity
    assert np.allclose(held.tip_wrench[:3], taken, atol=1e-4)


def test_anchor_reproduces_measured_tensions():
    pull = MODEL.pull_for_bend((0.8, -0.4))
    bare = replace(MODEL.free(pull, DOWN).hold(0.12, HoldKind.CLAMPED), beyond=None)
    measured = np.array((9.0, 3.0, 2.0, 6.0))
    hold = MODEL.anchor(bare, pull, measured, DOWN)
    assert np.allclose(MODEL.held(pull, hold, DOWN).tension, measured, atol=1e-6)
    pulled = MODEL.held(pull + 0.001, hold, DOWN).tension
    assert (pulled > measured).all()


def test_tension_control_is_the_same_equilibrium_and_softer():
    pull, w = MODEL.pull_for_bend((0.6, 0.2)), np.array((0.2, 0.0, 0.1, 0.0, 0.0, 0.0))
    locked = MODEL.free(pull, DOWN, w)
    controlled = MODEL.free(pull, DOWN, w, tension=locked.tension)
    assert np.allclose(controlled.tip_position, locked.tip_position, atol=1e-8)
    assert np.allclose(controlled.base_wrench, locked.base_wrench, atol=1e-8)
    assert controlled.compliance[0, 0] > 1.5 * locked.compliance[0, 0]


def test_a_bar_leaves_the_turn_about_its_axis_free():
    pull = MODEL.pull_for_bend((0.6, 0.0))
    axis, pivot = np.array((0.0, 1.0, 0.0)), np.array((0.04, 0.0, 0.0))
    hold = MODEL.free(pull, NOTHING).hold(0.25, HoldKind.BAR, axis=axis, pivot=pivot)
    moved = hold.seen_from(Pose(np.eye(3), np.array((-0.008, 0.0, -0.002))))
    solution = MODEL.held(pull, moved, NOTHING)
    centre = solution.tip_position + solution.tip_rotation @ pivot
    assert np.allclose(centre, moved.pose @ pivot, atol=1e-8)
    assert np.allclose(solution.tip_rotation @ hold.pose.rotation.T @ axis, axis, atol=1e-8)
    about_bar = solution.tip_wrench[3:] + np.cross(solution.tip_position - centre, solution.tip_wrench[:3])
    assert about_bar @ axis == pytest.approx(0.0, abs=1e-8)
    assert np.linalg.norm(so3.log(solution.tip_rotation @ moved.pose.rotation.T)) > 0.01


def test_warm_and_cold_agree_along_a_path():
    pull = MODEL.pull_for_bend((0.5, 0.2))
    hold = MODEL.free(pull, DOWN).hold(0.25, HoldKind.CLAMPED)
    warm = None
    for x in np.linspace(0, 1, 9):
        seen = hold.seen_from(Pose(so3.exp((0.0, 0.05 * x, 0.02 * x)), np.array((-0.01, 0.004, -0.003)) * x))
        warm = MODEL.held(pull, seen, DOWN, start=warm)
        cold = MODEL.held(pull, seen, DOWN)
        assert np.allclose(warm.base_wrench, cold.base_wrench, atol=1e-5)


def test_force_grows_towards_the_taut_limit_and_beyond_it_is_refused():
    pull = MODEL.pull_for_bend((math.radians(30), 0.0))
    hold = MODEL.free(pull, NOTHING).hold(0.25, HoldKind.CLAMPED)
    margins, forces = [], []
    for d in (0.0, 2e-3, 4e-3, 6e-3, 7e-3, 8e-3):
        solution = MODEL.held(pull, hold.seen_from(Pose(np.eye(3), np.array((d, 0.0, 0.0)))), NOTHING)
        margins.append(solution.taut_margin)
        forces.append(np.linalg.norm(solution.base_wrench[:3]))
    assert (np.diff(margins) < 0).all()
    assert (np.diff(forces) > 0).all()
    assert forces[-1] > 25
    with pytest.raises(LimitViolated, match="distance of the held section"):
        MODEL.held(pull, hold.seen_from(Pose(np.eye(3), np.array((0.0, 0.0, 0.004)))), NOTHING)


def test_room_is_the_way_to_the_taut_limit():
    hold = MODEL.free(MODEL.pull_for_bend((math.radians(30), 0.0)), NOTHING).hold(0.25, HoldKind.CLAMPED)
    for direction in np.vstack((np.eye(3), -np.eye(3), (1.0, 2.0, -0.5))):
        way = hold.room(direction) * direction / np.linalg.norm(direction)
        assert np.linalg.norm(hold.pose.position - way) == pytest.approx(0.25)
        just_inside = hold.seen_from(Pose(np.eye(3), -0.995 * way))
        assert np.linalg.norm(just_inside.pose.position) < 0.25
    assert hold.room((0.0, 0.0, -1.0)) == pytest.approx(0.0029, abs=2e-4)
    with pytest.raises(ValueError, match="direction"):
        hold.room((0.0, 0.0, 0.0))


def test_a_buckling_load_is_refused_and_not_answered_with_the_straight_arm():
    pull = MODEL.pull_for_bend((0.0, 0.0))
    assert MODEL.free(pull, NOTHING, (0, 0, -1.0, 0, 0, 0)).tip_position[2] == pytest.approx(0.25)
    with pytest.raises(NoSolution, match="buckles"):
        MODEL.free(pull, NOTHING, (0, 0, -8.0, 0, 0, 0))


def test_tension_that_buckles_the_backbone_between_its_disks_is_refused():
    weak = ArmParameters((replace(REFERENCE.segments[0], disks=2),), REFERENCE.tendons)
    with pytest.raises(LimitViolated, match="sum of tensions"):
        RodModel(weak.scaled(T0=5.0)).free(np.zeros(4), NOTHING)


@pytest.mark.parametrize(
    "arguments",
    [
        {"pull": (0.0, 0.0, 0.0)},
        {"pull": (0.0, math.nan, 0.0, 0.0)},
        {"gravity": (0.0, 0.0, math.inf)},
        {"tip_wrench": (0.0, 0.0, 0.0)},
    ],
)
def test_nonsense_is_refused(arguments):
    with pytest.raises(ValueError, match=r"shape|finite"):
        MODEL.free(**{"pull": np.zeros(4), "gravity": NOTHING, **arguments})


def test_holds_say_what_they_need():
    with pytest.raises(ValueError, match="axis"):
        Hold(0.2, Pose.identity(), HoldKind.BAR)
    with pytest.raises(ValueError, match="axis"):
        Hold(0.2, Pose.identity(), HoldKind.CLAMPED, np.array((0.0, 1.0, 0.0)))
    with pytest.raises(ValueError, match="arc_length"):
        Hold(0.0, Pose.identity())


def test_solutions_cannot_be_changed():
    solution = MODEL.free(MODEL.pull_for_bend((0.3, 0.0)), DOWN)
    for name in ("tip_position", "tip_rotation", "tension", "base_wrench", "tip_wrench", "pull", "gravity"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(solution, name)[...] = 0
    with pytest.raises(ValueError, match="read-only"):
        solution.derivatives.pull[...] = 0


def test_where_the_mass_is_agrees_with_the_base_wrench():
    solution = MODEL.free(MODEL.pull_for_bend((0.9, 0.4)), DOWN, payload=Payload(0.05, np.array((0.02, 0.0, 0.01))))
    moments = solution.moments
    assert moments.mass == pytest.approx(REFERENCE.mass + 0.05)
    assert np.allclose(solution.base_wrench[:3], moments.mass * DOWN)
    assert np.allclose(solution.base_wrench[3:], np.cross(moments.first, DOWN), atol=1e-12)


def test_sections_lie_on_the_backbone():
    solution = MODEL.free(MODEL.pull_for_bend((0.9, 0.4)), DOWN, (0.3, 0.2, 0.1, 0.0, 0.0, 0.01))
    s = np.linspace(0, 0.25, 501)
    R, p = solution.detail.sections(s)
    assert np.allclose(p[0], 0, atol=1e-12)
    assert np.allclose(R[0], np.eye(3), atol=1e-6)
    assert np.allclose(p[-1], solution.tip_position, atol=1e-10)
    assert np.allclose(R[-1], solution.tip_rotation, atol=1e-6)
    assert np.allclose(np.gradient(p, s, axis=0, edge_order=2), R[:, :, 2], atol=1e-5)
    assert np.allclose(solution.shape(501), p)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("guides", Guides)
def test_tendons_far_stiffer_than_the_backbone_are_solved_as_well_as_rounding_allows(fast, guides):
    if fast:
        pytest.importorskip("numba")
    segment = Segment(L=0.25, r=0.02, disks=10, EI=1e-4, GJ=7.5e-5, line_mass=0.01, end_mass=0.0)
    tendons = tuple(Tendon(-0.5 * math.pi * k, 1e6, 0.05) for k in range(4))
    model = RodModel(ArmParameters((segment,), tendons, guides), fast=fast)
    for theta, delta in itertools.product((0.2, 0.7, 1.1, 1.6), (0.0, 0.4, 2.0)):
        bend = (theta * math.cos(delta), theta * math.sin(delta))
        pull = model.pull_for_bend(bend)
        free = model.free(pull, NOTHING)
        assert np.allclose(free.bend, model.bend_for_pull(pull), atol=1e-7)
        assert np.allclose(free.bend, bend, atol=1e-3)  # a tendon that would have to push is slack


def test_the_compiled_model_gives_the_same_answers():
    pytest.importorskip("numba")
    fast = RodModel(REFERENCE, fast=True)
    rng = np.random.default_rng(0)
    for i in range(12):
        pull, g = MODEL.pull_for_bend(rng.normal(size=2) * 0.6), 6 * rng.normal(size=3)
        load, w = Payload(0.05, 0.02 * rng.normal(size=3)), rng.normal(size=6) * (0.5, 0.5, 0.5, 0.02, 0.02, 0.02)
        a, b = (m.free(pull, g, w, load, follower_wrench=0.2 * w) for m in (MODEL, fast))
        assert np.allclose(a.base_wrench, b.base_wrench, atol=1e-8)
        assert np.allclose(a.derivatives.pull, b.derivatives.pull, atol=1e-6)
        assert a.residual == pytest.approx(b.residual, rel=1e-3, abs=1e-9)
        kind = KINDS[i % 3]
        axis = rng.normal(size=3) if kind is HoldKind.BAR else None
        hold = a.hold((0.25, 0.14)[i % 2], kind, axis=axis, pivot=0.02 * rng.normal(size=3) * (i % 4 > 0))
        hold = hold.seen_from(Pose(np.eye(3), -0.02 * hold.pose.position))
        a, b = (m.held(pull, hold, g) for m in (MODEL, fast))
        assert np.allclose(a.base_wrench, b.base_wrench, atol=1e-7)
        assert np.allclose(a.tension, b.tension, atol=1e-7)


@pytest.mark.parametrize("fast", [False, True])
def test_a_straight_arm_that_is_pushed_buckles_in_no_plane_that_the_model_could_know(fast):
    """The least bend decides; without one every plane is as good, and none is answered."""
    if fast:
        pytest.importorskip("numba")
    model = RodModel(ArmParameters.of(ArmConfig(), Guides.CONTINUOUS), fast=fast)
    closer = Pose(np.eye(3), np.array((0.0, 0.0, -0.005)))
    for u in ((0.0, 0.0), (1e-16, 0.0)):
        pull = model.pull_for_bend(u)
        hold = model.free(pull, NOTHING).hold(0.25, HoldKind.CLAMPED).seen_from(closer)
        with pytest.raises(NoSolution):
            model.held(pull, hold, NOTHING)
    for delta in (0.3, 2.0):
        pull = model.pull_for_bend(1e-4 * np.array((math.cos(delta), math.sin(delta))))
        hold = model.free(pull, NOTHING).hold(0.25, HoldKind.CLAMPED).seen_from(closer)
        wrench = model.held(pull, hold, NOTHING).base_wrench
        P = model.parameters
        assert -wrench[2] == pytest.approx(4 * math.pi**2 * P.EI / P.L**2, rel=0.02)  # Euler's load, and a little
        across = np.array((math.cos(delta), math.sin(delta)))
        assert abs(across @ wrench[3:5]) < 1e-6 * np.linalg.norm(wrench[3:5])
