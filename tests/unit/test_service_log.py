"""Levels of the log under journald, and none at a terminal."""

import logging
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from arm_companion.service_log import JournalFormatter, logging_to, priority


def test_levels_are_syslogs() -> None:
    levels = (logging.CRITICAL, logging.ERROR, logging.WARNING, logging.INFO, logging.DEBUG)
    assert [priority(level) for level in levels] == [2, 3, 4, 6, 7]


def test_every_line_of_a_traceback_has_the_level_of_its_record() -> None:
    try:
        raise ValueError("one\ntwo")
    except ValueError:
        record = logging.LogRecord("name", logging.ERROR, "", 0, "failed", None, sys.exc_info())
    lines = JournalFormatter("%(levelname)s %(name)s: %(message)s").format(record).splitlines()
    assert lines[0] == "<3>ERROR name: failed"
    assert len(lines) > 3
    assert all(line.startswith("<3>") for line in lines)


@pytest.mark.realtime
@pytest.mark.parametrize("journald", [True, False], ids=["journald", "a pipe of somebody else"])
def test_the_daemon_marks_its_lines_for_journald_alone(tmp_path: Path, journald: bool) -> None:
    reading, writing = os.pipe()
    facts = os.fstat(writing)
    config = tmp_path / "config.toml"
    config.write_text(f'extends = "{Path(__file__).parents[2]}/configs/sim.toml"\n')
    process = subprocess.Popen(
        [sys.executable, "-m", "arm_companion", "run", "--config", config, "--set", "servos.port=/dev/none",
         "--set", "links.autopilot.url=udpout:127.0.0.1:9", "--set", "links.ground.url=udpout:127.0.0.1:9"],
        stderr=writing, env={**os.environ, "JOURNAL_STREAM": f"{facts.st_dev}:{facts.st_ino + (not journald)}"},
    )  # fmt: skip
    os.close(writing)
    try:
        with os.fdopen(reading, encoding="utf-8") as stream:
            said = ""
            end = time.monotonic() + 20.0
            while "servo bus" not in said or "link" not in said:
                assert time.monotonic() < end
                said += stream.readline()
            process.terminate()
            said += stream.read()
    finally:
        process.kill()
        process.wait(10.0)
    marks = "<4>" if journald else ""
    assert re.search(rf"^{marks}WARNING arm_companion\.drivers\.servo_bus: ", said, re.MULTILINE)
    assert bool(re.search(r"^<6>INFO ", said, re.MULTILINE)) is journald
    assert all(line.startswith("<") is journald for line in said.splitlines())


def test_a_daemon_within_another_program_logs_to_a_file_and_not_to_its_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = logging.getLogger("arm_companion.app")
    with logging_to(tmp_path / "daemon.log"):
        log.info("STOWED -> READYING")
        log.warning("no contact")
    log.info("afterwards")
    assert (tmp_path / "daemon.log").read_text().splitlines() == [
        "INFO arm_companion.app: STOWED -> READYING",
        "WARNING arm_companion.app: no contact",
    ]
    assert capfd.readouterr().err == ""
