"""The daemon as in flight, a process of its own, against the simulated world and a stock pymavlink ground station.

Nothing here shares a line of code or an event loop with the daemon: sockets, a pty and signals join them.
"""

import contextlib
import math
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arm_companion.__main__ import main
from arm_companion.cli.sim import TOO_SLOW
from arm_companion.sim import runner
from arm_companion.sim.world import World as Simulated

pytestmark = pytest.mark.realtime

READY, STOW, PERCH, RELEASE = 64000, 64001, 64002, 64004
ACCEPTED, TEMPORARILY_REJECTED, DENIED, FAILED, IN_PROGRESS = 0, 1, 2, 4, 5
ARM, AUTOPILOT = (1, 192), (1, 1)
# what a shell starts in the background inherits that Ctrl-C is ignored
_INTERRUPTIBLE = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
    return port


class Station:
    """mavutil on two ports: one hears the autopilot, one the arm."""

    def __init__(self, autopilot_port: int, arm_port: int) -> None:
        os.environ["MAVLINK20"] = "1"
        from pymavlink import mavutil

        self._links = {
            target: mavutil.mavlink_connection(
                f"udpin:127.0.0.1:{port}", source_system=255, source_component=190, dialect="common"
            )
            for target, port in ((AUTOPILOT, autopilot_port), (ARM, arm_port))
        }
        self.texts = ""

    def close(self) -> None:
        for link in self._links.values():
            link.close()

    def hear(
        self, target: tuple[int, int], name: str, timeout: float, when: Callable[[Any], bool] = lambda _: True
    ) -> Any:
        until = time.monotonic() + timeout
        link = self._links[target]
        while time.monotonic() < until:
            message = link.recv_match(type=[name, "STATUSTEXT"], blocking=True, timeout=0.2)
            if message is not None and message.get_type() == "STATUSTEXT":
                self.texts += message.text
            if (
                message is None
                or message.get_type() != name
                or (message.get_srcSystem(), message.get_srcComponent()) != target
                or not when(message)
            ):
                continue
            return message
        raise AssertionError(f"no {name} from {target} within {timeout} s")

    def command(self, target: tuple[int, int], command: int, *parameters: float, timeout: float = 10.0) -> int:
        link = self._links[target]
        link.mav.command_long_send(*target, command, 0, *parameters, *[0.0] * (7 - len(parameters)))
        ack = self.hear(target, "COMMAND_ACK", timeout, lambda a: a.command == command and a.result != IN_PROGRESS)
        return int(ack.result)

    def raw(self, target: tuple[int, int], data: bytes) -> None:
        self._links[target].write(data)


class World:
    """`arm-companion sim world` on ports of its own."""

    def __init__(self, folder: Path) -> None:
        companion, ground, arm = free_port(), free_port(), free_port()
        self.folder = folder
        settings = {
            "links.autopilot.url": f"udpin:127.0.0.1:{companion}",
            "links.ground.url": f"udpout:127.0.0.1:{arm}",
            "sim.autopilot_url": f"udpout:127.0.0.1:{companion}",
            "sim.operator_autopilot_url": f"udpin:127.0.0.1:{ground}",
            "sim.operator_arm_url": f"udpin:127.0.0.1:{arm}",
            "servos.port": str(folder / "bus"),
        }
        words = [sys.executable, "-m", "arm_companion", "sim", "world", "--output", str(folder)]
        for key, value in settings.items():
            words += ["--set", f"{key}={value}"]
        self.station = Station(ground, arm)
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def stop(self) -> str:
        self.process.send_signal(signal.SIGINT)
        try:
            output, _ = self.process.communicate(timeout=15.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            output, _ = self.process.communicate()
        self.station.close()
        return output

    @property
    def log(self) -> str:
        return (self.folder / "daemon.log").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("world"))
    yield world
    world.stop()


def test_the_component_is_discovered_under_the_autopilots_system_id(world: World) -> None:
    beat = world.station.hear(ARM, "HEARTBEAT", 15.0)
    assert beat.type == 18  # MAV_TYPE_ONBOARD_CONTROLLER
    assert beat.autopilot == 8  # MAV_AUTOPILOT_INVALID


def test_a_command_too_early_is_rejected_with_the_reason_in_words(world: World) -> None:
    assert world.station.command(ARM, PERCH) == TEMPORARILY_REJECTED
    world.station.hear(ARM, "HEARTBEAT", 3.0)
    assert "PERCH is not possible in state" in world.station.texts


