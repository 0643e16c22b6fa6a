"""The arm as a line and the bar beside it, for people to look at: nothing is decided by it."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from arm_companion.arm.model import ArmSolution
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array
from arm_companion.mission.facts import Vec3
from arm_companion.mission.situation import Situation

_WRAPPED_POINTS: Final = 16


@dataclass(frozen=True, slots=True)
class BarSeen:
    """The bar in body axes (FRD) from the vehicle's centre of mass."""

    point_b: Vec3  # m, on its axis, nearest to the arm's base
    axis_b: Vec3  # unit
    radius: float  # m


@dataclass(frozen=True, slots=True)
class Outline:
    """Arm and bar in body axes (FRD) from the vehicle's centre of mass.

    Attributes:
        backbone_b: from base to tip, m; empty while the mechanics have no solution.
        held: the part up to the bar is the anchored rod, and the rest is drawn as lying around the bar. Otherwise the
            line is that of an arm which touches nothing.
        bar: None while the vehicle's state is not fresh.
    """

    backbone_b: tuple[Vec3, ...]
    held: bool
    bar: BarSeen | None


def outline(s: Situation) -> Outline:
    """What the newest prediction looks like, of a cycle with the memory after its step."""
    prediction, mount = s.state.prediction, s.mount
    if prediction is None:
        return Outline((), False, _bar(s, None))
    rod = prediction.anchored or prediction.free
    if rod is None:
        return Outline((), False, _bar(s, None))
    line, centre = rod.detail.line(), None
    if held := prediction.anchored is not None:
        wrapped, centre = _wrapped(s, rod)
        line, centre = np.vstack((line, wrapped[1:])), mount @ centre
    return Outline(tuple((x, y, z) for x, y, z in (mount @ line).tolist()), held, _bar(s, centre))


def _wrapped(s: Situation, rod: ArmSolution) -> tuple[Array, Array]:
    """The part beyond the held section (k, 3) around the bar, touching it with its disks, and the bar's centre (3,).

    Base axes, m.
    """
    radius = s.held_radius + s.config.perch.disk_radius_m
    inward = np.array((*s.towards_bar_a, 0.0))
    length = max(s.parameters.model.parameters.L - s.config.perch.free_arc_m, 0.0)
    turn = np.linspace(0.0, length / radius, _WRAPPED_POINTS)[:, None]
    local = radius * ((1.0 - np.cos(turn)) * inward + np.sin(turn) * np.array((0.0, 0.0, 1.0)))
    R, p = rod.tip_rotation, rod.tip_position
    return np.asarray(local @ R.T + p), np.asarray(R @ (radius * inward) + p)


def _bar(s: Situation, held_at: Array | None) -> BarSeen | None:
    """The bar where the estimator has it; a held one where the grip has it, (3,) body axes, m."""
    if not s.vehicle_fresh:
        return None
    R_bw = so3.from_quaternion(s.facts.vehicle.attitude_wb).T
    held = held_at is not None
    axis = R_bw @ np.asarray(s.held_axis_w if held else s.bar.axis_w)
    point = held_at
    if point is None:
        point = R_bw @ (np.asarray(s.bar.point_w) - np.asarray(s.facts.vehicle.position_w))
        point = point + axis * float(axis @ (s.mount.position - point))
    if not math.isfinite(float(point.sum())):
        return None
    return BarSeen(_vec3(point), _vec3(axis), s.held_radius if held else s.bar.radius)


def _vec3(v: Array) -> Vec3:
    x, y, z = v.tolist()
    return x, y, z
