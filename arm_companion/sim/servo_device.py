"""One emulated XL430: its registers and their rules, its motion, its protections and its power.

Where the maker's manual leaves open what firmware does, the emulator takes the less forgiving reading, so
that a driver which lives with it lives with the real one: a goal written with torque off is kept and driven
to as soon as the torque comes on.
"""

import random
from collections.abc import Callable
from functools import cache

from arm_companion.protocol import control_table as ct
from arm_companion.protocol.control_table import HardwareError, MovingStatus, OperatingMode, Register
from arm_companion.protocol.dynamixel import StatusError
from arm_companion.sim.servo_motion import STALL_CURRENT_PER_V, STALL_TORQUE_PER_V, Gains, Motor, Trajectory

BOOT_S = 0.25
BROWN_OUT_V = 4.5
AMBIENT_C = 25.0
LOAD_NOISE = 0.01  # one sigma of the reported load, share of full load
_HEATING_K_PER_W = 5.0
_COOLING_S = 200.0
_LOAD_FILTER_S = 0.01
_OVERLOAD_SHARE = 0.8
_OVERLOAD_S = 2.0
_IN_POSITION_TICKS = 12
_FOLLOWING_TICKS = 200
_MODES = {OperatingMode.POSITION, OperatingMode.EXTENDED_POSITION, OperatingMode.PWM}
"""Velocity mode, which the arm has no use for, is not emulated; nor are drive modes other than 0 (normal
direction, profiles by velocity)."""
# What every step of the motion looks up, spelled out once: a servo takes a thousand steps a second.
_TORQUE_ENABLE, _OPERATING_MODE = ct.TORQUE_ENABLE.address, ct.OPERATING_MODE.address
_GOAL_PWM, _PWM_LIMIT, _GOAL_POSITION = ct.GOAL_PWM.address, ct.PWM_LIMIT.address, ct.GOAL_POSITION.address
_PROFILE_VELOCITY, _PROFILE_ACCELERATION = ct.PROFILE_VELOCITY.address, ct.PROFILE_ACCELERATION.address
_P_GAIN, _I_GAIN, _D_GAIN = ct.POSITION_P_GAIN.address, ct.POSITION_I_GAIN.address, ct.POSITION_D_GAIN.address
_MIN_VOLTAGE_LIMIT, _MAX_VOLTAGE_LIMIT = ct.MIN_VOLTAGE_LIMIT.address, ct.MAX_VOLTAGE_LIMIT.address
_TEMPERATURE_LIMIT, _BUS_WATCHDOG = ct.TEMPERATURE_LIMIT.address, ct.BUS_WATCHDOG.address
_PWM_MODE = int(OperatingMode.PWM)
_SPEED = ct.VELOCITY_UNIT_RAD_PER_S / ct.TICK_RAD  # ticks/s for each unit of the register
_ACCELERATION = ct.ACCELERATION_UNIT_RAD_PER_S2 / ct.TICK_RAD  # ticks/s^2
_GOALS = {ct.GOAL_PWM, ct.GOAL_VELOCITY, ct.GOAL_POSITION}


@cache
def _within(address: int, size: int) -> tuple[Register, ...]:
    """Registers that share bytes with a range, in order."""
    return tuple(
        register
        for start, register in sorted(ct.REGISTERS.items())
        if start < address + size and start + register.size > address
    )


