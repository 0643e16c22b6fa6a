"""Cycles whose step raised: they stand in the record, and replay tells whether today's code still fails there."""

import asyncio
import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import orjson
import pytest

from arm_companion import app
from arm_companion.__main__ import main
from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.mission import mission
from arm_companion.record import open_recorder, shares
from arm_companion.record import replay as replay_module
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.reader import Reader
from arm_companion.record.replay import Failed, replay
from arm_companion.record.topics import COMMANDS, FACTS, FAILURES, STATE
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.memory import MemoryPipe
from tests.conftest import MavlinkPeer
from tests.unit.test_daemon_services import config

BUG = "ZeroDivisionError: float division"
FAILING = range(30, 33)


def failing(cycles: range, error: Exception) -> Callable[..., Any]:
    """The mission, but in these cycles it raises."""
    number = itertools.count()

    def step(*arguments: Any) -> Any:
        if next(number) in cycles:
            raise error
        return mission.step(*arguments)

    return step


def bug() -> Exception:
    return ZeroDivisionError("float division")


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Half a second of a daemon that failed in three cycles."""
    path = tmp_path / "r.mcap"
    fly(path, monkeypatch, FAILING)
    return path


def fly(path: Path, monkeypatch: pytest.MonkeyPatch, cycles: range) -> None:
    monkeypatch.setattr(app, "step", failing(cycles, bug()))

    async def serve() -> None:
        settings = config(path.parent)
        peers = {name: MavlinkPeer(1, 1) for name in settings.links}
        openers = Openers({name: peer.pipe.opener(0) for name, peer in peers.items()}, MemoryPipe().opener(0))
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        recorder = open_recorder(path, settings, clock, patient=True)
        daemon = Daemon(settings, openers, clock, ServiceManager(""), recorder)
        stop = asyncio.Event()
        task = asyncio.create_task(daemon.run(stop))
        await asyncio.sleep(0.5)
        stop.set()
        await task

    run_simulated(serve())


def test_a_cycle_that_failed_is_recorded_with_its_error(record: Path) -> None:
    reader = Reader(record)
    found = {topic: {i.sequence: i.data for i in reader.messages((topic,))} for topic in (FACTS, STATE, COMMANDS)}
    failures = {item.sequence: orjson.loads(item.data) for item in reader.messages((FAILURES,))}
    assert list(failures) == list(FAILING)
    assert found[FACTS].keys() == found[STATE].keys()
    assert found[FACTS].keys() - found[COMMANDS].keys() == set(FAILING)
    assert failures[30]["error"] == BUG
    assert re.fullmatch(r"arm_companion\.app:\d+ in _cycle", failures[30]["where"])
    assert failures[30]["t"] == orjson.loads(found[FACTS][30])["t"]
    assert len({found[STATE][i] for i in range(30, 34)}) == 1, "memory stayed as it was"


def test_code_that_fails_in_the_same_way_does_the_same(
    record: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(replay_module, "step", failing(FAILING, bug()))
    outcome = replay(Reader(record))
    assert outcome.identical
    assert not outcome.gaps
    assert [(f.cycle, f.recorded, f.now) for f in outcome.failed] == [(i, BUG, BUG) for i in FAILING]
    monkeypatch.setattr(replay_module, "step", failing(FAILING, bug()))
    assert main(["replay", str(record)]) == 0
    said = capsys.readouterr().out
    assert f"3 cycles failed in flight, from cycle 30, 0.30 s on: {BUG} (" in said
    assert "today's code fails there in the same way" in said


def test_code_that_no_longer_fails_is_told_and_all_else_is_the_same(
    record: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outcome = replay(Reader(record))
    assert outcome.cycles - outcome.same == 3, "memory went on as the daemon's did"
    assert outcome.first is not None
    assert (outcome.first.cycle, outcome.first.field, outcome.first.recorded) == (30, "failure", BUG)
    assert [f.now for f in outcome.failed] == [""] * 3
    assert main(["replay", str(record)]) == 3
    assert "today's code does not fail there" in capsys.readouterr().out
    monkeypatch.setattr(replay_module, "step", failing(FAILING, ValueError("another")))
    outcome = replay(Reader(record))
    assert isinstance(outcome.failed[0], Failed)
    assert outcome.failed[0].now == "ValueError: another"
    assert not outcome.identical
    assert main(["replay", str(record), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["failed"][0]["recorded"] == BUG


def test_a_share_leaves_failed_cycles_to_a_replay_in_one_go(record: Path) -> None:
    assert shares.share(record, "", (0, 20)) is None


def test_a_page_tells_of_failed_cycles(
    record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(record), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["grade"] == "bad"
    (told,) = (point for point in found["points"] if BUG in point)
    assert told.startswith("3 cycles failed, the first at 0.3 s: ")
    assert not any("missing" in point for point in found["points"])
    never = tmp_path / "never.mcap"
    fly(never, monkeypatch, range(1000))
    assert main(["report", str(never)]) == 1
    assert f"no cycle that did not fail: {BUG}" in capsys.readouterr().err
    assert main(["replay", str(never)]) == 3


def test_a_record_without_the_channel_of_failures_is_read_as_before(record: Path, tmp_path: Path) -> None:
    """Such as one of a version that left these cycles out."""
    reader, path = Reader(record), tmp_path / "old.mcap"
    file = McapFile(path, reader.versions)
    for item in reader:
        if item.sequence not in FAILING or item.topic not in {FACTS, STATE, FAILURES}:
            file.text(item.topic, item.unix_ns, item.data, item.sequence)
    file.close()
    outcome = replay(Reader(path))
    assert outcome.gaps == [(30, 3)]
    assert outcome.identical
    assert not outcome.failed
