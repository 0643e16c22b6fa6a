"""A small nonlinear least-squares fit: Levenberg and Marquardt between bounds, and the t that its intervals need.

A handful of parameters and a residual that is smooth in them need no library; the daemon's machine has none.
"""

from collections.abc import Callable
from statistics import NormalDist

import numpy as np

from arm_companion.errors import ModelError, NoSolution
from arm_companion.geometry.arrays import Array

_ITERATIONS = 40
_STEP = 1e-3  # of a parameter, for derivatives
_CONVERGED = 1e-5  # largest step of a parameter


def levenberg_marquardt(
    residual: Callable[[Array], Array], start: Array, lower: Array, upper: Array, step: float = _STEP
) -> tuple[Array, Array, Array]:
    """The x between `lower` and `upper` that makes the sum of squares of `residual(x)` least.

    Args:
        residual: (q,) of x (p,); a `ModelError` from it makes the step shorter.
        start: x to begin with.
        lower: bounds (p,).
        upper: bounds (p,).
        step: of a parameter, for derivatives.

    Returns:
        x (p,), residual (q,) there and Jacobian (q, p) by forward differences, at most one converged step old.

    Raises:
        NoSolution: when it does not settle.
    """
    x, damping = np.array(start), 1e-3
    r = residual(x)
    J = _jacobian(residual, x, r, step)
    for _ in range(_ITERATIONS):
        gradient = J.T @ r
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))  # pressed against a bound
        A = J.T @ J
        scale = np.diag(A) + 1e-12 * float(np.trace(A))
        A = A + damping * np.diag(scale)
        A[held] = 0.0
        A[:, held] = 0.0
        A[held, held] = 1.0
        trial = np.clip(x - np.linalg.solve(A, np.where(held, 0.0, gradient)), lower, upper)
        move = float(np.abs(trial - x).max())
        try:
            r_trial = residual(trial)
        except ModelError:
            r_trial = np.full_like(r, np.inf)
        better = float(r_trial @ r_trial) < float(r @ r)
        if better:
            x, r, damping = trial, r_trial, max(damping / 10, 1e-9)
        if move < _CONVERGED:
            return x, r, J
        if better:
            J = _jacobian(residual, x, r, step)
        else:
            damping *= 10
    raise NoSolution(move, "the fit does not settle")


def _jacobian(residual: Callable[[Array], Array], x: Array, r: Array, step: float) -> Array:
    return np.column_stack([(residual(x + step * e) - r) / step for e in np.eye(x.size)])


def student(confidence: float, degrees: int) -> float:
    """Quantile of Student's t, two-sided; Cornish and Fisher's expansion, within 1 % from 3 degrees of freedom."""
    z = NormalDist().inv_cdf(0.5 * (1 + confidence))
    n = float(max(degrees, 1))
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    fourth = (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160
    return z + first / n + second / n**2 + third / n**3 + fourth / n**4
