"""The state directory: calibrations, and where the servos last stood. Files are replaced whole, never half written."""

import asyncio
import json
import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from arm_companion.drivers.calibration import VERSION, TendonCalibration, TensionCalibration
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.writer import Writer
from arm_companion.last_writes import Ending, wait_for
from arm_companion.record_codec import dumps, loads

_log = logging.getLogger(__name__)

TENDONS, TENSION, PARKED = "tendons.json", "tension.json", "parked.json"
_NOTE_EVERY_S = 1.0
_MOVED_TICKS = 8
_STILL_TICKS_PER_S = 20.0
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Parked:
    """Where servos stood when they were last seen to know their turns: ids, and ticks of each."""

    ids: tuple[int, ...]
    ticks: tuple[int, ...]

    def by_id(self) -> dict[int, int]:
        """Ticks by id."""
        return dict(zip(self.ids, self.ticks, strict=True))


def save(path: Path, value: object) -> None:
    """Write a value as readable JSON, in one step: a power loss leaves the old file or the new one.

    Raises:
        OSError: the directory cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(".new")
    with fresh.open("w", encoding="utf-8") as stream:
        stream.write(json.dumps(json.loads(dumps(value)), indent=2) + "\n")
        stream.flush()
        os.fsync(stream.fileno())
    fresh.replace(path)


def read(cls: type[T], path: Path) -> T | None:
    """The value that `save` wrote; None when there is no such file.

    Raises:
        ValueError: the file is damaged, cannot be read or is of another version; the message is for people.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    try:
        value = loads(cls, text)
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if (version := getattr(value, "version", VERSION)) != VERSION:
        raise ValueError(f"{path} is of version {version}, not {VERSION}")
    return value


def tendons(directory: str) -> TendonCalibration | str:
    """The tendons' calibration; or in words why it cannot be used, empty when there is none."""
    if not directory:
        return ""
    try:
        found = read(TendonCalibration, Path(directory) / TENDONS)
    except ValueError as error:
        return str(error)
    if found is not None and not found.tendons:
        return f"{Path(directory) / TENDONS} holds no tendon"
    return "" if found is None else found


def tension(directory: str) -> TensionCalibration | None:
    """The tensions' calibration.

    Raises:
        ValueError: there is one that cannot be used.
    """
    return read(TensionCalibration, Path(directory) / TENSION) if directory else None


def parked(directory: str) -> dict[int, int]:
    """Where servos last stood, ticks by id; what cannot be read is as good as unknown."""
    try:
        found = read(Parked, Path(directory) / PARKED) if directory else None
        return {} if found is None else found.by_id()
    except ValueError as error:
        _log.warning("%s", error)
        return {}


class ParkingLog:
    """Keeps `parked.json` up to date, so that a servo that is turned without power is found out.

    Writes happen in a thread, at most once a second, and only when a servo that stands has moved since. A disk that
    fails is told once and costs nothing else.
    """

    def __init__(self, directory: str, known: Mapping[int, int]) -> None:
        self._path = Path(directory) / PARKED if directory else None
        self._known = dict(known)
        self._next_at = 0.0
        self._failed = False
        self._writer = Writer("parking log") if directory else None
        self._writing: Future[None] | None = None

    def note(self, servos: Sequence[ServoState]) -> None:
        """Look at the servos; called once a cycle."""
        if self._writer is None or not servos or (self._writing is not None and not self._writing.done()):
            return
        now = asyncio.get_running_loop().time()
        if now < self._next_at:
            return
        self._next_at = now + _NOTE_EVERY_S
        if self._take(servos):
            self._writing = self._writer.submit(self._save)

    def end(self, servos: Sequence[ServoState] = ()) -> list[Ending]:
        """Have it written where the servos stand at the end; nothing waits here."""
        writer, self._writer = self._writer, None
        if writer is None:
            return []
        self._take(servos)
        writer.submit(self._save)
        return writer.end()

    def close(self, servos: Sequence[ServoState] = ()) -> None:
        """Write where the servos stand at the end, unless the disk hangs."""
        wait_for(self.end(servos))

    def _take(self, servos: Sequence[ServoState]) -> bool:
        """Whether a servo that is known, and stands, stands elsewhere than noted."""
        changed = False
        for servo in servos:
            known = not (servo.turns_lost or servo.silent) and servo.ready
            if known and abs(servo.speed) < _STILL_TICKS_PER_S:
                changed |= abs(servo.position - self._known.get(servo.id, 1 << 30)) > _MOVED_TICKS
                if changed:
                    self._known[servo.id] = servo.position
        return changed

    def _save(self) -> None:
        if self._path is None:
            return
        known = dict(self._known)
        try:
            save(self._path, Parked(tuple(known), tuple(known.values())))
        except OSError as error:
            if not self._failed:
                _log.warning("where the servos stand cannot be kept: %s", error)
            self._failed = True
