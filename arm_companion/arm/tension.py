"""Tension of a tendon from what its servo reports, from the statics, and from both.

A servo without a current sensor infers its load from its duty. Between that and the tendon stand the gain, which
falls with the supply voltage, and the friction of the gears: against the motion while the servo turns, and anything
between -f and +f while it stands, where no reading can tell. What is not known is in the sigma.
"""

import math
from dataclasses import dataclass

_MOVING_SHARE = 0.3
"""One sigma of the friction of a turning gear, as share of it, before anybody has measured it."""


@dataclass(frozen=True, slots=True)
class Tension:
    """An estimate of one tendon's tension.

    Attributes:
        value: N, never negative.
        sigma: one sigma of one reading, N.
        bias: the part of `sigma` that no averaging takes away, N.
    """

    value: float
    sigma: float
    bias: float


@dataclass(frozen=True, slots=True)
class LoadCurve:
    """From load to tension for one servo: `tension = gain (V / volts) (load - offset) -+ friction`.

    Attributes:
        gain: N at 100 % load.
        volts: supply at which `gain` holds, V.
        gain_sigma: share of `gain`.
        offset: load without torque, share of full load.
        friction: of the gears at the tendon, N.
        friction_sigma: of it while the servo turns, N.
        noise: of one reading of the load, share of full load.
    """

    gain: float
    volts: float
    gain_sigma: float
    offset: float
    friction: float
    friction_sigma: float
    noise: float

    @classmethod
    def nominal(
        cls, torque: float, volts: float, torque_sigma: float, friction: float, noise: float, radius: float
    ) -> "LoadCurve":
        """Before any calibration: torques (N m) at a pulley of `radius` m."""
        f = friction / radius
        return cls(torque / radius, volts, torque_sigma, 0.0, f, _MOVING_SHARE * f, noise)

    def tension(self, load: float, direction: int, voltage: float) -> Tension:
        """Tension behind a load.

        Args:
            load: share of full load, positive when pulling.
            direction: +1 while the servo takes tendon in, -1 while it lets out, 0 while it stands.
            voltage: of the supply, V; without a reading (not above 0) that of the curve is taken.
        """
        gain = self.gain * (voltage / self.volts if voltage > 0.0 else 1.0)
        motor = gain * (load - self.offset)
        friction = self.friction_sigma if direction else self.friction / math.sqrt(3.0)  # uniform between -f and f
        bias = math.hypot(friction, self.gain_sigma * motor)
        return Tension(max(motor - direction * self.friction, 0.0), math.hypot(bias, gain * self.noise), bias)


def statics_sigma(tension: float, stiffness: float, zero_sigma: float, spread: float) -> float:
    """One sigma of a tension that the statics predict, N: from the tendon's zero, and from the model's parameters.

    Args:
        tension: predicted, N.
        stiffness: of the tendon, N/m.
        zero_sigma: of its zero, m.
        spread: relative, of what the tension comes from otherwise.
    """
    return math.hypot(stiffness * zero_sigma, spread * tension)


def fuse(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Two independent estimates (value, sigma), each weighted by its variance; a sigma of inf says nothing."""
    (a, s), (b, t) = one, other
    if math.isinf(t) or s == 0.0:
        return one
    if math.isinf(s) or t == 0.0:
        return other
    share = t * t / (s * s + t * t)
    return share * a + (1.0 - share) * b, s * t / math.hypot(s, t)
