"""The gripper at the tip, whoever moves it: what the mission sees of it, and how it is told."""

from collections.abc import Sequence
from typing import Protocol

from arm_companion.config.schema import Config
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.autopilot_gripper import AutopilotGripper
from arm_companion.drivers.gripper_servo import GripperServo
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.servo_health import ServoState
from arm_companion.mission.gripper_facts import GripperOrder, GripperState


class Gripper(Protocol):
    """What the daemon's cycle does with a gripper."""

    def state(self, servos: Sequence[ServoState], now: float) -> GripperState | None:
        """What is known of it, with the states of all servos on the bus; None: the arm has none."""

    def goals(self, order: GripperOrder | None, now: float) -> tuple[int | None, ...]:
        """Tell it where its jaws are to be, None: as they are; called once a cycle.

        Returns:
            Goals, ticks, of the servos behind the tendons'; None keeps the last.
        """


class NoGripper:
    """An arm without one."""

    def state(self, _servos: Sequence[ServoState], _now: float) -> None:
        """Nothing is known of it."""

    def goals(self, _order: GripperOrder | None, _now: float) -> tuple[int | None, ...]:
        """No servo is behind the tendons'."""
        return ()


def gripper_of(config: Config, link: MavlinkLink, autopilot: Autopilot) -> Gripper:
    """The configured gripper.

    Args:
        config: whose gripper it is.
        link: to the autopilot.
        autopilot: who moves the jaws, if no servo does.
    """
    match config.gripper_by:
        case "servo":
            return GripperServo(config.gripper)
        case "autopilot":
            return AutopilotGripper(config.gripper, link, autopilot)
    return NoGripper()
