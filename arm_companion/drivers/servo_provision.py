"""Giving a new servo its id, its speed, its mode and its limits, and seeing that it has them.

What is to be done follows from what the servo says of itself, so that an interrupted set-up goes on where it
stopped. Id and speed are written last: until then the servo is found where it was.
"""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_link import DRAIN_S, ServoLink
from arm_companion.drivers.servo_scan import FoundServo, OpenAt, link_at, ping
from arm_companion.errors import CommandRejected, ConfigError, DeviceFault
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.control_table import HardwareError, OperatingMode, Register

_NO_SECOND_ID = 255
_SHUTDOWN = HardwareError.OVERLOAD | HardwareError.ELECTRICAL_SHOCK | HardwareError.OVERHEATING
_TENTHS = 1 / ct.VOLTAGE_UNIT_V


@dataclass(frozen=True, slots=True)
class Step:
    """One register to be written, and why."""

    register: Register
    present: int
    wanted: int
    why: str


@dataclass(frozen=True, slots=True)
class Plan:
    """All that turns a servo as found into one of the arm's.

    Attributes:
        found: the servo.
        id: that it will have.
        baud: at which it will listen, bit/s.
        steps: registers in the order of writing, id and speed last.
    """

    found: FoundServo
    id: int
    baud: int
    steps: tuple[Step, ...]


def wanted_registers(config: ServosConfig) -> tuple[tuple[Register, int, str], ...]:
    """EEPROM of every servo of the arm, besides id and speed: register, value, reason."""
    return (
        (ct.RETURN_DELAY, 0, "answers begin at once, which keeps the cycle short"),
        (ct.DRIVE_MODE, 0, "normal direction; servos.directions turns tendons round"),
        (ct.OPERATING_MODE, int(OperatingMode.EXTENDED_POSITION), "positions over many turns of the pulley"),
        (ct.SECONDARY_ID, _NO_SECOND_ID, "it obeys its own id alone"),
        (ct.STARTUP_CONFIGURATION, 0, "the torque stays off at power-up"),
        (ct.TEMPERATURE_LIMIT, config.temperature_limit_c, "degC, servos.temperature_limit_c"),
        (ct.MAX_VOLTAGE_LIMIT, round(config.voltage_max_v * _TENTHS), "0.1 V, servos.voltage_max_v"),
        (ct.MIN_VOLTAGE_LIMIT, round(config.voltage_min_v * _TENTHS), "0.1 V, servos.voltage_min_v"),
        (ct.PWM_LIMIT, round(config.pwm_limit * ct.PWM_FULL), "of 885, servos.pwm_limit"),
        (ct.VELOCITY_LIMIT, ct.VELOCITY_LIMIT.initial, "as from the factory"),
        (ct.SHUTDOWN, int(_SHUTDOWN), "overload, electrical shock and overheating drop the torque"),
    )


def baud_code(baud: int) -> int:
    """The servo's number for a speed.

    Raises:
        ConfigError: it has none.
    """
    for code, rate in ct.BAUD_CODES.items():
        if rate == baud:
            return code
    raise ConfigError(f"servos.baud = {baud} is no speed of an XL430: {', '.join(map(str, ct.BAUD_CODES.values()))}")


def choose(found: Sequence[FoundServo], config: ServosConfig, wanted_id: int | None = None) -> tuple[FoundServo, int]:
    """The one servo that is to be set up, and the id that it will have.

    That is the only servo that is not yet where one of the arm's belongs; if there is none, the one that already
    has the wanted id, whose registers are then seen to.

    Args:
        found: all servos on the bus, at all speeds.
        config: of the arm.
        wanted_id: one of `config.ids`; None takes the first that nobody has.

    Raises:
        CommandRejected: it is not clear which servo is meant, two have one id, or the id is taken.
    """
    for servo in found:
        if servo.crowded:
            raise CommandRejected(
                f"answers of id {servo.id} at {servo.baud} bit/s are damaged: two servos with one id? "
                "Connect one of them alone"
            )
    placed = {s.id: s for s in found if s.baud == config.baud and s.id in config.ids}
    new = [s for s in found if s not in placed.values()]
    if wanted_id is None:
        missing = [servo for servo in config.ids if servo not in placed]
        if not missing:
            raise CommandRejected("all of the arm's servos answer: name the one to be looked after with --id")
        wanted_id = missing[0]
    if len(new) > 1:
        others = ", ".join(f"id {s.id} at {s.baud} bit/s" for s in new)
        raise CommandRejected(f"several servos are new ({others}): connect one new servo at a time")
    if new and wanted_id in placed:
        raise CommandRejected(
            f"id {wanted_id} is taken already; the new servo answers as id {new[0].id} at {new[0].baud} bit/s"
        )
    if not new and wanted_id not in placed:
        raise CommandRejected(f"no new servo answers that could become id {wanted_id}: see wiring and power")
    return (new[0] if new else placed[wanted_id]), wanted_id


