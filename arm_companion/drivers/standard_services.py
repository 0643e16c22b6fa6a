"""Standard commands that our component answers at once: messages on demand, intervals, control, restart."""

import enum
import logging
import math
from collections.abc import Callable
from typing import Final

from arm_companion.drivers.access import Access
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.commands import Command, read_control
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.errors import CommandRejected
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

Maker = Callable[[float], Message | None]
"""Makes a message for whoever asks, of what REQUEST_MESSAGE's param2 names; None: there is none of it."""

_INTERVAL: Final = mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL


class Power(enum.Enum):
    """What PREFLIGHT_REBOOT_SHUTDOWN asks of this daemon."""

    RESTART = 1
    STOP = 2


class StandardServices:
    """Messages on demand, intervals, primary control, restart.

    Args:
        commands: where they come from.
        access: who may restart us or take control.
        component_id: ours.
        busy: why the daemon must not end now; None when it may.
        on_power: ends the daemon.
    """

    def __init__(
        self,
        commands: CommandService,
        access: Access,
        component_id: int,
        busy: Callable[[], str | None],
        on_power: Callable[[Power], None],
    ) -> None:
        self._commands = commands
        self._access = access
        self._component_id = component_id
        self._busy = busy
        self._on_power = on_power
        self._makers: dict[float, Maker] = {}
        commands.serve(mav.MAV_CMD_REQUEST_MESSAGE, self._request_message)
        commands.serve(mav.MAV_CMD_SET_MESSAGE_INTERVAL, self._set_interval)
        commands.serve(mav.MAV_CMD_GET_MESSAGE_INTERVAL, self._get_interval)
        commands.serve(mav.MAV_CMD_ARM_CONTROL, self._control)
        commands.serve(mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, self._power)

    def offer(self, id_: int, maker: Maker) -> None:
        """Send a message of this id to whoever requests it."""
        self._makers[id_] = maker

    def _request_message(self, command: Command, link: MavlinkLink) -> int:
        id_, about = command.parameters[:2]
        if id_ == _INTERVAL:
            return self._send_interval(about, link)
        if id_ in self._makers:
            if (message := self._makers[id_](about)) is None:
                return self._commands.reject_for_now(command, link, "there is nothing to tell yet")
            link.send(message)
        elif not link.streams.ask(id_):
            return int(mav.MAV_RESULT_UNSUPPORTED)
        return int(mav.MAV_RESULT_ACCEPTED)

    def _get_interval(self, command: Command, link: MavlinkLink) -> int:
        return self._send_interval(command.parameters[0], link)

    def _send_interval(self, about: float, link: MavlinkLink) -> int:
        if not (math.isfinite(about) and 0 <= about <= 0xFFFF):  # wide ids do not fit into the answer
            return int(mav.MAV_RESULT_UNSUPPORTED)
        link.send(mav.MAVLink_message_interval_message(int(about), link.streams.interval_us(about)))
        return int(mav.MAV_RESULT_ACCEPTED)

    def _set_interval(self, command: Command, link: MavlinkLink) -> int:
        """Anybody whose link trusts him may say what he wants to hear there."""
        if not command.sender.trusted:
            raise CommandRejected("the sender does not sign")
        id_, interval_us = command.parameters[:2]
        return int(mav.MAV_RESULT_ACCEPTED if link.streams.set_interval(id_, interval_us) else mav.MAV_RESULT_DENIED)

    def _control(self, command: Command, _: MavlinkLink) -> int:
        self._access.control(command.sender, read_control(command))
        return int(mav.MAV_RESULT_ACCEPTED)

    def _power(self, command: Command, link: MavlinkLink) -> int:
        self._access.require(command.sender)
        autopilot, computer, action, component = command.parameters[:4]
        if component not in (0.0, self._component_id):
            raise CommandRejected(f"param4 = {component:g} is another component")
        if autopilot or computer or action not in (Power.RESTART.value, Power.STOP.value):
            raise CommandRejected("only param3 = 1 (restart the daemon) and 2 (stop it) are carried out here")
        if (reason := self._busy()) is not None:
            return self._commands.reject_for_now(command, link, reason)
        power = Power(int(action))
        log.warning("asked to %s by %d/%d", power.name.lower(), command.system, command.component)
        self._on_power(power)
        return int(mav.MAV_RESULT_ACCEPTED)
