"""The daemon's record on disk, written by a thread of its own behind a bounded queue.

The loop puts cycles into words, a few at a time, since the first takes three times as long as those right behind it.
What is left to the thread, compression above all, hardly needs the interpreter, for which the next cycle would have to
wait. A slow disk costs records, a full one the rest of the record until there is room again; both are counted and told,
and neither ever costs a cycle.
"""

import collections
import logging
import secrets
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from arm_companion.config.schema import Config, RecordConfig
from arm_companion.config.table import as_table
from arm_companion.last_writes import Ending
from arm_companion.mission.facts import Notice
from arm_companion.record import storage
from arm_companion.record.batch import Batch, WrittenCycle, in_words
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.recorder import FailedCycle, Frame, Record, Recorder
from arm_companion.record.starts import starts_text
from arm_companion.record.topics import (
    CONFIGURATION,
    FACTS,
    LOG,
    RAW,
    STARTS,
    STATE,
    TRANSITIONS,
    bytes_message,
    log_message,
    transition,
)

log = logging.getLogger(__name__)

_TOGETHER: Final = 10
"""Cycles that are put into words at once: half a millisecond of the last one's time."""
_QUEUE: Final = 100
"""Batches of so many cycles that wait for the disk: five seconds at 200 Hz."""
_STARTS_S: Final = 10.0
"""So often does it stand in the record where the solver starts."""
_SYNC_S: Final = 2.0
_RETRY_S: Final = 10.0
_RAW_S: Final = 1.0
_GATHER_S: Final = 0.1
"""So often does the thread wake up."""
_SWITCH_S: Final = 0.0005
"""So long does a cycle wait at most for the interpreter while the thread has it."""
_AT_ONCE: Final = 10
_BREATH_S: Final = 0.001
"""Pause after each batch of a longer backlog, and while the queue of a patient recorder is full."""
_MB: Final = 1_000_000


