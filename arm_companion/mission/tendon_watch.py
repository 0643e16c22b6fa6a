"""Tendons that broke, or jumped off their pulleys: what the servo's load says against what the statics say.

A servo at rest hides several newtons in its gears, so a single reading proves nothing. What counts is a difference
that is many sigma large and stays: noise is averaged away, friction and the model's own doubt are not.
"""

import math
from dataclasses import dataclass

from arm_companion.config.schema import LimitsConfig
from arm_companion.mission.facts import TendonState
from arm_companion.mission.motion import low_pass
from arm_companion.values import replace

_SMOOTHING_S = 0.3
_GONE_SHARE = 0.4  # of the expected tension, under which a tendon does not pull any more


@dataclass(frozen=True)
class Expected:
    """What the statics say of one tendon.

    Attributes:
        tension: N.
        sigma: one sigma, N.
        exact: nothing but the arm itself acts on it; otherwise, at a bar, it may be tighter by any amount.
    """

    tension: float
    sigma: float
    exact: bool


@dataclass(frozen=True)
class TendonWatch:
    """One tendon under suspicion.

    Attributes:
        difference: of load and statics, N, smoothed; positive where the load says more.
        bias: of the load's tension, N, smoothed; one sigma.
        below_s: for how long the load has said too little.
        above_s: for how long it has said too much.
        broken: why it counts as broken, latched; empty: it does not.
        jumped: why it counts as off its path, latched.
    """

    difference: float = 0.0
    bias: float = 0.0
    below_s: float = 0.0
    above_s: float = 0.0
    broken: str = ""
    jumped: str = ""

    @property
    def fault(self) -> str:
        """What is wrong, in words; empty when nothing is."""
        return self.broken or self.jumped


def watch(
    old: tuple[TendonWatch, ...],
    tendons: tuple[TendonState, ...],
    expected: tuple[Expected, ...],
    dt: float,
    limits: LimitsConfig,
) -> tuple[TendonWatch, ...]:
    """Suspicions after one cycle.

    Args:
        old: of the cycle before; empty at the start.
        tendons: as the servos report them.
        expected: what the statics say; empty when they have no solution.
        dt: s.
        limits: thresholds.
    """
    before = old if len(old) == len(tendons) else (TendonWatch(),) * len(tendons)
    if len(expected) != len(tendons) or dt <= 0.0:
        return tuple(_forget(w) for w in before)
    return tuple(
        _watch_one(i, w, tendon, says, dt, limits)
        for i, (w, tendon, says) in enumerate(zip(before, tendons, expected, strict=True))
    )


def _forget(w: TendonWatch) -> TendonWatch:
    """A new start, with what was found already."""
    return TendonWatch(broken=w.broken, jumped=w.jumped)


def _watch_one(
    i: int, w: TendonWatch, tendon: TendonState, says: Expected, dt: float, limits: LimitsConfig
) -> TendonWatch:
    if not (tendon.torque and tendon.ready and tendon.homed) or tendon.silent or math.isinf(tendon.tension_sigma):
        return _forget(w)
    difference = low_pass(w.difference, tendon.tension - says.tension, dt, _SMOOTHING_S)
    bias = max(low_pass(w.bias, tendon.tension_bias, dt, _SMOOTHING_S), tendon.tension_bias)
    noise = math.sqrt(max(tendon.tension_sigma**2 - tendon.tension_bias**2, 0.0) * dt / (2.0 * _SMOOTHING_S))
    threshold = limits.tension_disagreement_sigma * math.hypot(bias, noise, says.sigma)
    w = replace(
        w,
        difference=difference,
        bias=bias,
        below_s=w.below_s + dt if difference < -threshold else 0.0,
        above_s=w.above_s + dt if says.exact and difference > threshold else 0.0,
    )
    if w.fault or max(w.below_s, w.above_s) < limits.tension_disagreement_s:
        return w
    found = max(says.tension + difference, 0.0)
    figures = f"load says {found:.1f} N, statics {says.tension:.1f} N"
    if found < _GONE_SHARE * says.tension:
        return replace(w, broken=f"tendon {i + 1} broken or off its pulley: {figures}")
    return replace(w, jumped=f"tendon {i + 1} jumped or caught: {figures}")
