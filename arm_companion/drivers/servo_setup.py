"""Bringing one servo into the state that the arm needs, without ever letting go of what it holds."""

import asyncio
from dataclasses import dataclass

from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_health import ServoRecord
from arm_companion.drivers.servo_link import DRAIN_S, ServoLink
from arm_companion.errors import DeviceFault
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.control_table import OperatingMode

SPEED_LIMIT_RAD_PER_S = 6.0
"""Of the servos' own trajectories, just under what an XL430 does at 12 V."""

_PING_SIZE = 3


@dataclass(frozen=True, slots=True)
class Settings:
    """What a servo is set to.

    Attributes:
        watchdog: raw value of the bus watchdog.
        profile_velocity: raw speed limit of the servo's own trajectory: the last bound on a wrong goal.
        profile_acceleration: raw acceleration limit of it, 0: none.
        goal_pwm: raw limit of what it puts out; None: as it is after power-up, its own PWM limit.
        within_a_turn: its travel is less than a turn, so that the angle of its horn says all.
    """

    watchdog: int
    profile_velocity: int
    profile_acceleration: int = 0
    goal_pwm: int | None = None
    within_a_turn: bool = False


def settings_of(config: ServosConfig, speed_limit_rad_per_s: float = SPEED_LIMIT_RAD_PER_S) -> Settings:
    """What every servo of a configuration is set to."""
    return Settings(
        watchdog=min(max(round(config.watchdog_s / ct.WATCHDOG_UNIT_S), 1), ct.BUS_WATCHDOG.upper),
        profile_velocity=max(round(speed_limit_rad_per_s / ct.VELOCITY_UNIT_RAD_PER_S), 1),
    )


@dataclass(frozen=True, slots=True)
class ServoInfo:
    """What a servo is, as found when it was set up."""

    id: int
    model: int
    firmware: int
    return_delay: int  # raw, 2 us
    shutdown: int  # HardwareError bits that drop its torque
    fresh: bool  # its RAM was as after power-up: nothing has set it up since


async def identify(link: ServoLink, servo: int) -> tuple[int, int]:
    """Model number and firmware version.

    Raises:
        DeviceFault: it is silent, or no XL430-W250 with a bus watchdog.
    """
    data = await link.command(servo, dxl.ping(servo), _PING_SIZE)
    model, firmware = int.from_bytes(data[:2], "little"), data[2]
    if model != ct.MODEL_NUMBER_XL430_W250:
        raise DeviceFault(servo, 0, f"model number {model}, not {ct.MODEL_NUMBER_XL430_W250} (XL430-W250)")
    if firmware < ct.FIRST_FIRMWARE_WITH_WATCHDOG:
        raise DeviceFault(servo, 0, f"firmware {firmware} is older than {ct.FIRST_FIRMWARE_WITH_WATCHDOG}: no watchdog")
    return model, firmware


async def set_up(link: ServoLink, record: ServoRecord, settings: Settings) -> ServoInfo:
    """Prepare one servo for goals, all but its turns (`servo_homing`); its torque stays as it is, off or on.

    EEPROM is written only where it differs and only with the torque off. A tripped bus watchdog is cleared,
    and the servo told to stay where it is before anything can move it.

    Raises:
        DeviceFault: it is silent, of another kind, has a hardware error, or would have to let go to be set up.
    """
    servo = record.id
    model, firmware = await identify(link, servo)
    await _make_talkative(link, servo)
    record.error_bits = await link.read(servo, ct.HARDWARE_ERROR_STATUS)
    if record.error_bits:  # answers carry no address, and a late one to an earlier question may pass for this
        await asyncio.sleep(DRAIN_S)
        record.error_bits = await link.read(servo, ct.HARDWARE_ERROR_STATUS)
    record.torque = await link.read(servo, ct.TORQUE_ENABLE) == 1
    if record.error_bits:
        raise DeviceFault(servo, record.error_bits, "hardware error; it needs a reboot")
    await _settle(link, servo, ct.OPERATING_MODE, OperatingMode.EXTENDED_POSITION, torque=record.torque)
    await _settle(link, servo, ct.DRIVE_MODE, 0, torque=record.torque)
    if not record.torque:
        await _settle(link, servo, ct.RETURN_DELAY, 0, torque=False)
    return_delay = await link.read(servo, ct.RETURN_DELAY)
    link.expect_return_delay(servo, return_delay)
    fresh = await link.read(servo, ct.PROFILE_VELOCITY) == 0
    watchdog = await link.read(servo, ct.BUS_WATCHDOG)
    if watchdog == ct.WATCHDOG_TRIPPED:
        await link.write(servo, ct.BUS_WATCHDOG, 0)
    if watchdog == ct.WATCHDOG_TRIPPED or not record.torque:
        await stay(link, record)
    if settings.goal_pwm is not None:
        most = await link.read(servo, ct.PWM_LIMIT)
        await link.write(servo, ct.GOAL_PWM, min(settings.goal_pwm, most))
    await link.write(servo, ct.PROFILE_ACCELERATION, settings.profile_acceleration)
    await link.write(servo, ct.PROFILE_VELOCITY, settings.profile_velocity)
    await link.write(servo, ct.BUS_WATCHDOG, settings.watchdog)
    shutdown = await link.read(servo, ct.SHUTDOWN)
    record.tripped = False
    record.firmware = firmware
    record.missed = 0
    return ServoInfo(servo, model, firmware, return_delay, shutdown, fresh)


async def stay(link: ServoLink, record: ServoRecord) -> None:
    """Make the present position the goal, so that torque coming on moves nothing.

    Raises:
        DeviceFault: the servo is silent, or refuses.
    """
    position = await link.read(record.id, ct.PRESENT_POSITION)
    await link.write(record.id, ct.GOAL_POSITION, position)
    record.goal = position


async def _make_talkative(link: ServoLink, servo: int) -> None:
    """Have the servo acknowledge writes, which everything else relies on."""
    if await link.read(servo, ct.STATUS_RETURN_LEVEL) != ct.STATUS_RETURN_LEVEL.initial:
        level = ct.STATUS_RETURN_LEVEL
        await link.tell(dxl.write(servo, level.address, level.encode(level.initial)))


async def _settle(link: ServoLink, servo: int, register: ct.Register, value: int, *, torque: bool) -> None:
    present = await link.read(servo, register)
    if present == value:
        return
    if torque:
        raise DeviceFault(servo, 0, f"{register.name} is {present}, not {value}, and its torque is on")
    await link.write(servo, register, value)
