"""What is known of one servo: its last answer, its faults, and the history that telemetry shows."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Self

from arm_companion.drivers.servo_link import ServoLink
from arm_companion.errors import DeviceFault
from arm_companion.protocol.control_table import (
    LOAD_FULL,
    TICK_CLOCK_MODULUS_MS,
    TICK_RAD,
    VELOCITY_UNIT_RAD_PER_S,
    VOLTAGE_UNIT_V,
    Echo,
    Feedback,
    HardwareError,
)

_FASTEST_TICKS_PER_S = 8000.0  # well beyond the 61 rev/min of an unloaded XL430
_JUMP_TICKS = 128.0
_CLOCK_TOLERANCE_MS = 60.0
_CLOCK_DRIFT = 0.03
_CLOCK_MEMORY_S = 8.0  # older comparisons are ambiguous: the servo's clock wraps after 33 s
_NEVER_HEARD = Feedback(0, 0, 0, 0, 0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class ServoState:
    """One servo as it last answered, in its own sense of direction."""

    id: int
    position: int  # ticks
    speed: float  # ticks/s
    load: float  # share of full load, positive towards growing positions
    voltage: float  # V
    temperature: float  # degC
    error_bits: int  # hardware errors, register 70
    torque: bool  # torque is on
    tripped: bool  # its bus watchdog stopped it: goals are refused until `start`
    turns_lost: bool  # it lost power or jumped: the position says nothing of the tendon until homed
    ready: bool  # set up, and nothing stands in the way of goals
    silent: bool  # has not answered for several cycles, or never
    age_s: float  # since its last answer, inf: never answered

    @property
    def fault(self) -> DeviceFault | None:
        """What is wrong with it, the gravest first; None: nothing, or it has not been set up yet."""
        if self.silent:
            return DeviceFault(self.id, self.error_bits, "does not answer")
        if self.error_bits:
            return DeviceFault(self.id, self.error_bits, hardware_errors(self.error_bits))
        if self.turns_lost:
            return DeviceFault(self.id, 0, "has lost its turns: it must be homed")
        if self.tripped:
            return DeviceFault(self.id, 0, "its bus watchdog stopped it")
        return None


def hardware_errors(bits: int) -> str:
    """Hardware-error bits in words."""
    known = [error.name.lower().replace("_", " ") for error in HardwareError if bits & error and error.name]
    return ", ".join(known) or "not looked up yet"


@dataclass(slots=True)
class ServoCounters:
    """History of one servo since the daemon started."""

    answers: int = 0
    lost: int = 0  # requests without a good answer; each is tried again
    missed_cycles: int = 0  # cycles without any good answer
    alerts: int = 0  # cycles in which it said that a hardware error stands
    power_losses: int = 0
    watchdog_trips: int = 0
    goals_lost: int = 0  # goals found not to have arrived, and sent again


@dataclass(slots=True)
class ServoRecord:
    """The bus driver's mind about one servo."""

    id: int
    missed: int  # cycles in a row without an answer
    counters: ServoCounters = field(default_factory=ServoCounters)
    feedback: Feedback | None = None
    answered_at: float = -math.inf
    goal: int | None = None  # ticks, last one sent
    goal_lost: bool = False  # the servo was found to have another one
    goal_confirmed: bool = False  # the servo was found to have this one
    error_bits: int = 0
    torque: bool = False
    tripped: bool = False
    turns_lost: bool = False
    set_up: bool = False
    firmware: int = 0  # 0: not known yet
    vouched: bool = False  # its LED says that its turns are known
    stood: int | None = None  # ticks, where it was last heard while its turns were known
    _tick_ms: int = 0
    _tick_between: tuple[float, float] = (-math.inf, -math.inf)  # when it was asked for, and when it came

    def take(self, feedback: Feedback, now: float) -> None:
        """Note an answer. A position that no motion explains marks the turns as lost."""
        if self.feedback is not None:
            possible = _JUMP_TICKS + _FASTEST_TICKS_PER_S * (now - self.answered_at)
            if abs(feedback.position - self.feedback.position) > possible:
                self.turns_lost = True
        if self.set_up and not self.turns_lost:
            self.stood = feedback.position
        self.feedback = feedback
        self.answered_at = now
        self.missed = 0
        self.counters.answers += 1

    def take_echo(self, echo: Echo, asked: float, now: float) -> None:
        """Compare what the servo has with what it was sent, and its clock with ours.

        The servo read its clock at some time between the question and its answer, which a stall of this process may
        set far apart: only a clock that fits no such time has started afresh.

        Args:
            echo: the answer.
            asked: time of the question, s.
            now: time of the answer, s.
        """
        self.goal_confirmed = echo.goal == self.goal
        self.goal_lost = self.torque and self.goal is not None and not self.goal_confirmed
        self.counters.goals_lost += self.goal_lost
        before = self._tick_between
        least, most = asked - before[1], now - before[0]
        if most < _CLOCK_MEMORY_S:
            off = (echo.tick_ms - self._tick_ms - 500 * (least + most)) % TICK_CLOCK_MODULUS_MS
            off = min(off, TICK_CLOCK_MODULUS_MS - off)
            if off > _CLOCK_TOLERANCE_MS + 500 * (most - least) + _CLOCK_DRIFT * 1000 * most:
                self.lose_power()
        self._tick_ms, self._tick_between = echo.tick_ms, (asked, now)

    def rebase(self, position: int) -> None:
        """The servo counts its ticks from elsewhere now, and stands at `position`."""
        if self.feedback is not None:
            self.feedback = self.feedback._replace(position=position)

    @property
    def movable(self) -> bool:
        """Goals mean something to it, and it would follow them."""
        return self.set_up and not (self.turns_lost or self.tripped)

    def hold(self) -> None:
        """Make the position last heard the goal."""
        if self.feedback is not None:
            self.goal = self.feedback.position
            self.goal_confirmed = False

    def take_watchdog(self, *, tripped: bool) -> None:
        """Note whether the bus watchdog has stopped the servo."""
        if tripped and not self.tripped:
            self.counters.watchdog_trips += 1
        self.tripped = tripped

    def lose_power(self) -> None:
        """The servo started afresh: what was set up, and the turns it had counted, are gone."""
        self.counters.power_losses += 1
        self.turns_lost = True
        self.torque = False
        self.set_up = False
        self.tripped = False
        self.goal = None
        self.goal_lost = False
        self._tick_between = (-math.inf, -math.inf)

    def state(self, now: float, silent_after: int) -> ServoState:
        """The servo's state for the rest of the daemon."""
        raw = self.feedback or _NEVER_HEARD
        return ServoState(
            id=self.id,
            position=raw.position,
            speed=raw.velocity * (VELOCITY_UNIT_RAD_PER_S / TICK_RAD),
            load=raw.load / LOAD_FULL,
            voltage=raw.voltage * VOLTAGE_UNIT_V,
            temperature=float(raw.temperature),
            error_bits=self.error_bits,
            torque=self.torque,
            tripped=self.tripped,
            turns_lost=self.turns_lost,
            ready=self.movable and not self.error_bits,
            silent=self.missed >= silent_after,
            age_s=now - self.answered_at,
        )


