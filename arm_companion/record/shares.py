"""A replay in shares, each in a process of its own, for a record that is expected to come out the same.

A cycle follows from the memory before it. That is recorded, and once in a while with it where the solver starts
(`starts`). A process begins at such a place, and ends at the one where the next begins: what it calculated by then,
memory and start included, must be what is recorded there. So the next one has started from the right place as well,
and all shares together are the whole replay. Where anything differs there is no answer, and the record is to be
replayed in one go, which says what and why.
"""

import functools
import itertools
import multiprocessing
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import orjson

from arm_companion.config.schema import Config
from arm_companion.errors import ArmError
from arm_companion.record.reader import Reader
from arm_companion.record.replay import Moved, Outcome, Runner, Written, cycle_of, mechanics_of, written
from arm_companion.record.starts import starts_text
from arm_companion.record.topics import FACTS
from arm_companion.record_codec import plain

_WORTH_BYTES: Final = 4_000_000
"""A shorter record, half a minute or so, is replayed before all processes have started."""

_MOST: Final = 8
"""Processes; more of them would mostly read what is not theirs."""


def replay_in_shares(path: Path, mechanics: str = "") -> Outcome | None:
    """The outcome of a record whose every command is the same; None when it is to be replayed in one go."""
    processes = min(os.cpu_count() or 1, _MOST)
    if processes == 1 or not path.is_file() or path.stat().st_size < _WORTH_BYTES:
        return None
    reader = Reader(path)
    count = reader.count(FACTS)
    if count is None:
        return None
    work = functools.partial(share, path, mechanics)
    whole = Outcome()
    with multiprocessing.get_context("spawn").Pool(processes) as pool:  # leaving it ends whoever is still at work
        for part in pool.imap_unordered(work, stretches(count, processes)):
            if part is None:
                return None
            whole.begins = part.begins
            whole.cycles += part.cycles
            whole.same += part.same
            whole.seconds = max(whole.seconds, part.seconds)
            whole.recorded += part.recorded
    whole.recorded.sort(key=_when)
    whole.now = list(whole.recorded)
    whole.remarks = reader.begins(whole.begins)
    return whole if whole.cycles == count else None


def _when(move: Moved) -> float:
    return move.seconds


def stretches(count: int, processes: int) -> list[tuple[int, int]]:
    """About the first cycle of each process and of the next one, counted in what is read.

    They begin where a start is recorded.
    """
    return list(itertools.pairwise(round(count * k / processes) for k in range(processes + 1)))


def share(path: Path, mechanics: str, stretch: tuple[int, int]) -> Outcome | None:
    """What a process does; None when it found something that only a replay in one go can tell.

    Args:
        path: of the record.
        mechanics: as for `replay`.
        stretch: about its first cycle, and the next process', counted from the first that is read: the first one
            there whose start is recorded.
    """
    first, end = stretch
    try:
        reader = Reader(path)
        recorded = reader.versions.get("mechanics", "numpy")
        outcome = Outcome()
        runner = Runner(outcome, None, mechanics_of(mechanics or recorded, recorded, outcome.why))
        started, base = False, -1
        for found in _unbroken(reader):
            if isinstance(found, Config):
                runner.configure(found)
                continue
            if base < 0:
                base = found.number
                runner.start, first, end = cycle_of(found).t, base + first, base + end
            if started and found.number >= end and found.starts:
                outcome.begins = base
                return outcome if _as_recorded(runner, found) else None
            started = started or found.number == first == base or (found.number >= first and bool(found.starts))
            if started:
                runner.take(cycle_of(found))
                if not outcome.identical:
                    return None
    except (ArmError, LookupError, TypeError, ValueError):  # memory of another version, or none, has any of these
        return None
    outcome.begins = base
    return None if reader.remarks or base < 0 else outcome


def _unbroken(reader: Reader) -> Iterator[Written | Config]:
    """What is written, of a record from its part's beginning.

    Raises:
        ValueError: a cycle is missing, or failed in flight.
    """
    expected = 0 if reader.part == 1 else None
    for found in written(reader):
        if isinstance(found, Written):
            if found.failure or found.number != (found.number if expected is None else expected):
                raise ValueError(found.number)
            expected = found.number + 1
        yield found


def _as_recorded(runner: Runner, next_one: Written) -> bool:
    """Whether the memory is what the next process has begun with."""
    if runner.state is None:
        return False
    t = orjson.loads(next_one.facts)["t"]
    return orjson.dumps(plain(runner.state)) == next_one.state and starts_text(runner.state, t) == next_one.starts
