"""The keep-out cone: where the arm must never be, because propellers, landing gear and hull are.

The cone opens from its apex towards the vehicle's centre of mass and beyond, without end. The arm is the arc of its
bend, as thick as its disks.
"""

import math
from dataclasses import dataclass

import numpy as np

from arm_companion.geometry.arrays import Array, sealed
from arm_companion.geometry.se3 import Pose

_NODES = np.linspace(0.0, 1.0, 33)[1:]  # the base stays where it is; the chords are within 0.2 mm of a full turn's arc
_STEP_RAD = 0.05


@dataclass(frozen=True)
class KeepOut:
    """A cone in the arm's base axes, and the arm that stays out of it.

    Attributes:
        apex: (3,), m.
        axis: into the cone, unit (3,).
        half_angle: rad, under a right angle.
        length: of the arm, m.
        radius: of its disks, m.
    """

    apex: Array
    axis: Array
    half_angle: float
    length: float
    radius: float

    @classmethod
    def of(cls, apex_b: Array, half_angle: float, T_ba: Pose, length: float, radius: float) -> "KeepOut":
        """The cone with its apex at `apex_b`, (3,) m from the vehicle's centre of mass in body axes.

        Args:
            apex_b: not at the centre itself.
            half_angle: rad.
            T_ba: mount of the arm.
            length: of the arm, m.
            radius: of its disks, m.

        Raises:
            ValueError: the apex is at the centre of mass, which leaves the cone without a direction.
        """
        away = float(np.linalg.norm(apex_b))
        if away < 1e-6:
            raise ValueError("the apex of the keep-out cone is at the vehicle's centre of mass")
        R, p = T_ba.rotation, T_ba.position
        return cls(sealed(R.T @ (apex_b - p)), sealed(R.T @ (-apex_b / away)), half_angle, length, radius)

    def clearance(self, bend: Array) -> float:
        """Least distance in m between cone and arm at the bend u (2,), rad; negative inside.

        Args:
            bend: of the arm without load.
        """
        return float(self.distance(_arc(bend, self.length)).min()) - self.radius

    def distance(self, points: Array) -> Array:
        """Distance (...) in m of points (..., 3), base axes, from the cone's surface; negative inside."""
        from_apex = points - self.apex
        along = from_apex @ self.axis
        across = np.sqrt(np.maximum((from_apex**2).sum(axis=-1) - along**2, 0.0))
        cosine, sine = math.cos(self.half_angle), math.sin(self.half_angle)
        nearest = across * cosine - along * sine
        before_apex = across * sine + along * cosine < 0.0  # nothing of the cone is nearer than its apex
        distance: Array = np.where(before_apex, np.hypot(across, along), nearest)
        return distance

    def admits(self, bend: Array, next_bend: Array) -> bool:
        """Whether the arm may go on from one bend (2,) to the next: outside the cone, or at least not deeper in it."""
        after = self.clearance(next_bend)
        return after >= 0.0 or after >= self.clearance(bend)

    def least_on_way(self, bend: Array, goal: Array) -> float:
        """Least clearance, m, on the straight way in bends from one (2,) to another."""
        steps = max(math.ceil(float(np.linalg.norm(goal - bend)) / _STEP_RAD), 1)
        bends = bend + np.arange(steps + 1)[:, None] / steps * (goal - bend)
        return float(self.distance(_arc(bends, self.length)).min()) - self.radius


def _arc(bend: Array, length: float) -> Array:
    """Points (..., k, 3) of arcs with bends (..., 2), base axes; `arm.arc.tip_position` for many sections at once."""
    angles = _NODES[:, None] * bend[..., None, :]
    theta = np.sqrt((angles**2).sum(axis=-1, keepdims=True))
    aside = 0.5 * angles * np.sinc(theta / (2.0 * math.pi)) ** 2
    along = np.sinc(theta / math.pi)
    points: Array = length * _NODES[:, None] * np.concatenate((aside, along), axis=-1)
    return points
