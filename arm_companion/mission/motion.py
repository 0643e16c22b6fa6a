"""Smooth bounded motion of references: position, velocity and acceleration that belong to each other."""

import math
from dataclasses import dataclass

from arm_companion.mission.facts import Vec3

ZERO: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Reference:
    """Where the vehicle is asked to be, world axes (NED).

    Attributes:
        position: m.
        velocity: m/s.
        yaw: rad.
        acceleration: m/s^2, of the velocity.
    """

    position: Vec3
    velocity: Vec3 = ZERO
    yaw: float = 0.0
    acceleration: Vec3 = ZERO

    @property
    def still(self) -> "Reference":
        """The same place, at rest."""
        return Reference(self.position, ZERO, self.yaw)


def add(a: Vec3, b: Vec3) -> Vec3:
    """Sum of two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a: Vec3, b: Vec3) -> Vec3:
    """`a - b`."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(a: Vec3, k: float) -> Vec3:
    """`k a`."""
    return (k * a[0], k * a[1], k * a[2])


def dot(a: Vec3, b: Vec3) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def norm(a: Vec3) -> float:
    """Euclidean length."""
    return math.sqrt(dot(a, a))


def clip_norm(a: Vec3, limit: float) -> Vec3:
    """`a`, shortened to `limit` where it is longer."""
    length = norm(a)
    return a if length <= limit else scale(a, limit / length)


def wrap_angle(a: float) -> float:
    """The same angle in [-pi, pi)."""
    return (a + math.pi) % (2.0 * math.pi) - math.pi


def ramp(value: float, goal: float, speed: float, dt: float) -> float:
    """`value` moved towards `goal` by at most `speed * dt`."""
    change = goal - value
    most = speed * dt
    return goal if abs(change) <= most else value + math.copysign(most, change)


def low_pass(old: float, new: float, dt: float, lag_s: float) -> float:
    """`old` after `dt` seconds of a first-order lag behind `new`; backward Euler, so that no step is too long."""
    return old + dt / (lag_s + dt) * (new - old)


def low_pass_vec(old: Vec3, new: Vec3, dt: float, lag_s: float) -> Vec3:
    """The same of three numbers."""
    return add(old, scale(sub(new, old), dt / (lag_s + dt)))


def follow(
    reference: Reference,
    goal: Vec3,
    yaw: float,
    *,
    speed: float,
    acceleration: float,
    yaw_rate: float,
    dt: float,
) -> Reference:
    """Move a reference along the straight line to `goal`, with bounded speed and acceleration.

    The speed never exceeds what can still be braked before the goal, so the reference arrives without
    overshoot whatever its velocity was before.
    """
    if dt <= 0.0:
        return reference
    yaw_now = reference.yaw + ramp(0.0, wrap_angle(yaw - reference.yaw), yaw_rate, dt)
    to_go = sub(goal, reference.position)
    distance = norm(to_go)
    # braking in steps of a dt covers v^2 / 2a + v dt / 2: the largest v whose braking still fits
    brake = 0.5 * acceleration * (math.sqrt(dt * dt + 8.0 * distance / acceleration) - dt)
    wanted = scale(to_go, min(speed, brake) / distance) if distance > 0.0 else ZERO
    change = clip_norm(sub(wanted, reference.velocity), acceleration * dt)
    velocity = add(reference.velocity, change)
    if distance <= acceleration * dt * dt and norm(reference.velocity) <= acceleration * dt * (1.0 + 1e-9):
        return Reference(goal, ZERO, yaw_now)
    return Reference(add(reference.position, scale(velocity, dt)), velocity, yaw_now, scale(change, 1.0 / dt))


def arrived(reference: Reference, goal: Vec3) -> bool:
    """Whether the reference itself rests at `goal`."""
    return reference.position == goal and reference.velocity == ZERO


def rotate(q: tuple[float, float, float, float], v: Vec3) -> Vec3:
    """Turn `v` by the unit quaternion (w, x, y, z): body axes into world axes for an attitude."""
    w, x, y, z = q
    t = (2.0 * (y * v[2] - z * v[1]), 2.0 * (z * v[0] - x * v[2]), 2.0 * (x * v[1] - y * v[0]))
    return (
        v[0] + w * t[0] + (y * t[2] - z * t[1]),
        v[1] + w * t[1] + (z * t[0] - x * t[2]),
        v[2] + w * t[2] + (x * t[1] - y * t[0]),
    )


def unrotate(q: tuple[float, float, float, float], v: Vec3) -> Vec3:
    """The inverse of `rotate`: world axes into body axes."""
    return rotate((q[0], -q[1], -q[2], -q[3]), v)


def yaw_of(q: tuple[float, float, float, float]) -> float:
    """Heading (rad, clockwise from north) of an attitude in a NED world."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def turn_by_yaw(v: Vec3, yaw: float) -> Vec3:
    """Turn `v` about the world's z axis."""
    c, s = math.cos(yaw), math.sin(yaw)
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])
