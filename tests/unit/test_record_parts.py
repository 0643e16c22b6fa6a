"""A part of a record alone: on a long flight the first ones are deleted, and the rest is to be replayed too."""

import dataclasses
import errno
import functools
import itertools
import json
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import pytest

from arm_companion.__main__ import main
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import Config, RecordConfig
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import State
from arm_companion.record import shares, storage
from arm_companion.record.file_recorder import FileRecorder
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.reader import Reader
from arm_companion.record.recorder import Record
from arm_companion.record.replay import cycles, replay
from arm_companion.record.topics import COMMANDS, FACTS
from arm_companion.record.versions import versions

GOLDEN = Path(__file__).parents[1] / "golden" / "perch.mcap"
CYCLES = 450


@functools.cache
def flight() -> tuple[Config, list[Record]]:
    """What today's code makes of the golden flight's beginning."""
    state, parameters, found = State(), None, []
    for item in itertools.islice(cycles(Reader(GOLDEN)), CYCLES + 1):
        if isinstance(item, Config):
            parameters = Parameters(item, RodModel(ArmParameters.of(item.arm)))
            continue
        assert parameters is not None
        before = state
        state, commands = step(state, item.facts, item.t, parameters)
        found.append(Record(item.t, item.facts, before, commands))
    assert parameters is not None
    return parameters.config, found


def write(path: Path, options: RecordConfig, open_file: type[McapFile] = McapFile) -> FileRecorder:
    """The flight, no faster than the disk takes it, as a real one."""
    config, records = flight()
    made = FileRecorder(path, options, versions(config), lambda t: 1.7e9 + t, patient=True, open_file=open_file)
    made.configure(records[0].t, config)
    made.mechanics("numpy")
    nap = threading.Event()
    for i, record in enumerate(records):
        made.put(record)
        while i % 10 == 9 and made._queue:
            made._hurry.set()
            nap.wait(0.001)
    made.close()
    assert made.troubles() == []
    return made


def parts_of(path: Path) -> list[Path]:
    found = [path]
    while storage.following(found[-1]).is_file():
        found.append(storage.following(found[-1]))
    return found


def commands_of(path: Path) -> Iterator[tuple[int, bytes]]:
    return ((item.sequence, item.data) for item in Reader(path).messages((COMMANDS,)))


@pytest.mark.parametrize("part_mb", [0.001, 0.06, 0.15])
def test_every_part_is_replayed_alone_as_it_is_in_the_whole(tmp_path: Path, part_mb: float) -> None:
    path = tmp_path / "r.mcap"
    write(path, RecordConfig(part_mb=part_mb))
    parts = parts_of(path)
    assert len(parts) >= 2
    whole = replay(Reader(path))
    assert whole.identical, whole.first
    assert whole.begins == 0
    assert whole.cycles == CYCLES
    everything = list(commands_of(path))
    ends = []
    for part in parts:
        outcome = replay(Reader(part))
        assert outcome.identical, (part.name, outcome.first, outcome.why)
        ends.append(outcome.begins + outcome.cycles)
        assert list(commands_of(part)) == everything[outcome.begins :]
        assert outcome.now == [
            dataclasses.replace(move, seconds=pytest.approx(move.seconds - whole.seconds + outcome.seconds))
            for move in whole.now[len(whole.now) - len(outcome.now) :]
        ]
    assert ends == [CYCLES] * len(parts), "each goes on to the flight's end with the parts behind it"


def test_a_part_without_those_behind_it_is_replayed_too(tmp_path: Path) -> None:
    """Together they are the flight, and each ends where the next begins."""
    path = tmp_path / "r.mcap"
    write(path, RecordConfig(part_mb=0.06))
    parts, at = parts_of(path), 0
    for number, part in enumerate(parts):
        alone = tmp_path / f"alone{number}.mcap"
        part.rename(alone)
        outcome = replay(Reader(alone))
        assert outcome.identical, (part.name, outcome.first)
        assert outcome.begins == at
        at += outcome.cycles
    assert at == CYCLES


def test_behind_a_full_disk_a_part_begins_that_is_replayed_alone(tmp_path: Path) -> None:
    class Full(McapFile):
        """Once, when this much stands in it."""

        most = 30_000

        def text(self, topic: str, unix_ns: int, data: bytes, sequence: int = 0) -> None:
            super().text(topic, unix_ns, data, sequence)
            if self.size > self.most and topic == FACTS:
                Full.most = 10**9
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "r.mcap"
    made = write(path, RecordConfig(), Full)
    assert made.dropped > 50
    assert replay(Reader(path)).identical, "memory and start stand behind the gap"
    path.unlink()
    outcome = replay(Reader(tmp_path / "r-002.mcap"))
    assert outcome.identical
    assert outcome.begins + outcome.cycles == CYCLES


def test_where_a_replay_begins_in_the_flight_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.mcap"
    write(path, RecordConfig(part_mb=0.06))
    second = tmp_path / "r-002.mcap"
    begin = next(iter(commands_of(second)))[0]
    path.unlink()
    words = f"part 2 of a record, which begins with cycle {begin} of the flight"
    assert main(["replay", str(second)]) == 0
    said = capsys.readouterr().out
    assert words in said
    assert "bit for bit" in said
    assert main(["replay", str(second), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["begins"] == begin
    assert main(["report", str(second), "--output", str(tmp_path / "page")]) == 0
    said = capsys.readouterr().out
    assert words in said
    assert "are missing" not in said
    assert main(["replay", str(path)]) == 1
    assert "the oldest part that is left is r-002.mcap" in capsys.readouterr().err


def test_a_part_is_replayed_on_several_cores_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.mcap"
    write(path, RecordConfig(part_mb=0.04))
    second = tmp_path / "r-002.mcap"
    count = Reader(second).count(FACTS)
    assert count is not None
    begin = CYCLES - count
    found = [shares.share(second, "", stretch) for stretch in shares.stretches(count, 2)]
    assert [share and share.begins for share in found] == [begin, begin]
    both = [share.cycles for share in found if share is not None]
    assert sum(both) == count
    assert min(both) > 0, "the parts behind it begin where one can start"

    class Here:
        """A pool without processes."""

        def __init__(self, _: int) -> None:
            self.imap_unordered = map

        def __enter__(self) -> Self:
            return self

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(shares, "_WORTH_BYTES", 0)
    monkeypatch.setattr(shares.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(shares.multiprocessing, "get_context", lambda _: type("Context", (), {"Pool": Here}))
    outcome, one_go = shares.replay_in_shares(second), replay(Reader(second))
    assert outcome is not None
    assert dataclasses.replace(outcome, seconds=0.0) == dataclasses.replace(one_go, seconds=0.0)
