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
    hinge = _Hinge(w, y, way)
    low, high = float(w.min()), float(w.max())
    at = low
    for _ in range(_REFINEMENTS):
        grid = np.linspace(low, high, _GRID)
        k = int(np.argmin(hinge.cost(grid)))
        at, low, high = float(grid[k]), float(grid[max(k - 1, 0)]), float(grid[min(k + 1, _GRID - 1)])
    A = np.column_stack((way, ~way, np.maximum(w - at, 0.0)))
    x, *_ = np.linalg.lstsq(A, y, rcond=None)
    level_in, level_out, slope = (float(v) for v in x)
    r = y - A @ x
    if not slope > 0.0:
        raise NoSolution(math.inf, "the load does not rise")
    J = np.column_stack((-slope * (w > at), A))
    variance = float(r @ r) / max(w.size - 4, 1)
    try:
        sigma = math.sqrt(variance * float(np.linalg.inv(J.T @ J)[0, 0]))
    except (np.linalg.LinAlgError, ValueError):
        raise NoSolution(math.inf, "it is not seen where the load begins to rise") from None
    return Knee(at, sigma * _correlation(r), slope, level_in, level_out, math.sqrt(variance))


class _Hinge:
    """Sums of squares that the best levels and slope leave, for any place of the knee.

    From sums over the readings beyond the knee, so that hundreds of places cost no more than one fit does: the daemon
    asks within a cycle.

    Args:
        w: (q,) m wound up.
        y: (q,) share of full load.
        way: (q,) whether the servo took in.
    """

    def __init__(self, w: Array, y: Array, way: npt.NDArray[np.bool_]) -> None:
        order = np.argsort(w, kind="stable")
        self._w = w[order]
        # about their means: differences of large sums would lose what is looked for
        self._middle = float(w.mean())
        w, y = self._w - self._middle, y[order] - y.mean()
        ways = np.column_stack((way[order], ~way[order])).astype(np.float64)
        self._count, self._load = ways.sum(axis=0), ways.T @ y
        self._total = float(y @ y) - float(np.sum(self._load**2 / self._count))
        # each row: of all readings from there on
        self._n, self._sum = _from_here(ways), _from_here(ways * w[:, None])
        self._square, self._y, self._wy = (_from_here(v[:, None])[:, 0] for v in (w * w, y, w * y))

    def cost(self, at: Array) -> Array:
        """Sums of squares (k,) with the knee at (k,), m."""
        first, at = np.searchsorted(self._w, at, side="right"), at - self._middle
        n, total = self._n[first], self._sum[first]
        h = total - at[:, None] * n  # sums of max(w - at, 0), for each way
        hh = self._square[first] - 2.0 * at * total.sum(axis=1) + at * at * n.sum(axis=1)
        hy = self._wy[first] - at * self._y[first]
        spread = hh - (h * h / self._count).sum(axis=1)
        gain = hy - (h * self._load / self._count).sum(axis=1)
        seen = spread > 1e-9 * max(float(self._square[0]), 1e-30)
        return np.asarray(self._total - np.where(seen, gain * gain / np.where(seen, spread, 1.0), 0.0))


def _from_here(v: Array) -> Array:
    """Sums (q + 1, k) of the rows of v (q, k) from each one to the last; the last row is none."""
    return np.vstack((np.cumsum(v[::-1], axis=0)[::-1], np.zeros((1, v.shape[1]))))


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