async def make_plan(open_at: OpenAt, found: FoundServo, servo_id: int, config: ServosConfig) -> Plan:
    """Read the servo and list what must change.

    Raises:
        ConfigError: the configured speed is none of the servo's.
        CommandRejected: it holds torque, or is no servo that can be used.
        DeviceFault: it is silent.
        LinkError: the port cannot be opened.
    """
    if found.model != ct.MODEL_NUMBER_XL430_W250:
        raise CommandRejected(f"servo {found.id} is {found.kind}, not an XL430-W250")
    if found.firmware < ct.FIRST_FIRMWARE_WITH_WATCHDOG:
        raise CommandRejected(f"servo {found.id} has firmware {found.firmware} without bus watchdog: update it first")
    ends = (
        (ct.ID, servo_id, "its place among the arm's servos"),
        (ct.BAUD_RATE, baud_code(config.baud), f"{config.baud} bit/s, servos.baud"),
    )
    async with link_at(open_at, found.baud) as link:
        if await link.read(found.id, ct.TORQUE_ENABLE):
            raise CommandRejected(f"the torque of servo {found.id} is on: it may hold something; switch it off first")
        steps = []
        for register, wanted, why in (*wanted_registers(config), *ends):
            present = await link.read(found.id, register)
            if present != wanted:
                steps.append(Step(register, present, wanted, why))
    return Plan(found, servo_id, config.baud, tuple(steps))


async def carry_out(
    open_at: OpenAt, plan: Plan, config: ServosConfig, report: Callable[[str], None] = lambda _: None
) -> None:
    """Write what the plan says, each register read back, and at the end all of them again.

    Raises:
        DeviceFault: the servo falls silent, refuses, does not keep a value, or the new id answers already. What
            was written stays; a new scan and plan go on from there.
        LinkError: the port cannot be opened.
    """
    found = plan.found
    async with link_at(open_at, found.baud) as link:
        if await link.read(found.id, ct.TORQUE_ENABLE):
            raise DeviceFault(found.id, 0, "its torque has come on meanwhile")
        for step in plan.steps:
            if step.register in (ct.ID, ct.BAUD_RATE):
                continue
            await link.write(found.id, step.register, step.wanted)
            await _see(link, found.id, step.register, step.wanted)
            report(f"{step.register.name} = {step.wanted}")
        if plan.id != found.id:
            await _rename(link, found.id, plan.id)
            report(f"id = {plan.id}")
        if plan.baud != found.baud:
            await _tell(link, plan.id, ct.BAUD_RATE, baud_code(plan.baud))
            report(f"baud rate = {plan.baud} bit/s")
    async with link_at(open_at, plan.baud) as link:
        if await ping(link, plan.id, tries=4) is None:
            raise DeviceFault(plan.id, 0, f"does not answer at {plan.baud} bit/s, its new speed; scan again")
        for register, wanted, _ in wanted_registers(config):
            await _see(link, plan.id, register, wanted)
    report(f"servo {plan.id} answers at {plan.baud} bit/s, and all of its registers read back right")


async def _rename(link: ServoLink, old: int, new: int) -> None:
    if await ping(link, new) is not None:
        raise DeviceFault(new, 0, "another servo has this id already")
    await _tell(link, old, ct.ID, new)
    if await ping(link, new, tries=4) is None:
        raise DeviceFault(new, 0, "does not answer to its new id; scan again")
    if await ping(link, old) is not None:
        raise DeviceFault(old, 0, "a servo still answers to the old id: there are two")


async def _tell(link: ServoLink, servo: int, register: Register, value: int) -> None:
    """Write what changes where the answer would come from; firmware differs in whether one comes."""
    await link.tell(dxl.write(servo, register.address, register.encode(value)))
    await asyncio.sleep(DRAIN_S)


async def _see(link: ServoLink, servo: int, register: Register, wanted: int) -> None:
    value = await link.read(servo, register)
    if value != wanted:
        raise DeviceFault(servo, 0, f"{register.name} reads back as {value}, not {wanted}")


def describe(steps: Iterable[Step]) -> list[str]:
    """The steps as a table for people."""
    return [f"  {step.register.name:<22}{step.present:>7} -> {step.wanted:<8}{step.why}" for step in steps]