@dataclass(frozen=True, slots=True)
class BusCounters:
    """History of the bus and of each servo on it."""

    servos: dict[int, ServoCounters]
    frames: int
    garbage_bytes: int
    crc_errors: int
    strays: int
    reconnects: int
    latency_s: float  # mean time of a transaction beyond its time on the wire

    @classmethod
    def of(cls, link: ServoLink, records: Iterable[ServoRecord], reconnects: int = 0) -> Self:
        """What link and records have counted."""
        parser = link.parser
        return cls(
            servos={r.id: r.counters for r in records},
            frames=parser.frames,
            garbage_bytes=parser.garbage,
            crc_errors=parser.crc_errors,
            strays=link.strays,
            reconnects=reconnects,
            latency_s=link.latency.mean_s,
        )


def fault_of(record: ServoRecord, otherwise: str) -> DeviceFault:
    """What a servo has that did not do as it was told: what is known to be wrong with it, or else `otherwise`."""
    if record.missed:
        return DeviceFault(record.id, 0, "does not answer")
    return DeviceFault(record.id, record.error_bits, "" if record.error_bits else otherwise)


def raise_together(what: str, faults: Sequence[DeviceFault]) -> None:
    """Raise an `ExceptionGroup` if there are any faults."""
    if faults:
        raise ExceptionGroup(f"{what}: {len(faults)} of the servos failed", faults)
