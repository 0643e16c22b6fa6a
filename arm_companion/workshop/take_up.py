"""Where a tendon becomes taut, from how the load of its servo rises while it takes up the slack. Pure arithmetic.

A tendon alone bends the arm, which is soft (some 0.2 N/mm): where it starts to pull tells how the arm is bent, not
how tight the tendons are against each other. All tendons together cannot bend it and are stiff (3 N/mm): where they
start to pull tells their tightness and nothing else. Both together give the zeros.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arm_companion.errors import NoSolution
from arm_companion.geometry.arrays import Array

_LEAST_SAMPLES = 8
_GRID = 60
_REFINEMENTS = 4


@dataclass(frozen=True, slots=True)
class Baseline:
    """Load of a servo that turns without pulling: friction of its gears, and the reading's own offset."""

    inwards: float  # share of full load, mean
    outwards: float
    noise: float  # one sigma of one reading
    samples: int

    @property
    def friction(self) -> float:
        """Half of the difference, share of full load."""
        return 0.5 * (self.inwards - self.outwards)


@dataclass(frozen=True, slots=True)
class Knee:
    """Where a tendon alone becomes taut.

    Attributes:
        at: m wound up.
        sigma: one sigma of it, m.
        slope: by which its tension grows from there, N/m.
    """

    at: float
    sigma: float
    slope: float


def baseline(inwards: Sequence[float], outwards: Sequence[float]) -> Baseline:
    """From loads (shares) of a slack tendon's servo on the way in and on the way out.

    Raises:
        NoSolution: too few readings.
    """
    if min(len(inwards), len(outwards)) < _LEAST_SAMPLES:
        raise NoSolution(math.inf, "too few readings of the slack tendon")
    i, o = np.asarray(inwards), np.asarray(outwards)
    noise = math.sqrt((float(i.var(ddof=1)) + float(o.var(ddof=1))) / 2.0)
    return Baseline(float(i.mean()), float(o.mean()), noise, min(len(i), len(o)))


def knee(wound: Sequence[float], force: Sequence[float], noise: float) -> Knee:
    """Fit `force = max(0, slope (wound - at))` by least squares.

    Args:
        wound: (n,) m.
        force: (n,) N, friction taken off.
        noise: of one force, N; the scatter about the fit counts when it is larger.

    Raises:
        NoSolution: the force does not rise.
    """
    w, f = np.asarray(wound, dtype=np.float64), np.asarray(force, dtype=np.float64)
    if w.size < _LEAST_SAMPLES:
        raise NoSolution(math.inf, "too few readings")
    low, high = float(w.min()), float(w.max())
    best = low
    for _ in range(_REFINEMENTS):
        grid = np.linspace(low, high, _GRID)
        costs = [_hinge(w, f, float(at))[1] for at in grid]
        k = int(np.argmin(costs))
        best = float(grid[k])
        low, high = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, _GRID - 1)])
    slope, cost = _hinge(w, f, best)
    if not slope > 0.0:
        raise NoSolution(math.inf, "the tension does not rise")
    h = np.maximum(w - best, 0.0)
    J = np.column_stack((-slope * (h > 0.0), h))
    scatter = max(noise, math.sqrt(cost / max(w.size - 2, 1)))
    try:
        covariance = scatter**2 * np.linalg.inv(J.T @ J)
    except np.linalg.LinAlgError:
        raise NoSolution(math.inf, "the knee is not seen") from None
    return Knee(best, math.sqrt(float(covariance[0, 0])), slope)


def _hinge(w: Array, f: Array, at: float) -> tuple[float, float]:
    """Slope of the best hinge with its knee `at`, and its sum of squares."""
    h = np.maximum(w - at, 0.0)
    square = float(h @ h)
    slope = float(h @ f) / square if square > 0.0 else 0.0
    r = f - slope * h
    return slope, float(r @ r)


def crossing(x: Sequence[float], y: Sequence[float], level: float, noise: float) -> tuple[float, float]:
    """Where the straight line through points (x, y) reaches `level`, and one sigma of that.

    Raises:
        NoSolution: too few points, or no line that rises.
    """
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.size < _LEAST_SAMPLES or float(np.ptp(a)) == 0.0:
        raise NoSolution(math.inf, "too few readings of all tendons together")
    middle = float(a.mean())
    slope, height = (float(c) for c in np.polyfit(a - middle, b, 1))
    if not slope > 0.0:
        raise NoSolution(math.inf, "the tensions do not rise together")
    scatter = max(noise, float(np.std(b - slope * (a - middle) - height, ddof=min(2, a.size - 1))))
    away = (level - height) / slope
    spread = float(((a - middle) ** 2).sum())
    return middle + away, scatter / slope * math.sqrt(1.0 / a.size + away * away / spread)


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
