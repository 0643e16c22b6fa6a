"""The daemon's record on disk, written by a thread of its own behind a bounded queue.

The loop's part of a cycle is one entry into the queue. A slow disk costs records, a full one the rest of the record
until there is room again; both are counted and told, and neither ever costs a cycle.
"""

import collections
import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from arm_companion.config.schema import Config, RecordConfig
from arm_companion.config.table import as_table
from arm_companion.mission.facts import Notice
from arm_companion.record import storage
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.recorder import Frame, Record, Recorder
from arm_companion.record.topics import (
    COMMANDS,
    CONFIGURATION,
    FACTS,
    LOG,
    RAW,
    STATE,
    TRANSITIONS,
    log_message,
    transition,
)
from arm_companion.record_codec import plain

log = logging.getLogger(__name__)

_QUEUE: Final = 1000
"""Cycles that wait for the disk: five seconds at 200 Hz."""
_SYNC_S: Final = 2.0
_RETRY_S: Final = 10.0
_RAW_S: Final = 1.0
_JOIN_S: Final = 0.05
"""Raw bytes of a pipe that are one message of the record."""
_BREATH_S: Final = 0.001
_GATHER_S: Final = 0.025
_FEW: Final = 10
_MB: Final = 1_000_000


@dataclass(slots=True)
class _Batch:
    """What came since the last cycle, and the cycle that ends it."""

    configs: list[tuple[float, Config]] = field(default_factory=list)
    notices: list[tuple[float, Notice]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    record: Record | None = None
    sequence: int = 0
    last: bool = False

    @property
    def t(self) -> float | None:
        if self.record is not None:
            return self.record.t
        return next((item[0] for item in (*self.configs, *self.notices)), None)


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
        self._versions = dict(versions)
        self._unix = unix
        self._patient = patient
        self._open_file = open_file
        self._queue: queue.Queue[_Batch] = queue.Queue(_QUEUE)
        self._batch = _Batch()
        self._sequence = 0
        self._raw_left = 0.0
        self._raw_since = float("-inf")
        self._raw_lost = False
        self._troubles: collections.deque[str] = collections.deque(maxlen=16)
        self._slow = False
        # what follows is the thread's alone
        self._file: McapFile | None = None
        self._parts = 0
        self._begun = ""
        self._frames: list[Frame] = []
        self._config: Config | None = None
        self._synced = self._retry_at = float("-inf")
        self._failing = False
        self._breath = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    # --- called on the loop ---

    def configure(self, t: float, config: Config) -> None:
        """See `Recorder`."""
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
        """Queue the cycle with all that came since the one before, or count it as dropped."""
        self._batch.record = record
        self._batch.sequence = self._sequence
        self._sequence += 1
        batch, self._batch = self._batch, _Batch()
        if self._patient:
            self._queue.put(batch)
            return
        try:
            self._queue.put_nowait(batch)
        except queue.Full:
            self.dropped += 1
            self._batch.configs = batch.configs  # without these no replay; what was said is small, too
            self._batch.notices = batch.notices[-100:]
            if not self._slow:
                self._slow = True
                self._troubles.append("record: the disk is too slow, cycles are missing")
            return
        if self._slow and self._queue.qsize() < _QUEUE // 2:
            self._slow = False
            self._troubles.append(f"record: complete again, {self.dropped} cycles are missing")

    def troubles(self) -> list[str]:
        """See `Recorder`."""
        texts = []
        while self._troubles:
            texts.append(self._troubles.popleft())
        return texts

    def close(self) -> None:
        """Write what is queued; give up on a disk that hangs."""
        self._batch.last = True
        try:
            self._queue.put(self._batch, timeout=1.0)
        except queue.Full:
            log.warning("record: the disk does not take the last cycles")
            return
        self._thread.join(timeout=None if self._patient else 5.0)
        for text in self.troubles():
            log.warning("%s", text)
        if self.dropped:
            log.warning("record: %d cycles are missing", self.dropped)

    # --- the thread ---

    def _run(self) -> None:
        while True:
            batch = self._queue.get()
            try:
                self._take(batch)
            except OSError as error:
                self._fail(batch, error)
            except Exception:
                log.exception("record: a cycle could not be written")
                self.dropped += 1
            if batch.last:
                break
            if not self._patient:
                self._rest()
        self._finish()

    def _rest(self) -> None:
        """Leave the interpreter to the cycle.

        To wake up costs as much as to write a cycle, so a few are gathered; few, because the cycle waits for the
        lock while they are encoded. With a long backlog every one is followed by a pause.
        """
        waiting = self._queue.qsize()
        if waiting == 0:
            self._breath.wait(_GATHER_S)
        elif waiting > _FEW:
            self._breath.wait(_BREATH_S)

    def _take(self, batch: _Batch) -> None:
        if batch.configs:
            self._config = batch.configs[-1][1]
        t = batch.t
        if t is None:
            return
        if self._file is None:
            if t < self._retry_at:
                self.dropped += batch.record is not None
                return
            self._next_part(t)
        file = self._file
        if file is None:
            return
        self._write(file, batch)
        if file.size > self._options.part_mb * _MB:
            self._finish()
            self._next_part(t)
        elif t - self._synced > _SYNC_S:
            self._synced = t
            file.sync()
            if storage.free_mb(self._first.parent) < self._options.keep_free_mb:
                self._make_room()

    def _write(self, file: McapFile, batch: _Batch) -> None:
        for t, config in batch.configs:
            self._write_config(file, t, config)
        for t, notice in batch.notices:
            now = self._ns(t)
            file.json(LOG, now, log_message(now, notice))
            change = transition(notice.text)
            if change is not None:
                before, after, cause = change
                file.json(TRANSITIONS, now, {"t": t, "before": before, "after": after, "cause": cause})
        self._frames += batch.frames
        if self._frames and self._frames[-1].t - self._frames[0].t >= _JOIN_S:
            self._write_frames(file)
        if (record := batch.record) is not None:
            now = self._ns(record.t)
            stamp = {"t": record.t}
            file.json(FACTS, now, stamp | plain(record.facts), batch.sequence)
            file.json(STATE, now, plain(record.state), batch.sequence)
            file.json(COMMANDS, now, stamp | plain(record.commands), batch.sequence)

    def _write_frames(self, file: McapFile) -> None:
        frames, self._frames = self._frames, []
        for (pipe, sent), some in _joined(frames).items():
            way = "sent" if sent else "received"
            file.raw(f"{RAW}{pipe}/{way}", self._ns(some[0].t), b"".join([frame.data for frame in some]))

    def _write_config(self, file: McapFile, t: float, config: Config) -> None:
        file.json(CONFIGURATION, self._ns(t), {"t": t, "config": as_table(config)})

    def _next_part(self, t: float) -> None:
        self._first.parent.mkdir(parents=True, exist_ok=True)
        self._parts += 1
        self._make_room()
        self._begun = self._begun or str(self._ns(t))  # ties the parts together
        path = storage.part(self._first, self._parts)
        self._file = self._open_file(path, {**self._versions, "part": str(self._parts), "begun": self._begun})
        self._synced = t
        if self._config is not None and self._parts > 1:
            self._write_config(self._file, t, self._config)
        if self._failing:
            self._failing = False
            self._troubles.append(f"record: goes on in {path.name}, {self.dropped} cycles are missing")

    def _make_room(self) -> None:
        present = storage.part(self._first, self._parts)
        options = self._options
        for file in storage.make_room(self._first, present, options.budget_mb, options.keep_free_mb):
            log.info("record: %s deleted, the disk budget is used up", file)
        if storage.free_mb(self._first.parent) < options.keep_free_mb:
            raise OSError(f"less than {options.keep_free_mb:g} MB are free")

    def _fail(self, batch: _Batch, error: OSError) -> None:
        self.dropped += batch.record is not None
        if self._file is not None:
            self._file.abandon()
            self._file = None
        self._frames.clear()
        self._retry_at = (batch.t or 0.0) + _RETRY_S
        if not self._failing:
            self._failing = True
            self._troubles.append(f"record stopped: {error.strerror or error}")

    def _finish(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            self._write_frames(file)
            file.close()
        except OSError as error:
            file.abandon()
            self._troubles.append(f"record: its last cycles are lost: {error.strerror or error}")

    def _ns(self, t: float) -> int:
        return round(self._unix(t) * 1e9)


def _joined(frames: list[Frame]) -> dict[tuple[str, bool], list[Frame]]:
    """Frames by pipe and direction: one message for each, since a message costs more than its bytes."""
    found: dict[tuple[str, bool], list[Frame]] = {}
    for frame in frames:
        found.setdefault((frame.pipe, frame.sent), []).append(frame)
    return found
