"""References whose acceleration is continuous: position, velocity and acceleration that belong to each other.

A bounded one (`motion.follow`) leads, and its mean over the last moments is what is sent. A mean stays within the
bounds of what it is a mean of, whatever the leader does and however often its goal changes: speed, acceleration, and
every straight limit on the place. The acceleration of the mean is the mean of the accelerations, and steps no more.
"""

from dataclasses import dataclass

from arm_companion.mission.facts import Vec3
from arm_companion.mission.motion import ZERO, Reference, follow, low_pass_vec, norm, scale, sub

_MEAN_S = 0.2
_THERE_M = 1e-3


@dataclass(frozen=True)
class Glide:
    """A point on its way.

    Attributes:
        lead: the bounded reference.
        position: m, or rad where the point is a bend.
        velocity: 1/s of that.
        acceleration: 1/s^2 of that.
    """

    lead: Reference
    position: Vec3
    velocity: Vec3 = ZERO
    acceleration: Vec3 = ZERO

    @classmethod
    def rest(cls, position: Vec3) -> "Glide":
        """At rest."""
        return cls(Reference(position), position)


def glide(before: Glide, goal: Vec3, *, speed: float, acceleration: float, dt: float) -> Glide:
    """One step towards `goal`, within a speed and an acceleration."""
    if dt <= 0.0:
        return before
    lead = follow(before.lead, goal, 0.0, speed=speed, acceleration=acceleration, yaw_rate=1.0, dt=dt)
    pushed = scale(sub(lead.velocity, before.lead.velocity), 1.0 / dt)
    return Glide(
        lead,
        low_pass_vec(before.position, lead.position, dt, _MEAN_S),
        low_pass_vec(before.velocity, lead.velocity, dt, _MEAN_S),
        low_pass_vec(before.acceleration, pushed, dt, _MEAN_S),
    )


def there(g: Glide, goal: Vec3) -> bool:
    """Whether it has come to `goal`, but for what the mean still has to go."""
    return g.lead.position == goal and norm(sub(g.position, goal)) <= _THERE_M
