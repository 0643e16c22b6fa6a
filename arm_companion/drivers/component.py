"""Our MAVLink component: its heartbeat and identity, and whatever is addressed to it."""

import enum
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from arm_companion.clock import Clock, ticks
from arm_companion.config.schema import VehicleConfig
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.commands import is_ours, read_command
from arm_companion.drivers.flight_stack import AutopilotFinder
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.status_text import Speaker
from arm_companion.drivers.targets import read_bar
from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Answer, Bar, Notice, Request, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

HEARTBEAT: Final = mav.MAVLINK_MSG_ID_HEARTBEAT
HEARTBEAT_PERIOD_S: Final = 1.0

_COMPLAINT_PERIOD_S: Final = 2.0


class SystemStatus(enum.IntEnum):
    """MAV_STATE, as our heartbeat tells it."""

    BOOT = mav.MAV_STATE_BOOT
    CALIBRATING = mav.MAV_STATE_CALIBRATING
    STANDBY = mav.MAV_STATE_STANDBY
    ACTIVE = mav.MAV_STATE_ACTIVE
    CRITICAL = mav.MAV_STATE_CRITICAL
    EMERGENCY = mav.MAV_STATE_EMERGENCY
    POWEROFF = mav.MAV_STATE_POWEROFF


@dataclass(slots=True)
class ComponentCounters:
    """What came in since the start, besides commands."""

    not_for_us: int = 0  # addressed to another system or component
    bad_targets: int = 0  # ARM_TARGETs that cannot be used, or may not be set by their sender


class Component:
    """The face of this daemon to everybody on MAVLink.

    Args:
        links: all links; those with role "autopilot" tell the system id.
        vehicle: our ids and who may command.
        clock: the loop's time.
    """

    def __init__(self, links: Sequence[MavlinkLink], vehicle: VehicleConfig, clock: Clock) -> None:
        self.counters = ComponentCounters()
        self.status = SystemStatus.BOOT
        """What the heartbeat says of us."""
        self._links = links
        self._clock = clock
        self._speaker = Speaker(links)
        self.commands = CommandService(vehicle, self._speaker, clock)
        self._finder = AutopilotFinder(vehicle)
        self._follow_autopilot = not vehicle.system_id
        self._bar: Bar | None = None
        self._complained = float("-inf")
        for link in links:
            link.streams.offer(HEARTBEAT, 1.0 / HEARTBEAT_PERIOD_S, fixed=True)
            link.subscribe_open(self._beat)
            link.subscribe(self._on_command, (mav.MAVLINK_MSG_ID_COMMAND_LONG, mav.MAVLINK_MSG_ID_COMMAND_INT))
            link.subscribe(self._on_target, (mav.MAVLINK_MSG_ID_ARM_TARGET,))
            link.subscribe(self._on_ping, (mav.MAVLINK_MSG_ID_PING,))
            if link.role == "autopilot":
                link.subscribe(self._on_heartbeat, (HEARTBEAT,))

    @property
    def active(self) -> bool:
        """Whether a behaviour is under way that moves the vehicle."""
        return self.status is SystemStatus.ACTIVE

    @active.setter
    def active(self, value: bool) -> None:
        self.status = SystemStatus.ACTIVE if value else SystemStatus.STANDBY

    def take(self) -> tuple[list[Request], Bar | None]:
        """What has come since the last call: requests in order, and the newest target."""
        bar, self._bar = self._bar, None
        return self.commands.take(), bar

    def answer(self, answer: Answer) -> None:
        """Tell whoever asked. Progress may be told often; the first other result ends the request."""
        self.commands.answer(answer)

    def notify(self, notice: Notice) -> None:
        """Tell everybody."""
        self._speaker.say(notice)

    async def run(self) -> None:
        """Send heartbeats, the first at once, until cancelled."""
        async for _ in ticks(HEARTBEAT_PERIOD_S):
            for link in self._links:
                self._beat(link)

    # --- identity ---

    def _beat(self, link: MavlinkLink) -> None:
        link.send(
            mav.MAVLink_heartbeat_message(
                mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, int(self.status), 3
            )
        )

    def _on_heartbeat(self, message: Message, _: MavlinkLink) -> None:
        before = self._finder.system_id
        if not self._follow_autopilot or not self._finder.heard(message, self._clock.now()):
            return
        system = self._finder.system_id
        if system == before:
            return
        log.info("our system id is %d, as the autopilot's", system)
        for link in self._links:
            link.system_id = system
            # Until our first heartbeat the autopilot takes messages that are meant for us as its own.
            self._beat(link)

    # --- what is addressed to us ---

    def _is_self(self, message: Message, link: MavlinkLink) -> bool:
        return bool(message.get_srcSystem() == link.system_id and message.get_srcComponent() == link.component_id)

    def _for_us(self, message: Message, link: MavlinkLink, *, only_ours_know: bool) -> bool:
        """Whether a message with an address is for us; component 0 is everybody.

        What everybody may take is taken only if nobody else knows it.
        """
        everybody = message.target_component == 0 and only_ours_know
        ours = everybody or message.target_component == link.component_id
        if message.target_system == link.system_id and ours and not self._is_self(message, link):
            return True
        self.counters.not_for_us += 1
        return False

    def _on_command(self, message: Message, link: MavlinkLink) -> None:
        if not self._for_us(message, link, only_ours_know=is_ours(message.command)):
            return
        self.commands.handle(read_command(message), link)
        if link.streams.take_asked(HEARTBEAT):
            self._beat(link)

    def _on_target(self, message: Message, link: MavlinkLink) -> None:
        if not self._for_us(message, link, only_ours_know=True):
            return
        try:
            self._bar = self._read_target(message)
        except CommandRejected as rejected:
            self.counters.bad_targets += 1
            now = self._clock.now()
            if now - self._complained >= _COMPLAINT_PERIOD_S:  # targets stream: one word is enough
                self._complained = now
                self._speaker.say(Notice(Severity.WARNING, f"target refused: {rejected.reason}"), link)

    def _read_target(self, message: Message) -> Bar:
        if not self.commands.may_command(message.get_srcSystem()):
            raise CommandRejected(f"system {message.get_srcSystem()} may not command the arm")
        return read_bar(message)

    def _on_ping(self, message: Message, link: MavlinkLink) -> None:
        """A ping to nobody in particular is a question; one with an address is somebody's answer."""
        if message.target_system == 0 and message.target_component == 0 and not self._is_self(message, link):
            link.send(
                mav.MAVLink_ping_message(
                    message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                )
            )
