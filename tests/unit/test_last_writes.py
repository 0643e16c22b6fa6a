"""The end of the daemon on a disk that hangs, and on one that is only slow."""

import asyncio
import contextlib
import dataclasses
import functools
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, cast

import pytest

from arm_companion import last_writes
from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import load
from arm_companion.config.schema import MavlinkConfig, RecordConfig
from arm_companion.drivers import calibration_files, computer, keeper
from arm_companion.drivers.computer import ComputerWatch
from arm_companion.last_writes import MOST_S, STALL_S, Ending, wait_for
from arm_companion.mission.facts import Facts, VehicleState
from arm_companion.mission.state import State
from arm_companion.record import file_recorder
from arm_companion.record.file_recorder import FileRecorder
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.reader import Reader
from arm_companion.record.recorder import FailedCycle
from arm_companion.record.topics import FACTS
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.memory import MemoryPipe
from tests.conftest import MavlinkPeer


class Disk:
    """Threads on it, in a time of their own: each gets something done every so often, and has so much to do."""

    def __init__(self) -> None:
        self.t = 0.0  # s
        self.told: dict[str, bool] = {}

    def thread(self, name: str, every_s: float = 1e9, jobs: int = 1, *, patient: bool = False) -> Ending:
        disk = self

        class Thread:
            ident = len(name)

            def is_alive(self) -> bool:
                return disk.t < every_s * jobs

            def join(self, timeout: float) -> None:
                disk.t += timeout

        return Ending(
            cast("threading.Thread", Thread()),
            lambda: int(self.t / every_s),
            functools.partial(self.told.__setitem__, name),
            patient,
        )


def test_a_dead_disk_is_given_up_once_for_all_threads() -> None:
    disk = Disk()
    wait_for([disk.thread("keeper"), disk.thread("parking log"), disk.thread("recorder")])
    assert disk.t == pytest.approx(STALL_S, abs=0.1)
    assert disk.told == {"keeper": False, "parking log": False, "recorder": False}


def test_a_slow_disk_is_waited_for() -> None:
    disk = Disk()
    wait_for([disk.thread("recorder", 1.5, 3)])
    assert disk.told == {"recorder": True}
    assert disk.t == pytest.approx(4.5, abs=0.1)


def test_one_thread_that_gets_on_shows_that_the_disk_is_alive() -> None:
    disk = Disk()
    wait_for([disk.thread("keeper", 3.5), disk.thread("recorder", 0.5, 6)])
    assert disk.told == {"keeper": True, "recorder": True}


def test_a_disk_that_gets_on_for_ever_is_given_up_before_systemd_kills() -> None:
    disk = Disk()
    wait_for([disk.thread("recorder", 0.5, 1000)])
    assert disk.t == pytest.approx(MOST_S, abs=0.1)
    assert disk.told == {"recorder": False}


def test_in_simulated_time_it_is_waited_for_however_long_it_takes() -> None:
    disk = Disk()
    wait_for([disk.thread("recorder", 60.0, patient=True)])
    assert disk.told == {"recorder": True}


def hang(release: threading.Event) -> Callable[..., Any]:
    def hanging(*_: object, **__: object) -> NoReturn:
        release.wait(30.0)
        raise OSError("the disk is gone")

    return hanging


def test_a_daemon_ends_soon_when_nothing_can_be_written_any_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    release = threading.Event()
    settings = dataclasses.replace(
        load("sim.toml", [f'calibration.directory="{tmp_path}"']), mavlink=MavlinkConfig(state_directory=str(tmp_path))
    )

    async def main() -> float:
        peers = {"autopilot": MavlinkPeer(1, 1), "ground": MavlinkPeer(255, 190)}
        openers = Openers({name: peer.pipe.opener(0) for name, peer in peers.items()}, MemoryPipe().opener(0))
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        about = {"format": "1"}
        recorder = FileRecorder(tmp_path / "r.mcap", RecordConfig(), about, clock.unix, open_file=hang(release))
        daemon = Daemon(settings, openers, clock, ServiceManager(""), recorder)
        stop = asyncio.Event()
        task = asyncio.create_task(daemon.run(stop))
        await asyncio.sleep(0.5)
        daemon._keeper.put(tmp_path / "parameters.json", b"{}")
        stop.set()
        begun = time.perf_counter()
        await task
        return time.perf_counter() - begun

    monkeypatch.setattr(keeper, "write_atomically", hang(release))
    monkeypatch.setattr(calibration_files, "save", hang(release))
    monkeypatch.setattr(last_writes, "STALL_S", 0.3)
    assert run_simulated(main()) < 2.0
    for who in ("keeper", "parking log", "record"):
        assert f"{who}: the disk does not answer" in caplog.text
    release.set()


@pytest.mark.parametrize("dead", [False, True])
def test_a_record_is_written_out_on_a_slow_disk_and_what_a_dead_one_costs_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, dead: bool
) -> None:
    """The queue takes longer than any of its writes may."""
    release, cycles = threading.Event(), 100

    class Slow(McapFile):
        def text(self, topic: str, unix_ns: int, data: bytes, sequence: int = 0) -> None:
            if topic == FACTS:
                release.wait(30.0 if dead and sequence == 60 else 0.015)
            super().text(topic, unix_ns, data, sequence)

        def sync(self) -> None:
            pytest.fail("the end waits for no disk to have it all")

    monkeypatch.setattr(last_writes, "STALL_S", 1.0)
    monkeypatch.setattr(file_recorder, "_GATHER_S", 60.0)
    made = FileRecorder(tmp_path / "r.mcap", RecordConfig(), {"format": "1"}, lambda t: t, open_file=Slow)
    made.configure(0.0, load("sim.toml"))
    for i in range(cycles):
        made.failed(FailedCycle(float(i), Facts(VehicleState(), ()), State(), "no matter", "here"))
    made.close()
    if dead:
        assert f"the disk does not answer; the last {cycles} cycles are lost" in caplog.text
        release.set()
        return
    assert "record: " not in caplog.text
    assert len(list(Reader(tmp_path / "r.mcap").messages((FACTS,)))) == cycles


def test_the_loop_ends_while_a_look_at_the_disk_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    monkeypatch.setattr(computer, "look", hang(release))

    async def main() -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.05):
                await ComputerWatch().run()

    later = threading.Timer(5.0, release.set)
    later.start()
    asyncio.run(main())
    assert not release.is_set()
    later.cancel()
    release.set()
