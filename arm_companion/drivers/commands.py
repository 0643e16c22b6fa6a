"""Commands of the dialect: from COMMAND_LONG and COMMAND_INT to checked orders."""

import math
from dataclasses import dataclass
from typing import Final

from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Order
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message


@dataclass(frozen=True, slots=True)
class Command:
    """A command as it came in."""

    command: int  # MAV_CMD
    parameters: tuple[float, ...]  # the seven of COMMAND_LONG, unchecked
    confirmation: int  # 0 the first time; COMMAND_INT has none
    system: int  # of the sender
    component: int


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter that a command uses."""

    index: int  # 1 to 7
    label: str
    lower: float
    upper: float
    whole: bool = False

    def read(self, command: Command) -> float:
        """The checked value.

        Raises:
            CommandRejected: not finite, not whole where it must be, or out of range.
        """
        value = command.parameters[self.index - 1]
        name = f"param{self.index} ({self.label})"
        if not math.isfinite(value):
            raise CommandRejected(f"{name} is not a number")
        if not self.lower <= value <= self.upper:
            raise CommandRejected(f"{name} = {value:g} is outside {self.lower:g} to {self.upper:g}")
        if self.whole and value != round(value):
            raise CommandRejected(f"{name} = {value:g} is not a whole number")
        return value


ANCHOR: Final = mav.ARM_PERCH_KIND_ANCHOR
JOG_BEND: Final = mav.ARM_JOG_KIND_BEND
JOG_VEHICLE: Final = mav.ARM_JOG_KIND_VEHICLE

_PERCH_KIND: Final = Parameter(1, "kind", 0, 1, whole=True)
_JOG_KIND: Final = Parameter(1, "kind", 1, 3, whole=True)
_BEND: Final = (
    Parameter(2, "theta", -4.0 * math.pi, 4.0 * math.pi),
    Parameter(3, "delta", -2.0 * math.pi, 2.0 * math.pi),
)
_OFFSET: Final = tuple(Parameter(i, axis, -1.0, 1.0) for i, axis in ((2, "x"), (3, "y"), (4, "z")))

_NAMES: Final = {
    mav.MAV_CMD_ARM_READY: "READY",
    mav.MAV_CMD_ARM_STOW: "STOW",
    mav.MAV_CMD_ARM_PERCH: "PERCH",
    mav.MAV_CMD_ARM_GRASP: "GRASP",
    mav.MAV_CMD_ARM_RELEASE: "RELEASE",
    mav.MAV_CMD_ARM_ABORT: "ABORT",
    mav.MAV_CMD_ARM_JOG: "JOG",
    mav.MAV_CMD_ARM_CALIBRATE: "CALIBRATE",
    mav.MAV_CMD_ARM_CLEAR_ERRORS: "CLEAR_ERRORS",
    mav.MAV_CMD_ARM_FEEDFORWARD: "FEEDFORWARD",
}

URGENT: Final = frozenset({Order.STOW, Order.ABORT})
"""Ways to safety: taken whatever else waits, and whatever their unused parameters hold."""


def is_ours(command: int) -> bool:
    """Whether the command is one of this dialect, and so nobody else's."""
    return command in _NAMES


def name_of(command: int) -> str:
    """Short name for people."""
    return _NAMES.get(command, f"command {command}")


def order_of(command: int) -> Order | None:
    """The order that a command stands for; None for one that this version cannot carry out."""
    return Order.__members__.get(_NAMES.get(command, ""))


def read_command(message: Message) -> Command:
    """The content of a COMMAND_LONG or COMMAND_INT."""
    if message.get_msgId() == mav.MAVLINK_MSG_ID_COMMAND_LONG:
        last = (message.param5, message.param6, message.param7)
        confirmation = message.confirmation
    else:
        last = (float(message.x), float(message.y), message.z)
        confirmation = 0
    parameters = (message.param1, message.param2, message.param3, message.param4, *last)
    return Command(message.command, parameters, confirmation, message.get_srcSystem(), message.get_srcComponent())


def read_parameters(order: Order, command: Command) -> tuple[float, ...]:
    """The parameters that the order uses, checked; what it does not use is not looked at.

    Raises:
        CommandRejected: with the reason in words.
    """
    match order.name:
        case "PERCH":
            if (kind := _PERCH_KIND.read(command)) != ANCHOR:
                raise CommandRejected("only the anchor perch (param1 = 0) is available")
            return (kind,)
        case "JOG":
            kind = _JOG_KIND.read(command)
            if kind == JOG_BEND:
                return (kind, *(p.read(command) for p in _BEND))
            if kind == JOG_VEHICLE:
                return (kind, *(p.read(command) for p in _OFFSET))
            raise CommandRejected("jogging by tip position is not available")
    return ()