class FileRecorder(Recorder):
    """Writes a record in parts.

    Args:
        path: of the first part.
        options: size of a part, budget, and what of the raw bytes is kept.
        versions: what the record is of.
        unix: Unix time, s, of a loop time.
        patient: wait for the disk when the queue is full, for simulated time, which outruns any disk.
        open_file: makes the file of a part.
    """

    def __init__(
        self,
        path: Path,
        options: RecordConfig,
        versions: dict[str, str],
        unix: Callable[[float], float],
        *,
        patient: bool = False,
        open_file: Callable[[Path, dict[str, str]], McapFile] = McapFile,
    ) -> None:
        self.raw = options.raw
        self.dropped = 0
        """Cycles that the disk has cost."""
        self._first = path
        self._options = options
        # several fit into the budget, so that making room for the next leaves something of the flight
        self._part_mb = min(options.part_mb, 0.25 * options.budget_mb) if options.budget_mb else options.part_mb
        self._versions = dict(versions)
        self._unix = unix
        self._patient = patient
        self._open_file = open_file
        self._queue: collections.deque[Batch] = collections.deque()
        self._batch = Batch()
        self._records: list[Record | FailedCycle] = []
        self._sequence = 0
        self._starts_at = float("-inf")
        self._raw_left = 0.0
        self._raw_since = float("-inf")
        self._raw_lost = False
        self._troubles: collections.deque[str] = collections.deque(maxlen=16)
        self._slow = False
        self._ending = False
        # what follows is the thread's alone
        self._file: McapFile | None = None
        self._parts = 0
        self._done = 0  # batches
        self._saved = 0  # cycles of the files before the present one
        self._given = 0  # cycles of the present file, or of the one that is to be opened
        self._begun = ""
        self._config: Config | None = None
        self._now = self._synced = self._retry_at = float("-inf")
        self._failing = False
        self._hurry = threading.Event()
        self._breath = threading.Event()  # never set
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        sys.setswitchinterval(_SWITCH_S)

    # --- called on the loop ---

    def configure(self, t: float, config: Config) -> None:
        """See `Recorder`."""
        if self._records:  # of the configuration before
            self._flush()
        self._batch.configs.append((t, config))

    def mechanics(self, name: str) -> None:
        """See `Recorder`."""
        self._versions["mechanics"] = name

    def notice(self, t: float, notice: Notice) -> None:
        """See `Recorder`."""
        self._batch.notices.append((t, notice))

    def frame(self, frame: Frame) -> None:
        """Take raw bytes, as many each second as the options allow."""
        if frame.t - self._raw_since >= _RAW_S:
            self._raw_since, self._raw_left = frame.t, 1e3 * self._options.raw_kb_per_s
        self._raw_left -= len(frame.data)
        if self._raw_left >= 0.0:
            self._batch.frames.append(frame)
        elif not self._raw_lost:
            self._raw_lost = True
            self._troubles.append(f"record: raw bytes beyond {self._options.raw_kb_per_s:g} kB/s are left out")

    def put(self, record: Record) -> None:
        """Take the cycle, or count it as dropped."""
        self._add(record)

    def failed(self, cycle: FailedCycle) -> None:
        """Take the cycle, or count it as dropped."""
        self._add(cycle)

    def _add(self, record: Record | FailedCycle) -> None:
        self._records.append(record)
        if len(self._records) >= _TOGETHER:
            self._flush()

    def _flush(self) -> None:
        """Queue the cycles with all that came since those before."""
        records, self._records = self._records, []
        first, self._sequence = self._sequence, self._sequence + len(records)
        while self._patient and len(self._queue) >= _QUEUE:
            self._hurry.set()
            self._breath.wait(_BREATH_S)
        if len(self._queue) >= _QUEUE:
            self._lose(len(records))
            self._batch.notices = self._batch.notices[-100:]  # they are small, and without configurations no replay
            self._batch.frames.clear()
            if not self._slow:
                self._slow = True
                self._troubles.append("record: the disk is too slow, cycles are missing")
            return
        batch, self._batch = self._batch, Batch()
        batch.cycles = [cycle for i, record in enumerate(records) if (cycle := self._in_words(first + i, record))]
        self._queue.append(batch)
        if self._slow and len(self._queue) < _QUEUE // 2:
            self._slow = False
            self._troubles.append(f"record: complete again, {self.dropped} cycles are missing")

    def _in_words(self, sequence: int, record: Record | FailedCycle) -> WrittenCycle | None:
        try:
            return in_words(sequence, record, self._starts(record))
        except Exception:
            log.exception("record: a cycle could not be put into words")
            self._lose(1)
            return None

    def _starts(self, record: Record | FailedCycle) -> bytes:
        """Where the solver starts in this cycle, when that is due."""
        if record.state.prediction is None or 0.0 <= record.t - self._starts_at < _STARTS_S:
            return b""
        self._starts_at = record.t
        return starts_text(record.state, record.t)

    def _lose(self, cycles: int) -> None:
        """Count cycles that will be missing; a replay can go on behind them from the next start."""
        self.dropped += cycles
        self._starts_at = float("-inf")

    def troubles(self) -> list[str]:
        """See `Recorder`."""
        texts = []
        while self._troubles:
            texts.append(self._troubles.popleft())
        return texts

    def end(self) -> list[Ending]:
        """See `Recorder`."""
        self._flush()
        self._ending = True
        self._queue.append(Batch(last=True))
        self._hurry.set()
        return [Ending(self._thread, lambda: self._done, self._tell, self._patient)]

    def _tell(self, ended: bool) -> None:
        """Log what the disk has cost."""
        if not ended:
            file = self._file
            saved = self._saved + (file.count(FACTS) if file is not None else 0)
            lost = self._sequence - self.dropped - saved
            log.error("record: the disk does not answer; the last %d cycles are lost", lost)
        for text in self.troubles():
            log.warning("%s", text)
        if self.dropped:
            log.warning("record: %d cycles are missing", self.dropped)

    # --- the thread ---

    def _run(self) -> None:
        ended = False
        while not ended:
            self._hurry.wait(_GATHER_S)
            self._hurry.clear()
            ended = self._write_queued()
        self._finish()

    def _write_queued(self) -> bool:
        """Write what waits; whether it ended with the record's last."""
        behind = len(self._queue) > _AT_ONCE and not self._patient
        while self._queue:
            batch = self._queue.popleft()
            try:
                self._take(batch)
            except OSError as error:
                self._fail(error)
            except Exception:
                log.exception("record: cycles could not be written")
                self._lose(len(batch.cycles))
            self._done += 1
            if batch.last:
                return True
            if behind:  # leave the interpreter to the cycle
                self._breath.wait(_BREATH_S)
        return False

    def _take(self, batch: Batch) -> None:
        if batch.configs:
            self._config = batch.configs[-1][1]
        t = batch.t
        if t is None:
            return
        self._now = t
        if self._file is not None and self._file.size > self._part_mb * _MB:
            if batch.resumable:
                self._finish()
            else:  # it soon comes; a part that could not be replayed alone is worth less than its budget
                self._starts_at = float("-inf")
        if self._file is None:
            if t < self._retry_at:
                self._lose(len(batch.cycles))
                return
            self._given = len(batch.cycles)
            self._next_part(t)
        else:
            self._given += len(batch.cycles)
        file = self._file
        if file is None:
            return
        self._write(file, batch)
        if t - self._synced > _SYNC_S:
            self._synced = t
            self._sync(file)

    def _sync(self, file: McapFile) -> None:
        """Every few seconds: what a power cut would take, and what is left of the disk."""
        if not self._ending:  # what the kernel has by then it writes without us
            file.sync()
        if storage.free_mb(self._first.parent) < self._options.keep_free_mb:
            self._make_room(storage.part(self._first, self._parts))

    def _write(self, file: McapFile, batch: Batch) -> None:
        for t, config in batch.configs:
            self._write_config(file, t, config)
        for t, notice in batch.notices:
            now = self._ns(t)
            file.json(LOG, now, log_message(now, notice))
            change = transition(notice.text)
            if change is not None:
                before, after, cause = change
                file.json(TRANSITIONS, now, {"t": t, "before": before, "after": after, "cause": cause})
        for frame in batch.frames:
            way = "sent" if frame.sent else "received"
            file.json(f"{RAW}{frame.pipe}/{way}", self._ns(frame.t), bytes_message(frame.t, frame.data))
        for cycle in batch.cycles:
            now = self._ns(cycle.t)
            if cycle.starts:
                file.text(STARTS, now, cycle.starts, cycle.sequence)
            file.text(FACTS, now, cycle.facts, cycle.sequence)
            file.text(STATE, now, cycle.state, cycle.sequence)
            file.text(cycle.topic, now, cycle.outcome, cycle.sequence)

    def _write_config(self, file: McapFile, t: float, config: Config) -> None:
        file.json(CONFIGURATION, self._ns(t), {"t": t, "config": as_table(config)})

    def _next_part(self, t: float) -> None:
        self._first.parent.mkdir(parents=True, exist_ok=True)
        path = storage.part(self._first, self._parts + 1)
        self._make_room(path)
        goes_on = bool(self._begun)
        # ties the parts together, and to no others of this name: every simulated flight begins at the same time
        self._begun = self._begun or f"{self._ns(t)}-{secrets.token_hex(4)}"
        self._file = self._open_file(path, {**self._versions, "part": str(self._parts + 1), "begun": self._begun})
        self._parts += 1
        self._synced = t
        if self._config is not None and goes_on:
            self._write_config(self._file, t, self._config)
        if self._failing:
            self._failing = False
            self._troubles.append(f"record: goes on in {path.name}, {self.dropped} cycles are missing")

    def _make_room(self, present: Path) -> None:
        options = self._options
        for file in storage.make_room(self._first, present, self._part_mb, options.budget_mb, options.keep_free_mb):
            log.info("record: %s deleted, the disk budget is used up", file)
        if storage.free_mb(self._first.parent) < options.keep_free_mb:
            self._finish()
            raise OSError(f"less than {options.keep_free_mb:g} MB are free")

    def _fail(self, error: OSError) -> None:
        self._abandon()
        self._retry_at = self._now + _RETRY_S
        if not self._failing:
            self._failing = True
            self._troubles.append(f"record stopped: {error.strerror or error}")

    def _finish(self) -> None:
        file = self._file
        if file is None:
            return
        try:
            file.close()
        except OSError as error:
            self._abandon()
            self._troubles.append(f"record: its last cycles are lost: {error.strerror or error}")
        else:
            self._saved += file.count(FACTS)
        self._file, self._given = None, 0

    def _abandon(self) -> None:
        """Leave the present file, or give up the one that could not be opened, without what is not in a whole chunk."""
        file, self._file = self._file, None
        saved = 0
        if file is not None:
            file.abandon()
            saved = file.count(FACTS)
            self._saved += saved
            self._parts -= not saved  # a reader looks for part after part, and the next try takes the same file
        self._lose(self._given - saved)
        self._given = 0

    def _ns(self, t: float) -> int:
        return round(self._unix(t) * 1e9)
