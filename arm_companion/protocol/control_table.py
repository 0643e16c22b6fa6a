"""The control table of the XL430-W250: what a servo knows and obeys, by address.

Numbers are the maker's (XL430-W250 control table, Protocol 2.0). Raw values are integers in the servo's own
units; the constants below turn them into SI.
"""

import enum
import math
import struct
from dataclasses import dataclass
from typing import NamedTuple

MODEL_NUMBER_XL430_W250 = 1060
FIRST_FIRMWARE_WITH_WATCHDOG = 38
FIRST_FIRMWARE_WITH_FAST_SYNC_READ = 45

TICKS_PER_TURN = 4096
TICK_RAD = 2 * math.pi / TICKS_PER_TURN
VELOCITY_UNIT_RAD_PER_S = 0.229 * 2 * math.pi / 60
ACCELERATION_UNIT_RAD_PER_S2 = 214.577 * 2 * math.pi / 3600
PWM_FULL = 885  # 100 % duty
LOAD_FULL = 1000  # 100 % load
VOLTAGE_UNIT_V = 0.1
WATCHDOG_UNIT_S = 0.02
WATCHDOG_TRIPPED = -1
RETURN_DELAY_UNIT_S = 2e-6
TICK_CLOCK_MODULUS_MS = 32_768
EXTENDED_POSITION_LIMIT_TICKS = 1_048_575

BAUD_CODES = {
    0: 9_600,
    1: 57_600,
    2: 115_200,
    3: 1_000_000,
    4: 2_000_000,
    5: 3_000_000,
    6: 4_000_000,
    7: 4_500_000,
}


class OperatingMode(enum.IntEnum):
    """Values of register 11."""

    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    PWM = 16


class HardwareError(enum.IntFlag):
    """Bits of registers 63 (which of them drop the torque) and 70 (which are present)."""

    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20


class MovingStatus(enum.IntFlag):
    """Bits of register 123."""

    IN_POSITION = 0x01
    PROFILE_ONGOING = 0x02
    FOLLOWING_ERROR = 0x08
    RECTANGULAR = 0x10
    TRIANGULAR = 0x20
    TRAPEZOIDAL = 0x30


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of the table.

    Attributes:
        address: first byte.
        size: bytes, 1, 2 or 4, little endian.
        writable: may be written at all; addresses below 64 (EEPROM) only with torque off.
        signed: two's complement.
        lower: least value that may be written.
        upper: greatest value that may be written.
        initial: value as the servo leaves the factory (EEPROM) or as it starts (RAM).
    """

    name: str
    address: int
    size: int
    writable: bool = False
    signed: bool = False
    lower: int = 0
    upper: int = 0
    initial: int = 0

    @property
    def eeprom(self) -> bool:
        """Kept without power, and locked while the torque is on."""
        return self.address < RAM_START

    def encode(self, value: int) -> bytes:
        """Little-endian bytes of `value`.

        Raises:
            OverflowError: when the value does not fit the register's size.
        """
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        """Value of exactly the register's bytes."""
        return int.from_bytes(data, "little", signed=self.signed)


RAM_START = 64
TABLE_SIZE = 148

_read = Register


def _write(name: str, address: int, size: int, lower: int, upper: int, initial: int) -> Register:
    return Register(name, address, size, True, lower < 0, lower, upper, initial)


MODEL_NUMBER = _read("model number", 0, 2, initial=MODEL_NUMBER_XL430_W250)
MODEL_INFORMATION = _read("model information", 2, 4)
FIRMWARE_VERSION = _read("firmware version", 6, 1, initial=46)
ID = _write("id", 7, 1, 0, 252, 1)
BAUD_RATE = _write("baud rate", 8, 1, 0, 7, 1)
RETURN_DELAY = _write("return delay time", 9, 1, 0, 254, 250)
DRIVE_MODE = _write("drive mode", 10, 1, 0, 13, 0)
OPERATING_MODE = _write("operating mode", 11, 1, 0, 16, OperatingMode.POSITION)
SECONDARY_ID = _write("secondary id", 12, 1, 0, 255, 255)  # above 252: none
PROTOCOL_TYPE = _write("protocol type", 13, 1, 1, 2, 2)
HOMING_OFFSET = _write("homing offset", 20, 4, -1_044_479, 1_044_479, 0)
MOVING_THRESHOLD = _write("moving threshold", 24, 4, 0, 1023, 10)
TEMPERATURE_LIMIT = _write("temperature limit", 31, 1, 0, 100, 72)
MAX_VOLTAGE_LIMIT = _write("max voltage limit", 32, 2, 60, 140, 140)
MIN_VOLTAGE_LIMIT = _write("min voltage limit", 34, 2, 60, 140, 60)
PWM_LIMIT = _write("PWM limit", 36, 2, 0, PWM_FULL, PWM_FULL)
VELOCITY_LIMIT = _write("velocity limit", 44, 4, 0, 1023, 265)
MAX_POSITION_LIMIT = _write("max position limit", 48, 4, 0, 4095, 4095)
MIN_POSITION_LIMIT = _write("min position limit", 52, 4, 0, 4095, 0)
STARTUP_CONFIGURATION = _write("startup configuration", 60, 1, 0, 3, 0)
SHUTDOWN = _write("shutdown", 63, 1, 0, 0x3D, 52)

