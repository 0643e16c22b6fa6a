"""Sharing the way to a point between vehicle and arm: the bend, and where the vehicle hovers for it. Pure.

The arm is the unloaded arc of its bend u = (theta cos delta, theta sin delta); what gravity does to it is a matter of
the cycle, which sees it. The vehicle hovers level at a heading that stays. A bend u leaves to the vehicle the move
d(u) that puts the point of the arm on the target, and the split is the bend with the least

    w (sqrt(1 + |d|^2 / L^2) - 1) + |u|^2 / 2,

whose first term is quadratic near by and linear far away, so that a far target bends the arm no further. The second
derivatives of an arc's points are L / 3 at most, so for w < 3 this cost is strictly convex in u: there is one best
split, it has no preferred direction and no singularity at zero bend, and it moves on continuously with the target. It
lies in the plane of target and base axis, because a bend out of that plane is farther away and costs the same.

Where a limit bars the best split, the nearest one in that plane which no limit bars is taken, the cheaper of the two
sides. Limits hold on all of the way: straight for the vehicle, straight in u for the arm.
"""

import math
from dataclasses import dataclass

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.keep_out import KeepOut
from arm_companion.errors import ModelError
from arm_companion.geometry.arrays import Array
from arm_companion.geometry.se3 import Pose

CONVEX_BELOW = 3.0
"""Weight from which on the cost may have more than one valley."""

_HALVINGS = 50
_SCAN_RAD = 0.1
_FINE_RAD = 0.02
_ON_WAY = np.linspace(0.0, 1.0, 129)
_CONE_MARGIN_M = 0.005
_NO_SIDE_M = 1e-12


class OutOfReach(ModelError):
    """No split of the way keeps all limits; the message says which one is in the way."""


@dataclass(frozen=True)
class Arm:
    """An arm on its airframe.

    Attributes:
        T_ba: mount.
        length: m.
        at: arc length, m, of the point that is to be on the target; `length` is the tip.
    """

    T_ba: Pose
    length: float
    at: float

    def point(self, bend: Array) -> Array:
        """The point (3,), m, base axes, at a bend u (2,), rad."""
        return arc.tip_position(bend * (self.at / self.length), self.at)

    def offset(self, bend: Array, heading: float) -> Array:
        """From the level vehicle's centre of mass to the point (3,), m, world axes."""
        return _turned(self.T_ba.position + self.T_ba.rotation @ self.point(bend), heading)


@dataclass(frozen=True)
class Limits:
    """What holds on all of the way. Where the way begins too low, too near or with the arm in the cone, no more so.

    Attributes:
        bend_max: rad.
        move_max: of the vehicle, m.
        lowest: greatest z, NED, of the vehicle, m.
        clearance: least distance of target and vehicle, m.
        keep_out: where neither arm nor target may be.
    """

    bend_max: float
    move_max: float
    lowest: float
    clearance: float
    keep_out: KeepOut | None = None


@dataclass(frozen=True)
class Split:
    """How the way is shared.

    Attributes:
        bend: u (2,), rad.
        vehicle: (3,), m, world axes.
        miss: by how much the point stays off the target, m.
    """

    bend: Array
    vehicle: Array
    miss: float = 0.0


def split(target: Array, vehicle: Array, heading: float, arm: Arm, now: Array, weight: float, limits: Limits) -> Split:
    """The best split of the way.

    Args:
        target: (3,), m, world axes.
        vehicle: where it is, (3,), m, world axes.
        heading: rad, at which it stays.
        arm: that reaches.
        now: its bend (2,), rad.
        weight: of the vehicle's move against the bend, under `CONVEX_BELOW`.
        limits: that hold.

    Raises:
        OutOfReach: every split breaks a limit.
        ValueError: the weight is not within its bounds.
    """
    if not 0.0 <= weight < CONVEX_BELOW:
        raise ValueError(f"weight {weight:g} is outside 0 to {CONVEX_BELOW:g}")
    way = _Way(target, vehicle, heading, arm, now, limits)
    best = _best(way, weight)
    if (reason := way.barred(best)) is None:
        return way.split(best)
    found = [theta for side in (-1.0, 1.0) if (theta := _nearest(way, best, side)) is not None]
    if not found:
        raise OutOfReach(reason)
    return way.split(min(found, key=lambda theta: way.cost(theta, weight)))


