"""Derivatives of the rod's equations against finite differences, and the compiled equations against them."""

import numpy as np
import pytest

from arm_companion.arm.parameters import ArmParameters, Guides, Tendon
from arm_companion.arm.rod_equations import Loads, Rod
from arm_companion.config.schema import ArmConfig
from arm_companion.errors import LimitViolated
from arm_companion.geometry import so3

P = ArmParameters.of(ArmConfig())


def two_segments(guides=Guides.DISKS):
    distal = tuple(Tendon(t.angle + 0.4, 2500.0, 3.0, segment=1) for t in P.tendons)
    return ArmParameters((P.segments[0], P.segments[0]), (*P.tendons, *distal), guides)


def case(parameters, seed=0, *, tip_moment=True):
    """A rod far from equilibrium under every kind of load."""
    rng = np.random.default_rng(seed)
    rod = Rod(parameters, parameters.L, 4, 2, 24)
    c = 0.3 * rng.normal(size=rod.mesh.size)
    c[0] = 1.0
    loads = Loads(
        gravity=np.array((1.0, 2.0, 9.0)),
        end_mass=0.05,
        force=rng.normal(size=3),
        moment=0.1 * rng.normal(size=3) * tip_moment,
        follower_force=rng.normal(size=3) * tip_moment,
        follower_moment=0.1 * rng.normal(size=3) * tip_moment,
        hung=[(0.02 * rng.normal(size=3), rng.normal(size=3))],
    )
    pull = 0.01 * rng.normal(size=parameters.n) + parameters.T0 / parameters.k_T
    return rod, c, loads, pull


@pytest.mark.parametrize("parameters", [P, ArmParameters.of(ArmConfig(), Guides.CONTINUOUS), two_segments()])
def test_tangent_and_jacobians_are_slopes(parameters):
    rod, c, loads, pull = case(parameters)
    k, h = parameters.k_T, 1e-6
    state = rod.evaluate(c, loads, pull, k)
    tangent = rod.tangent(state, loads, k)
    for j, step in enumerate(h * np.eye(c.size)):
        up, down = (rod.evaluate(x, loads, pull, k) for x in (c + step, c - step))
        assert np.allclose((up.residual - down.residual) / (2 * h), tangent[:, j], atol=2e-7)
        assert np.allclose((up.tip - down.tip) / (2 * h), state.J_p[j], atol=1e-8)
        assert np.allclose(so3.log(up.R_tip @ down.R_tip.T) / (2 * h), state.J_phi[j], atol=1e-7)
        assert np.allclose((up.cables.longer - down.cables.longer) / (2 * h), state.cables.path[:, j], atol=1e-8)


def test_residual_is_the_slope_of_the_energy():
    """With conservative loads only: backbone, tendons, gravity, dead forces at the end."""
    rod, c, loads, pull = case(P, tip_moment=False)
    k, h = P.k_T, 1e-5

    def energy(c):
        s = rod.evaluate(c, loads, pull, k)
        stretch = s.tension / k
        masses = np.append(rod.node_mass, loads.end_mass)
        points = np.vstack(((s.tip[:, None] - s.P).T, s.tip))
        fall = masses @ points @ loads.gravity + loads.force @ s.tip
        fall += sum(force @ (s.tip + s.R_tip @ point) for point, force in loads.hung)
        return 0.5 * rod.diagonal @ c**2 + 0.5 * k @ stretch**2 - fall

    slope = [(energy(c + d) - energy(c - d)) / (2 * h) for d in h * np.eye(c.size)]
    assert np.allclose(slope, rod.evaluate(c, loads, pull, k).residual, atol=1e-7)


def test_tangent_of_conservative_loads_is_symmetric():
    rod, c, loads, pull = case(P, tip_moment=False)
    loads.hung.clear()
    state = rod.evaluate(c, loads, pull, P.k_T)
    K = rod.tangent(state, loads, P.k_T)
    assert np.allclose(K, K.T, atol=1e-7)


def test_untwisted_parallel_tendons_act_on_the_mean_bend_alone():
    rod = Rod(ArmParameters.of(ArmConfig(), Guides.CONTINUOUS), P.L, 4, 2, 12)
    c = np.random.default_rng(1).normal(size=rod.mesh.size) * 0.3
    c[2 * rod.mesh.modes :] = 0.0
    loads = Loads(np.zeros(3), 0.0, np.zeros(3), np.zeros(3))
    state = rod.evaluate(c, loads, P.T0 / P.k_T, P.k_T)
    assert np.allclose(state.cables.longer, -P.H @ c[[0, rod.mesh.modes]], atol=1e-12)
    assert np.allclose(state.cables.path[:, 1 : rod.mesh.modes], 0, atol=1e-14)


def test_a_constant_curvature_is_an_arc():
    from arm_companion.arm import arc

    rod = Rod(P, P.L, 5, 3, 12)
    c = np.zeros(rod.mesh.size)
    c[0], c[rod.mesh.modes] = 1.1, -0.7
    state = rod.evaluate(c, Loads(np.zeros(3), 0.0, np.zeros(3), np.zeros(3)), P.T0 / P.k_T, P.k_T)
    assert np.allclose(state.tip, arc.tip_position((1.1, -0.7), P.L), atol=1e-12)
    assert np.allclose(state.R_tip, arc.tip_rotation((1.1, -0.7)), atol=1e-12)
    assert np.allclose(state.J[[0, rod.mesh.modes]].T, arc.jacobian((1.1, -0.7), P.L), atol=1e-11)


def test_a_bend_inside_the_pitch_radius_is_refused():
    rod = Rod(P, P.L, 4, 2, 12)
    c = np.zeros(rod.mesh.size)
    c[0] = 1.01 * P.L / P.r
    with pytest.raises(LimitViolated, match="pitch radius"):
        rod.evaluate(c, Loads(np.zeros(3), 0.0, np.zeros(3), np.zeros(3)), P.T0 / P.k_T, P.k_T)


@pytest.mark.parametrize("parameters", [P, ArmParameters.of(ArmConfig(), Guides.CONTINUOUS), two_segments()])
def test_compiled_equations_are_the_same(parameters):
    pytest.importorskip("numba")
    from arm_companion.arm.fast import FastRod

    for seed in range(3):
        rod, c, loads, pull = case(parameters, seed)
        fast = FastRod(parameters, parameters.L, 4, 2, 24)
        a, b = (r.evaluate(c, loads, pull, parameters.k_T) for r in (rod, fast))
        for name in ("tip", "R_tip", "m", "base_wrench", "F", "M", "residual", "J", "P", "kappa", "D", "tension"):
            assert np.allclose(getattr(a, name), getattr(b, name), atol=1e-11), name
        assert np.allclose(a.cables.path, b.cables.path, atol=1e-13)
        assert np.allclose(a.cables.longer, b.cables.longer, atol=1e-13)
        K = rod.tangent(a, loads, parameters.k_T)
        # the compiled one takes the far half from the near one by symmetry
        assert np.allclose(K, fast.tangent(b, loads, parameters.k_T), atol=1e-6)
        assert rod.imbalance(a) == pytest.approx(fast.imbalance(b), rel=1e-9)
