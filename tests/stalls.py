"""Whether this machine stood still, and another try at a real-time test that met it standing still.

A shared machine takes its processors away for tenths of a second at a time, and what runs against the wall clock then
sees a world that jumps: a vehicle's state that is too old, a servo that is silent. That is no verdict on the program.
So a program that only sleeps runs on every processor beside the real-time tests. A test that fails while one of them
woke up late is run again, from fresh fixtures; one that the machine lets down time after time is skipped, loudly. On a
machine that keeps time every failure counts.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from _pytest.reports import TestReport
from _pytest.runner import runtestprotocol

STALL_S = 0.05
"""A sleeper as late as that explains a failure once."""
LONG_STALL_S = 0.1
"""The daemon calls its own cycle late from here on; a test that meets that in every try is skipped."""
TRIES = 3

_SLEEPER = r"""
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
parent = os.getppid()
while os.getppid() == parent:
    begun = time.monotonic()
    time.sleep(0.01)
    if (late := time.monotonic() - begun - 0.01) > float(sys.argv[2]):
        os.write(1, f"{begun} {late}\n".encode())
"""


class Sleepers:
    """One process a processor, which tells when it woke up late."""

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="stalls"))
        self._processes = []
        for cpu in sorted(os.sched_getaffinity(0)):
            words = [sys.executable, "-S", "-c", _SLEEPER, str(cpu), str(STALL_S)]
            with (self._folder / str(cpu)).open("wb") as told:  # one each: two that write into one tear lines
                self._processes.append(subprocess.Popen(words, stdout=told))

    def longest(self, since: float) -> float:
        """The longest that a processor was away since a time of the monotonic clock, s."""
        lines = [line for told in self._folder.iterdir() for line in told.read_text(encoding="ascii").splitlines(True)]
        whole = [line.split() for line in lines if line.endswith("\n")]
        return max((float(late) for begun, late in whole if float(begun) >= since), default=0.0)

    def stop(self) -> None:
        """End them."""
        for process in self._processes:
            process.kill()
            process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)


class AnotherTry:
    """pytest's plug-in."""

    def __init__(self) -> None:
        self._sleepers: Sleepers | None = None
        self._told: list[str] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
        if item.get_closest_marker("realtime") is None:
            return None
        self._sleepers = self._sleepers or Sleepers()
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for report in self._reports(item, nextitem):
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def _reports(self, item: pytest.Item, nextitem: pytest.Item | None) -> list[TestReport]:
        assert self._sleepers is not None
        stalls: list[float] = []
        while True:
            begun = time.monotonic()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            if not any(report.failed for report in reports):
                return reports
            stalls.append(self._sleepers.longest(begun))
            if stalls[-1] < STALL_S:
                return reports
            said = f"{item.nodeid} failed while a processor stood still for {stalls[-1]:.2f} s"
            if len(stalls) == TRIES:
                if min(stalls) >= LONG_STALL_S:
                    for report in reports:
                        _let_off(report, said)
                return reports
            self._told.append(f"{said}; run again")
            item.session._setupstate.teardown_exact(None)
            item._initrequest()  # type: ignore[attr-defined]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self._told:
            terminalreporter.section("this machine stood still")
            for line in self._told:
                terminalreporter.line(line)

    def pytest_unconfigure(self) -> None:
        if self._sleepers is not None:
            self._sleepers.stop()


def _let_off(report: TestReport, said: str) -> None:
    """Make a failure a skip, with what failed in the reason."""
    if report.failed:
        what = " ".join(line[1:].strip() for line in report.longreprtext.splitlines() if line.startswith("E "))
        path, line, _ = report.location
        report.outcome = "skipped"
        report.longrepr = (path, line or 0, f"NO FAIR MACHINE in {TRIES} tries: {said}: {what}")
