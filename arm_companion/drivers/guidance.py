"""The newest target and set-point: taken from whoever may give them, kept with their age."""

import dataclasses
from dataclasses import dataclass
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import LimitsConfig, MavlinkConfig
from arm_companion.drivers.access import Access, sender_of
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.status_text import Speaker
from arm_companion.drivers.targets import read_bar, read_object, read_setpoint
from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import ArmSetpoint, Bar, GraspTarget, Notice, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

_COMPLAINT_PERIOD_S: Final = 2.0
_MOST_SENDERS: Final = 64
CLOCKS_APART_S: Final = 0.5
"""By how much a sender's clock may run ahead of ours."""


@dataclass(slots=True)
class GuidanceCounters:
    """What came in since the start."""

    targets: int = 0
    bad_targets: int = 0  # that cannot be used, or may not be given by their sender
    setpoints: int = 0
    bad_setpoints: int = 0
    late: int = 0  # older than one that has been taken: they came out of order, or twice


class Guidance:
    """Where the bar or object is, and where the arm is streamed to.

    Args:
        access: who may say so.
        mavlink: how old they may be.
        limits: greatest bend.
        speaker: says why something is refused; things stream, so one word in two seconds is enough.
        clock: for the ages.
    """

    def __init__(
        self, access: Access, mavlink: MavlinkConfig, limits: LimitsConfig, speaker: Speaker, clock: Clock
    ) -> None:
        self.counters = GuidanceCounters()
        self.limits = limits
        self._access = access
        self._max_age_s = mavlink.target_age_s
        self._speaker = speaker
        self._clock = clock
        self._complained = float("-inf")
        self._newest: dict[tuple[int, int, int, int], float] = {}  # stamp by sender, message and kind
        self._told: dict[float, Message] = {}  # the newest target that was taken, by kind
        self._new_bar: Bar | None = None
        self._bar_at = self._object_at = self._setpoint_at = float("-inf")
        self._object: GraspTarget | None = None
        self._setpoint: ArmSetpoint | None = None

    def take_bar(self) -> Bar | None:
        """The newest bar that has come since the last call."""
        bar, self._new_bar = self._new_bar, None
        return bar

    def told(self, kind: float) -> Message | None:
        """The newest target of a kind as it was taken, for who wants to know whether his own has come; None before."""
        target = self._told.get(kind)
        if target is None:
            return None
        return mav.MAVLink_arm_target_message(0, 0, *(getattr(target, name) for name in target.fieldnames[2:]))

    @property
    def bar_age_s(self) -> float:
        """Since the newest bar was measured; inf before the first."""
        return self._clock.now() - self._bar_at

    @property
    def grasp_target(self) -> tuple[GraspTarget | None, float]:
        """The newest object and its age, s."""
        return self._object, self._clock.now() - self._object_at

    @property
    def setpoint(self) -> ArmSetpoint | None:
        """The newest set-point with its age; None before the first, and when it has timed out."""
        if self._setpoint is None:
            return None
        age = self._clock.now() - self._setpoint_at
        if age > self._setpoint.timeout_s:
            self._setpoint = None
            return None
        return dataclasses.replace(self._setpoint, age_s=age)

    def drop_setpoint(self) -> None:
        """The arm goes another way: the streamed set-point counts no more."""
        self._setpoint = None

    def handle(self, message: Message, link: MavlinkLink) -> None:
        """Take an ARM_TARGET or ARM_SETPOINT that is addressed to us."""
        is_target = message.get_msgId() == mav.MAVLINK_MSG_ID_ARM_TARGET
        try:
            sender = sender_of(message, link)
            if is_target:
                self._access.require_informant(sender)
                taken = self._take_target(message)
            else:
                self._access.require(sender)
                taken = self._take_setpoint(message)
        except CommandRejected as rejected:
            self._complain("target" if is_target else "set-point", rejected.reason, link)
            if is_target:
                self.counters.bad_targets += 1
            else:
                self.counters.bad_setpoints += 1
            return
        if not taken:
            self.counters.late += 1
        elif is_target:
            self.counters.targets += 1
        else:
            self.counters.setpoints += 1

    def _take_target(self, message: Message) -> bool:
        if message.kind == mav.ARM_TARGET_KIND_BAR:
            bar = read_bar(message)
            if (at := self._measured_at(message)) is None:
                return False
            self._new_bar, self._bar_at = bar, at
        elif message.kind == mav.ARM_TARGET_KIND_OBJECT:
            thing = read_object(message)
            if (at := self._measured_at(message)) is None:
                return False
            self._object, self._object_at = thing, at
        else:
            raise CommandRejected(f"targets of kind {message.kind} are not known")
        self._told[message.kind] = message
        return True

    def _take_setpoint(self, message: Message) -> bool:
        setpoint = read_setpoint(message, self.limits.bend_max_rad)
        if (at := self._measured_at(message)) is None:
            return False
        self._setpoint, self._setpoint_at = setpoint, at
        return True

    def _measured_at(self, message: Message) -> float | None:
        """Loop time of the message's stamp; None when a newer one has been taken. No stamp means now.

        Raises:
            CommandRejected: the stamp is too old, or in the future.
        """
        now = self._clock.now()
        if message.time_usec == 0:
            return now
        stamp: float = message.time_usec * 1e-6
        age = self._clock.unix(now) - stamp
        if age > self._max_age_s:
            raise CommandRejected(f"it is {age:.3g} s old; at most {self._max_age_s:g} s are allowed")
        if age < -CLOCKS_APART_S:
            raise CommandRejected(f"its time is {-age:.3g} s ahead of ours")
        key = (message.get_srcSystem(), message.get_srcComponent(), message.get_msgId(), message.kind)
        if stamp <= self._newest.get(key, float("-inf")):
            return None
        if len(self._newest) >= _MOST_SENDERS:
            self._newest.clear()  # the age limit still holds
        self._newest[key] = stamp
        return now - max(age, 0.0)

    def _complain(self, what: str, reason: str, link: MavlinkLink) -> None:
        now = self._clock.now()
        if now - self._complained >= _COMPLAINT_PERIOD_S:
            self._complained = now
            self._speaker.say(Notice(Severity.WARNING, f"{what} refused: {reason}"), link)
