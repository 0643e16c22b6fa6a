"""How much the arm carries, weighed with the vehicle's own thrust.

A multirotor tells the thrust that it asks of its rotors as a share without unit (ATTITUDE_TARGET.thrust). What that
share is worth is found in free flight, where the vehicle's mass is all that it lifts. With u the share, c the cosine
of the tilt, and v the speed downwards,

    g - dv/dt = c (a + b (u - u_0)) + d v                                                     (free flight)

has three unknowns: a, what the rotors lift while hovering, which falls as the battery empties; b, how steep the
curve of the rotors is, with whatever makes the supply sag; d, the drag. A Kalman filter finds them, and how fast a
falls, which goes on while something is held and a cannot be seen. Whatever the thrust then is beyond the weight of the
vehicle m is load:

    (m + load) (g - dv/dt) = m (c (a + b (u - u_0)) + d v)                                    (carrying)

The derivative is never taken: all signals pass the same low-pass filter, w' = p (v - w), which gives dv/dt as it is.
What is asked of the rotors passes their own lag before it.

Steepness and drag are learnt from manoeuvres alone. In a hover the autopilot answers the noise of its own estimate, and
a curve that is fitted to those answers becomes flatter with every minute.
"""

import math
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from arm_companion.arm.reaction import GRAVITY
from arm_companion.geometry.arrays import Array
from arm_companion.mission.facts import VehicleState
from arm_companion.mission.motion import rotate
from arm_companion.values import replace

DRAG_PER_S = 0.14
"""Drag of rotors and airframe in slow flight, as an acceleration for each metre a second, before it is learnt."""

ROTOR_LAG_S = 0.04
"""From the thrust that is told to the thrust, s: rotors of a foot take 30 ms, and it is told 50 times a second."""

_POLE = 6.0  # rad/s, of the low-pass filter
_MANOEUVRE = 0.3  # m/s^2, from which on steepness shows above the noise
_FAST_M_PER_S = 0.5  # and drag
_VIOLENT = 1.5  # m/s^2, beyond which the curve is no straight line
_SPECTRUM = 1.5e-3  # m^2/s^3: an acceleration known to 0.05 m/s^2, with errors that last 0.3 s
_DRIFT = 0.005  # m/s^2 per root second, of what the rotors lift at the same share, besides the battery's fall
_PRIOR_SLOPE = 1.25  # of the curve at hover, over that of a straight line through zero
_PRIOR_SIGMA = (1.0, 0.35, 0.1, 0.003)  # of a, m/s^2; the slope, in the same terms; the drag; a's fall, m/s^3
_FALL_DRIFT = 1e-4  # m/s^3 per root second
_LEAST_SHARE = 0.05  # rotors that idle say nothing
_IDLE = 0.6  # of the hover's thrust, under which something else holds the vehicle up
_CLIMB_M_PER_S = (
    0.15  # by which a take-off is known: PX4 says that it flies while its rotors still spin up on the ground
)
_UPRIGHT = 0.7  # cosine of the greatest tilt at which a hover is a hover
_SETTLE_S = 1.0  # after the take-off or a gap, until the filter and the ground are left behind
_GAINS = (0.7, 2.0)  # what a curve of rotors can do
_LEAST_SLOPE = 1.0  # m/s^2
_CALIBRATED = 0.1  # m/s^2, one sigma of a that is good enough to weigh with
_MASS_SPREAD = 0.05  # one sigma of the vehicle's configured mass, relative
_WEIGHED_S = 1.5  # of averaging, until a weight counts
_ENOUGH_S = 8.0  # of averaging, from which on the weight is known, and drift is that of the battery

Vec4 = tuple[float, float, float, float]
Covariance = tuple[Vec4, Vec4, Vec4, Vec4]


@dataclass(frozen=True)
class Flow:
    """What the vehicle does with its thrust, each after the low-pass filter.

    Attributes:
        up: c, cosine of the tilt.
        push: u c, the upward part of the share of thrust.
        sink: v, speed downwards, m/s.
        spun: c and u c after the rotors' lag alone; None: the same.
    """

    up: float
    push: float
    sink: float
    spun: tuple[float, float] | None = None


