"""Real-time tests on a machine that stands still: what is tried again, what is let off, and what is not."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import tests
from tests import stalls

_CONFTEST = """
from tests import stalls

stalls.Sleepers.longest = lambda self, since: {longest}

def pytest_configure(config):
    config.addinivalue_line("markers", "realtime: runs against the wall clock")
    config.pluginmanager.register(stalls.AnotherTry())
"""

_TESTS = """
import pytest

worlds = []

@pytest.fixture(scope="module")
def world():
    worlds.append("made")
    return len(worlds)

@pytest.mark.realtime
def test_second_world(world):
    assert world == 2

@pytest.mark.realtime
def test_same_world(world):
    assert world == 2

@pytest.mark.realtime
def test_never():
    assert False, "the reason"

def test_of_no_time():
    assert False
"""


@pytest.mark.parametrize(
    ("longest", "outcomes", "said"),
    [
        (0.2, "1 failed, 2 passed, 1 skipped", "NO FAIR MACHINE in 3 tries"),
        (0.07, "2 failed, 2 passed", "stood still for 0.07 s; run again"),
        (0.01, "4 failed", "the reason"),
    ],
)
def test_a_failure_counts_unless_the_machine_stood_still(
    tmp_path: Path, longest: float, outcomes: str, said: str
) -> None:
    (tmp_path / "conftest.py").write_text(_CONFTEST.format(longest=longest), encoding="ascii")
    (tmp_path / "test_some.py").write_text(_TESTS, encoding="ascii")
    words = [sys.executable, "-m", "pytest", "-ra", "-p", "no:cacheprovider", str(tmp_path)]
    here = str(Path(tests.__path__[0]).parent)
    run = subprocess.run(
        words, cwd=tmp_path, env={**os.environ, "PYTHONPATH": here}, capture_output=True, text=True, check=False
    )
    assert outcomes in run.stdout.splitlines()[-1], run.stdout
    assert said in run.stdout
    assert "the reason" in run.stdout, "what is let off says what it was"


def test_every_sleeper_is_understood_while_all_of_them_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")  # `print` then writes each word by itself
    monkeypatch.setattr(stalls, "STALL_S", -1.0)  # tell every time
    begun = time.monotonic()
    sleepers = stalls.Sleepers()
    try:
        until = begun + 20.0
        while (longest := sleepers.longest(begun)) == 0.0 and time.monotonic() < until:
            time.sleep(0.01)
        for _ in range(200):
            assert sleepers.longest(begun) >= longest > 0.0
            time.sleep(0.001)
        told = [line.split() for file in sleepers._folder.iterdir() for line in file.read_text().splitlines(True)[:-1]]
        assert len({float(begun) for begun, _ in told}) > 10
        assert sleepers.longest(time.monotonic() + 1.0) == 0.0
    finally:
        sleepers.stop()
    assert not sleepers._folder.exists()
