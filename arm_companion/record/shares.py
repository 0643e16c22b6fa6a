"""A replay in shares, each in a process of its own, for a record that is expected to come out the same.

A cycle follows from the memory before it. That is recorded, all but where the solver starts, which comes of every solve
since the first cycle; so each process solves the equilibria of all cycles from recorded memory, which is the smaller
part, and runs whole cycles in its own stretches of the flight. What it calculates there, memory included, must be what
is recorded: then the others have started from the right place as well, and all shares together are the whole replay.
Where anything differs there is no answer, and the record is to be replayed in one go, which says what and why.
"""

import functools
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
from arm_companion.record.replay import Cycle, Moved, Outcome, Runner, cycles, mechanics_of
from arm_companion.record_codec import build, plain
from arm_companion.values import replace

_STRETCH: Final = 1000
"""Cycles in a row of one process."""


_WORTH_BYTES: Final = 4_000_000
"""A shorter record, half a minute or so, is replayed before all processes have started."""

_MOST: Final = 4
"""Processes; more of them would mostly solve the same equilibria."""


def replay_in_shares(path: Path, mechanics: str = "") -> Outcome | None:
    """The outcome of a record whose every command is the same; None when it is to be replayed in one go."""
    processes = min(os.cpu_count() or 1, _MOST)
    if processes == 1 or not path.is_file() or path.stat().st_size < _WORTH_BYTES:
        return None
    work = functools.partial(share, path, mechanics, processes)
    whole = Outcome()
    with multiprocessing.get_context("spawn").Pool(processes) as pool:  # leaving it ends whoever is still at work
        for part in pool.imap_unordered(work, range(processes)):
            if part is None:
                return None
            whole.cycles += part.cycles
            whole.same += part.same
            whole.seconds = max(whole.seconds, part.seconds)
            whole.recorded += part.recorded
    whole.recorded.sort(key=_when)
    whole.now = list(whole.recorded)
    return whole if whole.cycles else None


def _when(move: Moved) -> float:
    return move.seconds


def share(path: Path, mechanics: str, processes: int, k: int) -> Outcome | None:
    """What the k-th of the processes does; None when it found something that only a replay in one go can tell."""
    try:
        reader = Reader(path)
        recorded = reader.versions.get("mechanics", "numpy")
        outcome = Outcome()
        fast = mechanics_of(mechanics or recorded, recorded, outcome.why)
        way = _Way(Runner(outcome, None, fast), processes, k)
        before: Cycle | None = None
        for found in cycles(reader):
            if not isinstance(found, Cycle):
                if before is not None:  # not worth the trouble: parameters hardly ever change in flight
                    return None
                way.runner.configure(found)
                continue
            if found.number != (0 if before is None else before.number + 1):
                return None
            if before is None:
                way.begin(found)
            elif not way.take(before, found.state) or not outcome.identical:
                return None
            before = found
        if before is not None and way.owns(before.number):
            way.runner.take(before)
    except (ArmError, LookupError, TypeError, ValueError):  # memory of another version, or none, has any of these
        return None
    return outcome if outcome.identical and not reader.remarks else None


class _Way:
    """One process' way through the record."""

    def __init__(self, runner: Runner, processes: int, k: int) -> None:
        self.runner = runner
        self._k = k
        self._processes = processes
        self._solved = State().prediction  # the last one, with the equilibria that were found since the first cycle

    def owns(self, number: int) -> bool:
        """Whether this process runs the whole of a cycle."""
        return number // _STRETCH % self._processes == self._k

    def begin(self, first: Cycle) -> None:
        """At the first cycle."""
        self.runner.start = first.t
        self.runner.resume(build(State, orjson.loads(first.state)), first.number)

    def take(self, cycle: Cycle, after: bytes) -> bool:
        """A cycle, with the memory recorded after it; False when something differs."""
        return self._run(cycle, after) if self.owns(cycle.number) else self._solve(cycle, after)

    def _run(self, cycle: Cycle, after: bytes) -> bool:
        runner = self.runner
        runner.take(cycle)
        state = runner.state
        if state is None:
            return False
        solved = state.prediction is not self._solved
        self._solved = state.prediction
        # others start from what is recorded here
        return not (solved or not self.owns(cycle.number + 1)) or orjson.dumps(plain(state)) == after

    def _solve(self, cycle: Cycle, after: bytes) -> bool:
        mine_is_next = self.owns(cycle.number + 1)
        table = orjson.loads(after)
        solved = (table["prediction"] or {"t": None})["t"] == cycle.t
        if not (solved or mine_is_next):
            return True
        state = build(State, table)
        if solved and state.prediction is not None and self.runner.parameters is not None:
            s = Situation(replace(state, prediction=self._solved), cycle.facts, cycle.t, self.runner.parameters)
            free, known, _ = equilibria(s)
            self._solved = replace(state.prediction, free=free, anchored=known)
        if mine_is_next:
            self.runner.resume(replace(state, prediction=self._solved), cycle.number + 1)
        return True