def test_bytes_that_are_no_messages_are_survived_on_both_links(world: World) -> None:
    noise = random.Random(7)
    for size in (1, 7, 60, 280, 1400):
        world.station.hear(ARM, "HEARTBEAT", 15.0)  # what came before has been read: a socket holds only so much
        for _ in range(20):
            world.station.raw(ARM, noise.randbytes(size))
            world.station.raw(ARM, b"\xfd" + noise.randbytes(size))
    assert world.station.command(ARM, PERCH, float("nan")) == DENIED
    world.station.hear(ARM, "HEARTBEAT", 3.0)


def test_a_stock_ground_station_flies_a_perch_and_lets_go(world: World) -> None:
    station = world.station
    station.hear(AUTOPILOT, "HEARTBEAT", 5.0)
    station.hear(ARM, "HEARTBEAT", 10.0)  # who commands before that is not heard
    until = time.monotonic() + 20.0
    while station.command(ARM, READY, timeout=20.0) != ACCEPTED:
        assert time.monotonic() < until, "the arm does not find itself stowed"
        time.sleep(0.5)
    until = time.monotonic() + 40.0
    while station.command(AUTOPILOT, 400, 1.0) != ACCEPTED:
        assert time.monotonic() < until, "the vehicle does not arm"
        time.sleep(1.0)
    assert station.command(AUTOPILOT, 22, 0, 0, 0, 0, 0, 0, math.nan) == ACCEPTED  # a number would be one over the sea
    station.hear(AUTOPILOT, "LOCAL_POSITION_NED", 40.0, lambda m: m.z < -2.0)
    assert station.command(AUTOPILOT, 176, 1.0, 6.0) == ACCEPTED
    station.hear(AUTOPILOT, "HEARTBEAT", 5.0, lambda m: (m.custom_mode >> 16) & 0xFF == 6)
    assert station.command(ARM, PERCH, timeout=120.0) == ACCEPTED, world.log[-2000:]
    assert station.command(ARM, RELEASE, timeout=90.0) == ACCEPTED, world.log[-2000:]
    assert station.command(ARM, STOW, timeout=20.0) == ACCEPTED
    assert station.command(AUTOPILOT, 21) == ACCEPTED
    station.hear(AUTOPILOT, "HEARTBEAT", 60.0, lambda m: not m.base_mode & 128)


@contextlib.contextmanager
def daemon(*settings: str) -> Iterator["subprocess.Popen[str]"]:
    words = [sys.executable, "-m", "arm_companion", "run", "--config", "sim.toml"]
    for setting in settings:
        words += ["--set", setting]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_the_first_heartbeat_comes_soon_even_with_nothing_connected(tmp_path: Path) -> None:
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", port))
        ground.settimeout(10.0)
        start = time.monotonic()
        with daemon(
            f"links.ground.url=udpout:127.0.0.1:{port}",
            f"links.autopilot.url=udpin:127.0.0.1:{free_port()}",
            f"servos.port={tmp_path / 'nothing'}",
        ) as process:
            frame = ground.recv(300)
            # the budget is 1.5 s on a quiet machine, and `make bench` measures it; this only catches a hang
            assert time.monotonic() - start < 8.0
            assert frame[0] == 0xFD
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=5.0) == 0
            assert process.stderr is not None
            assert "stopping in STARTUP" in process.stderr.read()


def words_until(notify: socket.socket, quiet_s: float) -> list[bytes]:
    """What the service manager hears until it hears nothing for so long."""
    notify.settimeout(quiet_s)
    heard = []
    with contextlib.suppress(TimeoutError):
        while True:
            heard += [notify.recv(64)]
    return heard


def test_a_daemon_that_stands_still_stops_feeding_the_watchdog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.bind(str(tmp_path / "notify"))
        notify.settimeout(15.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        with daemon(
            f"links.ground.url=udpout:127.0.0.1:{free_port()}",
            f"links.autopilot.url=udpin:127.0.0.1:{free_port()}",
            f"servos.port={tmp_path / 'nothing'}",
        ) as process:
            assert notify.recv(64) == b"READY=1"
            assert [notify.recv(64) for _ in range(20)] == [b"WATCHDOG=1"] * 20
            process.send_signal(signal.SIGSTOP)
            until = time.monotonic() + 10.0
            while Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
                assert time.monotonic() < until, "it does not stop"
                time.sleep(0.01)
            notify.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:  # what it sent before it stopped
                    notify.recv(64)
            notify.settimeout(2.5)  # the unit's WatchdogSec is 2
            with pytest.raises(TimeoutError):
                notify.recv(64)
            process.send_signal(signal.SIGCONT)
            notify.settimeout(10.0)
            assert notify.recv(64) == b"WATCHDOG=1"
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=10.0) == 0
            assert words_until(notify, 0.2)[-1] == b"STOPPING=1"


