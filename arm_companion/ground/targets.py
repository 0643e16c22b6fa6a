"""Where bar or object is, told until the arm shows that it has just that.

ARM_TARGET has no acknowledgement, and ARM_STATUS tells only that some target is known: an order after a target that got
lost would send the vehicle to the one before. So the arm is asked for what it has (REQUEST_MESSAGE).
"""

import contextlib
import math
from collections.abc import Awaitable, Callable
from typing import Final

from arm_companion.errors import ArmError
from arm_companion.ground.arm import Arm
from arm_companion.ground.channel import ArmSilent
from arm_companion.ground.commands import CommandFailed
from arm_companion.ground.reports import Vector
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

_TRIES: Final = 4
_REFUSED_S: Final = 0.5
_ANSWER_S: Final = 1.0
_ROUNDING: Final = 1e-6  # of 32 bits


async def tell_bar(arm: Arm, position: Vector, axis: Vector, radius: float) -> None:
    """Tell where the bar is, and see it taken; arguments as `Arm.target_bar`.

    Raises:
        ArmSilent: not heard, or no answer.
        ArmError: it is refused, or the arm does not show that it has it.
    """
    wanted = (*position, *axis, radius)
    await _tell(arm, "bar", mav.ARM_TARGET_KIND_BAR, lambda: arm.target_bar(position, axis, radius), wanted)


async def tell_object(arm: Arm, position: Vector, axis_rad: float, radius: float) -> None:
    """Tell where the object is, and see it taken; arguments as `Arm.target_object`.

    Raises:
        ArmSilent: not heard, or no answer.
        ArmError: it is refused, or the arm does not show that it has it.
    """
    wanted = (*position, math.cos(axis_rad / 2.0), 0.0, 0.0, math.sin(axis_rad / 2.0), radius)
    send = arm.target_object
    await _tell(arm, "object", mav.ARM_TARGET_KIND_OBJECT, lambda: send(position, axis_rad, radius), wanted)


async def _tell(arm: Arm, name: str, kind: int, send: Callable[[], Awaitable[None]], wanted: tuple[float, ...]) -> None:
    said = len(arm.texts)
    has = None

    def refusal() -> str:
        return next((t.text for t in list(arm.texts)[said:] if t.text.startswith("target refused")), "")

    for _ in range(_TRIES):
        await send()
        with contextlib.suppress(ArmSilent):  # a refusal comes at once
            await arm.channel.wait_for(lambda: bool(refusal()), _REFUSED_S, "")
        if refusal():
            raise ArmError(refusal())
        has = await _asked(arm, kind)
        if has is not None and all(map(_same, wanted, _numbers(has))):
            return
    other = "" if has is None else ": it has one at {:.2f} {:.2f} {:.2f}".format(*has.position)
    raise ArmError(f"the arm does not show that it has taken the {name}{other}")


async def _asked(arm: Arm, kind: int) -> Message | None:
    """The target that the arm has; None when it does not tell of one."""
    heard: list[Message] = []

    def take(message: Message) -> None:
        if message.get_type() == "ARM_TARGET" and message.kind == kind:
            heard.append(message)

    end = arm.channel.watch(take)
    try:
        await arm.order(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_ARM_TARGET, kind)
        with contextlib.suppress(ArmSilent):
            await arm.channel.wait_for(lambda: bool(heard), _ANSWER_S, "")
    except CommandFailed:  # it has none
        return None
    finally:
        end()
    return heard[-1] if heard else None


def _numbers(target: Message) -> tuple[float, ...]:
    direction = target.axis if target.kind == mav.ARM_TARGET_KIND_BAR else target.q
    return (*target.position, *direction, target.radius)


def _same(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
