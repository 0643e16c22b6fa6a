"""The shipped unit under a real systemd: start, watchdog, restart, and what is not restarted."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.service.conftest import Machine

pytestmark = pytest.mark.realtime

FLY = "run --config sim.toml --set servos.port=/dev/none"


def test_it_is_ready_when_its_cycle_runs_and_a_daemon_that_stands_still_is_started_again(
    boot: Callable[[str], Machine],
) -> None:
    machine = boot(FLY)
    machine.until(lambda: machine.show("SubState") == "running")
    first = machine.daemon()
    assert first
    os.kill(first, signal.SIGSTOP)
    machine.until(lambda: machine.show("NRestarts") == "1" and machine.show("SubState") == "running")
    assert machine.daemon() not in (0, first)
    assert not Path(f"/proc/{first}").exists()


def test_a_configuration_that_cannot_be_used_is_not_tried_again(boot: Callable[[str], Machine]) -> None:
    machine = boot("run --config sim.toml --set vehicle.mass_kg=-1")
    machine.until(lambda: machine.show("ActiveState") == "failed")
    assert machine.show("ExecMainStatus") == "78"
    assert machine.show("NRestarts") == "0"


def test_a_daemon_that_dies_is_started_again_and_one_that_is_stopped_is_not(boot: Callable[[str], Machine]) -> None:
    machine = boot(FLY)
    machine.until(lambda: machine.show("SubState") == "running")
    first = machine.daemon()
    os.kill(first, signal.SIGKILL)
    machine.until(lambda: machine.daemon() not in (0, first) and machine.show("SubState") == "running")
    os.kill(machine.daemon(), signal.SIGTERM)
    machine.until(lambda: machine.show("ActiveState") == "inactive")
    assert machine.show("Result") == "success"
