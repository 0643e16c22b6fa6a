"""The live view, looked at by a websocket client that is not Foxglove's: the protocol's own frames, byte by byte."""

import asyncio
import contextlib
import dataclasses
import functools
import json
import re
import struct
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websockets
from mcap.reader import make_reader

from arm_companion.__main__ import main
from arm_companion.__main__ import main as command_line
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.clock import Clock, ticks
from arm_companion.config import Config
from arm_companion.errors import ConfigError
from arm_companion.geometry import so3
from arm_companion.live.feed import Address, LiveView
from arm_companion.live.scene import scene, transforms, turn_to
from arm_companion.mission.facts import Notice, Severity
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import State
from arm_companion.record.reader import Reader
from arm_companion.record.recorder import Record
from arm_companion.record.replay import Cycle, cycles
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, LOG, SCHEMAS, STATE, TRANSITIONS
from tests.peers.test_mqtt_connection import free_udp_port

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden" / "perch.mcap"
WIRE = struct.Struct("<BIQ")


@functools.cache
def flown(wanted: bool) -> tuple[Record, Situation]:
    """A cycle of the golden flight, and the same after its step: of a held arm, or of a free one."""
    state, parameters = State(), None
    for found in cycles(Reader(GOLDEN)):
        if not isinstance(found, Cycle):
            parameters = Parameters(found, RodModel(ArmParameters.of(found.arm)))
            continue
        assert parameters is not None
        before = state
        state, commands = step(before, found.facts, found.t, parameters)
        prediction = state.prediction
        if prediction is not None and (prediction.anchored is not None) is wanted and commands.wrench.valid:
            return Record(found.t, found.facts, before, commands), Situation(state, found.facts, found.t, parameters)
    raise AssertionError("there is none")


