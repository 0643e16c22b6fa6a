"""ARM_TARGET and ARM_SETPOINT: from what somebody claims to values that the mission may use.

The messages stream and may be lost, so that each stands for itself: it is taken whole or not at all, and only the
newest counts.
"""

import math
from collections.abc import Sequence
from typing import Final

from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import ArmSetpoint, Bar, GraspTarget, Quaternion, SetpointKind, Vec3
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

LONGEST_TIMEOUT_S: Final = 5.0
"""Nobody may stream to the arm at less than one set-point in this time."""

_SHORTEST_TIMEOUT_S: Final = 0.02
_FARTHEST_M: Final = 10_000.0
_FARTHEST_TIP_M: Final = 10.0
_RADII_M: Final = (0.002, 0.5)
_SHORTEST_AXIS: Final = 1e-3
_QUATERNION_NORM: Final = (0.9, 1.1)
_ENTRIES: Final = 6
_GREATEST_VARIANCE: Final = 1e4  # m^2


def read_bar(target: Message) -> Bar:
    """The bar that an ARM_TARGET describes.

    Raises:
        CommandRejected: it describes something else, in another frame, or with impossible numbers.
    """
    if target.kind != mav.ARM_TARGET_KIND_BAR:
        raise CommandRejected(f"kind {target.kind} is not a bar")
    point, radius = _place(target)
    a, b, c = target.axis
    length = math.hypot(a, b, c)
    if not (math.isfinite(length) and length >= _SHORTEST_AXIS):
        raise CommandRejected("axis has no direction")
    axis = (a / length, b / length, c / length)
    return Bar(point, axis, radius, _covariance(target.position_covariance), _sigma(target.direction_sigma))


def read_object(target: Message) -> GraspTarget:
    """The object that an ARM_TARGET describes.

    Raises:
        CommandRejected: it describes something else, in another frame, or with impossible numbers.
    """
    if target.kind != mav.ARM_TARGET_KIND_OBJECT:
        raise CommandRejected(f"kind {target.kind} is not an object")
    position, radius = _place(target)
    covariance, sigma = _covariance(target.position_covariance), _sigma(target.direction_sigma)
    return GraspTarget(position, _attitude(target.q), radius, covariance, sigma)


def read_setpoint(setpoint: Message, bend_max_rad: float) -> ArmSetpoint:
    """What an ARM_SETPOINT asks for, of age zero.

    Args:
        setpoint: the message.
        bend_max_rad: greatest bend that may be asked for.

    Raises:
        CommandRejected: a number that counts is impossible; those that do not count may be anything.
    """
    timeout = setpoint.timeout
    if not _SHORTEST_TIMEOUT_S <= timeout <= LONGEST_TIMEOUT_S:
        raise CommandRejected(f"timeout {timeout:g} s is outside {_SHORTEST_TIMEOUT_S:g} to {LONGEST_TIMEOUT_S:g} s")
    nan = math.nan
    if setpoint.kind == SetpointKind.BEND:
        if not abs(setpoint.theta) <= bend_max_rad:
            raise CommandRejected(f"theta {setpoint.theta:g} rad is not within {bend_max_rad:g} rad")
        if not abs(setpoint.delta) <= 2.0 * math.pi:
            raise CommandRejected(f"delta {setpoint.delta:g} rad is not within one turn")
        return ArmSetpoint(SetpointKind.BEND, setpoint.theta, setpoint.delta, (nan, nan, nan), 0.0, timeout)
    if setpoint.kind == SetpointKind.TIP:
        x, y, z = setpoint.tip_position
        if not math.hypot(x, y, z) <= _FARTHEST_TIP_M:
            raise CommandRejected(f"tip_position is not finite or beyond {_FARTHEST_TIP_M:g} m")
        return ArmSetpoint(SetpointKind.TIP, nan, nan, (x, y, z), 0.0, timeout)
    raise CommandRejected(f"set-points of kind {setpoint.kind} are not known")


def _place(target: Message) -> tuple[Vec3, float]:
    """Position and radius."""
    if target.frame != mav.MAV_FRAME_LOCAL_NED:
        raise CommandRejected(f"frame {target.frame} is not MAV_FRAME_LOCAL_NED")
    x, y, z = target.position
    if not all(math.isfinite(c) and abs(c) <= _FARTHEST_M for c in (x, y, z)):
        raise CommandRejected(f"position is not finite or beyond {_FARTHEST_M:g} m")
    lower, upper = _RADII_M
    if not lower <= target.radius <= upper:
        raise CommandRejected(f"radius {target.radius:g} m is outside {lower:g} to {upper:g} m")
    return (x, y, z), target.radius


def _attitude(q: Sequence[float]) -> Quaternion | None:
    """A unit quaternion; None when it is not told (NaN first, or all zero as some libraries fill in)."""
    if math.isnan(q[0]) or not any(q):
        return None
    norm = math.hypot(*q)
    lower, upper = _QUATERNION_NORM
    if not lower < norm < upper:
        raise CommandRejected("q is not a unit quaternion")
    w, x, y, z = q
    return w / norm, x / norm, y / norm, z / norm


def _covariance(entries: Sequence[float]) -> tuple[float, ...] | None:
    """The upper triangle; None when it is not told (NaN first, or all zero)."""
    if math.isnan(entries[0]) or not any(entries):
        return None
    xx, xy, xz, yy, yz, zz = entries
    if not all(map(math.isfinite, entries)) or max(xx, yy, zz) > _GREATEST_VARIANCE:
        raise CommandRejected("position_covariance is not finite or too large")
    minors = (xx * yy - xy * xy, xx * zz - xz * xz, yy * zz - yz * yz)
    determinant = xx * minors[2] - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    slack = 1e-6 * max(xx, yy, zz, 0.0)  # float32 rounding
    if min(xx, yy, zz) < 0.0 or min(minors) < -slack * slack or determinant < -(slack**3):
        raise CommandRejected("position_covariance is no covariance")
    return xx, xy, xz, yy, yz, zz


def _sigma(value: float) -> float | None:
    """One sigma; None when it is not told (NaN, or zero)."""
    if math.isnan(value) or value == 0.0:
        return None
    if not 0.0 < value <= math.pi:
        raise CommandRejected(f"direction_sigma {value:g} rad is outside 0 to pi")
    return value
