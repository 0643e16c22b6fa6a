"""Where a tendon becomes taut, from how the load of its servo rises while it takes up the slack. Pure arithmetic.

A tendon alone bends the arm, which is soft (some 0.2 N/mm): where it starts to pull tells how the arm is bent, not
how tight the tendons are against each other. All tendons together cannot bend it and are stiff (3 N/mm): where they
start to pull tells their tightness and nothing else. Both together give the zeros.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from arm_companion.errors import NoSolution
from arm_companion.geometry.arrays import Array

_LEAST_SAMPLES = 8
_GRID = 60
_REFINEMENTS = 4
_MOST_CORRELATED = 0.95


@dataclass(frozen=True, slots=True)
class Knee:
    """Where a tendon alone becomes taut, and the load of its servo before that.

    Attributes:
        at: m wound up.
        sigma: one sigma of it, m.
        slope: by which the load grows from there, share of full load per m.
        inwards: load of the slack servo on the way in, share of full load: friction, and the reading's own offset.
        outwards: the same on the way out.
        noise: one sigma of one reading of the load.
    """

    at: float
    sigma: float
    slope: float
    inwards: float
    outwards: float
    noise: float

    @property
    def friction(self) -> float:
        """Of the gears, share of full load: half of what the direction makes."""
        return 0.5 * (self.inwards - self.outwards)


def knee(wound: Sequence[float], load: Sequence[float], inwards: Sequence[bool]) -> Knee:
    """Fit `load = level(direction) + slope max(0, wound - at)` by least squares.

    Given `at` the rest is linear, so only `at` is searched for.

    Args:
        wound: (n,) m.
        load: (n,) share of full load.
        inwards: (n,) whether the servo took in.

    Raises:
        NoSolution: too few readings, or the load does not rise.
    """
    w, y = np.asarray(wound), np.asarray(load)
    way = np.asarray(inwards, dtype=np.bool_)
    if min(int(way.sum()), int((~way).sum())) < _LEAST_SAMPLES:
        raise NoSolution(math.inf, "too few readings")
    low, high = float(w.min()), float(w.max())
    at = low
    for _ in range(_REFINEMENTS):
        grid = np.linspace(low, high, _GRID)
        k = int(np.argmin([_hinge(w, y, way, float(g))[1] for g in grid]))
        at, low, high = float(grid[k]), float(grid[max(k - 1, 0)]), float(grid[min(k + 1, _GRID - 1)])
    x, cost = _hinge(w, y, way, at)
    level_in, level_out, slope = (float(v) for v in x)
    r = y - _basis(w, way, at) @ x
    if not slope > 0.0:
        raise NoSolution(math.inf, "the load does not rise")
    J = np.column_stack((-slope * (w > at), way, ~way, np.maximum(w - at, 0.0))).astype(np.float64)
    variance = cost / max(w.size - 4, 1)
    try:
        sigma = math.sqrt(variance * float(np.linalg.inv(J.T @ J)[0, 0]))
    except (np.linalg.LinAlgError, ValueError):
        raise NoSolution(math.inf, "it is not seen where the load begins to rise") from None
    return Knee(at, sigma * _correlation(r), slope, level_in, level_out, math.sqrt(variance))


def _hinge(w: Array, y: Array, way: npt.NDArray[np.bool_], at: float) -> tuple[Array, float]:
    """Levels and slope of the best hinge with its knee `at` (3,), and its sum of squares."""
    A = _basis(w, way, at)
    x, *_ = np.linalg.lstsq(A, y, rcond=None)
    r = y - A @ x
    return np.asarray(x, dtype=np.float64), float(r @ r)


def _basis(w: Array, way: npt.NDArray[np.bool_], at: float) -> Array:
    return np.column_stack((way, ~way, np.maximum(w - at, 0.0)))


def _correlation(r: Array) -> float:
    """By how much sigmas grow because one residual (n,) resembles the next: the arm swings, servos stick and slip."""
    rho = float(r[1:] @ r[:-1]) / max(float(r @ r), 1e-30)
    rho = min(max(rho, 0.0), _MOST_CORRELATED)
    return math.sqrt((1.0 + rho) / (1.0 - rho))


def balanced(H: Array) -> Array:
    """Combinations of tensions that bend nothing (n, n - m), orthonormal columns: the null space of H^T.

    Args:
        H: (n, m) m, how tendons' paths change with the bend.
    """
    u, _, _ = np.linalg.svd(H, full_matrices=True)
    return np.asarray(u[:, H.shape[1] :])


def combine(alone: Array, alone_sigma: Array, N: Array, together: Array, together_sigma: Array) -> tuple[Array, Array]:
    """Zeros from where tendons pull alone and where they pull together, each weighted by its variance.

    Args:
        alone: (n,) m.
        alone_sigma: (n,) m.
        N: (n, k) combinations of zeros that `together` knows: `N^T zeros`.
        together: (k,) m.
        together_sigma: (k,) m.

    Returns:
        Zeros (n,), m, and one sigma of each (n,), m.
    """
    P = np.diag(np.square(alone_sigma))
    S = N.T @ P @ N + np.diag(np.square(together_sigma))
    K = np.linalg.solve(S, N.T @ P).T
    zeros = alone + K @ (together - N.T @ alone)
    covariance = P - K @ N.T @ P
    return zeros, np.sqrt(np.clip(np.diag(covariance), 0.0, None))