def alone(
    target: Array, vehicle: Array, heading: float, arm: Arm, now: Array, limits: Limits, tolerance: float
) -> Split:
    """The bend that comes nearest to the target while the vehicle stays; arguments as `split`.

    An arc's tips are a surface, and only what lies on it is reached.

    Raises:
        OutOfReach: it stays farther off than `tolerance`, m, or a limit is in the way.
    """
    way = _Way(target, vehicle, heading, arm, now, limits)
    thetas = np.arange(0.0, limits.bend_max + _FINE_RAD, _FINE_RAD).clip(0.0, limits.bend_max)
    nearest = float(min(thetas, key=way.miss))
    lower, upper = max(nearest - _FINE_RAD, 0.0), min(nearest + _FINE_RAD, limits.bend_max)
    for _ in range(_HALVINGS):
        first, second = lower + (upper - lower) / 3.0, upper - (upper - lower) / 3.0
        if way.miss(first) <= way.miss(second):
            upper = second
        else:
            lower = first
    theta = 0.5 * (lower + upper)
    if not (miss := way.miss(theta)) <= tolerance:  # also where the target is no number
        raise OutOfReach(f"the arm alone stays {miss * 100:.1f} cm away from the point")
    if (reason := way.bend_barred(theta)) is not None:
        raise OutOfReach(reason)
    return Split(way.bend(theta), np.array(vehicle, dtype=float), miss)


