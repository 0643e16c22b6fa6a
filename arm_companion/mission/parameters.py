"""What does not change in flight: the configuration, the arm's model, and what follows from both."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from arm_companion.arm.keep_out import KeepOut
from arm_companion.arm.model import ArmModel
from arm_companion.arm.reaction import mount
from arm_companion.config.schema import Config
from arm_companion.geometry.arrays import Array
from arm_companion.geometry.se3 import Pose
from arm_companion.mission.facts import Vec3


@dataclass(frozen=True)
class Parameters:
    """What does not change in flight."""

    config: Config
    model: ArmModel

    @cached_property
    def mount(self) -> Pose:
        """T_ba: the arm's base on the airframe."""
        return mount(self.config.mount.position_m, self.config.mount.rpy_deg)

    @cached_property
    def keep_out(self) -> KeepOut | None:
        """The cone that the arm never enters; None: there is none."""
        cone = self.config.limits.keep_out
        if not cone.half_angle_deg:
            return None
        half_angle, radius = math.radians(cone.half_angle_deg), self.config.perch.disk_radius_m
        return KeepOut.of(np.asarray(cone.apex_m), half_angle, self.mount, self.model.parameters.L, radius)

    @cached_property
    def towards_bar_a(self) -> tuple[float, float]:
        """Direction of bending, base axes, in which a vehicle that faces the bar wraps it."""
        x, y, _ = column(self.mount.rotation.T, 0)  # forward in base axes
        length = math.hypot(x, y)
        return (x / length, y / length) if length > 0.0 else (1.0, 0.0)

    @cached_property
    def wrap_clearance(self) -> float:
        """Least distance of arm and keep-out cone on the way to the full wrap, m; infinite without a cone."""
        if self.keep_out is None:
            return math.inf
        return self.keep_out.least_on_way(np.zeros(2), self.config.perch.wrap_bend_rad * np.array(self.towards_bar_a))

    def admits(self, bend: tuple[float, float], next_bend: tuple[float, float]) -> bool:
        """Whether the keep-out cone lets the arm go on from one bend to the next, rad."""
        if self.keep_out is None or bend == next_bend:
            return True
        return self.keep_out.admits(np.asarray(bend), np.asarray(next_bend))


def column(matrix: Array, j: int) -> Vec3:
    """One of a matrix (3, n), as a vector (3,)."""
    return float(matrix[0, j]), float(matrix[1, j]), float(matrix[2, j])
