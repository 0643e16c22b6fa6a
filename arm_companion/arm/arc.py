"""Kinematics of one arc of constant curvature, in coordinates without a singularity.

The paper's model (Zhao et al., IDETC 2022, eqs. 1 to 9) in u = (theta cos delta, theta sin delta) instead of
psi = (theta, delta): psi is polar and breaks down at theta = 0, where the arm spends its life. With t = |u|

    A = (1 - cos t)/t^2   S = sin t/t   B = (t - sin t)/t^3   dA = A'/t   dS = S'/t
    p = L [A u; S]        R = I + S K + A K^2,   K = hat(-u_y, u_x, 0)

Every quotient is a smooth function of t^2, taken from its series when t^2 is small.
"""

import math
from typing import NamedTuple

import numpy as np

from arm_companion.errors import LimitViolated
from arm_companion.geometry.arrays import Array, ArrayLike

_SERIES_BELOW = 2.5e-3  # t^2 under which the quotients lose digits and the series does not


class Quotients(NamedTuple):
    """A, S, B and the derivatives of A and S by t^2 / 2, at one angle t."""

    A: float
    S: float
    B: float
    dA: float
    dS: float


def quotients(t2: float) -> Quotients:
    """The quotients at t^2 = `t2`, rad^2."""
    if t2 < _SERIES_BELOW:
        return Quotients(
            0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56)),
            1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)),
            1 / 6 - t2 / 120 * (1 - t2 / 42 * (1 - t2 / 72)),
            -1 / 12 + t2 / 180 * (1 - t2 * 3 / 112 * (1 - t2 / 67.5)),
            -1 / 3 + t2 / 30 * (1 - t2 / 28 * (1 - t2 / 54)),
        )
    t = math.sqrt(t2)
    s, c = math.sin(t), math.cos(t)
    versine = 2 * math.sin(0.5 * t) ** 2
    return Quotients(
        versine / t2,
        s / t,
        (t - s) / (t2 * t),
        (t * s - 2 * versine) / (t2 * t2),
        (t * c - s) / (t2 * t),
    )


def tip_position(u: ArrayLike, L: float) -> Array:
    """p_tip_base (3,), m, of the bend u (2,), rad."""
    ux, uy = float(u[0]), float(u[1])  # type: ignore[arg-type]
    k = quotients(ux * ux + uy * uy)
    return np.array((L * k.A * ux, L * k.A * uy, L * k.S))


def tip_rotation(u: ArrayLike) -> Array:
    """R_at (3, 3) of the bend u (2,), rad: no twist about the backbone (the paper's frame {G})."""
    x, y = float(u[0]), float(u[1])  # type: ignore[arg-type]
    k = quotients(x * x + y * y)
    A, S = k.A, k.S
    return np.array(
        (
            (1 - A * x * x, -A * x * y, S * x),
            (-A * x * y, 1 - A * y * y, S * y),
            (-S * x, -S * y, 1 - A * (x * x + y * y)),
        )
    )


def jacobian(u: ArrayLike, L: float) -> Array:
    """J_xu (6, 2): tip twist [m/s; rad/s], base axes, tip point, per du/dt.

    J_v = L [A I + dA u u^T; dS u^T], J_omega = (I + A K + B K^2) [[0, -1], [1, 0], [0, 0]].
    """
    x, y = float(u[0]), float(u[1])  # type: ignore[arg-type]
    A, _, B, dA, dS = quotients(x * x + y * y)
    xy = x * y
    return np.array(
        (
            (L * (A + dA * x * x), L * dA * xy),
            (L * dA * xy, L * (A + dA * y * y)),
            (L * dS * x, L * dS * y),
            (-B * xy, -1 + B * x * x),
            (1 - B * y * y, B * xy),
            (-A * y, A * x),
        )
    )