class _Way:
    """The splits in the plane of target and base axis, by their theta."""

    def __init__(self, target: Array, vehicle: Array, heading: float, arm: Arm, now: Array, limits: Limits) -> None:
        self.target, self.vehicle, self.heading, self.arm, self.now, self.limits = (
            target,
            vehicle,
            heading,
            arm,
            now,
            limits,
        )
        self._target_a = self._in_base(vehicle[None, :])[0]
        x, y, z = self._target_a.tolist()
        self.aside, self.along = math.hypot(x, y), z
        # straight ahead of the base no direction is better than another: then the target's is any
        self._plane = np.array((x, y)) / self.aside if self.aside > _NO_SIDE_M else np.array((1.0, 0.0))

    def bend(self, theta: float) -> Array:
        """u (2,), rad."""
        bend: Array = theta * self._plane
        return bend

    def split(self, theta: float) -> Split:
        """The split at a bend of `theta`, rad."""
        bend = self.bend(theta)
        return Split(bend, self.target - self.arm.offset(bend, self.heading))

    def miss(self, theta: float) -> float:
        """Distance of point and target while the vehicle stays, m."""
        aside, along = self._point(theta)
        return math.hypot(self.aside - aside, self.along - along)

    def cost(self, theta: float, weight: float) -> float:
        """As the module says."""
        return weight * (math.hypot(1.0, self.miss(theta) / self.arm.length) - 1.0) + 0.5 * theta * theta

    def slope(self, theta: float, weight: float) -> float:
        """d cost / d theta."""
        reach, length = self.arm.at, self.arm.length
        share = reach / length
        t = theta * share
        k = arc.quotients(t * t)
        aside, along = reach * k.A * t, reach * k.S
        d_aside, d_along = share * reach * (k.A + k.dA * t * t), share * reach * k.dS * t
        toward = (self.aside - aside) * d_aside + (self.along - along) * d_along
        far = math.hypot(1.0, self.miss(theta) / length)
        slope: float = theta - weight * toward / (length * length * far)
        return slope

    def barred(self, theta: float) -> str | None:
        """Which limit a split breaks on its way, in words."""
        return self._vehicle_barred(self.split(theta).vehicle) or self.bend_barred(theta)

    def bend_barred(self, theta: float) -> str | None:
        """Which limit the arm's part breaks on its way, in words."""
        keep_out = self.limits.keep_out
        if keep_out is None:
            return None
        least = keep_out.least_on_way(self.now, self.bend(theta))
        if least >= min(_CONE_MARGIN_M, keep_out.clearance(self.now)):
            return None
        return f"on its way the arm comes {(_CONE_MARGIN_M - least) * 100:.1f} cm too near to the keep-out cone"

    def _vehicle_barred(self, goal: Array) -> str | None:
        limits, start = self.limits, self.vehicle
        move = goal - start
        if (distance := float(np.linalg.norm(move))) > limits.move_max:
            return f"the vehicle would move {distance:.2f} m; at most {limits.move_max:g} m are allowed"
        if goal[2] > max(limits.lowest, start[2]):
            return f"the vehicle would come down to {-goal[2]:.2f} m; it stays above {-limits.lowest:g} m"
        way = start + _ON_WAY[:, None] * move
        share = float(((self.target - start) @ move) / max(distance * distance, _NO_SIDE_M))
        nearest = float(np.linalg.norm(start + min(max(share, 0.0), 1.0) * move - self.target))
        if nearest < min(limits.clearance, float(np.linalg.norm(start - self.target))) - _NO_SIDE_M:
            return f"the vehicle would come within {nearest:.2f} m of the point; {limits.clearance:g} m are kept"
        if limits.keep_out is not None and float(limits.keep_out.distance(self._in_base(way)).min()) < 0.0:
            return "the point is in the vehicle's keep-out cone somewhere on the way"
        return None

    def _point(self, theta: float) -> tuple[float, float]:
        """Of the arm in this plane: aside and along the base's axis, m."""
        t = theta * self.arm.at / self.arm.length
        k = arc.quotients(t * t)
        return self.arm.at * k.A * t, self.arm.at * k.S

    def _in_base(self, vehicles: Array) -> Array:
        """The target (k, 3), m, in the base axes of vehicles at (k, 3), m."""
        level = _turned((self.target - vehicles).T, -self.heading).T
        in_base: Array = (level - self.arm.T_ba.position) @ self.arm.T_ba.rotation
        return in_base


def _best(way: _Way, weight: float) -> float:
    """theta of the least cost, whose slope is negative or zero at no bend and grows from there."""
    lower, upper = 0.0, way.limits.bend_max
    if way.slope(lower, weight) >= 0.0:
        return lower
    if way.slope(upper, weight) <= 0.0:
        return upper
    for _ in range(_HALVINGS):
        middle = 0.5 * (lower + upper)
        if way.slope(middle, weight) <= 0.0:
            lower = middle
        else:
            upper = middle
    return lower


def _nearest(way: _Way, barred: float, side: float) -> float | None:
    """The theta next to a barred one, on one side, that no limit bars; None: there is none."""
    end = 0.0 if side < 0.0 else way.limits.bend_max
    outside = barred
    while outside != end:
        allowed = outside + side * min(_SCAN_RAD, abs(end - outside))
        if way.barred(allowed) is None:
            break
        outside = allowed
    else:
        return None
    for _ in range(_HALVINGS // 2):
        middle = 0.5 * (outside + allowed)
        if way.barred(middle) is None:
            allowed = middle
        else:
            outside = middle
    return allowed


def _turned(vectors: Array, heading: float) -> Array:
    """Vectors (3,) or (3, k) turned about the world's z axis."""
    c, s = math.cos(heading), math.sin(heading)
    turned: Array = np.array((c * vectors[0] - s * vectors[1], s * vectors[0] + c * vectors[1], vectors[2]))
    return turned
