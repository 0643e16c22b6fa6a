"""Statics of the unloaded arm: tendon goals for a bend, and the bend that tendon goals lead to.

Without load and gravity every segment of the rod is an exact arc, so these small problems are not an
approximation. u (2 m,) holds the bend of each of the m segments; one segment has u = (theta cos delta,
theta sin delta). The paper's statics (eq. 11) in these coordinates: H^T tau + J_xu^T w = (EI / L) u.
"""

import numpy as np

from arm_companion.arm.parameters import ArmParameters
from arm_companion.errors import LimitViolated, NoSolution
from arm_companion.geometry.arrays import Array, ArrayLike

_ITERATIONS = 60
_TOLERANCE = 1e-12
_ROUNDING = 16 * 2.0**-52


def stretch_tension(parameters: ArmParameters, u: ArrayLike, pull: ArrayLike) -> Array:
    """Tension tau (n,), N, of tendons that can only pull: max(0, T0 + k_T (pull - H u - chord loss))."""
    u = np.asarray(u, dtype=np.float64)
    slack = np.asarray(pull) - parameters.H @ u - parameters.chord_loss @ (u * u)
    return np.maximum(0.0, parameters.T0 + parameters.k_T * slack)


def pull_for_tension(parameters: ArmParameters, u: ArrayLike, tension: ArrayLike) -> Array:
    """Tendon goals (n,), m, that give these tensions (n,), N, at the bend u, stretch made up for."""
    u = np.asarray(u, dtype=np.float64)
    path = parameters.H @ u + parameters.chord_loss @ (u * u)
    return np.asarray(path + (np.asarray(tension) - parameters.T0) / parameters.k_T)


def bending_moment(parameters: ArmParameters, u: ArrayLike, tension: ArrayLike) -> Array:
    """What tendons of these tensions leave to be held at bend u (2 m,), N m: (EI_eff / L) u - H^T tau.

    With real disks EI_eff = EI - l_d^2 sum(tau) / 12 (chords pull the arm further into its bend).
    """
    u = np.asarray(u, dtype=np.float64)
    tau = np.asarray(tension)
    return np.asarray((parameters.bending - 2 * tau @ parameters.chord_loss) * u - tau @ parameters.H)


def symmetric_tension(parameters: ArmParameters, u: ArrayLike, pretension: ArrayLike) -> Array:
    """Tension (n,) that holds the bend u with the smallest departure from `pretension`; may be negative.

    For four tendons T0 + theta EI / (2 r L) cos(phi_i - delta). Where an entry is negative that bend is not
    reached with this pretension: the tendon goes slack first.
    """
    tau = np.array(np.broadcast_to(np.asarray(pretension, dtype=np.float64), (parameters.n,)))
    # The disks' share of the stiffness depends on the sum of tensions, which the correction hardly changes.
    for _ in range(3 if parameters.chord_loss.any() else 1):
        tau = tau + parameters.least_tension @ bending_moment(parameters, u, tau)
    return np.asarray(tau)


def pull_for_bend(parameters: ArmParameters, u: ArrayLike, pretension: float | None = None) -> Array:
    """Tendon goals (n,), m, for the unloaded bend u (2 m,), own stretch included.

    Args:
        parameters: the arm.
        u: bend, rad.
        pretension: mean tension, N; the configured one when None. Goals are differential about it: a bend
            so large that the outer tendon goes slack is not fully reached (`bend_for_pull` tells).
    """
    start: ArrayLike = parameters.T0 if pretension is None else np.full(parameters.n, pretension)
    return pull_for_tension(parameters, u, symmetric_tension(parameters, u, start))


def bend_for_pull(parameters: ArmParameters, pull: ArrayLike) -> Array:
    """The unloaded bend u (2 m,), rad, that tendon goals (n,), m, lead to, slack tendons left out.

    The minimum of EI |u|^2 / (2 L) + sum of tau_i^2 / (2 k_i), by Newton with the set of taut tendons updated
    in every step.

    Raises:
        LimitViolated: when chords between the disks take all stiffness: the backbone buckles between them.
        NoSolution: when no minimum is found.
    """
    q = np.asarray(pull, dtype=np.float64)
    H, c, k = parameters.H, parameters.chord_loss, parameters.k_T
    scale = float(parameters.bending.max())
    # What rounding of the goals leaves of the moment; tendons far stiffer than the backbone make much of it.
    reach = float(np.abs(H).max())
    rounding = _ROUNDING * float(k.max()) * reach * (float(np.abs(q).max()) + reach) / scale
    u = bend_of_differences(parameters, q)
    tau, residual, excess = stretch_tension(parameters, u, q), np.inf, np.inf
    for _ in range(_ITERATIONS):
        g = bending_moment(parameters, u, tau)
        residual = float(np.abs(g).max()) / scale
        excess = residual - _tolerance(parameters, tau) - rounding
        if excess < 0:
            break
        u, tau = _descent(parameters, u, tau, H + 2 * c * u, k * (tau > 0), g, q)
    if (parameters.bending - 2 * tau @ c).min() <= 0:
        raise LimitViolated("sum of tensions", float(tau.sum()), 0.0, buckling_tension(parameters))
    if not excess < 0:
        raise NoSolution(residual, "unloaded bend")
    return np.asarray(u)


def bend_of_differences(parameters: ArmParameters, pull: ArrayLike) -> Array:
    """The bend u (2 m,), rad, that the differences of goals (n,), m, ask for, as if no tendon went slack or yielded."""
    q = np.asarray(pull, dtype=np.float64)
    return np.asarray(np.linalg.lstsq(parameters.H, q - q.mean(), rcond=None)[0])


def buckling_tension(parameters: ArmParameters) -> float:
    """Sum of tensions, N, at which chords between the disks take all stiffness of a segment: 12 EI / l_d^2."""
    return min(12 * g.EI * (g.disks / g.L) ** 2 for g in parameters.segments)


def _tolerance(parameters: ArmParameters, tau: Array) -> float:
    """Of the moment left over, relative to EI / L: what double precision leaves of tensions of this size."""
    return _TOLERANCE * (1 + float(tau.max(initial=0.0)) * parameters.r / float(parameters.bending.max()))


def _descent(
    parameters: ArmParameters, u: Array, tau: Array, path: Array, k: Array, g: Array, q: Array
) -> tuple[Array, Array]:
    """Bend and tensions after a Newton step, halved until the energy falls.

    A kink where a tendon goes slack can overshoot.
    """
    K = path.T @ (k[:, None] * path) + np.diag(parameters.bending - 2 * tau @ parameters.chord_loss)
    step = np.linalg.solve(K, g)
    start = _energy(parameters, u, tau)
    rounding = 1e-12 * abs(start)  # below it the energy cannot tell better from worse
    for _ in range(30):
        there = u - step
        tension = stretch_tension(parameters, there, q)
        if _energy(parameters, there, tension) <= start - 1e-4 * float(step @ g) + rounding:
            return there, tension
        step = 0.5 * step
    return u - step, stretch_tension(parameters, u - step, q)


def _energy(parameters: ArmParameters, u: Array, tau: Array) -> float:
    return float(0.5 * parameters.bending @ (u * u) + 0.5 * (tau * tau / parameters.k_T).sum())