def twist_jacobians(u: ArrayLike, w: ArrayLike, L: float) -> Array:
    """d(J_xu^T w)/du (2, 2) at constant wrench w (6,) [N; N m], base axes, tip point.

    How the generalised force of a tip load turns with the bend: the term that stiffness under load needs.
    """
    x, y = float(u[0]), float(u[1])  # type: ignore[arg-type]
    t2 = x * x + y * y
    A, S, B, dA, dS = quotients(t2)
    ddA, ddS, dB = _second(t2, Quotients(A, S, B, dA, dS))
    fx, fy, fz, mx, my, mz = (float(value) for value in w)  # type: ignore[arg-type]
    uu = np.array(((x * x, x * y), (x * y, y * y)))
    f = np.array((fx, fy))
    uf = np.outer(np.array((x, y)), f)
    force = dA * (uf + uf.T) + (float(x * fx + y * fy) * dA + fz * dS) * np.eye(2)
    force += (float(x * fx + y * fy) * ddA + fz * ddS) * uu
    # J_omega^T m = [my, -mx] + (x mx + y my) B [-y, x] + A mz [-y, x]
    turn = np.array((-y, x))
    along = x * mx + y * my
    moment = B * np.outer(turn, np.array((mx, my)))
    moment += (along * dB + mz * dA) * np.outer(turn, np.array((x, y)))
    moment += (along * B + A * mz) * np.array(((0.0, -1.0), (1.0, 0.0)))
    return np.asarray(L * force + moment)


def _second(t2: float, k: Quotients) -> tuple[float, float, float]:
    """ddA = dA'/t, ddS = dS'/t and dB = B'/t at t^2 = `t2`."""
    if t2 < 8 * _SERIES_BELOW:  # differences of differences lose digits earlier
        return (
            1 / 90 - t2 / 1680 * (1 - t2 / 45 * (1 - t2 / 79.2)),
            1 / 15 - t2 / 210 * (1 - t2 / 36 * (1 - t2 / 66)),
            -1 / 60 + t2 / 1260 * (1 - t2 / 48 * (1 - t2 / 82.5)),
        )
    return (k.dS - 4 * k.dA) / t2, -(k.S + 3 * k.dS) / t2, -(k.dS + 2 * k.B) / t2


def acceleration(u: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike, L: float) -> Array:
    """Acceleration of the tip (3,), base axes, m/s^2, of a bend that moves.

    Args:
        u: bend (2,), rad.
        velocity: du/dt (2,), rad/s.
        acceleration: d2u/dt2 (2,), rad/s^2.
        L: length, m.
    """
    b, v, a = (np.asarray(value, dtype=np.float64) for value in (u, velocity, acceleration))
    t2 = float(b @ b)
    k = quotients(t2)
    ddA, ddS, _ = _second(t2, k)
    rate = float(b @ v)
    second = float(v @ v + b @ a)
    side = (ddA * rate * rate + k.dA * second) * b + 2 * k.dA * rate * v + k.A * a
    return np.array((L * side[0], L * side[1], L * (k.dS * second + ddS * rate * rate)))


def bend_for_direction(p_tip_base: ArrayLike) -> Array:
    """The bend u (2,) whose tip lies in the direction of `p_tip_base` (3,); a chord stands at theta / 2.

    Raises:
        LimitViolated: for the base point itself, which lies in no direction.
    """
    x, y, z = (float(value) for value in p_tip_base)  # type: ignore[arg-type]
    rho = math.hypot(x, y)
    if math.hypot(rho, z) < 1e-9:
        raise LimitViolated("tip distance from the base", 0.0, 1e-9, math.inf)
    # 2 atan2(rho, z) / rho, smooth through rho = 0 above the base
    ratio = 2 * math.atan2(rho, z) / rho if rho > 1e-12 else (2 / z if z > 0 else 0.0)
    return np.array((ratio * x, ratio * y))


def bend_for_tip(p_tip_base: ArrayLike, L: float, tolerance: float) -> Array:
    """The bend u (2,), rad, that brings the tip to `p_tip_base` (3,), m.

    An arc has two degrees of freedom: the tips that it reaches are one surface, and `tolerance`, m, says how
    far from it along its own direction the target may lie.

    Raises:
        LimitViolated: when the target is nearer or farther than the arc's chord by more than `tolerance`.
    """
    u = bend_for_direction(p_tip_base)
    chord = L * quotients(0.25 * float(u @ u)).S
    distance = math.sqrt(math.fsum(float(value) ** 2 for value in p_tip_base))  # type: ignore[arg-type]
    if abs(distance - chord) > tolerance:
        raise LimitViolated("tip distance from the base", distance, chord - tolerance, chord + tolerance)
    return u
