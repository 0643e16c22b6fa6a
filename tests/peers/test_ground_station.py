"""The ground side as people use it: MAVSDK on real sockets, the whole simulated system, and a stock MAVProxy."""

import asyncio
import contextlib
import json
import math
import os
import queue
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arm_companion.__main__ import main as arm_companion
from arm_companion.errors import LinkError
from arm_companion.ground import Arm, ArmSilent, CommandFailed, Status
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message

pytestmark = pytest.mark.realtime

DOCS = Path(__file__).parents[2] / "docs" / "ground.md"
MODULE = "arm_companion.ground.mavproxy_arm_companion"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


# MAVSDK against a component that is ours to script --------------------


class Vehicle(asyncio.DatagramProtocol):
    """Components 1/1 and 1/192 behind one socket that calls the station."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.received: list[Message] = []
        self.script: Callable[[Message], None] = lambda _: None
        self._codecs = {source: MavlinkCodec(*source) for source in ((1, 1), (1, 192))}
        self._reader = MavlinkCodec(0, 0)

    def connection_made(self, transport: Any) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, _: Any) -> None:
        for message in self._reader.feed(data):
            self.received.append(message)
            self.script(message)

    def say(self, message: Message, source: tuple[int, int] = (1, 192)) -> None:
        self.transport.sendto(self._codecs[source].encode(message), ("127.0.0.1", self.port))

    async def beat(self, *sources: tuple[int, int]) -> None:
        while True:
            for source in sources:
                kind = mav.MAV_TYPE_QUADROTOR if source == (1, 1) else mav.MAV_TYPE_ONBOARD_CONTROLLER
                stack = mav.MAV_AUTOPILOT_ARDUPILOTMEGA if source == (1, 1) else mav.MAV_AUTOPILOT_INVALID
                self.say(mav.MAVLink_heartbeat_message(kind, stack, 0, 0, 3, 3), source)
            await asyncio.sleep(0.2)

    def for_the_arm(self) -> list[Message]:
        return [m for m in self.received if getattr(m, "target_component", None) == 192]


@contextlib.asynccontextmanager
async def vehicle(*sources: tuple[int, int]) -> AsyncIterator[tuple[Vehicle, str]]:
    port = free_port()
    _, protocol = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: Vehicle(port), local_addr=("127.0.0.1", 0)
    )
    beating = asyncio.create_task(protocol.beat(*sources))
    try:
        yield protocol, f"udpin://127.0.0.1:{port}"
    finally:
        beating.cancel()
        protocol.transport.close()
        await asyncio.sleep(0.01)


def test_with_only_the_autopilot_there_nothing_is_sent_to_the_arm() -> None:
    async def main() -> None:
        async with vehicle((1, 1)) as (other, url):
            with pytest.raises(ArmSilent, match=r"no heartbeat of component 192 within 1.5 s on udpin:"):
                async with Arm.connect(url, timeout=1.5):
                    pass
            assert {m.get_type() for m in other.received} >= {"HEARTBEAT"}  # it was connected, and kept quiet
            assert other.for_the_arm() == []

    asyncio.run(main())


def test_an_address_that_cannot_be_opened_is_told() -> None:
    async def main(url: str) -> None:
        async with Arm.connect(url, timeout=1.0):
            pass

    for url in ("nonsense", "udpin://127.0.0.1:99999"):
        with pytest.raises(LinkError, match=url):
            asyncio.run(main(url))


def test_mavsdk_carries_every_kind_of_field_and_lies_are_not_believed() -> None:
    def script(arm: Vehicle) -> Callable[[Message], None]:
        def answer(message: Message) -> None:
            if message.get_type() == "COMMAND_LONG" and message.target_component == 192:
                ack = mav.MAVLink_command_ack_message(message.command, 0, 0, 0, 245, 190)
                arm.say(ack, (1, 1))  # accepted, says the autopilot
                text = b"READY denied: servo of tendon 2 does not answer, and so on"
                arm.say(mav.MAVLink_statustext_message(4, text[:50], 3, 0))
                arm.say(mav.MAVLink_statustext_message(4, text[50:], 3, 1))
                arm.say(mav.MAVLink_command_ack_message(message.command, 2, 0, 0, 245, 190))
            if message.get_type() == "PARAM_REQUEST_LIST" and message.target_component == 192:
                (small,) = struct.unpack("<f", struct.pack("<i", 12345))
                arm.say(mav.MAVLink_param_value_message(b"A_LONGEST_NAME_X", small, 6, 2, 0))
                arm.say(mav.MAVLink_param_value_message(b"B", 0.1, 9, 2, 1))

        return answer

    async def main() -> None:
        async with vehicle((1, 1), (1, 192)) as (other, url), Arm.connect(url, timeout=5.0) as arm:
            other.script = script(other)
            status = mav.MAVLink_arm_status_message(
                2**53 + 1, 0xFFFFFFFF, 1, math.nan, -0.1, [1.0, math.nan, 3.0], 0.0, 0.0, 5, 9, 255, 1, b"PERCHED", 9, 8
            )
            other.say(status)
            heard = await arm.first(Status)
            assert (heard.state, heard.progress, heard.control) == ("PERCHED", None, (9, 8))
            assert len(heard.flags) >= 14
            assert math.isnan(heard.theta)
            assert heard.delta == pytest.approx(-0.1)
            assert heard.tip_position[::2] == (1.0, 3.0)

            with pytest.raises(CommandFailed) as failed:
                await arm.ready()
            assert failed.value.result == "denied"
            assert failed.value.reason == "servo of tendon 2 does not answer, and so on"

            await arm.send_set_point(0.5, -0.25)
            parameters = await arm.parameters.read_all()
            assert [(p.name, p.value) for p in parameters] == [("A_LONGEST_NAME_X", 12345), ("B", pytest.approx(0.1))]
            (sent,) = [m for m in other.for_the_arm() if m.get_type() == "ARM_SETPOINT"]
            assert (sent.get_srcSystem(), sent.get_srcComponent()) == (245, 190)
            assert (sent.theta, sent.delta) == (0.5, -0.25)
            assert all(math.isnan(x) for x in sent.tip_position)

    asyncio.run(main())


# The whole simulated system --------------------


class World:
    """`arm-companion sim world` on ports of its own."""

    def __init__(self, folder: Path) -> None:
        companion, self.autopilot, self.arm = free_port(), free_port(), free_port()
        settings = {
            "links.autopilot.url": f"udpin:127.0.0.1:{companion}",
            "links.ground.url": f"udpout:127.0.0.1:{self.arm}",
            "sim.autopilot_url": f"udpout:127.0.0.1:{companion}",
            "sim.operator_autopilot_url": f"udpin:127.0.0.1:{self.autopilot}",
            "sim.operator_arm_url": f"udpin:127.0.0.1:{self.arm}",
            "servos.port": str(folder / "bus"),
        }
        words = [sys.executable, "-m", "arm_companion", "sim", "world", "--output", str(folder)]
        for key, value in settings.items():
            words += ["--set", f"{key}={value}"]
        self.process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.direct = f"udpin://127.0.0.1:{self.arm}"
        self.through = f"udpin://127.0.0.1:{self.autopilot}"

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(timeout=15.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("world"))
    yield world
    world.stop()


@pytest.fixture
def ground(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, Any, str]]:
    """Runs `arm-companion ground`: exit code, last JSON line of standard output, standard error."""

    def run(url: str, *words: str) -> tuple[int, Any, str]:
        capsys.readouterr()
        code = arm_companion(["ground", *words, "--connect", url, "--connect-timeout", "20", "--json"])
        captured = capsys.readouterr()
        lines = captured.out.splitlines()
        return code, json.loads(lines[-1]) if lines else None, captured.err

    return run


Ground = Callable[..., tuple[int, Any, str]]


def test_through_the_autopilot_the_arm_is_heard_and_obeys(world: World, ground: Ground) -> None:
    until = time.monotonic() + 20.0
    while (answer := ground(world.through, "status"))[1]["status"]["state"] == "STARTUP":
        assert time.monotonic() < until
    code, told, said = answer
    assert (code, told["way"], told["status"]["state"]) == (0, "tunnel", "STOWED"), said
    assert [t["index"] for t in told["tendons"]["tendons"]] == [0, 1, 2, 3]
    assert told["wrench"]["source"] == "free"

    bar = ("--bar", "3", "0", "-2", "--bar-axis-deg", "90", "--bar-radius")
    code, told, said = ground(world.through, "perch", *bar, "9")
    assert (code, told["result"]) == (1, "failed")
    assert "target refused: radius 9 m" in said

    code, told, said = ground(world.through, "perch", *bar, "0.035")  # a target that goes up in a TUNNEL
    assert (code, told["result"]) == (1, "temporarily rejected")
    assert told["reason"] == "PERCH is not possible in state STOWED"

    code, told, said = ground(world.through, "ready", "--timeout", "20")
    assert (code, told["result"], told["action"]) == (0, "accepted", "ready"), said


def test_direct_it_does_the_same_and_records(world: World, ground: Ground, tmp_path: Path) -> None:
    code, told, _ = ground(world.direct, "grasp")
    assert (code, told["action"]) == (1, "grasp")
    assert told["result"] in ("unsupported", "denied", "temporarily rejected")

    assert ground(world.direct, "jog", "--theta-deg", "20", "--delta-deg", "90")[0] == 0
    record, table = tmp_path / "r.jsonl", tmp_path / "r.csv"
    code, told, _ = ground(world.direct, "record", "--output", str(record), "--seconds", "1.5")
    assert code == 0
    assert told["reports"] > 30
    assert ground(world.direct, "record", "--output", str(table), "--seconds", "0.3")[0] == 0
    assert table.read_text(encoding="utf-8").startswith("received,message,time,")
    code, told, _ = ground(world.direct, "plot", str(record), "--output", str(tmp_path / "r.png"))
    assert (code, (tmp_path / "r.png").stat().st_size > 10_000) == (0, True)
    states = [json.loads(line) for line in record.read_text(encoding="utf-8").splitlines()]
    assert {line["state"] for line in states if line["message"] == "ARM_STATUS"} == {"READY"}


def test_watch_in_a_pipe_prints_lines(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert arm_companion(["ground", "watch", "--connect", world.direct, "--seconds", "1.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines
    assert "1/192  READY  bend" in lines[-1]


def test_the_documented_example_runs(world: World) -> None:
    text = DOCS.read_text(encoding="utf-8")
    code = text.partition("```python\n")[2].partition("```")[0]
    code = code.replace("udpin://127.0.0.1:14560", world.direct)
    assert world.direct in code
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30.0, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "PERCH temporarily rejected" in ended.stdout
    assert "N on the airframe" in ended.stdout


def test_an_arm_that_is_not_there_is_code_3(capsys: pytest.CaptureFixture[str]) -> None:
    url = f"udpin://127.0.0.1:{free_port()}"
    assert arm_companion(["ground", "ready", "--connect", url, "--connect-timeout", "0.3", "--json"]) == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out)["result"] == "not heard"
    assert f"no heartbeat of component 192 within 0.3 s on {url}" in captured.err


# MAVProxy --------------------


class MavProxy:
    """A stock MAVProxy whose prompt is typed into."""

    def __init__(self, port: int, folder: Path) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        words = [sys.executable, str(program), f"--master=udpin:127.0.0.1:{port}", "--default-modules="]
        self.process = subprocess.Popen(
            [*words, f"--state-basedir={folder}", "--mav20", "--no-state"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
            cwd=folder,
            env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        )
        self.said = ""
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")

    def wait(self, text: str, timeout: float = 15.0) -> None:
        """Wait until a line has `text`."""
        until = time.monotonic() + timeout
        while (left := until - time.monotonic()) > 0.0:
            try:
                line = self._lines.get(timeout=left)
            except queue.Empty:
                break
            self.said += line
            if text in line:
                return
        raise AssertionError(f"MAVProxy never said {text!r}, but:\n{self.said}")

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()


def test_a_stock_mavproxy_commands_the_arm_through_the_autopilot(world: World, tmp_path: Path) -> None:
    proxy = MavProxy(world.autopilot, tmp_path)
    try:
        proxy.wait("Detected vehicle 1:192")
        proxy.type(f"module load {MODULE}")
        proxy.wait(f"Loaded module {MODULE}")
        proxy.wait("arm: heard as 1/192")
        proxy.wait("arm: state ")  # comes inside TUNNEL
        proxy.type("armc release")
        proxy.wait("RELEASE temporarily rejected: RELEASE is not possible in state")
        proxy.type("armc stow")
        proxy.wait("arm: STOW accepted")
        proxy.type("armc ready")
        proxy.wait("arm: READY accepted")
        proxy.type("armc status")
        proxy.wait("tension, N:")
        proxy.type("armc nonsense")
        proxy.wait("usage: armc")
        proxy.type(f"module unload {MODULE}")
        proxy.wait(f"Unloaded module {MODULE}")
        proxy.type("armc status")
        proxy.wait("Unknown command 'armc status'")
    finally:
        proxy.stop()
