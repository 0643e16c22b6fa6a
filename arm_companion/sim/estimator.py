"""The stand-in's state estimator: truth with errors that wander the way a real filter's do.

A navigation filter smooths, so its errors are slow, not white: each is a Gauss-Markov process, which drifts like a
bias over its correlation time and keeps its standard deviation for ever. Position and velocity pass a lag besides:
inertial sensors carry them from one moment to the next, so that within a tenth of a second their errors hardly change.
"""

import math
import random
from dataclasses import dataclass

from arm_companion.sim.flight_control import Estimate
from arm_companion.sim.ports import RigidState

_PERIOD_S = 0.01
_REFERENCE_NOISE_M = 0.004
_MOST_SCALE = 3.0
_WANDER_S = 5.0


@dataclass(frozen=True, slots=True)
class _Wander:
    """One sigma and correlation time of one kind of error, and time constant of the lag that smooths it."""

    sigma: float
    correlation_s: float
    smooth_s: float = 0.0


class Estimator:
    """Adds the errors of a good indoor or RTK estimate, all scaled by the one configured position noise.

    At 4 mm position noise: velocity 6 mm/s, attitude 2 mrad, rates 1 mrad/s, accelerometer 0.05 m/s^2; at most
    three times that, since inertial sensors do not get worse with the position fix. Zero noise gives the truth.
    How smooth position and velocity are was measured on ArduPilot's and PX4's SITL (docs/results.md).

    What satellites and a barometer do to a real flight stack's estimate comes on top: a position that wanders within
    seconds, and a velocity that shows nothing of it.

    Args:
        rng: draws the errors.
        position_noise_m: one sigma.
        wander_m: of the wandering, one sigma.
        inertial: whether inertial sensors smooth position and velocity; those of motion capture alone jump about.
    """

    def __init__(
        self, rng: random.Random, position_noise_m: float, wander_m: float = 0.0, *, inertial: bool = True
    ) -> None:
        self._rng = rng
        self._wander = [0.0, 0.0, 0.0]
        self._wander_keep = math.exp(-_PERIOD_S / _WANDER_S)
        self._wander_kick = wander_m * math.sqrt(1.0 - self._wander_keep**2)
        scale = min(position_noise_m / _REFERENCE_NOISE_M, _MOST_SCALE)
        kinds = (
            _Wander(0.8 * position_noise_m, 20.0),  # drift of the position; with the next one sigma in all
            _Wander(0.6 * position_noise_m, 0.2, 0.2) if inertial else _Wander(0.6 * position_noise_m, 0.1),
            _Wander(0.006 * scale, 0.25, 0.25),
            _Wander(0.002 * scale, 10.0),
            _Wander(0.001 * scale, 0.005),
            _Wander(0.05 * scale, 0.005),
        )
        self._keep = [math.exp(-_PERIOD_S / kind.correlation_s) for kind in kinds for _ in range(3)]
        self._lag = [math.exp(-_PERIOD_S / kind.smooth_s) if kind.smooth_s else 0.0 for kind in kinds for _ in range(3)]
        sigmas = [kind.sigma for kind in kinds for _ in range(3)]
        # a lag takes away from the spread of what passes it; before it there is that much more
        spreads = [
            s * math.sqrt((1.0 + g) * (1.0 - g * k) / ((1.0 - g) * (1.0 + g * k)))
            for s, k, g in zip(sigmas, self._keep, self._lag, strict=True)
        ]
        self._kick = [s * math.sqrt(1.0 - k * k) for s, k in zip(spreads, self._keep, strict=True)]
        self._rough = [rng.gauss(0.0, s) for s in spreads]
        self._error = [
            rough * s / spread if spread else 0.0 for rough, s, spread in zip(self._rough, sigmas, spreads, strict=True)
        ]
        self._quiet = position_noise_m == 0.0 and wander_m == 0.0
        self._since = 0.0

    def update(self, state: RigidState, dt: float) -> Estimate:
        """The estimate that belongs to the true `state`, `dt` seconds after the last one."""
        if self._quiet:
            return Estimate(state.position_w, state.velocity_w, state.attitude_wb, state.rate_b, state.specific_force_b)
        self._since += dt
        if self._since >= _PERIOD_S - 1e-9:
            self._since -= _PERIOD_S
            gauss = self._rng.gauss
            self._rough = [
                keep * rough + kick * gauss(0.0, 1.0)
                for keep, rough, kick in zip(self._keep, self._rough, self._kick, strict=True)
            ]
            self._error = [
                rough + lag * (error - rough)
                for lag, error, rough in zip(self._lag, self._error, self._rough, strict=True)
            ]
            if self._wander_kick:  # drawn only where there is any: the same seed gives the same flight without
                self._wander = [self._wander_keep * w + self._wander_kick * gauss(0.0, 1.0) for w in self._wander]
        e, far = self._error, self._wander
        p, v, r, f = state.position_w, state.velocity_w, state.rate_b, state.specific_force_b
        w, x, y, z = state.attitude_wb
        a, b, c = 0.5 * e[9], 0.5 * e[10], 0.5 * e[11]  # small turn in body axes
        attitude = (
            w - x * a - y * b - z * c,
            x + w * a + y * c - z * b,
            y + w * b + z * a - x * c,
            z + w * c + x * b - y * a,
        )
        norm = math.sqrt(sum(part * part for part in attitude))
        return Estimate(
            (p[0] + e[0] + e[3] + far[0], p[1] + e[1] + e[4] + far[1], p[2] + e[2] + e[5] + far[2]),
            (v[0] + e[6], v[1] + e[7], v[2] + e[8]),
            (attitude[0] / norm, attitude[1] / norm, attitude[2] / norm, attitude[3] / norm),
            (r[0] + e[12], r[1] + e[13], r[2] + e[14]),
            (f[0] + e[15], f[1] + e[16], f[2] + e[17]),
        )
