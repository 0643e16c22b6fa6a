"""What the mission knows of a gripper at the tip, and what it asks of it. Plain immutable values, to be recorded."""

import enum
from dataclasses import dataclass


class GripperAction(enum.Enum):
    """Which way the jaws go."""

    OPEN = "open"
    CLOSE = "close"


@dataclass(frozen=True)
class GripperOrder:
    """Where the jaws are to be from now on. A new order is another one even when it asks for the same."""

    action: GripperAction
    at: float  # loop time


@dataclass(frozen=True)
class JawState:
    """Jaws as their servo reports them; load and speed are positive when closing."""

    closed: float  # 0 open, 1 closed on nothing
    speed: float  # of `closed`, 1/s
    load: float  # share of full load
    temperature: float  # degC
    voltage: float  # V
    error_bits: int  # hardware-error bits of the servo
    silent: bool  # has not answered for several cycles
    torque: bool  # torque is on
    ready: bool  # it follows goals: set up, watchdog quiet, no fault
    homed: bool  # its turn is known


class GripperFate(enum.Enum):
    """What became of an order to the autopilot."""

    PENDING = "pending"
    TAKEN = "taken"
    REFUSED = "refused"


@dataclass(frozen=True)
class GripperAnswer:
    """What an autopilot that moves the jaws says of an order. It says nothing of the jaws themselves."""

    at: float  # loop time of the order that it is about
    fate: GripperFate
    since_s: float  # since this fate is known
    reason: str = ""  # of a refusal, in words


@dataclass(frozen=True)
class GripperState:
    """All that is known of the gripper in one cycle: by who moves it, one of the two is there."""

    jaws: JawState | None = None
    answer: GripperAnswer | None = None  # None with an autopilot: nothing has been asked yet


@dataclass(frozen=True)
class Grip:
    """What the mission remembers of the gripper.

    Attributes:
        order: where the jaws are to be; None: nobody has said, and they stay as they are.
        held_s: for how long closing jaws have stood short of closed, and pulled.
        touch_s: for how long something has been felt under the tip.
    """

    order: GripperOrder | None = None
    held_s: float = 0.0
    touch_s: float = 0.0


NO_GRIP = Grip()
"""Before anything is known."""
