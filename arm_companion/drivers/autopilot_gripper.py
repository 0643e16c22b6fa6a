"""A gripper on the autopilot's output, told by MAV_CMD_DO_GRIPPER.

All that comes back is the autopilot's acknowledgement, from a timer or with nothing moving at all. The command goes to
the autopilot's own component and to nobody else: to everybody it could come back to us as an order (`commands`).
"""

import asyncio
import logging
from collections.abc import Sequence
from typing import Final

from arm_companion.config.schema import GripperConfig
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.flight_stack import AUTOPILOT_COMPONENT
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.servo_health import ServoState
from arm_companion.mission.gripper_facts import (
    GripperAction,
    GripperAnswer,
    GripperFate,
    GripperOrder,
    GripperState,
)
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

RESEND_S: Final = 0.5
TRIES: Final = 5
_ACTIONS: Final = {
    GripperAction.OPEN: mav.GRIPPER_ACTION_RELEASE,
    GripperAction.CLOSE: mav.GRIPPER_ACTION_GRAB,
}
_WORDS: Final = {
    mav.MAV_RESULT_TEMPORARILY_REJECTED: "temporarily rejected",
    mav.MAV_RESULT_DENIED: "denied",
    mav.MAV_RESULT_UNSUPPORTED: "unsupported: has it a gripper that is switched on?",
    mav.MAV_RESULT_FAILED: "failed",
    mav.MAV_RESULT_CANCELLED: "cancelled",
}


class AutopilotGripper:
    """Tells the autopilot, until it has answered.

    Args:
        config: which of its grippers.
        link: connection to it.
        autopilot: who it is.
    """

    def __init__(self, config: GripperConfig, link: MavlinkLink, autopilot: Autopilot) -> None:
        self._config = config
        self._link = link
        self._autopilot = autopilot
        self._order: GripperOrder | None = None
        self._fate = GripperFate.PENDING
        self._reason = ""
        self._since = 0.0  # loop time from which the fate is known
        self._tries = 0
        self._sent_at = float("-inf")
        link.subscribe(self._on_ack, (mav.MAVLINK_MSG_ID_COMMAND_ACK,))

    def state(self, _servos: Sequence[ServoState], now: float) -> GripperState:
        """What the autopilot says of the newest order."""
        if self._order is None:
            return GripperState()
        return GripperState(answer=GripperAnswer(self._order.at, self._fate, now - self._since, self._reason))

    def goals(self, order: GripperOrder | None, now: float) -> tuple[int | None, ...]:
        """Send the command of a new order, and send it again while nobody answers; no servo is behind the tendons'."""
        if order is not None and order != self._order:
            self._order = order
            self._tries, self._sent_at = 0, float("-inf")
            self._settle(GripperFate.PENDING, now)
        if self._order is not None and self._fate is GripperFate.PENDING and now - self._sent_at >= RESEND_S:
            if self._tries < TRIES:
                self._send(self._order, now)
            else:
                self._settle(GripperFate.REFUSED, now, "the autopilot does not answer DO_GRIPPER")
        return ()

    def _send(self, order: GripperOrder, now: float) -> None:
        self._sent_at = now
        if not self._autopilot.heard:  # nobody to tell yet, which counts as no answer
            self._tries += 1
            return
        message = mav.MAVLink_command_long_message(
            self._autopilot.system_id,
            AUTOPILOT_COMPONENT,
            mav.MAV_CMD_DO_GRIPPER,
            self._tries,
            float(self._config.instance),
            float(_ACTIONS[order.action]),
            0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
        self._tries += 1
        self._link.send(message)

    def _on_ack(self, ack: Message, _: MavlinkLink) -> None:
        """Take the autopilot's answer; one that is still carrying it out is heard again."""
        sender = (ack.get_srcSystem(), ack.get_srcComponent())
        ours = ack.target_system in (0, self._link.system_id) and ack.target_component in (0, self._link.component_id)
        if ack.command != mav.MAV_CMD_DO_GRIPPER or sender != (self._autopilot.system_id, AUTOPILOT_COMPONENT):
            return
        if not ours or not self._tries or self._fate is not GripperFate.PENDING:
            return
        now = asyncio.get_running_loop().time()
        if ack.result == mav.MAV_RESULT_IN_PROGRESS:
            self._sent_at = now
        elif ack.result == mav.MAV_RESULT_ACCEPTED:
            self._settle(GripperFate.TAKEN, now)
        else:
            word = _WORDS.get(ack.result, f"result {ack.result}")
            self._settle(GripperFate.REFUSED, now, f"the autopilot answers DO_GRIPPER: {word}")

    def _settle(self, fate: GripperFate, now: float, reason: str = "") -> None:
        self._fate, self._since, self._reason = fate, now, reason
        if reason:
            log.warning("gripper: %s", reason)
