"""The paper's configuration-space stiffness, as it should read and as it is printed (its eq. 16).

psi = (theta, delta), u = theta (cos delta, sin delta). The potential V = E + sum k_i (q_mi - q_i)^2 / 2 of an arm
with locked motors has the second derivative

    K_psi = H - [dJ_q^T/dpsi] tau + J_q^T K_q J_q - [dJ_x^T/dpsi] w

over taut tendons only; the last term is the tip load's. The paper prints the third term with a minus and K_q as
E_T A / L, without the part of the tendon that runs through the housing.
"""

import math

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.parameters import ArmParameters
from arm_companion.geometry.arrays import Array, ArrayLike, sealed

_STRAIGHT = 1e-9  # rad, under which the bend has no direction of its own


def psi(u: ArrayLike, delta: float = 0.0) -> tuple[float, float]:
    """(theta, delta), rad, of a bend u (2,); `delta` where the arm is straight and has none."""
    x, y = float(u[0]), float(u[1])  # type: ignore[arg-type]
    theta = math.hypot(x, y)
    return (theta, math.atan2(y, x)) if theta > _STRAIGHT else (theta, delta)


def k_psi(
    parameters: ArmParameters,
    u: ArrayLike,
    tension: ArrayLike,
    *,
    wrench: ArrayLike | None = None,
    delta: float = 0.0,
) -> Array:
    """K_psi corrected (2, 2), N m/rad: one segment, motors locked.

    Args:
        parameters: the arm.
        u: bend (2,), rad: of a rod, its mean curvature times its length.
        tension: of each tendon (n,), N; zero means slack.
        wrench: dead tip wrench (6,) [N; N m], base axes.
        delta: direction of the bending plane of a straight arm, rad.
    """
    tau = np.asarray(tension, dtype=np.float64)
    held = parameters.k_T * (tau > 0)
    return _k_psi(parameters, u, tau, held, np.zeros(6) if wrench is None else np.asarray(wrench), delta)


def k_psi_printed(
    parameters: ArmParameters, u: ArrayLike, tension: ArrayLike, k_q: float, *, delta: float = 0.0
) -> Array:
    """K_psi as printed (2, 2), N m/rad, with K_q = `k_q`, N/m (the paper's E_T A / L): for comparison only."""
    tau = np.asarray(tension, dtype=np.float64)
    return _k_psi(parameters, u, tau, np.full(parameters.n, -k_q), np.zeros(6), delta)


def _k_psi(P: ArmParameters, u: ArrayLike, tau: Array, k: Array, wrench: Array, delta: float) -> Array:
    """By the chain rule from u: T^T K_u T + g . d2u/dpsi2, with g the force on u that tendons and rod leave."""
    theta, delta = psi(u, delta)
    along, across = np.array((math.cos(delta), math.sin(delta))), np.array((-math.sin(delta), math.cos(delta)))
    b = theta * along
    path = P.H + 2 * P.chord_loss * b
    bending = P.bending - 2 * tau @ P.chord_loss
    g = bending * b - tau @ P.H - arc.jacobian(b, P.L).T @ wrench
    K_u = np.diag(bending) + path.T @ (k[:, None] * path) - arc.twist_jacobians(b, wrench, P.L)
    T = np.column_stack((along, theta * across))
    K = T.T @ K_u @ T
    K[0, 1] += g @ across
    K[1, 0] += g @ across
    K[1, 1] -= theta * (g @ along)
    return sealed(K)
