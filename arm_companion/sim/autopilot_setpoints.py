"""SET_POSITION_TARGET_LOCAL_NED: which set-points the autopilots take, and what they mean."""

import math
from typing import Any

from arm_companion.protocol.dialect import mav
from arm_companion.sim.autopilot_flavours import Flavour
from arm_companion.sim.flight_control import FREE, Axes, MotionSetpoint


class SetpointRefused(Exception):
    """The set-point is dropped.

    Attributes:
        stops: the vehicle stops where it is (ArduPilot, position and acceleration without velocity).
    """

    def __init__(self, reason: str, *, stops: bool = False) -> None:
        self.stops = stops
        super().__init__(reason)


def decode(message: Any, flavour: Flavour, yaw: float) -> MotionSetpoint:
    """The set-point in world axes.

    Args:
        message: SET_POSITION_TARGET_LOCAL_NED. Frames LOCAL_NED and BODY_NED (no position) are known.
        flavour: ArduPilot takes no position with acceleration but without velocity.
        yaw: heading of the vehicle, which BODY_NED turns with.

    Raises:
        SetpointRefused: other frames (both stacks drop them in silence), force set-points, numbers that are
            not finite, and set-points that command nothing.
    """
    mask = message.type_mask
    if message.coordinate_frame not in (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_NED):
        raise SetpointRefused(f"frame {message.coordinate_frame}")
    if mask & mav.POSITION_TARGET_TYPEMASK_FORCE_SET:
        raise SetpointRefused("force set-points do not exist")
    position = _axes(mask, 0, message.x, message.y, message.z)
    velocity = _axes(mask, 3, message.vx, message.vy, message.vz)
    acceleration = _axes(mask, 6, message.afx, message.afy, message.afz)
    heading = None if mask & mav.POSITION_TARGET_TYPEMASK_YAW_IGNORE else message.yaw
    yaw_rate = 0.0 if mask & mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE else message.yaw_rate
    parts = [part for part in (*position, *velocity, *acceleration) if part is not None]
    if not all(math.isfinite(part) for part in (*parts, heading or 0.0, yaw_rate)):
        raise SetpointRefused("not finite")
    if not parts:
        raise SetpointRefused("nothing is commanded")
    if not flavour.is_px4 and velocity == FREE and FREE not in (position, acceleration):
        raise SetpointRefused("position and acceleration without velocity", stops=True)
    if message.coordinate_frame == mav.MAV_FRAME_BODY_NED:
        if position != FREE:
            raise SetpointRefused("a position in body axes")
        velocity, acceleration = _turn(velocity, yaw), _turn(acceleration, yaw)
    return MotionSetpoint(position, velocity, acceleration, heading, yaw_rate)


def _axes(mask: int, first_bit: int, x: float, y: float, z: float) -> Axes:
    return (
        None if mask & 1 << first_bit else x,
        None if mask & 2 << first_bit else y,
        None if mask & 4 << first_bit else z,
    )


def _turn(axes: Axes, yaw: float) -> Axes:
    forward, right, down = axes
    if forward is None or right is None:
        return None, None, down
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return cosine * forward - sine * right, sine * forward + cosine * right, down