@dataclass(frozen=True)
class ThrustCurve:
    """What the rotors lift at a share of thrust, per kilogram of the vehicle.

    Attributes:
        at: u_0, the share around which it is known.
        theta: a (m/s^2), b (m/s^2), d (1/s) and da/dt (m/s^3).
        covariance: of theta.
    """

    at: float
    theta: Vec4
    covariance: Covariance

    @classmethod
    def prior(cls, at: float) -> "ThrustCurve":
        """What is known of a hover at the share `at` before anything was measured."""
        slope = GRAVITY / at
        sigma = (_PRIOR_SIGMA[0], _PRIOR_SIGMA[1] * slope, *_PRIOR_SIGMA[2:])
        theta = (GRAVITY, _PRIOR_SLOPE * slope, DRAG_PER_S, 0.0)
        return cls(at, theta, _rows(np.diag(np.square(sigma))))

    @property
    def calibrated(self) -> bool:
        """Whether enough of a hover has been seen to weigh with."""
        return self.covariance[0][0] <= _CALIBRATED**2

    @property
    def gain_sigma(self) -> float:
        """One sigma of `gain`, which its slope is almost all of, unless a has not been seen for long."""
        P, at = self.covariance, self.at
        return math.sqrt(max(at * at * P[1][1] - 2.0 * at * P[0][1] + P[0][0], 0.0)) / GRAVITY

    @property
    def gain(self) -> float:
        """Acceleration that comes of one that is asked for, by an autopilot that takes thrust for proportional.

        Both flight stacks ask for the share u_h (1 + a / g) to accelerate by a, where u_h is that of their hover.
        """
        a, b, _, _ = self.theta
        hover = self.at + (GRAVITY - a) / max(b, _LEAST_SLOPE)
        return min(max(b * hover / GRAVITY, _GAINS[0]), _GAINS[1])

    def lift(self, flow: Flow) -> float:
        """c (a + b (u - u_0)) + d v, m/s^2."""
        return float(self._regressor(flow) @ np.array(self.theta))

    def sigma(self, flow: Flow) -> float:
        """One sigma of `lift`, m/s^2."""
        h = self._regressor(flow)
        return math.sqrt(max(float(h @ np.array(self.covariance) @ h), 0.0))

    def learn(self, flow: Flow, felt: float, dt: float) -> "ThrustCurve":
        """The curve after `dt` seconds in which the rotors lifted the vehicle's mass by `felt` = g - dv/dt, m/s^2."""
        ahead = self.ahead(dt)
        if abs(felt - GRAVITY) > _VIOLENT:
            return ahead
        h, before, P = self._regressor(flow), np.array(ahead.theta), np.array(ahead.covariance)
        Ph = P @ h
        spread = h @ Ph + _SPECTRUM / dt
        gain = Ph / spread
        if abs(felt - GRAVITY) < _MANOEUVRE and abs(flow.sink) < _FAST_M_PER_S:
            gain[1:3] = 0.0  # Schmidt's filter: what is not learnt stays as uncertain as it is
        theta = before + gain * (felt - float(h @ before))
        P += spread * np.outer(gain, gain) - np.outer(gain, Ph) - np.outer(Ph, gain)
        return replace(self, theta=_four(theta), covariance=_rows(0.5 * (P + P.T)))

    def _regressor(self, flow: Flow) -> Array:
        return np.array((flow.up, flow.push - self.at * flow.up, flow.sink, 0.0))

    def ahead(self, dt: float) -> "ThrustCurve":
        """The curve after `dt` seconds of flight in which nothing could be learnt, and the battery went on emptying."""
        theta, P = np.array(self.theta), np.array(self.covariance)
        theta[0] += theta[3] * dt
        P[0] += P[3] * dt
        P[:, 0] += P[:, 3] * dt
        P[0, 0] += _DRIFT**2 * dt
        P[3, 3] += _FALL_DRIFT**2 * dt
        return replace(self, theta=_four(theta), covariance=_rows(P))

    def forget(self, dt: float) -> "ThrustCurve":
        """The curve after `dt` seconds with rotors that idle, or whose thrust is not told."""
        P = np.array(self.covariance)
        P[0, 0] += _DRIFT**2 * dt
        return replace(self, covariance=_rows(P))

    def unplugged(self) -> "ThrustCurve":
        """The curve of a vehicle that stood disarmed, which is when people swap batteries: the rotors stay the same."""
        P = np.array(self.covariance)
        for i in (0, 3):
            P[i, i] = max(P[i, i], _PRIOR_SIGMA[i] ** 2)
        return replace(self, covariance=_rows(P))


class Found(Enum):
    """What a test lift finds on the arm."""

    LITTLE = auto()
    ENOUGH = auto()
    TOO_MUCH = auto()


