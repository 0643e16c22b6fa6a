"""ArduPilot's position controller, where it differs from PX4's: what is commanded is a path, not an acceleration.

A set-point moves a path of the controller's own (`AC_PosControl::input_pos_vel_accel`): the path is bent towards the
set-point with bounded acceleration and jerk, and the vehicle is held on the path by a PID with the path's own
acceleration fed forward. So an acceleration that is commanded for long, at a position that stays, becomes no force: it
moves the end of the path by a / (k_a k_v). Down, an inner loop follows the measured acceleration, and what it asks for
is smoothed on its way to the motors; ATTITUDE_TARGET tells it before that.

Gains are ArduPilot copter's defaults (4.7), in SI; structure and equations are those of AC_PosControl, AC_PID_2D and
AP_Math's control.cpp.
"""

import math
from dataclasses import dataclass, field

from arm_companion.sim.flight_control import (
    GRAVITY,
    Airframe,
    Estimate,
    FlightController,
    Gains,
    MotionSetpoint,
    clamp,
)


@dataclass(frozen=True, slots=True)
class AxisGains:
    """Gains of one axis; beside each the parameter for north and east.

    Attributes:
        position: 1/s, PSC_POSXY_P.
        velocity, integral, derivative: 1/s, 1/s^2 and 1, PSC_VELXY_P, _I and _D.
        accelerate: m/s^2, how hard the path is bent, WPNAV_ACCEL.
        speed: m/s, how fast a position error is closed, WPNAV_SPEED.
        jerk: m/s^3, PSC_JERK_XY.
    """

    position: float = 1.0
    velocity: float = 2.0
    integral: float = 1.0
    derivative: float = 0.25
    accelerate: float = 2.5
    speed: float = 10.0
    jerk: float = 5.0


LEVEL = AxisGains()
DOWN = AxisGains(position=1.0, velocity=5.0, integral=0.0, derivative=0.0, accelerate=1.0, speed=1.5)
_ERROR_CUTOFF_HZ = 5.0  # PSC_VELXY_FLTE and _FLTD
_THRUST_PER_ACCELERATION = 0.1  # PSC_ACCZ_P over the hover throttle of 0.5: share of hover thrust for 1 m/s^2
_THRUST_INTEGRAL = 0.2  # 1/s, PSC_ACCZ_I over the same
_ACCELERATION_CUTOFF_HZ = 20.0  # PSC_ACCZ_FLTE
_RELEASED = 0.999  # of the climb speed, from which on the take-off has begun
_THROTTLE_CUTOFF_HZ = 2.0  # POSCONTROL_THROTTLE_CUTOFF_FREQ_HZ, a constant


@dataclass(slots=True)
class _Path:
    """Where the controller wants one axis to be now, and its PID."""

    place: float
    speed: float = 0.0
    acceleration: float = 0.0
    error: float | None = None  # filtered velocity error
    slope: float = 0.0
    integral: float = 0.0

    def bend(self, goal: float | None, speed: float, acceleration: float, gains: AxisGains, dt: float) -> None:
        """Move on along the path, and bend it towards the set-point (shape_pos_vel_accel)."""
        self.place += self.speed * dt + 0.5 * self.acceleration * dt * dt
        self.speed += self.acceleration * dt
        towards = 0.5 * gains.jerk / gains.accelerate
        wanted = speed
        if goal is not None:
            close = square_root_control(goal - self.place, towards, 0.5 * gains.accelerate)
            wanted += clamp(close, -gains.speed, gains.speed)
        change = square_root_control(wanted - self.speed, gains.jerk / gains.accelerate, gains.jerk)
        target = clamp(change, -gains.accelerate, gains.accelerate) + acceleration
        step = gains.jerk * dt
        self.acceleration += clamp(target - self.acceleration, -step, step)

    def correct(self, error: float, gains: AxisGains, dt: float) -> float:
        """Acceleration that brings the velocity error to nothing (AC_PID_2D)."""
        share = _share(_ERROR_CUTOFF_HZ, dt)
        last = self.error
        if last is None:
            self.error = error
        else:
            self.error = last + share * (error - last)
            self.slope += share * ((self.error - last) / dt - self.slope)
        self.integral += gains.integral * self.error * dt
        return gains.velocity * self.error + self.integral + gains.derivative * self.slope


