"""What the sensors say of the arm's surroundings: the force on the vehicle, and the tension of the tendons.

An XL430 has no current sensor, and the friction of its gears hides several newtons of tendon tension while it
stands still. A touch of the bar is therefore looked for where it does show: in the vehicle's own motion. A
multirotor's thrust points along its body, so its attitude says which horizontal acceleration to expect, and
what is left over is a force from outside.
"""

import math
from dataclasses import dataclass

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import Quaternion, TendonState, Vec3, VehicleState
from arm_companion.mission.motion import low_pass, low_pass_vec, norm, rotate, scale, sub
from arm_companion.mission.payload import DRAG_PER_S
from arm_companion.values import replace

_POLE = 14.0  # rad/s, both poles of the observer
OBSERVER_LAG_S = 2.0 / _POLE
_TARE_S = 1.0
_TENSION_SMOOTHING_S = 0.15
_MOVING_M_PER_S = 0.002
_POSITION_SMOOTHING_S = 0.25
_JUMP_M = 0.2

Vec2 = tuple[float, float]


@dataclass(frozen=True)
class ForceObserver:
    """Horizontal force from outside on the vehicle, world axes (north, east).

    A Luenberger observer of velocity and force with `m dv/dt = m (g tan(tilt) - d v) + f`. Without the drag d the bias,
    which is found in motion, would stay in the force of a vehicle that is held.

    Attributes:
        velocity: estimate (2,), m/s; None before the first state.
        force: estimate (2,), N, with whatever wind and level error put on top.
        bias: mean of `force` while the arm was certainly free (2,), N.
        tared_s: length of that mean, s; a second is enough to go by.
        since_s: time since its end, s.
        above_s: how long the residual has been above the threshold without a break, s.
    """

    velocity: Vec2 | None = None
    force: Vec2 = (0.0, 0.0)
    bias: Vec2 = (0.0, 0.0)
    tared_s: float = 0.0
    since_s: float = 0.0
    above_s: float = 0.0

    @property
    def tared(self) -> bool:
        """Whether the bias is known."""
        return self.tared_s >= _TARE_S

    @property
    def residual(self) -> Vec2:
        """Force beyond the bias (2,), N; zero until that is known."""
        if not self.tared:
            return (0.0, 0.0)
        return (self.force[0] - self.bias[0], self.force[1] - self.bias[1])

    @property
    def bias_age_s(self) -> float:
        """For how long the wind may have changed since the bias was found, s; inf: it is not known."""
        return self.since_s if self.tared else math.inf

    def acceleration(self, vehicle: VehicleState, mass: float) -> Vec2:
        """Acceleration of the vehicle, m/s^2, north and east: what its tilt makes, and what is felt besides.

        Args:
            vehicle: newest state, fresh.
            mass: kg, with which it was observed; it cancels out.
        """
        lean = lean_of(vehicle.attitude_wb)
        if lean is None or self.velocity is None:
            return (0.0, 0.0)
        drag = scale(vehicle.velocity_w, DRAG_PER_S)
        return (lean[0] - drag[0] + self.force[0] / mass, lean[1] - drag[1] + self.force[1] / mass)


def observe_force(old: ForceObserver, vehicle: VehicleState, mass: float, dt: float) -> ForceObserver:
    """The observer after one cycle of `dt` seconds with a vehicle of `mass` kg."""
    v = (vehicle.velocity_w[0], vehicle.velocity_w[1])
    if old.velocity is None or dt <= 0.0:
        return replace(old, velocity=v)
    since_s = old.since_s + dt
    lean = lean_of(vehicle.attitude_wb)
    if lean is None:
        return replace(old, velocity=v, since_s=since_s)
    velocity, force = [], []
    for i in range(2):
        miss = v[i] - old.velocity[i]
        velocity.append(old.velocity[i] + dt * (lean[i] - DRAG_PER_S * v[i] + old.force[i] / mass + 2.0 * _POLE * miss))
        force.append(old.force[i] + dt * mass * _POLE * _POLE * miss)
    return replace(old, velocity=(velocity[0], velocity[1]), force=(force[0], force[1]), since_s=since_s)


def lean_of(attitude_wb: Quaternion) -> Vec2 | None:
    """Horizontal acceleration that the tilted thrust makes, m/s^2; None: far from a hover, and nothing can be said."""
    up = rotate(attitude_wb, (0.0, 0.0, -1.0))
    if up[2] > -0.5:  # more than 60 degrees
        return None
    return (GRAVITY * up[0] / -up[2], GRAVITY * up[1] / -up[2])


def tare(old: ForceObserver, dt: float) -> ForceObserver:
    """Take the present force into the bias: the arm is certainly free, and the vehicle far from the bar."""
    if dt <= 0.0:
        return old
    share = dt / (old.tared_s + dt)
    bias = (
        old.bias[0] + share * (old.force[0] - old.bias[0]),
        old.bias[1] + share * (old.force[1] - old.bias[1]),
    )
    return replace(old, bias=bias, tared_s=old.tared_s + dt, since_s=0.0)


def time_above(old: ForceObserver, direction: Vec2, threshold: float, dt: float) -> ForceObserver:
    """Count how long the residual along `direction` (unit) has been above `threshold`, N."""
    along = old.residual[0] * direction[0] + old.residual[1] * direction[1]
    return replace(old, above_s=old.above_s + dt if along > threshold else 0.0)


def smooth_tensions(old: tuple[float, ...], tendons: tuple[TendonState, ...], dt: float) -> tuple[float, ...]:
    """Tensions (n,), N, smoothed, taken only while a servo turns: at rest its gears' friction hides them."""
    if len(old) != len(tendons):
        return tuple(tendon.tension for tendon in tendons)
    return tuple(
        low_pass(before, tendon.tension, dt, _TENSION_SMOOTHING_S) if abs(tendon.speed) > _MOVING_M_PER_S else before
        for before, tendon in zip(old, tendons, strict=True)
    )


def smooth_position(old: Vec3, vehicle: VehicleState, dt: float) -> Vec3:
    """Vehicle position, m, smoothed over a quarter of a second; a jump is taken at once."""
    new = vehicle.position_w
    if norm(sub(new, old)) > _JUMP_M:
        return new
    return low_pass_vec(old, new, dt, _POSITION_SMOOTHING_S)


def delayed(old: Vec3, push: Vec3, dt: float) -> Vec3:
    """What the observers have felt of a `push` that is known, by their lag."""
    return low_pass_vec(old, push, dt, OBSERVER_LAG_S)


def strength(force: Vec2) -> float:
    """Magnitude, N."""
    return math.hypot(*force)