def test_a_bad_configuration_ends_with_code_78_and_says_what_is_allowed() -> None:
    with daemon("perch.bar_radius_m=9") as process:
        assert process.wait(timeout=10.0) == 78
        assert process.stderr is not None
        text = process.stderr.read()
    assert "perch.bar_radius_m" in text
    assert "0.002 to 0.5 m" in text


def on_ports_of_its_own(folder: Path) -> list[str]:
    """Settings with which a simulated flight meets no other."""
    ports = [free_port() for _ in range(3)]
    words = []
    for setting in (
        f"links.autopilot.url=udpin:127.0.0.1:{ports[0]}",
        f"sim.autopilot_url=udpout:127.0.0.1:{ports[0]}",
        f"sim.operator_autopilot_url=udpin:127.0.0.1:{ports[1]}",
        f"links.ground.url=udpout:127.0.0.1:{ports[2]}",
        f"sim.operator_arm_url=udpin:127.0.0.1:{ports[2]}",
        f"servos.port={folder / 'bus'}",
    ):
        words += ["--set", setting]
    return words


def running(words: list[str]) -> list[str]:
    """Processes with all of these words on their command lines."""
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            line = place.read_bytes().decode(errors="replace").replace("\0", " ")
            found += [line] if all(word in line for word in words) else []
    return found


@pytest.mark.parametrize("presses", [1, 3])
def test_ctrl_c_ends_a_flight_in_order_however_often_it_is_pressed(tmp_path: Path, presses: int) -> None:
    words = [sys.executable, "-m", "arm_companion", "sim", "perch", "--output", str(tmp_path)]
    words += on_ports_of_its_own(tmp_path)
    with subprocess.Popen(
        [sys.executable, "-c", _INTERRUPTIBLE, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as flight:
        assert flight.stdout is not None
        while "READY" not in flight.stdout.readline():
            assert flight.poll() is None
        for _ in range(presses):
            flight.send_signal(signal.SIGINT)
            time.sleep(0.05)
        _, said = flight.communicate(timeout=20.0)
    assert said == "arm-companion: interrupted\n"
    assert flight.returncode == 130
    assert running(["arm_companion", "run", str(tmp_path)]) == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of its parent's end")
def test_a_flight_that_is_killed_takes_its_daemon_with_it(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "arm_companion", "sim", "perch", "--output", str(tmp_path)]
    words += on_ports_of_its_own(tmp_path)
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as flight:
        assert flight.stdout is not None
        while "READY" not in flight.stdout.readline():
            assert flight.poll() is None
        daemon = ["arm_companion", "run", str(tmp_path)]
        assert len(running(daemon)) == 1
        flight.kill()
    until = time.monotonic() + 20.0
    while running(daemon):
        assert time.monotonic() < until, "the daemon flies on alone"
        time.sleep(0.1)


def test_a_daemon_that_ends_early_is_told_in_one_line_and_not_as_a_traceback(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "arm_companion", "sim", "world", "--output", str(tmp_path)]
    settings = {
        "links.ground.url": "nonsense:1",
        "links.autopilot.url": f"udpin:127.0.0.1:{free_port()}",
        "servos.port": str(tmp_path / "bus"),
    }
    for key, value in settings.items():
        words += ["--set", f"{key}={value}"]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=30.0, check=False)
    assert ended.returncode == 1
    assert "the daemon ended with code 78" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_flight_ends_as_soon_as_the_machine_is_hopelessly_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runner, "_HOPELESS_S", 0.5)
    advance = Simulated._advance

    def slow(late: Simulated) -> None:
        time.sleep(0.02)  # four milliseconds of flight in twenty
        advance(late)

    monkeypatch.setattr(Simulated, "_advance", slow)
    words = ["sim", "perch", "--output", str(tmp_path), *on_ports_of_its_own(tmp_path)]
    begun = time.monotonic()
    assert main(words) == TOO_SLOW
    assert time.monotonic() - begun < 25.0
    said = capsys.readouterr()
    assert "too slow for real time" in said.out
    assert "behind real time" in said.err