@dataclass(slots=True)
class _Vertical:
    """The inner loop that follows the measured acceleration downward."""

    error: float = 0.0
    integral: float = 0.0  # share of hover thrust

    def thrust(self, wanted: float, measured: float, dt: float) -> float:
        """Acceleration that the thrust shall make, for a wanted and a measured one, all downward."""
        self.error += _share(_ACCELERATION_CUTOFF_HZ, dt) * (wanted - measured - self.error)
        self.integral = clamp(self.integral + _THRUST_INTEGRAL * self.error * dt, -1.0, 1.0)
        return GRAVITY * (_THRUST_PER_ACCELERATION * self.error + self.integral)


@dataclass(slots=True)
class _Loops:
    paths: list[_Path] = field(default_factory=list)
    vertical: _Vertical = field(default_factory=_Vertical)
    throttle: float | None = None  # share of hover thrust, smoothed


class ArdupilotController(FlightController):
    """The cascade of `FlightController` with ArduPilot's outer loops."""

    def __init__(self, airframe: Airframe, gains: Gains | None = None) -> None:
        super().__init__(airframe, gains)
        self._loops = _Loops()

    def reset(self) -> None:
        """Forget path and integrators, as on the ground."""
        super().reset()
        self._loops = _Loops()

    def _translation(
        self, estimate: Estimate, setpoint: MotionSetpoint, dt: float, climb: float
    ) -> tuple[list[float], list[float]]:
        loops = self._loops
        if not loops.paths:
            loops.paths = [_Path(place) for place in estimate.position_w]
        wanted = [0.0, 0.0, 0.0]
        for i, path in enumerate(loops.paths):
            gains = DOWN if i == 2 else LEVEL
            goal, speed, forward = setpoint.position_w[i], setpoint.velocity_w[i], setpoint.acceleration_w[i]
            if goal is None and speed is None and forward is None:
                path.place, path.speed, path.acceleration = estimate.position_w[i], estimate.velocity_w[i], 0.0
                continue
            path.bend(goal, speed or 0.0, forward or 0.0, gains, dt)
            if i == 2 and climb < _RELEASED * self.gains.speed_up:  # not lifted off yet: its path begins there
                path.place, path.speed, path.acceleration = estimate.position_w[i], 0.0, 0.0
                loops.vertical = _Vertical()
            close = square_root_control(path.place - estimate.position_w[i], gains.position, gains.accelerate)
            target = path.speed + clamp(close, -gains.speed, gains.speed)
            if i == 2:
                target = clamp(target, -climb, max(gains.speed, -climb))
            wanted[i] = path.acceleration + path.correct(target - estimate.velocity_w[i], gains, dt)
        wanted[2] = loops.vertical.thrust(wanted[2], _sinking(estimate), dt)
        return wanted, [0.0, 0.0, 0.0]

    def _smoothed(self, thrust: float, dt: float) -> float:
        loops = self._loops
        last = thrust if loops.throttle is None else loops.throttle
        loops.throttle = last + _share(_THROTTLE_CUTOFF_HZ, dt) * (thrust - last)
        return loops.throttle


def square_root_control(error: float, gain: float, accelerate: float) -> float:
    """Speed that closes an error: in proportion to it when near, and so that the braking is bounded when far.

    Args:
        error: in the unit of what is closed.
        gain: 1/s.
        accelerate: greatest change of the result, per second.
    """
    near = accelerate / gain**2
    if abs(error) <= near:
        return gain * error
    return math.copysign(math.sqrt(2.0 * accelerate * (abs(error) - 0.5 * near)), error)


def _share(cutoff_hz: float, dt: float) -> float:
    """Of a first-order filter's way to its input in `dt` seconds."""
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


def _sinking(estimate: Estimate) -> float:
    """Measured acceleration downward, m/s^2: the accelerometer's, with gravity taken out."""
    w, x, y, z = estimate.attitude_wb
    a, b, c = estimate.specific_force_b
    return 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c + GRAVITY