@dataclass(frozen=True)
class Load:
    """The load on the arm, as far as thrust tells.

    Attributes:
        curve: of the rotors; None until the vehicle has been seen to hover.
        flow: what goes into the curve; None: no signal yet.
        seen_s: how long the filter has been running without a gap.
        now: load of this moment, kg, behind by the filter; nan: it cannot be told.
        mass: mean while the load was carried, kg.
        spread: one sigma of what the curve said while it was weighed, m/s^2.
        weighed_s: length of that mean, s.
        grip: tension of the tightest tendon while carrying, N, smoothed.
        light_s: how long `now` has been too little for the mean.
        propped_s: how long something else has carried part of it.
        found: what the test lift finds at this moment; None: it cannot be told, or there is no test lift.
        found_s: how long it has found just that.
        grounded: the vehicle has been seen to stand, and has not climbed since.
        before: what the flight stack's own loops lifted of it before a push began, kg.
    """

    curve: ThrustCurve | None = None
    flow: Flow | None = None
    seen_s: float = 0.0
    now: float = math.nan
    mass: float = 0.0
    spread: float = 0.0
    weighed_s: float = 0.0
    grip: float = 0.0
    light_s: float = 0.0
    propped_s: float = 0.0
    found: Found | None = None
    found_s: float = 0.0
    grounded: bool = False
    before: float = 0.0

    @property
    def known(self) -> bool:
        """Whether there is a weight that may be acted upon."""
        return self.weighed_s >= _WEIGHED_S

    @property
    def settled(self) -> bool:
        """Whether the weight does not change any more."""
        return self.weighed_s >= _ENOUGH_S

    @property
    def calibrated(self) -> bool:
        """Whether a load can be weighed now."""
        return self.curve is not None and self.curve.calibrated and math.isfinite(self.now)

    def sigma_now(self, vehicle_mass: float) -> float:
        """One sigma of `now`, kg: of the curve, and of what the low-pass filter leaves of the signals' errors."""
        if self.curve is None or self.flow is None:
            return math.inf
        return vehicle_mass / GRAVITY * math.hypot(self.curve.sigma(self.flow), math.sqrt(0.5 * _POLE * _SPECTRUM))

    def sigma(self, vehicle_mass: float) -> float:
        """One sigma of `mass`, kg: of the curve, of the mean, and of the mass of the vehicle that all is counted in."""
        if not self.weighed_s:
            return math.inf

        per = vehicle_mass / GRAVITY
        return math.hypot(
            per * self.spread,
            per * math.sqrt(_SPECTRUM / self.weighed_s),
            _MASS_SPREAD * self.mass,
        )


NO_LOAD = Load()
"""Before anything is known."""


def watch_load(
    old: Load, vehicle: VehicleState, mass: float, dt: float, *, lifted: float | None, lag_s: float = ROTOR_LAG_S
) -> Load:
    """The load after one cycle.

    Args:
        old: before it.
        vehicle: newest state, fresh.
        mass: of the vehicle with its arm, kg.
        dt: s.
        lifted: what the rotors surely lift besides the vehicle, kg, so that they may be learnt from; None: not known.
        lag_s: time constant from the thrust that is told to the thrust, s.
    """
    if dt <= 0.0:
        return old
    up = -rotate(vehicle.attitude_wb, (0.0, 0.0, -1.0))[2]
    stands = not vehicle.armed or vehicle.landed
    grounded = stands or (old.grounded and not vehicle.velocity_w[2] < -_CLIMB_M_PER_S)
    if grounded or not (up > _UPRIGHT and vehicle.thrust > _LEAST_SHARE):  # also where the thrust is nan
        curve = old.curve
        if curve is not None:
            curve = curve.forget(dt) if vehicle.armed else curve.unplugged()
        return replace(interrupted(old), curve=curve, grounded=grounded)
    new = Flow(up, up * vehicle.thrust, vehicle.velocity_w[2])
    flow, seen_s, curve = _filtered(old.flow or new, new, dt, lag_s), old.seen_s + dt, old.curve
    if seen_s < _SETTLE_S:
        return replace(old, flow=flow, seen_s=seen_s, now=math.nan, grounded=False)
    felt = GRAVITY - math.expm1(_POLE * dt) / dt * (new.sink - flow.sink)  # of samples, exactly
    if lifted is not None:
        curve = (curve or ThrustCurve.prior(flow.push / flow.up)).learn(flow, felt * (1.0 + lifted / mass), dt)
    elif curve is not None:
        asked = flow.push / flow.up / curve.at
        # rotors empty the battery with their power: a vehicle that hangs for an hour has not flown for one
        curve = curve.ahead(dt if asked > _IDLE else dt * asked**1.5)
    now = math.nan if curve is None else mass * (curve.lift(flow) / max(felt, 0.3 * GRAVITY) - 1.0)
    return replace(old, curve=curve, flow=flow, seen_s=seen_s, now=now)


def interrupted(old: Load) -> Load:
    """The load when nothing can be told of this moment."""
    return replace(old, flow=None, seen_s=0.0, light_s=0.0, propped_s=0.0, now=math.nan)


def weigh(old: Load, dt: float) -> Load:
    """Take the present load into the mean, until that is long enough: later the battery would be weighed too."""
    if not math.isfinite(old.now) or dt <= 0.0 or old.settled or old.curve is None or old.flow is None:
        return old
    total = old.weighed_s + dt
    mass = old.mass + dt / total * (old.now - old.mass)
    return replace(old, mass=mass, spread=old.curve.sigma(old.flow), weighed_s=total)


def _filtered(old: Flow, new: Flow, dt: float, lag_s: float) -> Flow:
    rotors, body = math.exp(-dt / lag_s), math.exp(-_POLE * dt)
    before = old.spun or (old.up, old.push)
    up, push = new.up + rotors * (before[0] - new.up), new.push + rotors * (before[1] - new.push)
    return Flow(
        up + body * (old.up - up),
        push + body * (old.push - push),
        new.sink + body * (old.sink - new.sink),
        (up, push),
    )


def _four(v: Array) -> Vec4:
    a, b, d, fall = v.tolist()
    return a, b, d, fall


def _rows(P: Array) -> Covariance:
    return _four(P[0]), _four(P[1]), _four(P[2]), _four(P[3])
