"""How one XL430 moves: trajectory, position controller, motor and gear train. Physics only, no registers.

The motor is a direct-current motor behind a 258.5:1 gear at the horn: torque grows with duty and voltage and
falls with speed (1.5 N m at stall, 61 rev/min without load, both at 12 V). The gear train has Coulomb
friction, so that a horn at rest holds a small load even without power. What a controller with proportional
gain does under load, it does here too: it sags, and stalls when the duty is exhausted.
"""

import functools
import math
from dataclasses import dataclass

from arm_companion.protocol.control_table import PWM_FULL, TICK_RAD

STALL_TORQUE_PER_V = 1.5 / 12.0  # N m / V
NO_LOAD_SPEED_PER_V = 61.0 / 60.0 * 2 * math.pi / 12.0  # rad/s / V
DAMPING = STALL_TORQUE_PER_V / NO_LOAD_SPEED_PER_V  # N m s/rad, back-EMF through the winding
DAMPING_OFF = 0.02  # N m s/rad, torque off: bridge open, gear grease only
FRICTION = 0.05  # N m, Coulomb, at the horn
INERTIA = 3.3e-3  # kg m^2, rotor seen through the gear
STALL_CURRENT_PER_V = 1.4 / 12.0  # A / V
_LONGEST_STEP_S = 0.002
_MS = 1e-3


@dataclass(frozen=True, slots=True)
class Gains:
    """Position controller, in PWM units (885 is full duty) and ticks.

    The maker gives `P/128`, `I/65536` and `D/16` without a time base; here I acts per millisecond and D on
    tenths of ticks per millisecond, which settles without overshoot at the factory's gains.
    """

    p: float
    i: float
    d: float

    @staticmethod
    @functools.cache
    def from_registers(p: int, i: int, d: int) -> "Gains":
        """Gains of the raw register values."""
        return Gains(p / 128, i / 65_536, d / 160)


@dataclass(slots=True)
class Trajectory:
    """Where the controller wants to be: a trapezoid in speed towards the goal, replanned in every step."""

    position: float  # ticks
    speed: float = 0.0  # ticks/s

    def step(self, goal: float, speed_limit: float, acceleration: float, dt: float) -> None:
        """Advance by `dt`. A limit of 0 is none; with no speed limit the trajectory jumps to its goal."""
        error = goal - self.position
        if not speed_limit:
            self.position, self.speed = goal, 0.0
            return
        wanted = min(speed_limit, abs(error) / dt)
        if acceleration:
            change = acceleration * dt
            stopping = math.sqrt(2 * acceleration * abs(error)) - change / 2
            wanted = math.copysign(min(wanted, max(stopping, 0.0)), error)
            if abs(error) <= change * dt and abs(self.speed) <= 2 * change:
                self.position, self.speed = goal, 0.0
                return
            self.speed += min(max(wanted - self.speed, -change), change)
        else:
            self.speed = math.copysign(wanted, error)
        self.position += self.speed * dt

    def stop(self, position: float) -> None:
        """Stand still at `position`."""
        self.position, self.speed = position, 0.0


class Motor:
    """Motor, gear and horn.

    Attributes:
        position: of the horn, ticks since the world began, unbounded.
        speed: ticks/s.
        duty: -1 to 1, what the controller puts out.
        torque: N m at the horn before friction, positive towards growing positions.
    """

    def __init__(self, position: float) -> None:
        self.position = position
        self.speed = 0.0
        self.duty = 0.0
        self.torque = 0.0
        self._integral = 0.0

    def release(self) -> None:
        """Switch the output off."""
        self.duty = self.torque = self._integral = 0.0

    def control(self, error: float, speed_error: float, gains: Gains, pwm_limit: float, dt: float) -> None:
        """Set the duty from the errors of position (ticks) and speed (ticks/s)."""
        if gains.i:
            bound = pwm_limit / gains.i
            self._integral = min(max(self._integral + error * dt / _MS, -bound), bound)
        pwm = gains.p * error + gains.i * self._integral + gains.d * speed_error * _MS
        self.duty = min(max(pwm, -pwm_limit), pwm_limit) / PWM_FULL

    def step(self, voltage: float, load_torque: float, dt: float, *, on: bool) -> None:
        """Integrate the motion over `dt`, implicitly in the damping and in the friction.

        Args:
            voltage: at the motor's bridge, V.
            load_torque: of the load on the horn, N m, positive towards growing positions.
            dt: s.
            on: the bridge drives; off, the horn only drags.
        """
        omega = self.speed * TICK_RAD
        drive = STALL_TORQUE_PER_V * voltage * self.duty if on else 0.0
        damping = DAMPING if on else DAMPING_OFF
        decay = 1.0 + dt * damping / INERTIA
        free = (omega + dt / INERTIA * (drive + load_torque)) / decay
        held = dt / INERTIA * FRICTION / decay
        omega = math.copysign(max(abs(free) - held, 0.0), free)
        self.torque = drive - damping * omega if on else 0.0
        self.speed = omega / TICK_RAD
        self.position += self.speed * dt


def substeps(dt: float) -> int:
    """Into how many steps to divide `dt` for the integration to stay accurate."""
    return max(1, math.ceil(dt / _LONGEST_STEP_S - 1e-9))
