"""A multirotor's cascaded controller: position, velocity, attitude and thrust, rates, and the rotors' lag.

Structure and default gains are those of PX4's multicopter controllers (PositionControl, AttitudeControl,
RateControl), so that a set-point with position, velocity and acceleration meets here what it meets in
flight: the position loop is a soft spring (mass * position_p * velocity_p, 3 N/m sideways at 1.8 kg), the
velocity integrators wind up while something holds the vehicle, and an acceleration is added as feed-forward.

World axes are NED, body axes FRD. Everything is plain floats: at 250 Hz and more, beside a physics engine, an
array for three numbers would cost more than the arithmetic.
"""

import math
from dataclasses import dataclass, field

from arm_companion.sim.ports import RotorCommand, Vec3

GRAVITY = 9.80665
ZERO: Vec3 = (0.0, 0.0, 0.0)
Axes = tuple[float | None, float | None, float | None]
"""Three axes of a set-point; None where the axis is not commanded."""
FREE: Axes = (None, None, None)


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains and limits; beside each the PX4 parameter whose default it is."""

    position_xy: float = 0.95  # 1/s, MPC_XY_P
    position_z: float = 1.0  # 1/s, MPC_Z_P
    velocity_xy: float = 1.8  # 1/s, MPC_XY_VEL_P_ACC
    velocity_z: float = 4.0  # 1/s, MPC_Z_VEL_P_ACC
    integral_xy: float = 0.4  # 1/s^2, MPC_XY_VEL_I_ACC
    integral_z: float = 2.0  # 1/s^2, MPC_Z_VEL_I_ACC
    derivative_xy: float = 0.2  # MPC_XY_VEL_D_ACC
    derivative_cutoff_hz: float = 5.0  # MPC_VELD_LP
    speed_xy: float = 12.0  # m/s, MPC_XY_VEL_MAX
    speed_up: float = 3.0  # m/s, MPC_Z_VEL_MAX_UP
    speed_down: float = 1.5  # m/s, MPC_Z_VEL_MAX_DN
    tilt: float = math.radians(45.0)  # MPC_TILTMAX_AIR
    attitude: float = 6.5  # 1/s, MC_ROLL_P and MC_PITCH_P
    heading: float = 2.8  # 1/s, MC_YAW_P
    rate_max: Vec3 = (math.radians(220.0), math.radians(220.0), math.radians(200.0))  # MC_*RATE_MAX
    # PX4's rate gains are shares of full torque; as angular accelerations on a 2 kg frame they come to these,
    # with the ratios of integral to proportional gain kept (0.2 / 0.15 and 0.1 / 0.2).
    rate: Vec3 = (18.0, 18.0, 8.0)  # 1/s
    rate_integral: Vec3 = (24.0, 24.0, 4.0)  # 1/s^2


@dataclass(frozen=True, slots=True)
class Airframe:
    """What the autopilot believes of its vehicle, and how far the rotors really are from that.

    Attributes:
        mass: kg, from which hover thrust follows.
        inertia: kg m^2, principal moments, body axes.
        thrust_scale: delivered over commanded thrust; the error in hover thrust that the integrators take up.
        thrust_max: share of hover thrust at full throttle.
        thrust_min: share of hover thrust that flying rotors keep (MPC_THR_MIN 0.12 at MPC_THR_HOVER 0.5).
        torque_max: N m, about each body axis.
        arm: m, from the centre to a rotor along a body axis: what thrust there is, it can turn the vehicle with.
        motor_lag: s, time constant of the rotors.
        thrust_curve: how far the rotors' thrust is from linear in what is commanded, at hover's own scale: of the
            share x of hover thrust they deliver (1 - c) x + c x^2 (PX4's THR_MDL_FAC, where it is left uncorrected).
    """

    mass: float
    inertia: Vec3 = (0.016, 0.016, 0.028)
    thrust_scale: float = 1.0
    thrust_max: float = 2.0
    thrust_min: float = 0.24
    torque_max: Vec3 = (1.8, 1.8, 0.35)
    arm: float = 0.18
    motor_lag: float = 0.025
    thrust_curve: float = 0.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """The autopilot's own idea of its motion."""

    position_w: Vec3 = ZERO  # m
    velocity_w: Vec3 = ZERO  # m/s
    attitude_wb: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # (w, x, y, z), body to world
    rate_b: Vec3 = ZERO  # rad/s
    specific_force_b: Vec3 = (0.0, 0.0, -GRAVITY)  # m/s^2

    @property
    def euler(self) -> Vec3:
        """Roll, pitch and yaw, rad."""
        w, x, y, z = self.attitude_wb
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        return roll, pitch, self.yaw

    @property
    def yaw(self) -> float:
        """Heading, rad clockwise from north."""
        w, x, y, z = self.attitude_wb
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def velocity_b(self) -> Vec3:
        """Velocity in body axes, m/s."""
        w, x, y, z = self.attitude_wb
        a, b, c = self.velocity_w
        return (
            (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y + w * z) * b + 2.0 * (x * z - w * y) * c,
            2.0 * (x * y - w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z + w * x) * c,
            2.0 * (x * z + w * y) * a + 2.0 * (y * z - w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c,
        )


@dataclass(frozen=True, slots=True)
class MotionSetpoint:
    """Where to fly. What is not None is commanded; position and velocity loops add to an acceleration."""

    position_w: Axes = FREE  # m
    velocity_w: Axes = FREE  # m/s
    acceleration_w: Axes = FREE  # m/s^2
    yaw: float | None = None  # rad; None keeps the heading
    yaw_rate: float = 0.0  # rad/s


def clamp(value: float, lower: float, upper: float) -> float:
    """`value`, or the bound that it passes."""
    return lower if value < lower else min(value, upper)


def wrap(angle: float) -> float:
    """The same angle within [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@dataclass(slots=True)
class _Memory:
    """Everything the loops remember."""

    velocity_integral: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])  # m/s^2
    rate_integral: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])  # rad/s^2
    velocity_last: Vec3 | None = None  # m/s
    velocity_slope: list[float] = field(default_factory=lambda: [0.0, 0.0])  # m/s^2, north and east
    yaw: float | None = None  # rad, held while no yaw is commanded


class FlightController:
    """The cascade with its integrators and the rotors behind it."""

    def __init__(self, airframe: Airframe, gains: Gains | None = None) -> None:
        self.airframe = airframe
        self.gains = gains or Gains()
        self._memory = _Memory()
        self._rotors = [0.0, 0.0, 0.0, 0.0]  # delivered thrust (N) and torques (N m)
        self.thrust = 0.0
        """Last commanded thrust as a share of believed hover thrust."""
        self.supply = 1.0
        """Share of its nominal thrust that the supply leaves to the rotors."""

    @property
    def velocity_integral(self) -> Vec3:
        """Acceleration (m/s^2, NED) that the velocity integrators have wound up."""
        north, east, down = self._memory.velocity_integral
        return north, east, down

    def reset(self) -> None:
        """Forget integrators and filters, as on the ground; rotors keep turning down by themselves."""
        self._memory = _Memory()

    def idle(self, dt: float) -> RotorCommand:
        """Rotors wind down (disarmed) for `dt` seconds."""
        self.thrust = 0.0
        return self._spin(0.0, ZERO, dt)

    def update(self, estimate: Estimate, setpoint: MotionSetpoint, dt: float, release: float = 1.0) -> RotorCommand:
        """One step of the cascade.

        Args:
            estimate: present motion.
            setpoint: where to fly. An axis with nothing set is left at zero acceleration.
            dt: s since the last step.
            release: of the vertical loop while taking off: from 0, where no set-point makes it lift, to 1,
                where the full climb speed is allowed.
        """
        gains = self.gains
        no_lift = -GRAVITY / gains.velocity_z
        climb = no_lift + release * (gains.speed_up - no_lift)
        acceleration, velocity_error = self._translation(estimate, setpoint, dt, climb)
        down, thrust, produced = self._attitude_and_thrust(acceleration, release)
        self._wind_up(acceleration, velocity_error, produced, thrust, dt)
        rate = self._attitude(estimate, down, setpoint)
        self.thrust = thrust
        thrust = self._smoothed(thrust, dt)
        torque = self._mix(thrust, self._rates(estimate.rate_b, rate, dt))
        return self._spin(thrust * self.airframe.mass * GRAVITY, torque, dt)

    def _smoothed(self, thrust: float, dt: float) -> float:  # noqa: ARG002 - for flight stacks that smooth
        """What the rotors are told of a thrust that is asked for, both shares of hover thrust."""
        return thrust

    def _translation(
        self, estimate: Estimate, setpoint: MotionSetpoint, dt: float, climb: float
    ) -> tuple[list[float], list[float]]:
        """Position P and velocity PID: acceleration, and velocity error (zero on axes without a loop)."""
        gains, memory = self.gains, self._memory
        pull = [0.0, 0.0, 0.0]  # velocity that the position error asks for
        wanted = [0.0, 0.0, 0.0]
        closed = [False, False, False]
        for i in range(3):
            goal, forward = setpoint.position_w[i], setpoint.velocity_w[i]
            if goal is not None:
                pull[i] = (gains.position_z if i == 2 else gains.position_xy) * (goal - estimate.position_w[i])
                closed[i] = True
            if forward is not None:
                wanted[i] = forward
                closed[i] = True
        wanted[0], wanted[1] = _limit_sum((wanted[0], wanted[1]), (pull[0], pull[1]), gains.speed_xy)
        wanted[2] = clamp(wanted[2] + pull[2], -climb, max(gains.speed_down, -climb))
        self._filter_velocity_slope(estimate.velocity_w, dt)
        acceleration, error = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        for i in range(3):
            forward = setpoint.acceleration_w[i]
            if forward is not None:
                acceleration[i] = forward
            if closed[i]:
                error[i] = wanted[i] - estimate.velocity_w[i]
                acceleration[i] += (gains.velocity_z if i == 2 else gains.velocity_xy) * error[i]
                acceleration[i] += memory.velocity_integral[i]
                if i < 2:
                    acceleration[i] -= gains.derivative_xy * memory.velocity_slope[i]
        return acceleration, error

    def _filter_velocity_slope(self, velocity: Vec3, dt: float) -> None:
        memory = self._memory
        if memory.velocity_last is not None:
            share = dt / (dt + 1.0 / (2.0 * math.pi * self.gains.derivative_cutoff_hz))
            for i in range(2):
                slope = (velocity[i] - memory.velocity_last[i]) / dt
                memory.velocity_slope[i] += share * (slope - memory.velocity_slope[i])
        memory.velocity_last = velocity

    def _attitude_and_thrust(
        self, acceleration: list[float], release: float
    ) -> tuple[Vec3, float, tuple[float, float]]:
        """Body z in the world, thrust as a share of hover thrust, and the horizontal acceleration produced.

        The tilt comes from the horizontal demand alone, as in PX4: a climb does not change it.
        """
        north, east, down = acceleration
        horizontal = math.hypot(north, east)
        tilt = min(math.atan2(horizontal, GRAVITY), self.gains.tilt)
        cosine, sine = math.cos(tilt), math.sin(tilt)
        least = self.airframe.thrust_min * release
        thrust = clamp((1.0 - down / GRAVITY) / cosine, least, self.airframe.thrust_max)
        if horizontal < 1e-9:
            return (0.0, 0.0, 1.0), thrust, (0.0, 0.0)
        towards = (north / horizontal, east / horizontal)
        body_z = (-towards[0] * sine, -towards[1] * sine, cosine)
        push = thrust * GRAVITY * sine
        return body_z, thrust, (towards[0] * push, towards[1] * push)

    def _wind_up(
        self,
        acceleration: list[float],
        error: list[float],
        produced: tuple[float, float],
        thrust: float,
        dt: float,
    ) -> None:
        """Integrate the velocity error; stop where throttle or tilt saturate (PX4's tracking anti-windup)."""
        gains, integral = self.gains, self._memory.velocity_integral
        north, east, down = error
        if (thrust <= self.airframe.thrust_min and down >= 0.0) or (thrust >= self.airframe.thrust_max and down <= 0.0):
            down = 0.0
        if math.hypot(acceleration[0], acceleration[1]) > math.hypot(*produced) + 1e-9:
            back = 2.0 / gains.velocity_xy
            north -= back * (acceleration[0] - produced[0])
            east -= back * (acceleration[1] - produced[1])
        integral[0] += gains.integral_xy * north * dt
        integral[1] += gains.integral_xy * east * dt
        integral[2] = clamp(integral[2] + gains.integral_z * down * dt, -GRAVITY, GRAVITY)

    def _attitude(self, estimate: Estimate, body_z: Vec3, setpoint: MotionSetpoint) -> Vec3:
        """Wanted body rates: tilt first, heading second.

        The tilt error is the shortest turn from body z to `body_z`: twice the vector part of PX4's reduced
        attitude error, 2 sin(angle/2) about an axis normal to body z.
        """
        gains, memory = self.gains, self._memory
        w, x, y, z = estimate.attitude_wb
        r00, r10 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
        r20, r21, r22 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        r01, r11 = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z)
        r02, r12 = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)
        to_x = r00 * body_z[0] + r10 * body_z[1] + r20 * body_z[2]
        to_y = r01 * body_z[0] + r11 * body_z[1] + r21 * body_z[2]
        to_z = r02 * body_z[0] + r12 * body_z[1] + r22 * body_z[2]
        half = math.sqrt(2.0 / max(1.0 + to_z, 1e-3))
        yaw = math.atan2(r10, r00)
        if setpoint.yaw is not None:
            memory.yaw = setpoint.yaw
        elif memory.yaw is None or setpoint.yaw_rate:
            memory.yaw = yaw
        heading_rate = gains.heading * wrap(memory.yaw - yaw) + setpoint.yaw_rate
        limit = gains.rate_max
        return (
            clamp(-gains.attitude * half * to_y, -limit[0], limit[0]),
            clamp(gains.attitude * half * to_x, -limit[1], limit[1]),
            clamp(heading_rate * r22, -limit[2], limit[2]),
        )

    def _rates(self, rate: Vec3, wanted: Vec3, dt: float) -> Vec3:
        gains, airframe, integral = self.gains, self.airframe, self._memory.rate_integral
        torque = [0.0, 0.0, 0.0]
        for i in range(3):
            error = wanted[i] - rate[i]
            inertia, most = airframe.inertia[i], airframe.torque_max[i]
            torque[i] = clamp(inertia * (gains.rate[i] * error + integral[i]), -most, most)
            bound = 0.5 * most / inertia
            integral[i] = clamp(integral[i] + gains.rate_integral[i] * error * dt, -bound, bound)
        return torque[0], torque[1], torque[2]

    def _mix(self, thrust: float, torque: Vec3) -> Vec3:
        """What of a torque the rotors can make at this thrust, since none of them pushes down.

        Without airmode both flight stacks give up torque rather than thrust, roll and pitch alike.
        """
        most = thrust * self.airframe.mass * GRAVITY * self.airframe.arm
        share = min(1.0, most / max(abs(torque[0]) + abs(torque[1]), 1e-9))
        return share * torque[0], share * torque[1], torque[2]

    def _spin(self, thrust: float, torque: Vec3, dt: float) -> RotorCommand:
        """First-order lag of the rotors towards what is commanded."""
        rotors, scale, c = self._rotors, self.airframe.thrust_scale, self.airframe.thrust_curve
        share = 1.0 - math.exp(-dt / self.airframe.motor_lag)
        hover = self.airframe.mass * GRAVITY
        delivered = scale * self.supply * thrust * (1.0 - c + c * thrust / hover)
        rotors[0] += share * (delivered - rotors[0])
        rotors[1] += share * (scale * torque[0] - rotors[1])
        rotors[2] += share * (scale * torque[1] - rotors[2])
        rotors[3] += share * (scale * torque[2] - rotors[3])
        return RotorCommand(rotors[0], (rotors[1], rotors[2], rotors[3]))


def _limit_sum(first: tuple[float, float], extra: tuple[float, float], most: float) -> tuple[float, float]:
    """`first + extra`, not longer than `most`: `first` is kept as far as possible (PX4's constrainXY)."""
    total = (first[0] + extra[0], first[1] + extra[1])
    if math.hypot(*total) <= most:
        return total
    speed = math.hypot(*first)
    if speed >= most:
        return first[0] * most / speed, first[1] * most / speed
    # the longest share s of `extra` with |first + s * extra| = most
    a = extra[0] ** 2 + extra[1] ** 2
    b = first[0] * extra[0] + first[1] * extra[1]
    share = (-b + math.sqrt(b * b + a * (most * most - speed * speed))) / a
    return first[0] + share * extra[0], first[1] + share * extra[1]