class Client:
    """Of the protocol foxglove.sdk.v1: JSON for what there is, binary frames for what is said."""

    def __init__(self, socket: websockets.ClientConnection) -> None:
        self.socket = socket
        self.channels: dict[str, dict[str, Any]] = {}

    async def until_told(self, topics: set[str]) -> None:
        while not topics <= self.channels.keys():
            message = await asyncio.wait_for(self.socket.recv(), 20.0)
            assert isinstance(message, str)
            told = json.loads(message)
            if told["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in told["channels"]}
            else:
                assert told.get("capabilities", []) == [], "it is for looking only"

    async def subscribe(self, *topics: str) -> None:
        entries = [{"id": self.channels[topic]["id"], "channelId": self.channels[topic]["id"]} for topic in topics]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": entries}))

    async def message(self, topic: str) -> tuple[int, bytes]:
        """The next message of a topic: its time in ns, and its bytes."""
        while True:
            data = await asyncio.wait_for(self.socket.recv(), 20.0)
            if isinstance(data, bytes):
                kind, subscription, ns = WIRE.unpack_from(data)
                if kind == 1 and subscription == self.channels[topic]["id"]:
                    return ns, data[WIRE.size :]


@contextlib.asynccontextmanager
async def client(port: int) -> AsyncIterator[Client]:
    for attempt in range(200):
        try:
            socket = await websockets.connect(
                f"ws://127.0.0.1:{port}",
                subprotocols=[websockets.Subprotocol("foxglove.sdk.v1")],
                max_size=None,
                close_timeout=1.0,
            )
            break
        except OSError:
            assert attempt < 199, "nothing serves it"
            await asyncio.sleep(0.1)
    async with socket:
        yield Client(socket)


def test_another_client_sees_the_topics_of_a_record_and_a_scene() -> None:
    record, cycle = flown(True)

    async def main() -> None:
        port = free_udp_port()
        clock = Clock(asyncio.get_running_loop(), 1.7e9)
        live = LiveView(cycle.config, clock, Address(port=port))
        task = asyncio.create_task(live.run())

        async def fly() -> None:
            async for _ in ticks(0.02):
                now = clock.now()
                live.publish(dataclasses.replace(record, t=now), cycle)

        flying = asyncio.create_task(fly())
        async with client(port) as seen:
            topics = {FACTS, STATE, COMMANDS, TRANSITIONS, LOG, CONFIGURATION}
            await seen.until_told({*topics, "/scene", "/tf"})
            for topic in topics:
                name, schema = SCHEMAS[topic]
                assert seen.channels[topic]["schemaName"] == name
                assert json.loads(seen.channels[topic]["schema"])["properties"] == schema["properties"]
            assert seen.channels["/scene"]["schemaName"] == "foxglove.SceneUpdate"
            assert live.take() is None, "nothing is made while nobody looks"
            await seen.subscribe(*topics, "/scene", "/tf")
            ns, data = await seen.message(COMMANDS)
            assert json.loads(data)["status"]["state"] == record.commands.status.state
            assert abs(ns / 1e9 - clock.unix(clock.now())) < 5.0
            assert len(json.loads((await seen.message(FACTS))[1])["tendons"]) == 4
            assert len((await seen.message("/scene"))[1]) > 500
            assert b"arm_base" in (await seen.message("/tf"))[1]
            live.event(Notice(Severity.WARNING, "READY -> APPROACH: order PERCH"))
            assert json.loads((await seen.message(TRANSITIONS))[1])["after"] == "APPROACH"
        async with client(port) as late:
            await late.until_told({CONFIGURATION})
            await late.subscribe(CONFIGURATION)
            assert "perch" in json.loads((await late.message(CONFIGURATION))[1])["config"]
        for _ in range(100):
            if not live._viewers:
                break
            await asyncio.sleep(0.1)
        assert not live._viewers, "who is gone is not fed any more"
        flying.cancel()
        task.cancel()
        for ended in (flying, task):
            with contextlib.suppress(asyncio.CancelledError):
                await ended

    asyncio.run(main())


def test_a_client_that_reads_nothing_delays_neither_the_loop_nor_the_others() -> None:
    record, cycle = flown(False)

    async def main() -> None:
        port = free_udp_port()
        clock = Clock(asyncio.get_running_loop(), 1.7e9)
        live = LiveView(cycle.config, clock, Address(port=port))
        task = asyncio.create_task(live.run())
        async with client(port) as deaf, client(port) as other:
            for one in (deaf, other):
                await one.until_told({COMMANDS, FACTS, STATE})
            await deaf.subscribe(COMMANDS, FACTS, STATE)
            deaf.socket.transport.pause_reading()
            await other.subscribe(COMMANDS)
            missed = seen = 0
            start = time.monotonic()
            hearing = asyncio.create_task(other.message(COMMANDS))
            async for tick in ticks(0.05):
                missed, seen = missed + tick.missed, seen + 1
                live.publish(dataclasses.replace(record, t=clock.now()), cycle)
                if time.monotonic() - start > 3.0:
                    break
            await hearing
            assert missed <= seen // 4, "this machine alone may lose a tick now and then"
            deaf.socket.transport.abort()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    asyncio.run(main())


def test_the_whole_daemon_serves_it_and_a_plain_http_request_gets_nothing(tmp_path: Path) -> None:
    async def main() -> None:
        port = free_udp_port()
        words = [sys.executable, "-m", "arm_companion", "run", "--config", "sim.toml", "--live", f"127.0.0.1:{port}"]
        for setting in (
            f"links.autopilot.url=udpin:127.0.0.1:{free_udp_port()}",
            f"links.ground.url=udpout:127.0.0.1:{free_udp_port()}",
            f"servos.port={tmp_path / 'nothing'}",
        ):
            words += ["--set", setting]
        daemon = await asyncio.create_subprocess_exec(*words, stderr=asyncio.subprocess.DEVNULL)
        try:
            async with client(port) as seen:
                await seen.until_told({COMMANDS, "/scene"})
                await seen.subscribe(COMMANDS, "/scene")
                assert json.loads((await seen.message(COMMANDS))[1])["status"]["state"] == "STARTUP"
                await seen.message("/scene")
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
                assert b" 200 " not in await asyncio.wait_for(reader.readline(), 10.0)
                writer.close()
        finally:
            daemon.terminate()
            assert await daemon.wait() == 0

    asyncio.run(main())


# the scene


def table(*, held: bool) -> dict[str, Any]:
    from arm_companion.live.feed import _drawn

    return _drawn(*flown(held))


def test_the_scene_has_vehicle_arm_bar_and_wrench_and_leaves_out_what_is_not_known() -> None:
    drawn = table(held=True)
    assert b"bar" in scene(1, drawn).encode()
    whole = len(scene(1, drawn).encode())
    without = drawn | {"bar": None, "force": None, "torque": None, "backbone": []}
    assert len(scene(1, without).encode()) < whole / 2
    assert b"body" in transforms(1, drawn).encode()
    fresh, stale = (transforms(1, drawn | {"fresh": fresh}).encode() for fresh in (True, False))
    assert len(stale) < len(fresh), "a vehicle that is not known stands nowhere"
    cone = {"apex": (0.0, 0.0, 0.05), "axis": (0.0, 0.0, -1.0), "half_angle": 1.0}
    assert b"keep-out" not in scene(1, drawn | {"keep_out": None}).encode()
    assert b"keep-out" in scene(1, drawn | {"keep_out": cone}).encode()
    zero = drawn | {"force": (0.0, 0.0, 0.0), "torque": (0.0, 0.0, 0.0)}
    assert len(scene(1, zero).encode()) < whole, "no wrench, no arrow"


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.6, -0.8), (0.0, 0.0, -1.0)])
def test_arrows_and_bars_are_turned_the_right_way(direction: tuple[float, float, float]) -> None:
    for axis in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        turned = so3.from_quaternion(turn_to(axis, direction)) @ axis
        assert turned == pytest.approx(direction, abs=1e-12)


