"""The fleet example: what it shows of messages, that its vehicles do not meet, its screen, and a flight of two."""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import aiomqtt
import pytest

from arm_companion.clock import ticks
from arm_companion.config import load
from tests.documentation import program
from tests.mqtt_broker import Broker, serving

SCRIPT = Path(__file__).parents[2] / "docs" / "examples" / "fleet" / "fleet.py"


@pytest.fixture(scope="module")
def fleet() -> ModuleType:
    return program(SCRIPT)


def test_a_vehicle_is_one_line_and_nonsense_changes_nothing(fleet: ModuleType) -> None:
    vehicle = fleet.Vehicle("3")
    assert "offline" in vehicle.line()
    vehicle.hear("availability", b"online")
    vehicle.hear("state", json.dumps({"state": "PERCHED"}).encode())
    vehicle.hear("wrench", json.dumps({"force": [3.0, 0.0, 4.0], "valid": True}).encode())
    vehicle.hear("tendons", json.dumps({"tension": [1.0, 27.5, None, 2.0]}).encode())
    line = vehicle.line()
    for words in ("online", "PERCHED", "5.00 N", "27.5 N"):
        assert words in line
    for nonsense in (b"", b"\xff", b"[]", b"{", b'"x"'):
        vehicle.hear("state", nonsense)
    assert vehicle.line() == line
    vehicle.hear("wrench", json.dumps({"force": None, "valid": False}).encode())
    assert "? N" in vehicle.line()


def test_no_two_vehicles_share_a_port_or_a_bus(fleet: ModuleType, tmp_path: Path) -> None:
    seen: set[str] = set()
    for number in range(1, 5):
        settings = list(fleet.settings(number, tmp_path, "127.0.0.1", 1883))
        config = load("sim.toml", settings)
        assert config.mqtt.vehicle == str(number)
        own = {config.servos.port, config.links["autopilot"].url, config.links["ground"].url}
        own |= {config.sim.operator_autopilot_url.rpartition(":")[2], config.mqtt.vehicle}
        assert not own & seen
        seen |= own


@pytest.mark.realtime
def test_the_screen_follows_a_broker(tmp_path: Path) -> None:
    if shutil.which("mosquitto") is None:
        pytest.skip("the example was not run against a broker: mosquitto is missing")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (tmp_path / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    broker = subprocess.Popen(
        ["mosquitto", "-c", str(tmp_path / "mosquitto.conf")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    async def main() -> str:
        async with asyncio.timeout(30.0):
            async for _ in ticks(0.1):
                try:
                    _, writer = await asyncio.open_connection("127.0.0.1", port)
                except OSError:
                    continue
                writer.close()
                break
            words = [sys.executable, str(SCRIPT), "watch", "--port", str(port)]
            screen = await asyncio.create_subprocess_exec(*words, stdout=asyncio.subprocess.PIPE)
            assert screen.stdout is not None
            async with aiomqtt.Client("127.0.0.1", port) as client:
                for number in ("1", "2"):
                    await client.publish(f"arm/{number}/availability", b"online", retain=True)
                    await client.publish(f"arm/{number}/state", b'{"state": "PERCHED"}', retain=True)
                told = b""
                while told.count(b"PERCHED") < 2:
                    told += await screen.stdout.readline()
            screen.terminate()
            await screen.communicate()
            return told.decode()

    try:
        told = asyncio.run(main())
    finally:
        broker.terminate()
        broker.wait()
    assert {line.split()[0] for line in told.splitlines()} == {"1", "2"}


@pytest.mark.scenario
@pytest.mark.realtime
def test_two_vehicles_that_fly_at_once_are_both_on_the_screen(tmp_path: Path) -> None:
    wanted = {"online", "STOWED", "READY", "APPROACH"}  # in the air; the perch itself wants a machine for itself

    async def main() -> dict[str, set[str]]:
        seen: dict[str, set[str]] = {}
        async with serving(Broker()) as broker:
            port = ("--port", str(broker.port))
            words = [sys.executable, str(SCRIPT)]
            screen = await asyncio.create_subprocess_exec(*words, "watch", *port, stdout=asyncio.subprocess.PIPE)
            fleet = await asyncio.create_subprocess_exec(
                *words,
                "fly",
                *port,
                "--output",
                str(tmp_path),
                stdout=asyncio.subprocess.DEVNULL,
                start_new_session=True,
            )
            assert screen.stdout is not None
            try:
                async with asyncio.timeout(90.0):
                    while not {name for name, states in seen.items() if states >= wanted} >= {"1", "2"}:
                        name, availability, state = (await screen.stdout.readline()).decode().split()[:3]
                        seen.setdefault(name, set()).update((availability, state))
                    os.killpg(fleet.pid, signal.SIGINT)
                    while not all("offline" in states for states in seen.values()):
                        name, availability = (await screen.stdout.readline()).decode().split()[:2]
                        seen[name].add(availability)
                    await fleet.wait()
            except TimeoutError:
                pytest.fail(f"not on the screen within 90 s: {seen}")
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(fleet.pid, signal.SIGKILL)
                screen.terminate()
                await screen.communicate()
        return seen

    assert set(asyncio.run(main())) == {"1", "2"}
    for vehicle in ("1", "2"):
        log = (tmp_path / vehicle / "daemon.log").read_text()
        assert "READY -> APPROACH" in log
        assert "Traceback" not in log


def test_without_a_broker_it_says_so() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        words = [sys.executable, str(SCRIPT), "watch", "--port", str(port)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=30.0, check=False)
    assert done.returncode == 1
    assert str(port) in done.stderr
    assert "Traceback" not in done.stderr