class EmulatedServo:
    """One servo.

    Attributes:
        values: raw value of every register, by address.
        motor: the horn's true motion, which no loss of power changes.
        lag: tells by how much its time, as `advance` counts it, is behind the world's clock, s; its own clock is not.
        silenced: its transmitter is broken: it obeys and does not answer.
    """

    def __init__(self, servo_id: int, baud: int, position: float, rng: random.Random) -> None:
        self.values = {address: register.initial for address, register in ct.REGISTERS.items()}
        self.motor = Motor(position)
        self.silenced = False
        self.lag: Callable[[], float] = lambda: 0.0
        self._rng = rng
        self._trajectory = Trajectory(position)
        self._turns = 0.0  # ticks from the horn's true position to the reported one
        self._wakes_at: float | None = None
        self._powered = self._plugged = True
        self._clock = 0.0
        self._booted_at = 0.0
        self._heard_at = 0.0
        self._strained_s = 0.0
        self._load = 0.0
        self._temperature = AMBIENT_C + 5.0
        self._voltage = 12.0
        self._registered: tuple[int, bytes] | None = None
        self.poke(ct.ID, servo_id)
        self.poke(ct.BAUD_RATE, next(code for code, rate in ct.BAUD_CODES.items() if rate == baud))
        self.poke(ct.RETURN_DELAY, 0)
        self.poke(ct.OPERATING_MODE, OperatingMode.EXTENDED_POSITION)
        self._boot()

    # What the rest of the simulation sees and does.

    def peek(self, register: Register) -> int:
        """Present value of a register, past all rules."""
        if not register.writable:
            self._refresh()
        return self.values[register.address]

    def poke(self, register: Register, value: int) -> None:
        """Set a register, past all rules and without side effects."""
        self.values[register.address] = value

    @property
    def id(self) -> int:
        """Its id on the bus."""
        return self.values[ct.ID.address]

    @property
    def firmware(self) -> int:
        """Version of its firmware."""
        return self.values[ct.FIRMWARE_VERSION.address]

    @property
    def baud(self) -> int:
        """Speed at which it listens."""
        return ct.BAUD_CODES[self.values[ct.BAUD_RATE.address]]

    @property
    def awake(self) -> bool:
        """Has power and has booted."""
        return self._powered and self._wakes_at is None

    @property
    def current(self) -> float:
        """A drawn from the supply."""
        if not self.awake:
            return 0.0
        return 0.05 + abs(self.motor.duty * self.motor.torque) * STALL_CURRENT_PER_V / STALL_TORQUE_PER_V

    @property
    def alert(self) -> bool:
        """A hardware error stands."""
        return self.values[ct.HARDWARE_ERROR_STATUS.address] != 0

    def trip(self, bits: int) -> None:
        """Let a hardware error happen; those in the shutdown mask drop the torque until a reboot."""
        self.values[ct.HARDWARE_ERROR_STATUS.address] |= bits
        if bits & self.values[ct.SHUTDOWN.address]:
            self._torque_off()

    def warm(self, temperature: float) -> None:
        """Bring it to a temperature, degC; from there it cools or warms as it would."""
        self._temperature = temperature

    def set_power(self, *, on: bool) -> None:
        """Cut or restore its cable; it boots afresh, and forgets turns and RAM."""
        self._plugged = on
        self._power(on=on)

    def _power(self, *, on: bool) -> None:
        if on and not self._powered:
            self._wakes_at = self._clock + BOOT_S
        if not on:
            self._wakes_at = None
            self._torque_off()
        self._powered = on

    # What the bus asks.

    def hear(self) -> None:
        """An instruction came: the watchdog's time begins again."""
        self._heard_at = self._clock

    def read(self, address: int, size: int) -> bytes | None:
        """Bytes of the control table, None outside of it."""
        if not 0 < size <= ct.TABLE_SIZE or address + size > ct.TABLE_SIZE:
            return None
        self._refresh()
        margin = 4  # a range may begin or end inside a register
        table = bytearray(margin + size + margin)
        for register in _within(address, size):
            at = margin + register.address - address
            table[at : at + register.size] = register.encode(self.values[register.address])
        return bytes(table[margin : margin + size])

    def write(self, address: int, data: bytes) -> StatusError:
        """Write whole registers, all or none of them."""
        changes: list[tuple[Register, int]] = []
        at = 0
        while at < len(data):
            register = ct.REGISTERS.get(address + at)
            if register is None or not register.writable:
                return StatusError.ACCESS
            if at + register.size > len(data):
                return StatusError.DATA_LENGTH
            value = register.decode(data[at : at + register.size])
            if error := self._refusal(register, value):
                return error
            changes.append((register, value))
            at += register.size
        if not changes:
            return StatusError.DATA_LENGTH
        for register, value in changes:
            self._apply(register, value)
        return StatusError.NONE

    def register_write(self, address: int, data: bytes) -> StatusError:
        """Keep a write until `act`."""
        register = ct.REGISTERS.get(address)
        if register is None or not register.writable:
            return StatusError.ACCESS
        self._registered = (address, data)
        self.values[ct.REGISTERED_INSTRUCTION.address] = 1
        return StatusError.NONE

    def act(self) -> StatusError:
        """Do the write that was kept."""
        if self._registered is None:
            return StatusError.INSTRUCTION
        (address, data), self._registered = self._registered, None
        self.values[ct.REGISTERED_INSTRUCTION.address] = 0
        return self.write(address, data)

    def reboot(self) -> None:
        """Go deaf for the time of a boot, then start afresh."""
        self._torque_off()
        self._wakes_at = self._clock + BOOT_S

    def clear_turns(self) -> StatusError:
        """Report the position within one turn from now on."""
        if self._moving():
            return StatusError.RESULT_FAIL
        self._forget_turns()
        self._hold()
        return StatusError.NONE

    # Time.

    def advance(self, dt: float, load_torque: float, voltage: float) -> None:
        """Let `dt` seconds pass under a load (N m on the horn) and a supply voltage."""
        self._clock += dt
        self._voltage = voltage
        if (self._plugged and voltage >= BROWN_OUT_V) != self._powered:
            self._power(on=not self._powered)
        if self._wakes_at is not None and self._clock >= self._wakes_at:
            self._wakes_at = None
            self._boot()
        on = self.values[_TORQUE_ENABLE] == 1 and self.awake
        if on:
            self._watch()
            self._control(dt)
        self.motor.step(voltage, load_torque, dt, on=on)
        self._protect(dt, voltage, on=on)

    def _watch(self) -> None:
        allowed = self.values[_BUS_WATCHDOG] * ct.WATCHDOG_UNIT_S
        if allowed > 0 and self._clock - self._heard_at > allowed:
            self.values[_BUS_WATCHDOG] = ct.WATCHDOG_TRIPPED
            self._hold()

    def _control(self, dt: float) -> None:
        v, motor, trajectory = self.values, self.motor, self._trajectory
        goal_pwm = v[_GOAL_PWM]
        if v[_OPERATING_MODE] == _PWM_MODE:
            motor.duty = goal_pwm / ct.PWM_FULL
            return
        trajectory.step(v[_GOAL_POSITION], v[_PROFILE_VELOCITY] * _SPEED, v[_PROFILE_ACCELERATION] * _ACCELERATION, dt)
        gains = Gains.from_registers(v[_P_GAIN], v[_I_GAIN], v[_D_GAIN])
        error = trajectory.position - (motor.position + self._turns)
        motor.control(error, trajectory.speed - motor.speed, gains, min(abs(goal_pwm), v[_PWM_LIMIT]), dt)

    def _protect(self, dt: float, voltage: float, *, on: bool) -> None:
        stall = STALL_TORQUE_PER_V * max(voltage, BROWN_OUT_V)
        share = self.motor.torque / stall if on else 0.0
        self._load += (share - self._load) * min(dt / _LOAD_FILTER_S, 1.0)
        heat = _HEATING_K_PER_W * voltage * voltage * STALL_CURRENT_PER_V * share * share
        self._temperature += (AMBIENT_C + 5.0 + heat - self._temperature) * dt / _COOLING_S
        if not self.awake:
            return
        self._strained_s = self._strained_s + dt if abs(self._load) > _OVERLOAD_SHARE else 0.0
        if self._strained_s > _OVERLOAD_S:
            self.trip(HardwareError.OVERLOAD)
        v = self.values
        if self._temperature > v[_TEMPERATURE_LIMIT]:
            self.trip(HardwareError.OVERHEATING)
        if not v[_MIN_VOLTAGE_LIMIT] <= voltage / ct.VOLTAGE_UNIT_V <= v[_MAX_VOLTAGE_LIMIT]:
            self.trip(HardwareError.INPUT_VOLTAGE)

    # Registers.

    def _refusal(self, register: Register, value: int) -> StatusError:
        v = self.values
        if register.eeprom and v[ct.TORQUE_ENABLE.address]:
            return StatusError.ACCESS
        if register is ct.BUS_WATCHDOG and v[ct.FIRMWARE_VERSION.address] < ct.FIRST_FIRMWARE_WITH_WATCHDOG:
            return StatusError.ACCESS
        if (
            not register.lower <= value <= register.upper
            or (register in _GOALS and v[ct.BUS_WATCHDOG.address] == ct.WATCHDOG_TRIPPED)
            or (register is ct.OPERATING_MODE and value not in _MODES)
            or (register is ct.DRIVE_MODE and value)
        ):
            return StatusError.DATA_RANGE
        if self._beyond_limit(register, value):
            return StatusError.DATA_LIMIT
        if register is ct.TORQUE_ENABLE and value and self._shut_down():
            return StatusError.RESULT_FAIL
        return StatusError.NONE

    def _beyond_limit(self, register: Register, value: int) -> bool:
        v = self.values
        if register is ct.GOAL_PWM:
            return abs(value) > v[ct.PWM_LIMIT.address]
        if register is ct.GOAL_VELOCITY:
            return abs(value) > v[ct.VELOCITY_LIMIT.address]
        if register is ct.GOAL_POSITION and v[ct.OPERATING_MODE.address] == OperatingMode.POSITION:
            return not v[ct.MIN_POSITION_LIMIT.address] <= value <= v[ct.MAX_POSITION_LIMIT.address]
        return False

    def _shut_down(self) -> bool:
        return bool(self.values[ct.HARDWARE_ERROR_STATUS.address] & self.values[ct.SHUTDOWN.address])

    def _apply(self, register: Register, value: int) -> None:
        before, self.values[register.address] = self.values[register.address], value
        if register is ct.TORQUE_ENABLE:
            if value and not before:
                self._torque_on()
            elif not value:
                self._torque_off()
        elif register is ct.OPERATING_MODE and value != before:
            for reset in (
                *(ct.VELOCITY_I_GAIN, ct.VELOCITY_P_GAIN, ct.FEEDFORWARD_1ST_GAIN, ct.FEEDFORWARD_2ND_GAIN),
                *(ct.POSITION_P_GAIN, ct.POSITION_I_GAIN, ct.POSITION_D_GAIN),
                *(ct.PROFILE_VELOCITY, ct.PROFILE_ACCELERATION),
            ):
                self.values[reset.address] = reset.initial
            self.values[ct.GOAL_PWM.address] = self.values[ct.PWM_LIMIT.address]
            if value == OperatingMode.POSITION:
                self._forget_turns()
        elif register is ct.HOMING_OFFSET:
            self._turns += value - before
        elif register is ct.BUS_WATCHDOG:
            self._heard_at = self._clock

    def _refresh(self) -> None:
        """Bring the measured registers up to date."""
        v = self.values
        position = self.motor.position + self._turns
        v[ct.REALTIME_TICK.address] = self._tick()
        v[ct.PRESENT_POSITION.address] = round(position)
        v[ct.PRESENT_VELOCITY.address] = round(self.motor.speed * ct.TICK_RAD / ct.VELOCITY_UNIT_RAD_PER_S)
        v[ct.PRESENT_PWM.address] = round(self.motor.duty * ct.PWM_FULL)
        load = (self._load + self._rng.gauss(0.0, LOAD_NOISE)) * ct.LOAD_FULL
        v[ct.PRESENT_LOAD.address] = min(max(round(load), -ct.LOAD_FULL), ct.LOAD_FULL)
        v[ct.PRESENT_VOLTAGE.address] = round(self._voltage / ct.VOLTAGE_UNIT_V)
        v[ct.PRESENT_TEMPERATURE.address] = round(self._temperature)
        v[ct.VELOCITY_TRAJECTORY.address] = round(self._trajectory.speed * ct.TICK_RAD / ct.VELOCITY_UNIT_RAD_PER_S)
        v[ct.POSITION_TRAJECTORY.address] = round(self._trajectory.position)
        v[ct.MOVING.address] = int(self._moving())
        v[ct.MOVING_STATUS.address] = self._moving_status(position)

    def _tick(self) -> int:
        return int((self._clock + self.lag() - self._booted_at) * 1000) % ct.TICK_CLOCK_MODULUS_MS

    def _moving(self) -> bool:
        threshold = self.values[ct.MOVING_THRESHOLD.address] * ct.VELOCITY_UNIT_RAD_PER_S
        return abs(self.motor.speed) * ct.TICK_RAD > threshold

    def _moving_status(self, position: float) -> int:
        v = self.values
        goal = v[ct.GOAL_POSITION.address]
        profile = MovingStatus(0)
        if v[ct.PROFILE_VELOCITY.address]:
            profile = MovingStatus.TRAPEZOIDAL if v[ct.PROFILE_ACCELERATION.address] else MovingStatus.RECTANGULAR
        arrived = abs(goal - position) <= _IN_POSITION_TICKS
        ongoing = abs(goal - self._trajectory.position) >= 1
        behind = abs(self._trajectory.position - position) > _FOLLOWING_TICKS
        return (
            profile.value
            | arrived * MovingStatus.IN_POSITION.value
            | ongoing * MovingStatus.PROFILE_ONGOING.value
            | behind * MovingStatus.FOLLOWING_ERROR.value
        )

    # States.

    def _boot(self) -> None:
        for address, register in ct.REGISTERS.items():
            if not register.eeprom:
                self.values[address] = register.initial
        self.values[ct.GOAL_PWM.address] = self.values[ct.PWM_LIMIT.address]
        self._registered = None
        self._booted_at, self._heard_at = self._clock + self.lag(), self._clock
        self._strained_s = 0.0
        self.motor.release()
        self._forget_turns()
        self._hold()

    def _forget_turns(self) -> None:
        turn = ct.TICKS_PER_TURN
        self._turns = self.values[ct.HOMING_OFFSET.address] - turn * float(self.motor.position // turn)
        self._trajectory.stop(self.motor.position + self._turns)

    def _hold(self) -> None:
        """Make the present position the goal."""
        position = self.motor.position + self._turns
        self.values[ct.GOAL_POSITION.address] = round(position)
        self._trajectory.stop(position)

    def _torque_on(self) -> None:
        if self.values[ct.OPERATING_MODE.address] == OperatingMode.POSITION:
            self._forget_turns()
        self._trajectory.stop(self.motor.position + self._turns)
        self._heard_at = self._clock

    def _torque_off(self) -> None:
        self.values[ct.TORQUE_ENABLE.address] = 0
        self.motor.release()
        self._trajectory.stop(self.motor.position + self._turns)
