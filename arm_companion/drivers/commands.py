"""Commands of the dialect and their standard relatives: from COMMAND_LONG and COMMAND_INT to checked orders."""

import math
from dataclasses import dataclass
from typing import Final

from arm_companion.config.schema import LimitsConfig, MavlinkConfig
from arm_companion.drivers.access import Sender
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
    sender: Sender

    @property
    def system(self) -> int:
        """System id of the sender."""
        return self.sender.system

    @property
    def component(self) -> int:
        """Component id of the sender."""
        return self.sender.component


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
_REACH_KIND: Final = Parameter(1, "kind", 0, 1, whole=True)
_POINT: Final = tuple(Parameter(i, axis, -10_000.0, 10_000.0) for i, axis in ((2, "north"), (3, "east"), (4, "down")))
_TIP: Final = tuple(Parameter(i, axis, -10.0, 10.0) for i, axis in ((2, "x"), (3, "y"), (4, "z")))

_NAMES: Final = {
    mav.MAV_CMD_ARM_READY: "READY",
    mav.MAV_CMD_ARM_STOW: "STOW",
    mav.MAV_CMD_ARM_PERCH: "PERCH",
    mav.MAV_CMD_ARM_GRASP: "GRASP",
    mav.MAV_CMD_ARM_RELEASE: "RELEASE",
    mav.MAV_CMD_ARM_ABORT: "ABORT",
    mav.MAV_CMD_ARM_JOG: "JOG",
    mav.MAV_CMD_ARM_REACH: "REACH",
    mav.MAV_CMD_ARM_CALIBRATE: "CALIBRATE",
    mav.MAV_CMD_ARM_CLEAR_ERRORS: "CLEAR_ERRORS",
    mav.MAV_CMD_ARM_FEEDFORWARD: "FEEDFORWARD",
    mav.MAV_CMD_ARM_CONTROL: "CONTROL",
    mav.MAV_CMD_DO_GRIPPER: "DO_GRIPPER",
    mav.MAV_CMD_DO_SET_ACTUATOR: "DO_SET_ACTUATOR",
    mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: "PREFLIGHT_REBOOT_SHUTDOWN",
}

URGENT: Final = frozenset({Order.STOW, Order.ABORT})
"""Ways to safety: taken whatever else waits, and whatever their unused parameters hold."""


_OURS: Final = range(64_000, 64_100)
_CONTROL: Final = Parameter(1, "action", 0, 2, whole=True)
_ENABLE: Final = Parameter(1, "enable", 0, 1, whole=True)
_GRIPPER_ACTION: Final = Parameter(2, "action", 0, 1, whole=True)
_ACTUATOR_SET: Final = Parameter(7, "index", 0, 0, whole=True)


def is_ours(command: int) -> bool:
    """Whether the command is one of this dialect, and so nobody else's."""
    return command in _NAMES and command in _OURS


def name_of(command: int) -> str:
    """Short name for people."""
    return _NAMES.get(command, f"command {command}")


def order_of(command: int) -> Order | None:
    """The order that a command of the dialect stands for; None for one that this version cannot carry out."""
    return Order.__members__.get(_NAMES.get(command, "")) if is_ours(command) else None


def read_command(message: Message, sender: Sender) -> Command:
    """The content of a COMMAND_LONG or COMMAND_INT."""
    if message.get_msgId() == mav.MAVLINK_MSG_ID_COMMAND_LONG:
        last = (message.param5, message.param6, message.param7)
        confirmation = message.confirmation
    else:
        last = (float(message.x), float(message.y), message.z)
        confirmation = 0
    parameters = (message.param1, message.param2, message.param3, message.param4, *last)
    return Command(message.command, parameters, confirmation, sender)


