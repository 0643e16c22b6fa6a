"""The thread that writes: jobs in their order, and an end also where the disk has none."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from arm_companion import last_writes
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.writer import Writer


def test_jobs_are_done_in_order_and_each_says_what_became_of_it() -> None:
    done: list[int] = []
    writer = Writer("test")
    fates = [writer.submit(done.append, number) for number in range(100)]
    failed = writer.submit(Path("/proc/none/at/all").unlink, missing_ok=False)
    writer.close()
    assert done == list(range(100))
    assert [fate.result(0.0) for fate in fates] == [None] * 100
    assert isinstance(failed.exception(0.0), OSError)
    writer.close()


def test_where_servos_stand_is_not_waited_for_on_a_disk_that_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    awake = threading.Event()
    monkeypatch.setattr(last_writes, "STALL_S", 0.01)
    monkeypatch.setattr(files, "save", lambda _path, _value: awake.wait(60.0))
    files.ParkingLog(str(tmp_path), {1: 2048}).close()
    assert not awake.is_set()
    assert "parking log: the disk does not answer" in caplog.text
    awake.set()


def test_the_interpreter_does_not_wait_for_a_job_that_hangs_either() -> None:
    code = (
        "import time; from arm_companion import last_writes; from arm_companion.drivers import writer;"
        "last_writes.STALL_S = 0.01; one = writer.Writer('test'); one.submit(time.sleep, 3600.0); one.close()"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60.0).returncode == 0
