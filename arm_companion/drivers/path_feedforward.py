"""A force against which ArduPilot shall hold, told in the only words that it has: a path.

ArduPilot takes the acceleration of a set-point for that of a path which the vehicle shall fly, not for a force: held
for long at a position that stays, it moves the path's end away by half a metre for each m/s^2, or without end
(`AC_PosControl::input_pos_vel_accel_NE`; docs/adr/0025). What its controller makes of a path e(t) beside the commanded
place, with the vehicle at that place, is the acceleration

    e'' + (P + I/s + D s) (s + K) e

with the gains P, I, D of velocity and K of position. This is solved for the e that makes the acceleration u which is
asked for: e = s w and

    (1 + D) w''' + (P + D K) w'' + (I + P K) w' + I K w = u.

Position, velocity and acceleration of e belong to each other, so that the path is followed and not bent. It fades by
itself as ArduPilot's integrator takes the force over: w is what that integrator holds by then. A set-point that comes
late must not forget it, or the same force is handed over twice. Down, where an inner loop follows the measured
acceleration (P_a and I_a, here in m/s^2 of thrust for a m/s^2 of error), P_a s + I_a stands in the place of s:

    (P_a s + I_a) (s^2 + P s + P K) w = u.
"""

from dataclasses import dataclass
from typing import Final

from arm_companion.mission.facts import Setpoint, Vec3

# ArduPilot copter's defaults: PSC_VELXY_P 2, _I 1, _D 0.25, PSC_POSXY_P 1; PSC_VELZ_P 5, PSC_POSZ_P 1; PSC_ACCZ_P
# and _I at half throttle in hover.
_P, _I, _D, _K = 2.0, 1.0, 0.25, 1.0
_LEVEL: Final = (1.0 + _D, _P + _D * _K, _I + _P * _K, _I * _K)
_P_DOWN, _K_DOWN, _P_A, _I_A = 5.0, 1.0, 0.98, 1.96
_DOWN: Final = (_P_A, _P_A * _P_DOWN + _I_A, _P_A * _P_DOWN * _K_DOWN + _I_A * _P_DOWN, _I_A * _P_DOWN * _K_DOWN)
_LONGEST_STEP_S: Final = 0.1
_FLIES_ON_S: Final = 3.0  # GUID_TIMEOUT: so long a path goes on whose set-points stop
_NOTHING: Final = 1e-6


@dataclass(slots=True)
class _Axis:
    """w and its derivatives."""

    w: float = 0.0
    place: float = 0.0  # w', which is e
    speed: float = 0.0
    acceleration: float = 0.0

    def step(self, u: float, coefficients: tuple[float, float, float, float], dt: float) -> None:
        third, second, first, zeroth = coefficients
        self.acceleration = (u - second * self.speed - first * self.place - zeroth * self.w) / third
        self.speed += dt * self.acceleration  # the newest speed moves the place: stable where the oldest is not
        self.place += dt * self.speed
        self.w += dt * self.place

    def fly_on(self, dt: float) -> None:
        """What the autopilot makes of a gap in the set-points: the last acceleration goes on, and then it stops."""
        if dt > _FLIES_ON_S:
            self.place = self.speed = self.acceleration = 0.0
            return
        self.w += dt * (self.place + dt * (self.speed / 2.0 + dt * self.acceleration / 6.0))
        self.place += dt * (self.speed + dt * self.acceleration / 2.0)
        self.speed += dt * self.acceleration


class PathFeedforward:
    """The path beside the set-points of one stream."""

    def __init__(self) -> None:
        self._axes = [_Axis() for _ in range(3)]
        self._last: float | None = None

    def reset(self) -> None:
        """The autopilot begins anew with its integrators where they are: nothing is to be taken over from before."""
        self._axes = [_Axis() for _ in range(3)]
        self._last = None

    def shaped(self, setpoint: Setpoint, now: float) -> Setpoint:
        """The set-point with its acceleration turned into a path.

        Args:
            setpoint: its acceleration is what the thrust shall make beyond that of hovering, m/s^2; what of it belongs
                to position and velocity is a path already.
            now: loop time, s.
        """
        dt = 0.0 if self._last is None else now - self._last
        if dt > _LONGEST_STEP_S:
            for axis in self._axes:
                axis.fly_on(dt)
            dt = 0.0
        self._last = now
        # of a path that is flown anyway, the acceleration is what ArduPilot takes it for
        forces = [a - b for a, b in zip(setpoint.acceleration_w, setpoint.path_w, strict=True)]
        for axis, u, coefficients in zip(self._axes, forces, (_LEVEL, _LEVEL, _DOWN), strict=True):
            axis.step(u, coefficients, dt)
        if all(abs(a.place) + abs(a.speed) + abs(a.acceleration) < _NOTHING for a in self._axes):
            return Setpoint(setpoint.position_w, setpoint.velocity_w, setpoint.path_w, setpoint.yaw)
        return Setpoint(
            _sum(setpoint.position_w, [axis.place for axis in self._axes]),
            _sum(setpoint.velocity_w, [axis.speed for axis in self._axes]),
            _sum(setpoint.path_w, [axis.acceleration for axis in self._axes]),
            setpoint.yaw,
        )


def _sum(a: Vec3, b: list[float]) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
