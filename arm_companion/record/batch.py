"""Cycles as they stand in the file, a few at a time, and what is written with them."""

from dataclasses import dataclass, field
from typing import NamedTuple

import orjson

from arm_companion.config.schema import Config
from arm_companion.mission.facts import Notice
from arm_companion.record.recorder import FailedCycle, Frame, Record
from arm_companion.record.topics import COMMANDS, FAILURES
from arm_companion.record_codec import plain


class WrittenCycle(NamedTuple):
    """Facts, memory, and commands or failure of a cycle, as they stand in the file."""

    sequence: int
    t: float  # loop time, s
    facts: bytes
    state: bytes
    topic: str
    outcome: bytes
    starts: bytes
    """Where the solver starts, when that stands with it."""
    resumable: bool
    """Whether a replay can begin here: the solver has solved nothing yet, or it stands here where it starts."""


@dataclass(slots=True)
class Batch:
    """A few cycles, and what came since the ones before."""

    configs: list[tuple[float, Config]] = field(default_factory=list)
    notices: list[tuple[float, Notice]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    cycles: list[WrittenCycle] = field(default_factory=list)
    last: bool = False

    @property
    def t(self) -> float | None:
        """Loop time of the newest cycle, s, or where there is none of what came first; None: there is neither."""
        if self.cycles:
            return self.cycles[-1].t
        return next((item[0] for item in (*self.configs, *self.notices)), None)

    @property
    def resumable(self) -> bool:
        """Whether a replay can begin with its first cycle."""
        return bool(self.cycles) and self.cycles[0].resumable


def in_words(sequence: int, record: Record | FailedCycle, starts: bytes) -> WrittenCycle:
    """A cycle as it stands in the file.

    Args:
        sequence: its number.
        record: the cycle.
        starts: where the solver starts, if that is to stand with it.
    """
    stamp = {"t": record.t}
    if isinstance(record, Record):
        topic, outcome = COMMANDS, plain(record.commands)
    else:
        topic, outcome = FAILURES, {"error": record.error, "where": record.where}
    return WrittenCycle(
        sequence,
        record.t,
        orjson.dumps(stamp | plain(record.facts)),
        orjson.dumps(plain(record.state)),
        topic,
        orjson.dumps(stamp | outcome),
        starts,
        bool(starts) or record.state.prediction is None,
    )