def read_parameters(order: Order, command: Command) -> tuple[float, ...]:
    """The parameters that the order uses, checked; what it does not use is not looked at.

    Raises:
        CommandRejected: with the reason in words.
    """
    match order.name:
        case "PERCH":
            return (_PERCH_KIND.read(command),)
        case "JOG":
            kind = _JOG_KIND.read(command)
            if kind == JOG_BEND:
                return (kind, *(p.read(command) for p in _BEND))
            return (kind, *(p.read(command) for p in (_OFFSET if kind == JOG_VEHICLE else _TIP)))
        case "REACH":
            return (_REACH_KIND.read(command), *(p.read(command) for p in _POINT))
        case "CALIBRATE":
            return _calibration(command)
        case "FEEDFORWARD":
            return (_ENABLE.read(command),)
    return ()


def _calibration(command: Command) -> tuple[float, ...]:
    step, sure = command.parameters[:2]
    if step != mav.ARM_CALIBRATION_STEP_TENDONS:
        raise CommandRejected(f"param1 = {step:g}: 1, the tendons' zeros, is all there is")
    if sure != 1.0:
        raise CommandRejected(f"param2 = {sure:g}: 1 confirms that nothing touches the arm")
    return step, sure


def read_control(command: Command) -> int:
    """What MAV_CMD_ARM_CONTROL asks for, ARM_CONTROL.

    Raises:
        CommandRejected: the parameter is none.
    """
    return int(_CONTROL.read(command))


class Translation:
    """Standard commands that mean one of our orders.

    Args:
        mavlink: what a gripper's grab means, and which actuator bends the arm.
        limits: the bend that an actuator's 1.0 means.
        component_id: ours, which is also the number of our gripper.
    """

    def __init__(self, mavlink: MavlinkConfig, limits: LimitsConfig, component_id: int) -> None:
        self.limits = limits
        self._grab = mavlink.grab.upper()
        self._actuator = mavlink.actuator
        self._component_id = component_id

    def knows(self, command: int) -> bool:
        """Whether a MAV_CMD may stand for an order at all."""
        return is_ours(command) or command in (mav.MAV_CMD_DO_GRIPPER, mav.MAV_CMD_DO_SET_ACTUATOR)

    def names_us(self, command: Command) -> bool:
        """Whether a command to everybody of our system is ours: nobody else knows it, or it names our gripper.

        PX4 sends the DO_GRIPPER and DO_SET_ACTUATOR of its mission to component 0.
        """
        match command.command:
            case mav.MAV_CMD_DO_GRIPPER:
                return command.parameters[0] == self._component_id
            case mav.MAV_CMD_DO_SET_ACTUATOR:
                return bool(self._actuator) and math.isfinite(command.parameters[self._actuator - 1])
        return is_ours(command.command)

    def order(self, command: Command) -> tuple[Order, tuple[float, ...]] | None:
        """The order with its parameters, checked; None when this version has no such order.

        Raises:
            CommandRejected: with the reason in words.
        """
        match command.command:
            case mav.MAV_CMD_DO_GRIPPER:
                return self._gripper(command)
            case mav.MAV_CMD_DO_SET_ACTUATOR:
                return self._set_actuator(command)
        order = order_of(command.command)
        return None if order is None else (order, read_parameters(order, command))

    def _gripper(self, command: Command) -> tuple[Order, tuple[float, ...]] | None:
        number = command.parameters[0]
        if number not in (0.0, self._component_id):
            raise CommandRejected(f"param1 = {number:g} is another gripper; this one is {self._component_id}")
        if _GRIPPER_ACTION.read(command) == mav.GRIPPER_ACTION_RELEASE:
            return Order.RELEASE, ()
        order = Order.__members__.get(self._grab)
        if order is None:
            return None
        return order, (float(ANCHOR),) if order is Order.PERCH else ()

    def _set_actuator(self, command: Command) -> tuple[Order, tuple[float, ...]] | None:
        if not self._actuator:
            return None
        _ACTUATOR_SET.read(command)
        value = Parameter(self._actuator, "actuator", -1.0, 1.0).read(command)
        return Order.JOG, (float(JOG_BEND), value * self.limits.bend_max_rad, 0.0)
