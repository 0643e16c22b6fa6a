"""The systemd unit: what it promises, what systemd itself says of it, and what the daemon takes of its limits."""

import ctypes
import os
import re
import resource
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from arm_companion import supervisor
from arm_companion.cli.run import START_AGAIN
from arm_companion.errors import ConfigError

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "arm-companion.service"
MOST_EXPOSED = 2.0


def values(key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", UNIT.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.fixture
def analyze() -> str:
    path = shutil.which("systemd-analyze")
    if path is None:
        warnings.warn("systemd-analyze IS NOT INSTALLED: the unit was not verified", pytest.PytestWarning, stacklevel=1)
        pytest.skip("systemd-analyze IS NOT INSTALLED: the unit was not verified")
    return path


@pytest.mark.filterwarnings("default::pytest.PytestWarning")
def test_systemd_finds_no_fault_with_the_unit(analyze: str, tmp_path: Path) -> None:
    copy = tmp_path / UNIT.name  # the same with a program that exists here
    text = UNIT.read_text(encoding="utf-8")
    assert text.count("/opt/arm-companion/venv/bin/arm-companion") == 1
    copy.write_text(text.replace("/opt/arm-companion/venv/bin/arm-companion", sys.executable), encoding="utf-8")
    done = subprocess.run([analyze, "verify", "--man=no", str(copy)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.filterwarnings("default::pytest.PytestWarning")
def test_verify_does_find_a_fault_where_there_is_one(analyze: str, tmp_path: Path) -> None:
    broken = tmp_path / UNIT.name
    broken.write_text(UNIT.read_text(encoding="utf-8").replace("WatchdogSec=2", "WatchdogSeconds=2"), encoding="utf-8")
    done = subprocess.run([analyze, "verify", "--man=no", str(broken)], capture_output=True, text=True, check=False)
    assert "WatchdogSeconds" in done.stderr


@pytest.mark.filterwarnings("default::pytest.PytestWarning")
def test_the_unit_exposes_little(analyze: str) -> None:
    done = subprocess.run(
        [analyze, "security", "--offline=true", "--no-pager", str(UNIT)], capture_output=True, text=True, check=False
    )
    found = re.search(r"Overall exposure level[^:]*: ([\d.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) <= MOST_EXPOSED


def test_exit_codes_are_the_daemons_own() -> None:
    assert values("RestartPreventExitStatus") == [str(ConfigError.exit_code)] == ["78"]
    assert values("RestartForceExitStatus") == [str(START_AGAIN)] == ["75"]
    assert values("Type") == ["notify"]
    assert values("Restart") == ["on-failure"]
    assert 0.0 < float(values("WatchdogSec")[0]) <= 5.0


def test_only_serial_ports_are_allowed_as_devices() -> None:
    assert values("DevicePolicy") == ["closed"]
    assert values("DeviceAllow")
    assert all(re.fullmatch(r"char-tty[A-Z]+ rw", device, re.IGNORECASE) for device in values("DeviceAllow"))


# priority and memory


class Libc:
    def __init__(self, answer: int = 0) -> None:
        self.asked: list[int] = []
        self._answer = answer

    def mlockall(self, flags: int) -> int:
        self.asked.append(flags)
        return self._answer


def limits(monkeypatch: pytest.MonkeyPatch, priority: int, memory: int) -> list[tuple[int, int]]:
    """Set the limits that the process sees; what it asks the scheduler for."""
    asked: list[tuple[int, int]] = []
    table = {resource.RLIMIT_RTPRIO: priority, resource.RLIMIT_MEMLOCK: memory}
    monkeypatch.setattr(resource, "getrlimit", lambda which: (table[which], table[which]))
    monkeypatch.setattr(os, "sched_setscheduler", lambda _, policy, p: asked.append((policy, p.sched_priority)))
    return asked


def test_at_a_shell_nothing_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = limits(monkeypatch, 0, 8 << 20)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: pytest.fail("memory must not be locked"))
    assert supervisor.take_priority() == []
    assert asked == []


@pytest.mark.parametrize(("limit", "priority"), [(20, 20), (5, 5), (resource.RLIM_INFINITY, 20)])
def test_what_the_unit_allows_is_taken(monkeypatch: pytest.MonkeyPatch, limit: int, priority: int) -> None:
    asked, libc = limits(monkeypatch, limit, resource.RLIM_INFINITY), Libc()
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: libc)
    assert supervisor.take_priority() == [f"real-time priority {priority}", "memory locked"]
    assert asked == [(os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, priority)]
    assert libc.asked == [7]


def test_a_kernel_that_refuses_is_told_and_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    limits(monkeypatch, 20, resource.RLIM_INFINITY)

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Libc(-1))
    first, second = supervisor.take_priority()
    assert first == "no real-time priority: Operation not permitted"
    assert second.startswith("memory not locked: ")
