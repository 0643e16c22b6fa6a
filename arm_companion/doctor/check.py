"""What a check is, and the runner that never lets a broken one hide the others."""

import enum
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from arm_companion.doctor.subject import Subject


class Level(enum.IntEnum):
    """How a check ended; the greater, the graver."""

    SKIPPED = 0
    OK = 1
    WARN = 2
    FAIL = 3


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one look found."""

    level: Level
    found: str
    mend: str = ""  # what to do; empty where nothing is to be done


def ok(found: str) -> Outcome:
    """All is well."""
    return Outcome(Level.OK, found)


def skipped(found: str, mend: str = "") -> Outcome:
    """Nothing could be looked at, for this reason."""
    return Outcome(Level.SKIPPED, found, mend)


def warn(found: str, mend: str) -> Outcome:
    """It works, worse than it could."""
    return Outcome(Level.WARN, found, mend)


def fail(found: str, mend: str) -> Outcome:
    """It does not work, or is not safe."""
    return Outcome(Level.FAIL, found, mend)


@dataclass(frozen=True, slots=True)
class Check:
    """One thing to look at. `look` gives one outcome or several; the gravest ones are what is told."""

    name: str
    why: str
    look: Callable[[Subject], Outcome | Iterable[Outcome]]


@dataclass(frozen=True, slots=True)
class Finding:
    """A check with its outcome: one row of the report."""

    check: str
    level: Level
    found: str
    why: str
    mend: str

    def as_json(self) -> dict[str, str]:
        """The row for `--json`."""
        return {
            "check": self.check,
            "level": self.level.name.lower(),
            "found": self.found,
            "why": self.why,
            "do": self.mend,
        }


_NOTHING: Final = skipped("there is nothing to look at")


def examine(checks: Iterable[Check], subject: Subject) -> list[Finding]:
    """Every check's finding, in order. A check that raises is itself the finding."""
    return [_finding(check, subject) for check in checks]


def _finding(check: Check, subject: Subject) -> Finding:
    try:
        looked = check.look(subject)
        outcomes = [looked] if isinstance(looked, Outcome) else list(looked)
    except Exception as error:  # noqa: BLE001 - whatever a check stumbles over, the others still count
        words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        outcomes = [fail(f"this check itself broke ({words})", "report it, with the file that --report makes")]
    worst = max((outcome.level for outcome in outcomes), default=Level.SKIPPED)
    told = [outcome for outcome in outcomes if outcome.level == worst] or [_NOTHING]
    found = "; ".join(outcome.found for outcome in told)
    mend = "; ".join(dict.fromkeys(outcome.mend for outcome in told if outcome.mend))
    return Finding(check.name, worst, found, check.why, mend)