# command line and layout


def test_words_that_are_no_address_are_refused() -> None:
    assert Address.read("0.0.0.0:9000") == Address("0.0.0.0", 9000)
    assert Address.read("[::1]:9000") == Address("::1", 9000)
    assert str(Address("::1", 9000)) == "[::1]:9000"
    for text in ("9000", "127.0.0.1", "example.org:9000", "127.0.0.1:0", "127.0.0.1:70000", "127.0.0.1:x", ""):
        with pytest.raises(ValueError, match=r"port|address"):
            Address.read(text)


def test_an_address_for_looking_is_asked_for_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--live", "nonsense"])
    assert "'nonsense' is not HOST:PORT, such as 127.0.0.1:8765" in capsys.readouterr().err


def test_simulated_time_has_no_live_view(capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line(["sim", "perch", "--simulated", "--live"]) == 2
    assert "real time" in capsys.readouterr().err


def test_without_the_sdk_the_daemon_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "foxglove" else object())

    async def main() -> None:
        with pytest.raises(ConfigError, match=r"foxglove-sdk.*arm-companion\[live\]"):
            LiveView(Config(), Clock(asyncio.get_running_loop(), 0.0), Address())

    asyncio.run(main())


def test_every_path_of_the_layout_names_something_that_is_sent() -> None:
    layout = json.loads((ROOT / "docs" / "foxglove_layout.json").read_text(encoding="utf-8"))
    panels = layout["configById"]

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert len(paths) > 10
    for path in paths:
        topic, *keys = path.split(".")
        schema = SCHEMAS[topic][1]
        for key in keys:
            name, *indices = re.findall(r"\w+", key)
            schema = schema["properties"][name]
            for _ in indices:
                schema = schema["items"]
        assert schema["type"] in {"number", "string"}, path
    assert panels["RosOut!log"]["topicToRender"] == LOG
    frames = repr(transforms(1, table(held=True)))
    camera = panels["3D!scene"]
    for name in [camera["followTf"], *(key.removeprefix("frame:") for key in camera["transforms"])]:
        assert f'"{name}"' in frames, name


@pytest.mark.parametrize("attitude", [(1.0, 0.0, 0.0, 0.0), (0.9, 0.3, -0.1, 0.3)])
def test_the_camera_follows_the_vehicle_and_stays_upright(attitude: tuple[float, ...]) -> None:
    """Through both ways of the tree: `vehicle` is where `body` is, and its third axis points up."""
    drawn = table(held=True) | {"fresh": True, "attitude_wb": attitude, "position_w": (1.0, 2.0, -3.0)}
    poses = {"map": (np.eye(3), np.zeros(3))}
    for parent, child, place, turn in re.findall(
        r'parent_frame_id: "(\w+)", child_frame_id: "(\w+)".*?Vector3 \{ (.*?) \}.*?Quaternion \{ (.*?) \}',
        repr(transforms(1, drawn)),
    ):
        p = np.array([float(number) for number in re.findall(r": (\S+?)(?:,|$)", place)])
        x, y, z, w = (float(number) for number in re.findall(r": (\S+?)(?:,|$)", turn))
        R0, p0 = poses[parent]
        q = np.array((w, x, y, z))
        poses[child] = R0 @ so3.from_quaternion(q / np.linalg.norm(q)), p0 + R0 @ p
    R, p = poses["vehicle"]
    assert p == pytest.approx(poses["body"][1])
    assert p == pytest.approx((2.0, 1.0, 3.0)), "east, north, up"
    assert R[:, 2] == pytest.approx((0.0, 0.0, 1.0))
    assert poses["world"][0][:, 2] == pytest.approx((0.0, 0.0, -1.0))


def test_a_record_has_the_same_channels() -> None:
    with GOLDEN.open("rb") as stream:
        names = {channel.topic for channel in make_reader(stream).get_summary().channels.values()}  # type: ignore[union-attr]
    assert {FACTS, STATE, COMMANDS, CONFIGURATION} <= names
