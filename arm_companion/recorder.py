"""Every cycle's time, facts, memory and commands, one JSON line each, and their replay.

The writing runs in a thread behind a bounded queue: a slow or full disk costs records, which are counted,
never a cycle.
"""

import logging
import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TextIO

from arm_companion.mission.facts import Commands, Facts
from arm_companion.mission.mission import step
from arm_companion.mission.situation import Parameters
from arm_companion.mission.state import State
from arm_companion.record_codec import dumps, loads

log = logging.getLogger(__name__)

_QUEUE = 2000
_END = None


@dataclass(frozen=True, slots=True)
class Record:
    """One cycle: what was known, what was remembered before, and what was asked for."""

    t: float
    facts: Facts
    state: State
    commands: Commands


class Recorder(Protocol):
    """Takes records without ever waiting."""

    def put(self, record: Record) -> None:
        """Take one record."""

    def close(self) -> None:
        """Write what is left and stop."""


class NoRecorder:
    """Records nothing."""

    def put(self, record: Record) -> None:
        """Forget it."""

    def close(self) -> None:
        """Nothing is open."""


class MemoryRecorder:
    """Keeps all records, for tests and simulated time."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def put(self, record: Record) -> None:
        """Keep it."""
        self.records.append(record)

    def close(self) -> None:
        """Nothing is open."""


class FileRecorder:
    """Appends records to a JSON-lines file from a thread of its own."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream: TextIO = path.open("w", encoding="utf-8")
        self._queue: queue.Queue[Record | None] = queue.Queue(_QUEUE)
        self.dropped = 0
        self._failed = False
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def put(self, record: Record) -> None:
        """Queue it, or count it as dropped when the disk cannot keep up."""
        try:
            self._queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what is queued; give up on a disk that hangs."""
        try:
            self._queue.put(_END, timeout=1.0)
        except queue.Full:
            log.warning("recorder: the disk does not take the last records")
            return
        self._thread.join(timeout=5.0)
        if self.dropped:
            log.warning("recorder: %d records dropped", self.dropped)

    def _write(self) -> None:
        while (record := self._queue.get()) is not _END:
            if self._failed:
                self.dropped += 1
                continue
            try:
                self._stream.write(dumps(record) + "\n")
            except OSError:
                log.exception("recorder stopped")
                self._failed = True
        try:
            self._stream.close()
        except OSError:
            log.exception("recorder: the last records are lost")


def read(path: Path) -> Iterator[Record]:
    """All records of a file. A last line that was cut off by a power loss ends the iteration.

    Raises:
        ValueError: a line before the last is damaged.
    """
    with path.open(encoding="utf-8") as stream:
        for line in stream:
            if not line.endswith("\n"):
                return
            yield loads(Record, line)


def replay(records: Iterable[Record], parameters: Parameters) -> tuple[int, Record | None]:
    """Run recorded facts through today's `step`, from the first record's memory on.

    Returns:
        How many cycles gave the same commands bit for bit, and the first record that did not, if any.
    """
    state: State | None = None
    count = 0
    for record in records:
        state, commands = step(record.state if state is None else state, record.facts, record.t, parameters)
        # the text form compares exactly and treats nan as equal to itself
        if dumps(commands) != dumps(record.commands):
            return count, record
        count += 1
    return count, None
