"""Our MAVLink component: its heartbeat and identity, and whatever is addressed to it."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Final

from arm_companion.clock import Clock, ticks
from arm_companion.config.schema import LimitsConfig, MavlinkConfig, VehicleConfig
from arm_companion.drivers.access import Access, sender_of
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.commands import URGENT, Translation, is_ours, read_command
from arm_companion.drivers.component_metadata import GENERAL, metadata_files, uri
from arm_companion.drivers.flight_stack import AutopilotFinder
from arm_companion.drivers.ftp_server import FtpServer
from arm_companion.drivers.guidance import CLOCKS_APART_S, Guidance
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.drivers.parameter_service import IDS as PARAMETER_IDS
from arm_companion.drivers.parameter_service import ParameterService
from arm_companion.drivers.settings import Settings
from arm_companion.drivers.standard_services import Power, StandardServices
from arm_companion.drivers.status_text import Speaker
from arm_companion.drivers.system_status import SystemStatus
from arm_companion.drivers.timesync import addressee
from arm_companion.mission.facts import Answer, Bar, Notice, Request, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.ftp import crc32
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

HEARTBEAT: Final = mav.MAVLINK_MSG_ID_HEARTBEAT
HEARTBEAT_PERIOD_S: Final = 1.0

CAPABILITIES: Final = (
    mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mav.MAV_PROTOCOL_CAPABILITY_FTP
)


@dataclass(slots=True)
class ComponentCounters:
    """What came in since the start, besides commands."""

    not_for_us: int = 0  # addressed to another system or component


class Component:
    """The face of this daemon to everybody on MAVLink.

    Args:
        links: all links; those with role "autopilot" tell the system id.
        vehicle: our ids and who may command.
        clock: the loop's time.
        mavlink: rules of the component; the defaults without.
        limits: what may be asked of the arm; the defaults without.
        settings: what the ground may read and change as parameters; without, there are none.
        on_power: ends the daemon when PREFLIGHT_REBOOT_SHUTDOWN asks for it; without, nobody can.
    """

    def __init__(
        self,
        links: Sequence[MavlinkLink],
        vehicle: VehicleConfig,
        clock: Clock,
        *,
        mavlink: MavlinkConfig | None = None,
        limits: LimitsConfig | None = None,
        settings: Settings | None = None,
        on_power: Callable[[Power], None] | None = None,
    ) -> None:
        mavlink = MavlinkConfig() if mavlink is None else mavlink
        limits = LimitsConfig() if limits is None else limits
        self.counters = ComponentCounters()
        self.hearers: list[Callable[[Notice], None]] = []
        """Who else is told what everybody on MAVLink is told."""
        self.status = SystemStatus.BOOT
        """What the heartbeat says of us."""
        self.active = False
        """Whether a behaviour is under way that moves the vehicle."""
        self._links = links
        self._clock = clock
        self._wall_told_s = 0.0
        self._started = clock.now()
        self._speaker = Speaker(links)
        self.access = Access(vehicle, mavlink, clock, self.notify)
        self._translation = Translation(mavlink, limits, vehicle.component_id)
        self.commands = CommandService(self.access, self._translation, self._speaker, clock)
        self.services = StandardServices(
            self.commands,
            self.access,
            vehicle.component_id,
            self._busy if on_power else lambda: "it runs embedded",
            on_power or (lambda _: None),
        )
        self.guidance = Guidance(self.access, mavlink, limits, self._speaker, clock)
        self._finder = AutopilotFinder(vehicle)
        self._follow_autopilot = not vehicle.system_id
        self._armed = False
        self._settings = settings
        self.parameters = None if settings is None else ParameterService(settings, self.access, self._speaker)
        files = metadata_files(vehicle.component_id)
        self.files = FtpServer(files)
        self._general = (uri(vehicle.component_id, GENERAL).encode(), crc32(files[GENERAL]))
        self.services.offer(mav.MAVLINK_MSG_ID_COMPONENT_INFORMATION_BASIC, lambda _: self._information())
        self.services.offer(mav.MAVLINK_MSG_ID_COMPONENT_METADATA, lambda _: self._metadata())
        self.services.offer(mav.MAVLINK_MSG_ID_ARM_TARGET, self.guidance.told)
        for link in links:
            link.streams.offer(HEARTBEAT, 1.0 / HEARTBEAT_PERIOD_S, fixed=True)
            link.subscribe_open(self._beat)
            link.subscribe(self._on_command, (mav.MAVLINK_MSG_ID_COMMAND_LONG, mav.MAVLINK_MSG_ID_COMMAND_INT))
            link.subscribe(self._on_cancel, (mav.MAVLINK_MSG_ID_COMMAND_CANCEL,))
            link.subscribe(self._on_guidance, (mav.MAVLINK_MSG_ID_ARM_TARGET, mav.MAVLINK_MSG_ID_ARM_SETPOINT))
            link.subscribe(self._on_parameter, PARAMETER_IDS)
            link.subscribe(self._on_file_transfer, (mav.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL,))
            link.subscribe(self._on_timesync, (mav.MAVLINK_MSG_ID_TIMESYNC,))
            link.subscribe(self._on_ping, (mav.MAVLINK_MSG_ID_PING,))
            link.subscribe(self._on_heartbeat, (HEARTBEAT,))

    def take(self) -> tuple[list[Request], Bar | None]:
        """What has come since the last call: requests in order, and the newest target."""
        requests = self.commands.take()
        if any(request.order in URGENT for request in requests):
            self.guidance.drop_setpoint()  # the arm goes another way
        return requests, self.guidance.take_bar()

    def answer(self, answer: Answer) -> None:
        """Tell whoever asked. Progress may be told often; the first other result ends the request."""
        self.commands.answer(answer)

    def notify(self, notice: Notice) -> None:
        """Tell everybody."""
        self._speaker.say(notice)
        for hear in self.hearers:
            hear(notice)

    async def run(self) -> None:
        """Send heartbeats, the first at once, until cancelled."""
        try:
            async for _ in ticks(HEARTBEAT_PERIOD_S):
                for link in self._links:
                    self._beat(link)
                self.access.expire()
                self._watch_wall_clock()
        finally:
            self.files.close()
            if self.parameters is not None:
                self.parameters.close()

    def set_limits(self, limits: LimitsConfig) -> None:
        """What may be asked of the arm from now on."""
        self._translation.limits = self.guidance.limits = limits

    def _watch_wall_clock(self) -> None:
        """Say once when the computer's clock has been set: ours stays, and what others stamp no longer fits it."""
        step = self._clock.wall_set_by_s
        if abs(step - self._wall_told_s) > CLOCKS_APART_S:
            self._wall_told_s = step
            where = f"{abs(step):.1f} s {'ahead of' if step > 0.0 else 'behind'}"
            text = f"the computer's clock was set and is {where} ours, which stays: restart the service on the ground"
            log.warning("%s; until then targets and MQTT commands with the new time may be refused", text)
            self.notify(Notice(Severity.WARNING, text))

    # --- identity ---

    def _beat(self, link: MavlinkLink) -> None:
        link.send(
            mav.MAVLink_heartbeat_message(
                mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, int(self.status), 3
            )
        )

    def _information(self) -> Message:
        """COMPONENT_INFORMATION_BASIC."""
        return mav.MAVLink_component_information_basic_message(
            self._boot_ms,
            CAPABILITIES,
            0,
            b"arm_companion",
            b"continuum arm",
            metadata.version("arm-companion").encode()[:23],
            b"",
            b"",
        )

    def _metadata(self) -> Message:
        """COMPONENT_METADATA."""
        where, crc = self._general
        return mav.MAVLink_component_metadata_message(self._boot_ms, crc, where)

    @property
    def _boot_ms(self) -> int:
        return round((self._clock.now() - self._started) * 1e3) & 0xFFFFFFFF

    def _busy(self) -> str | None:
        """Why the daemon must not end now."""
        if self.active:
            return "the arm is at work"
        return "the vehicle is armed" if self._armed else None

    def _on_heartbeat(self, message: Message, link: MavlinkLink) -> None:
        self.access.heard(message, link)
        if link.role == "autopilot":
            self._follow(message)

    def _follow(self, message: Message) -> None:
        """Be a part of the system of the autopilot that we hear."""
        before = self._finder.system_id
        if not self._finder.heard(message, self._clock.now()):
            return
        self._armed = bool(message.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
        system = self._finder.system_id
        if system == before or not self._follow_autopilot:
            return
        log.info("our system id is %d, as the autopilot's", system)
        for link in self._links:
            link.system_id = system
            # Until our first heartbeat the autopilot takes messages that are meant for us as its own.
            self._beat(link)

    # --- what is addressed to us ---

    def _is_self(self, message: Message, link: MavlinkLink) -> bool:
        return bool(message.get_srcSystem() == link.system_id and message.get_srcComponent() == link.component_id)

    def is_for_us(self, message: Message, link: MavlinkLink, *, everybody: bool) -> bool:
        """Whether a message with an address is for us.

        Args:
            message: it has target_system and target_component.
            link: where it came in.
            everybody: whether component 0, which is everybody of our system, means us too.
        """
        ours = message.target_component == link.component_id or (everybody and message.target_component == 0)
        if message.target_system == link.system_id and ours and not self._is_self(message, link):
            return True
        self.counters.not_for_us += 1
        return False

    def _on_command(self, message: Message, link: MavlinkLink) -> None:
        command = read_command(message, sender_of(message, link))
        if not self.is_for_us(message, link, everybody=self._translation.names_us(command)):
            return
        self.commands.handle(command, link)
        if link.streams.take_asked(HEARTBEAT):
            self._beat(link)

    def _on_cancel(self, message: Message, link: MavlinkLink) -> None:
        if self.is_for_us(message, link, everybody=is_ours(message.command)):
            self.commands.cancel(message.command, sender_of(message, link), link)

    def _on_guidance(self, message: Message, link: MavlinkLink) -> None:
        if self.is_for_us(message, link, everybody=True):
            self.guidance.handle(message, link)

    def _on_parameter(self, message: Message, link: MavlinkLink) -> None:
        service = self.parameters
        if service is not None and self.is_for_us(message, link, everybody=service.is_for_everybody(message)):
            service.handle(message, link)

    def _on_file_transfer(self, message: Message, link: MavlinkLink) -> None:
        if self.is_for_us(message, link, everybody=False):
            self.files.handle(message, link)

    def _on_timesync(self, message: Message, link: MavlinkLink) -> None:
        """A question has no time of the other side yet; an answer is the autopilot driver's."""
        system, component = addressee(message)
        if system not in (0, link.system_id) or component not in (0, link.component_id):
            return  # who asks the autopilot must not take our time for its
        if message.tc1 == 0 and not self._is_self(message, link):
            now = round(self._clock.now() * 1e9)
            link.send(mav.MAVLink_timesync_message(now, message.ts1), Priority.NOW)  # waiting would spoil it

    def _on_ping(self, message: Message, link: MavlinkLink) -> None:
        """A ping to nobody in particular is a question; one with an address is somebody's answer."""
        if message.target_system == 0 and message.target_component == 0 and not self._is_self(message, link):
            link.send(
                mav.MAVLink_ping_message(
                    message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                )
            )
