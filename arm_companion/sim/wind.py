"""The wind of the simulated world: steady, with gusts on top that come and go."""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

from arm_companion.sim.ports import Vec3

_LENGTH_S = (0.8, 3.0)  # of a gust
_PAUSE_S = (1.0, 6.0)  # between two of them
_LEAST_SHARE = 0.3  # of the greatest, that a gust has


@dataclass(frozen=True, slots=True)
class _Gust:
    start: float
    length: float
    peak: Vec3


class Wind:
    """Steady wind and "one minus cosine" gusts, the shape by which aircraft are certified.

    Their directions are level and even, their peaks even up to the greatest; all drawn from the seed.

    Args:
        steady: m/s, world NED.
        gust: greatest peak of a gust, m/s; 0: there are none.
        seed: of what is drawn.
    """

    def __init__(self, steady: Sequence[float], gust: float, seed: int) -> None:
        north, east, down = steady
        self._steady: Vec3 = (north, east, down)
        self._greatest = gust
        self._rng = random.Random(f"wind {seed}")  # noqa: S311 - repeatable by design
        self._gust = self._draw(0.0)

    def at(self, t: float) -> Vec3:
        """Wind in m/s, world NED, at time `t` in s; times must not go back."""
        if not self._greatest:
            return self._steady
        while t >= self._gust.start + self._gust.length:
            self._gust = self._draw(self._gust.start + self._gust.length)
        phase = (t - self._gust.start) / self._gust.length
        share = 0.5 * (1.0 - math.cos(2.0 * math.pi * phase)) if phase > 0.0 else 0.0
        (a, b, c), (x, y, z) = self._steady, self._gust.peak
        return (a + share * x, b + share * y, c + share * z)

    def _draw(self, after: float) -> _Gust:
        heading = self._rng.uniform(-math.pi, math.pi)
        peak = self._greatest * self._rng.uniform(_LEAST_SHARE, 1.0)
        start = after + self._rng.uniform(*_PAUSE_S)
        return _Gust(start, self._rng.uniform(*_LENGTH_S), (peak * math.cos(heading), peak * math.sin(heading), 0.0))
