"""Who may ask the arm for what: allowed systems, signed senders, and the one ground station that has control."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import MavlinkConfig, VehicleConfig
from arm_companion.drivers.flight_stack import AUTOPILOT_COMPONENT
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Notice, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

NOBODY: Final = (0, 0)

_MOST_STATIONS: Final = 32


@dataclass(frozen=True, slots=True)
class Sender:
    """Who asks: ids as they stand in the frame, and what its link knows of it."""

    system: int
    component: int
    role: str  # of the link
    ours: bool  # of the vehicle that we fly on
    trusted: bool  # signed, or need not be

    @property
    def address(self) -> tuple[int, int]:
        """System and component."""
        return self.system, self.component

    @property
    def is_mission(self) -> bool:
        """Whether it is our autopilot, which asks for something only when its mission says so."""
        return self.ours and self.component == AUTOPILOT_COMPONENT and self.role == "autopilot"


def sender_of(message: Message, link: MavlinkLink) -> Sender:
    """Who sent a message that came in on `link`."""
    system = message.get_srcSystem()
    trusted = link.trusts(signed=message.get_signed())
    return Sender(system, message.get_srcComponent(), link.role, system == link.system_id, trusted)


class Access:
    """The rules.

    Args:
        vehicle: which systems may command.
        mavlink: whether missions may, and how long a silent station keeps control.
        clock: ages the stations' heartbeats.
        tell: says to everybody who has control now.
    """

    def __init__(
        self, vehicle: VehicleConfig, mavlink: MavlinkConfig, clock: Clock, tell: Callable[[Notice], None]
    ) -> None:
        self._commanders = frozenset(vehicle.commanders)
        self._config = mavlink
        self._clock = clock
        self._tell = tell
        self._heard: dict[tuple[int, int], float] = {}
        self._holder = NOBODY

    @property
    def holder(self) -> tuple[int, int]:
        """Who has primary control; `NOBODY` when nobody has, or has fallen silent."""
        silent = self._silence(self._holder) > self._config.control_timeout_s
        return NOBODY if silent else self._holder

    def expire(self) -> None:
        """Take control from a station that has fallen silent, and say so; called now and then."""
        if self._holder != NOBODY and self.holder == NOBODY:
            self._give(NOBODY, f"control: {_name(self._holder)} is silent and has lost it")

    @property
    def ground_age_s(self) -> float:
        """Since the newest heartbeat of whoever has control, or else of any station that may command."""
        holder = self.holder
        stations = self._heard if holder == NOBODY else (holder,)
        return min((self._silence(station) for station in stations), default=float("inf"))

    def heard(self, heartbeat: Message, link: MavlinkLink) -> None:
        """Take the heartbeat of somebody who might be a ground station."""
        if heartbeat.type != mav.MAV_TYPE_GCS or self._stranger(sender_of(heartbeat, link)):
            return
        address = (heartbeat.get_srcSystem(), heartbeat.get_srcComponent())
        self._heard.pop(address, None)
        self._heard[address] = self._clock.now()
        if len(self._heard) > _MOST_STATIONS:
            self._heard.pop(next(a for a in self._heard if a != self._holder))

    def require(self, sender: Sender, *, urgent: bool = False) -> None:
        """Let the sender ask for something that moves or changes the arm.

        Args:
            sender: who asks.
            urgent: a way to safety, which needs no primary control.

        Raises:
            CommandRejected: it may not, with the reason in words.
        """
        if (reason := self._stranger(sender)) is not None:
            raise CommandRejected(reason)
        if sender.is_mission or urgent:
            return
        holder = self.holder
        if holder not in (NOBODY, sender.address):
            raise CommandRejected(f"{_name(holder)} has control")

    def require_informant(self, sender: Sender) -> None:
        """Let the sender say where a target is: whoever may command, and any peer on board.

        Raises:
            CommandRejected: it may not, with the reason in words.
        """
        if sender.role == "peer" and sender.trusted:
            return
        self.require(sender)

    def control(self, sender: Sender, action: int) -> None:
        """Carry out MAV_CMD_ARM_CONTROL.

        Raises:
            CommandRejected: another station has control, or the sender may not have it.
        """
        if (reason := self._stranger(sender)) is not None:
            raise CommandRejected(reason)
        holder = self.holder
        if action == mav.ARM_CONTROL_RELEASE:
            if holder == sender.address:
                self._give(NOBODY, f"control: {_name(holder)} has released it")
            elif holder != NOBODY:
                raise CommandRejected(f"{_name(holder)} has control")
            return
        if holder not in (NOBODY, sender.address) and action != mav.ARM_CONTROL_TAKE_OVER:
            raise CommandRejected(f"{_name(holder)} has control; param1 = 2 takes it over")
        self._heard[sender.address] = self._clock.now()
        if holder != sender.address:
            self._give(sender.address, f"control: {_name(sender.address)} has taken it")

    def _give(self, holder: tuple[int, int], words: str) -> None:
        self._holder = holder
        log.info("%s", words)
        self._tell(Notice(Severity.NOTICE, words))

    def _stranger(self, sender: Sender) -> str | None:
        """Why the sender's wishes never count; None when they may."""
        if not sender.trusted:
            return "the sender does not sign"
        if sender.is_mission:
            return None if self._config.mission_commands else "the mission may not command the arm"
        if self._commanders:
            allowed = sender.system in self._commanders
            return None if allowed else f"system {sender.system} may not command the arm"
        return "a peer may not command the arm" if sender.role == "peer" else None

    def _silence(self, station: tuple[int, int]) -> float:
        return self._clock.now() - self._heard.get(station, float("-inf"))


def _name(station: tuple[int, int]) -> str:
    return f"{station[0]}/{station[1]}"
