"""Turns: which of its many turns a servo's horn is in, who knows it, and how it is found again.

An XL430 knows its horn's angle within one turn always, and counts turns only while it has power. Its LED says
whether the count can be believed: the driver lights it when it does, and no power-up ever does.
"""

from arm_companion.drivers.servo_health import ServoRecord
from arm_companion.drivers.servo_link import ServoLink
from arm_companion.drivers.servo_setup import stay
from arm_companion.errors import DeviceFault
from arm_companion.protocol import control_table as ct

_TURN = ct.TICKS_PER_TURN


def nearest_turn(position: int, near: int) -> int:
    """The position at the same angle of the horn, whole turns aside, that is nearest to `near`; ticks."""
    return position + _TURN * round((near - position) / _TURN)


def let_out(record: ServoRecord, zero: int, direction: int, window: int) -> int | None:
    """Where a servo that lost its turns has kept its tendon let out all along.

    The outer tendon of a wrap is let out by more than a turn. When its servo has no power meanwhile, nothing takes that
    in, and it hangs slack beside the straight arm: its horn is at the angle at which it stood. A horn that had its
    tendon taken in was turned back by the arm as that straightened.

    Args:
        record: of the servo.
        zero: ticks.
        direction: +1 where growing positions take in, else -1.
        window: ticks, whole turns aside, within which it must still stand where it stood.

    Returns:
        Where it stood, ticks; None: it is to be expected near its zero.
    """
    if record.feedback is None or record.stood is None or direction * (record.stood - zero) >= 0:
        return None
    moved = nearest_turn(record.feedback.position, record.stood) - record.stood
    return record.stood if abs(moved) <= window else None


async def adopt(link: ServoLink, record: ServoRecord, zero: int, window: int) -> None:
    """Decide at the first meeting whether a servo's count of turns can be believed, and mark those that can.

    It can where someone vouched for it before (LED), and where the torque is on, which no servo has after a loss
    of power. Otherwise the arm is taken to hang straight, each tendon near its zero: a servo within `window` of
    it is homed there, and another has lost its turns.

    Args:
        link: the bus.
        record: of the servo, just set up.
        zero: ticks.
        window: ticks, whole turns aside; -1: nothing is taken for granted.

    Raises:
        DeviceFault: it is silent, or refuses.
    """
    if await link.read(record.id, ct.LED):
        record.turns_lost = False
        record.vouched = True  # whoever lit it: a jump must put it out
        return
    if record.torque:
        await _believe(link, record)
        return
    position = await link.read(record.id, ct.PRESENT_POSITION)
    if abs(nearest_turn(position, zero) - zero) <= window:
        await home(link, record, zero)
    else:
        record.turns_lost = True


async def home(link: ServoLink, record: ServoRecord, near: int) -> None:
    """Believe a servo again, whose horn is known to be within half a turn of `near`.

    Whole turns go into its homing offset, so that it reports the right position also to the next program. Its
    goal becomes where it is; the torque stays off.

    Args:
        link: the bus.
        record: of the servo.
        near: ticks.

    Raises:
        DeviceFault: it is silent, refuses, or its torque is on.
    """
    servo = record.id
    if await link.read(servo, ct.TORQUE_ENABLE):
        raise DeviceFault(servo, 0, "cannot be homed: its torque is on")
    position = await link.read(servo, ct.PRESENT_POSITION)
    wanted = nearest_turn(position, near)
    if wanted != position:
        offset = await link.read(servo, ct.HOMING_OFFSET) + wanted - position
        if not ct.HOMING_OFFSET.lower <= offset <= ct.HOMING_OFFSET.upper:
            raise DeviceFault(servo, 0, f"cannot be homed: a homing offset of {offset} is out of its range")
        await link.write(servo, ct.HOMING_OFFSET, offset)
        position = await link.read(servo, ct.PRESENT_POSITION)
        if abs(position - near) > _TURN // 2 + _TURN // 16:  # it may have been turned a little meanwhile
            raise DeviceFault(servo, 0, f"cannot be homed: it reports {position} where {near} was expected")
    await stay(link, record)
    record.rebase(position)
    await _believe(link, record)


async def doubt(link: ServoLink, record: ServoRecord) -> None:
    """Put the light of a servo out whose turns are lost, so that the next program does not believe it either.

    Raises:
        DeviceFault: it is silent, or refuses.
    """
    await link.write(record.id, ct.LED, 0)
    record.vouched = False


async def _believe(link: ServoLink, record: ServoRecord) -> None:
    await link.write(record.id, ct.LED, 1)
    record.turns_lost = False
    record.vouched = True