TORQUE_ENABLE = _write("torque enable", 64, 1, 0, 1, 0)
LED = _write("LED", 65, 1, 0, 1, 0)
STATUS_RETURN_LEVEL = _write("status return level", 68, 1, 0, 2, 2)
REGISTERED_INSTRUCTION = _read("registered instruction", 69, 1)
HARDWARE_ERROR_STATUS = _read("hardware error status", 70, 1)
VELOCITY_I_GAIN = _write("velocity I gain", 76, 2, 0, 16_383, 1000)
VELOCITY_P_GAIN = _write("velocity P gain", 78, 2, 0, 16_383, 100)
POSITION_D_GAIN = _write("position D gain", 80, 2, 0, 16_383, 4000)
POSITION_I_GAIN = _write("position I gain", 82, 2, 0, 16_383, 0)
POSITION_P_GAIN = _write("position P gain", 84, 2, 0, 16_383, 640)
FEEDFORWARD_2ND_GAIN = _write("feedforward 2nd gain", 88, 2, 0, 16_383, 0)
FEEDFORWARD_1ST_GAIN = _write("feedforward 1st gain", 90, 2, 0, 16_383, 0)
BUS_WATCHDOG = Register("bus watchdog", 98, 1, writable=True, signed=True, upper=127)  # reads -1 once tripped
GOAL_PWM = _write("goal PWM", 100, 2, -PWM_FULL, PWM_FULL, PWM_FULL)
GOAL_VELOCITY = _write("goal velocity", 104, 4, -1023, 1023, 0)
PROFILE_ACCELERATION = _write("profile acceleration", 108, 4, 0, 32_767, 0)
PROFILE_VELOCITY = _write("profile velocity", 112, 4, 0, 32_767, 0)
GOAL_POSITION = _write("goal position", 116, 4, -EXTENDED_POSITION_LIMIT_TICKS, EXTENDED_POSITION_LIMIT_TICKS, 0)
REALTIME_TICK = _read("realtime tick", 120, 2)
MOVING = _read("moving", 122, 1)
MOVING_STATUS = _read("moving status", 123, 1)
PRESENT_PWM = _read("present PWM", 124, 2, signed=True)
PRESENT_LOAD = _read("present load", 126, 2, signed=True)
PRESENT_VELOCITY = _read("present velocity", 128, 4, signed=True)
PRESENT_POSITION = _read("present position", 132, 4, signed=True)
VELOCITY_TRAJECTORY = _read("velocity trajectory", 136, 4, signed=True)
POSITION_TRAJECTORY = _read("position trajectory", 140, 4, signed=True)
PRESENT_VOLTAGE = _read("present input voltage", 144, 2)
PRESENT_TEMPERATURE = _read("present temperature", 146, 1)
BACKUP_READY = _read("backup ready", 147, 1)

REGISTERS: dict[int, Register] = {
    register.address: register for register in list(globals().values()) if isinstance(register, Register)
}
"""Every register by its first address."""


class Feedback(NamedTuple):
    """Raw values of the registers 124 to 146, which a servo reports in every cycle."""

    pwm: int
    load: int
    velocity: int
    position: int
    velocity_trajectory: int
    position_trajectory: int
    voltage: int
    temperature: int


FEEDBACK_ADDRESS = PRESENT_PWM.address
_FEEDBACK = struct.Struct("<hhiiiiHB")
FEEDBACK_SIZE = _FEEDBACK.size


def decode_feedback(data: bytes) -> Feedback:
    """The feedback block of exactly `FEEDBACK_SIZE` bytes."""
    return Feedback._make(_FEEDBACK.unpack(data))


class Echo(NamedTuple):
    """Raw values of the registers 116 to 123: the goal the servo really has, and its clock."""

    goal: int
    tick_ms: int
    moving: int
    moving_status: int


ECHO_ADDRESS = GOAL_POSITION.address
_ECHO = struct.Struct("<iHBB")
ECHO_SIZE = _ECHO.size


def decode_echo(data: bytes) -> Echo:
    """The echo block of exactly `ECHO_SIZE` bytes."""
    return Echo._make(_ECHO.unpack(data))
