"""A replay in shares, each in a process of its own, for a record that is expected to come out the same.

A cycle follows from the memory before it. That is recorded, all but where the solver starts, which comes of every solve
since the first cycle; so each process solves the equilibria of the cycles before its own from recorded memory, which is
the smaller part, and then runs its own. What it calculates there, memory included, must be what is recorded: then the
others have started from the right place as well, and all shares together are the whole replay. Where anything differs
there is no answer, and the record is to be replayed in one go, which says what and why.
"""

import functools
import itertools
import multiprocessing
import os
from pathlib import Path
from typing import Final

import orjson

from arm_companion.errors import ArmError
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import State
from arm_companion.mission.wrench import equilibria
from arm_companion.record.reader import Reader
from arm_companion.record.replay import Cycle, Moved, Outcome, Runner, Written, cycle_of, mechanics_of, written
from arm_companion.record.topics import FACTS
from arm_companion.record_codec import build, plain
from arm_companion.values import replace

_WORTH_BYTES: Final = 4_000_000
"""A shorter record, half a minute or so, is replayed before all processes have started."""

_MOST: Final = 4
"""Processes; more of them would mostly solve the same equilibria."""

_FOLLOWED: Final = 0.28
"""Time that a cycle takes of which only the equilibria are solved, of that of a whole one, over a flight."""


def replay_in_shares(path: Path, mechanics: str = "") -> Outcome | None:
    """The outcome of a record whose every command is the same; None when it is to be replayed in one go."""
    processes = min(os.cpu_count() or 1, _MOST)
    if processes == 1 or not path.is_file() or path.stat().st_size < _WORTH_BYTES:
        return None
    count = Reader(path).count(FACTS)
    if count is None:
        return None
    work = functools.partial(share, path, mechanics)
    whole = Outcome()
    with multiprocessing.get_context("spawn").Pool(processes) as pool:  # leaving it ends whoever is still at work
        for part in pool.imap_unordered(work, stretches(count, processes)):
            if part is None:
                return None
            whole.cycles += part.cycles
            whole.same += part.same
            whole.seconds = max(whole.seconds, part.seconds)
            whole.recorded += part.recorded
    whole.recorded.sort(key=_when)
    whole.now = list(whole.recorded)
    return whole if whole.cycles == count else None


def _when(move: Moved) -> float:
    return move.seconds


def stretches(count: int, processes: int) -> list[tuple[int, int]]:
    """First cycle of each process and of the next one: the later it begins, the more it has to follow before."""
    sizes = [(1.0 - _FOLLOWED) ** k for k in range(processes)]
    ends = [round(count * sum(sizes[: k + 1]) / sum(sizes)) for k in range(processes)]
    return list(itertools.pairwise([0, *ends]))


def share(path: Path, mechanics: str, stretch: tuple[int, int]) -> Outcome | None:
    """What a process does; None when it found something that only a replay in one go can tell.

    Args:
        path: of the record.
        mechanics: as for `replay`.
        stretch: its first cycle, and the next process'.
    """
    first, end = stretch
    try:
        reader = Reader(path)
        recorded = reader.versions.get("mechanics", "numpy")
        outcome = Outcome()
        fast = mechanics_of(mechanics or recorded, recorded, outcome.why)
        way = _Way(Runner(outcome, None, fast), first, end)
        before: Written | None = None
        for found in written(reader):
            if not isinstance(found, Written):
                if before is not None:  # not worth the trouble: parameters hardly ever change in flight
                    return None
                way.runner.configure(found)
                continue
            if found.number != (0 if before is None else before.number + 1):
                return None
            if before is None:
                way.begin(cycle_of(found))
            elif not way.take(before, found.state) or not outcome.identical:
                return None
            before = found
            if found.number == end:
                return outcome
        if before is not None:
            way.runner.take(cycle_of(before))
    except (ArmError, LookupError, TypeError, ValueError):  # memory of another version, or none, has any of these
        return None
    return outcome if outcome.identical and not reader.remarks else None


class _Way:
    """One process' way through the record, of which it runs the cycles from `first` on and before `end`."""

    def __init__(self, runner: Runner, first: int, end: int) -> None:
        self.runner = runner
        self._first = first
        self._end = end
        self._solved = State().prediction  # the last one, with the equilibria that were found since the first cycle
        self._solved_t: float | None = None  # its loop time

    def begin(self, cycle: Cycle) -> None:
        """At the record's first cycle."""
        self.runner.start = cycle.t
        self.runner.resume(build(State, orjson.loads(cycle.state)), cycle.number)

    def take(self, written: Written, after: bytes) -> bool:
        """A cycle, with the memory recorded after it; False when something differs."""
        return self._run(written, after) if written.number >= self._first else self._follow(written, after)

    def _run(self, written: Written, after: bytes) -> bool:
        runner = self.runner
        runner.take(cycle_of(written))
        state = runner.state
        if state is None:
            return False
        solved = state.prediction is not self._solved
        self._solved = state.prediction
        # others start from what is recorded here
        return not (solved or written.number + 1 == self._end) or orjson.dumps(plain(state)) == after

    def _follow(self, written: Written, after: bytes) -> bool:
        mine_is_next = written.number + 1 == self._first
        table = orjson.loads(after)
        solved_t = (table["prediction"] or {"t": None})["t"]
        solved, self._solved_t = solved_t not in (None, self._solved_t), solved_t
        if not (solved or mine_is_next):
            return True
        state = build(State, table)
        if solved and state.prediction is not None and self.runner.parameters is not None:
            cycle = cycle_of(written)
            s = Situation(replace(state, prediction=self._solved), cycle.facts, cycle.t, self.runner.parameters)
            free, known, _ = equilibria(s)
            self._solved = replace(state.prediction, free=free, anchored=known)
        if mine_is_next:
            self.runner.resume(replace(state, prediction=self._solved), self._first)
        return True
