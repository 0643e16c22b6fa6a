"""What a guided procedure asks for, as plain values, and what it gets back."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from arm_companion.errors import ArmError

T = TypeVar("T")


class Refused(ArmError):
    """A procedure cannot go on; the message says what to look for."""


@dataclass(frozen=True, slots=True)
class Say:
    """Tell the person something. Comes back as None."""

    text: str


@dataclass(frozen=True, slots=True)
class Ask:
    """Wait for the person. Comes back as True for Enter, as False for `n`.

    Attributes:
        text: what will be done and why, or a question that Enter answers with yes.
        sure: whether `--yes` answers it; otherwise only a person can.
    """

    text: str
    sure: bool = True


@dataclass(frozen=True, slots=True)
class AskNumber:
    """Ask the person for a number. Comes back as a float, or as None for an empty line."""

    text: str


@dataclass(frozen=True, slots=True)
class Engage:
    """Torque on, every servo staying where it is. Comes back as the positions, ticks."""


@dataclass(frozen=True, slots=True)
class Release:
    """Torque off, for every servo. Comes back as the positions, ticks."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Ends a move early: the smoothed load of one servo, or the mean of all, has risen this far.

    Attributes:
        servo: its place in the tendons' order; None for the mean of all.
        load: share of full load, positive when pulling.
    """

    servo: int | None
    load: float

    def of(self, loads: tuple[float, ...]) -> float:
        """The load that counts."""
        return sum(loads) / len(loads) if self.servo is None else loads[self.servo]


@dataclass(frozen=True, slots=True)
class Move:
    """Wind tendons up or let them out, straight and at one speed. Comes back as a `Trace`.

    Attributes:
        wound: where each servo goes, m wound up since `Engage`.
        speed: of the one that has the longest way, m/s.
        stop: what ends it early.
    """

    wound: tuple[float, ...]
    speed: float
    stop: Stop | None = None


@dataclass(frozen=True, slots=True)
class Keep:
    """Store a partial result, to go on from after an interruption. Comes back as None."""

    value: Any


@dataclass(frozen=True, slots=True)
class Sample:
    """All servos at one instant, in the tendons' order."""

    wound: tuple[float, ...]  # m since `Engage`
    load: tuple[float, ...]  # share of full load, positive when pulling
    voltage: tuple[float, ...]  # V
    temperature: tuple[float, ...]  # degC


@dataclass(frozen=True, slots=True)
class Trace:
    """What was measured on a move, and whether its `Stop` ended it."""

    samples: tuple[Sample, ...]
    stopped: bool = False

    def wound(self, i: int) -> list[float]:
        """Of servo `i`, m."""
        return [sample.wound[i] for sample in self.samples]

    def load(self, i: int) -> list[float]:
        """Of servo `i`, share of full load."""
        return [sample.load[i] for sample in self.samples]


Action: TypeAlias = Say | Ask | AskNumber | Engage | Release | Move | Keep
Procedure: TypeAlias = Generator[Action, Any, T]
