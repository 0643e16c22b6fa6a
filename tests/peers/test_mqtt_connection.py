"""The MQTT client against brokers: the one of the tests, good and bad, and mosquitto where it is installed."""

import asyncio
import contextlib
import dataclasses
import json
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from arm_companion.clock import Clock, precise_loop, ticks, unix_now
from arm_companion.config.schema import MqttConfig
from arm_companion.drivers.mqtt_client import Backlog, Connection
from arm_companion.drivers.mqtt_publisher import MqttPublisher
from arm_companion.protocol.mqtt import Packet
from tests.mqtt_broker import Broker, serving

pytestmark = pytest.mark.realtime

PLAIN = MqttConfig(host="127.0.0.1", vehicle="7", reconnect_max_s=0.5, keepalive_s=2)


async def until(happened: Callable[[], Any], seconds: float = 10.0) -> None:
    async with asyncio.timeout(seconds):
        async for _ in ticks(0.02):
            if happened():
                break


@contextlib.asynccontextmanager
async def connected(
    config: MqttConfig, backlog: Backlog | None = None
) -> AsyncIterator[tuple[Backlog, list[bytes], list[str]]]:
    """The client at work: its backlog, the commands that it heard, and what it said."""
    backlog = backlog or Backlog(config.queue_length)
    commands: list[bytes] = []
    said: list[str] = []
    task = asyncio.create_task(Connection(config, backlog, commands.append, said.append, jitter=lambda: 0.0).run())
    try:
        yield backlog, commands, said
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def run(main: Callable[[], Awaitable[None]]) -> None:
    async def whole() -> None:
        await main()

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(whole())


@pytest.mark.parametrize(("versions", "spoken"), [((4, 5), 5), ((4,), 4), ((5,), 5)])
def test_it_speaks_the_newest_version_that_the_broker_has(versions: tuple[int, ...], spoken: int) -> None:
    async def main() -> None:
        async with serving(Broker(versions)) as broker, connected(dataclasses.replace(PLAIN, port=broker.port)):
            await until(lambda: broker.payloads("arm/7/availability") == [b"online"])
            assert [session.version for session in broker.sessions] == [spoken]
            assert broker.sessions[0].will == ("arm/7/availability", b"offline", True)

    run(main)


def test_messages_arrive_with_their_quality_and_retained_where_they_should() -> None:
    async def main() -> None:
        async with (
            serving(Broker()) as broker,
            connected(dataclasses.replace(PLAIN, port=broker.port)) as (backlog, _, _),
        ):
            for name in ("state", "wrench", "events"):
                backlog.put(Packet(name, name.encode()))
            await until(lambda: len(broker.messages) == 4)
            assert [(m.topic, m.qos, m.retain) for m in broker.messages[1:]] == [
                ("arm/7/state", 0, True),
                ("arm/7/wrench", 0, False),
                ("arm/7/events", 1, False),
            ]

    run(main)


def test_a_client_that_ends_says_offline_itself_and_one_that_dies_has_its_will() -> None:
    async def main() -> None:
        async with serving(Broker()) as broker:
            config = dataclasses.replace(PLAIN, port=broker.port)
            async with connected(config):
                await until(lambda: broker.retained.get("arm/7/availability") == b"online")
            await until(lambda: broker.retained.get("arm/7/availability") == b"offline")

    run(main)


def test_a_broker_that_comes_back_is_found_and_told_the_state_again() -> None:
    async def main() -> None:
        broker = Broker()
        await broker.start()
        async with connected(dataclasses.replace(PLAIN, port=broker.port)) as (backlog, _, _):
            backlog.put(Packet("state", b"1"))
            await until(lambda: broker.payloads("arm/7/state") == [b"1"])
            await broker.stop()
            backlog.put(Packet("state", b"2"))
            again = Broker()
            again.port = broker.port
            async with serving(again):
                await until(lambda: b"2" in again.payloads("arm/7/state"))
                assert again.payloads("arm/7/availability")[0] == b"online"

    run(main)


def test_a_broker_that_is_absent_deaf_or_mad_only_fills_the_backlog() -> None:
    async def main() -> None:
        for prepare in ({"deaf": True}, {"noise": b"\xff" * 4096}, {"noise": b"\x30\xff\xff\xff\x7f" + b"x" * 100_000}):
            broker = Broker()
            for key, value in prepare.items():
                setattr(broker, key, value)
            async with serving(broker), connected(dataclasses.replace(PLAIN, port=broker.port)) as (backlog, _, _):
                for i in range(1000):
                    backlog.put(Packet("wrench", str(i).encode()))
                await asyncio.sleep(0.8)
                assert backlog.dropped == 1000 - PLAIN.queue_length
                oldest = await backlog.take()
                assert oldest.payload == str(1000 - PLAIN.queue_length).encode(), "the oldest were dropped"

    run(main)


def test_commands_are_heard_only_where_allowed_never_retained_ones_and_no_flood() -> None:
    async def main() -> None:
        async with serving(Broker()) as broker:
            config = dataclasses.replace(PLAIN, port=broker.port, commands=True)
            async with connected(config) as (_, commands, _):
                await until(lambda: broker.sessions and broker.sessions[0].filters == ["arm/7/command"])
                await broker.send("arm/7/command", b"kept", retain=True)
                await broker.send("arm/7/command", b"one")
                await until(lambda: commands)
                assert commands == [b"one"]
                for _ in range(500):
                    await broker.send("arm/7/command", b"x" * 5000)
                await asyncio.sleep(0.5)
                assert len(commands) <= 41
                assert max(map(len, commands)) <= 1025
            async with connected(dataclasses.replace(PLAIN, port=broker.port)):
                await until(lambda: broker.sessions and not broker.sessions[-1].filters)

    run(main)


def test_user_and_password_come_from_files(tmp_path: Path) -> None:
    (tmp_path / "user").write_text("arm\n")
    (tmp_path / "password").write_text("s3cret \n")

    async def main() -> None:
        config = dataclasses.replace(PLAIN, user_file=str(tmp_path / "user"), password_file=str(tmp_path / "password"))
        async with serving(Broker()) as broker, connected(dataclasses.replace(config, port=broker.port)):
            await until(lambda: broker.sessions)
            assert (broker.sessions[0].user, broker.sessions[0].password) == ("arm", "s3cret ")

    run(main)


# the process


def test_the_process_publishes_hears_is_started_again_and_ends_with_its_daemon() -> None:
    async def main() -> None:
        async with serving(Broker()) as broker:
            config = dataclasses.replace(PLAIN, port=broker.port, commands=True)
            publisher = MqttPublisher(config, Clock(asyncio.get_running_loop(), 1e9))
            task = asyncio.create_task(publisher.run())
            try:
                publisher.put(Packet("wrench", b"first"))
                await until(lambda: b"first" in broker.payloads("arm/7/wrench"), 30.0)
                (child,) = children()
                os.kill(child, signal.SIGKILL)
                await until(lambda: broker.retained.get("arm/7/availability") == b"offline")
                publisher.put(Packet("wrench", b"second"))
                await until(lambda: b"second" in broker.payloads("arm/7/wrench"), 30.0)
            finally:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
            await until(lambda: broker.retained.get("arm/7/availability") == b"offline")
            assert children() == []

    run(main)


def test_a_hostile_broker_does_not_touch_the_loop_of_the_daemon() -> None:
    """A flood that keeps the client's process at work: the ticks of this loop stay as they are."""

    async def flood(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        chunk = b"\x30\x7f\x00\x01a" + b"x" * 124
        with contextlib.suppress(ConnectionError):
            while not writer.is_closing():
                writer.write(b"\x20\x02\x00\x00" + chunk * 200)
                await writer.drain()
                await asyncio.sleep(0.005)
        writer.close()

    async def main() -> None:
        server = await asyncio.start_server(flood, "127.0.0.1", 0)
        config = dataclasses.replace(PLAIN, port=server.sockets[0].getsockname()[1])
        publisher = MqttPublisher(config, Clock(asyncio.get_running_loop(), 1e9))
        task = asyncio.create_task(publisher.run())
        missed = seen = 0
        start = time.monotonic()
        async for tick in ticks(0.05):
            publisher.put(Packet("wrench", b"x"))
            missed, seen = missed + tick.missed, seen + 1
            if time.monotonic() - start > 3.0:
                break
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        server.close()
        assert missed <= seen // 4, "this machine alone may lose a tick now and then"

    run(main)


def children() -> list[int]:
    """The client's processes that this one has started, from /proc: `ps` cuts command lines where it thinks fit."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # a process that ends while it is looked at
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid() and b"mqtt_client" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return found


def test_the_whole_daemon_tells_its_state_and_takes_a_command(tmp_path: Path) -> None:
    async def main() -> None:
        async with serving(Broker()) as broker:
            words = [sys.executable, "-m", "arm_companion", "run", "--config", "sim.toml"]
            for setting in (
                f"links.autopilot.url=udpin:127.0.0.1:{free_udp_port()}",
                f"links.ground.url=udpout:127.0.0.1:{free_udp_port()}",
                f"servos.port={tmp_path / 'nothing'}",
                "mqtt.host=127.0.0.1",
                f"mqtt.port={broker.port}",
                "mqtt.commands=true",
            ):
                words += ["--set", setting]
            daemon = await asyncio.create_subprocess_exec(*words, stderr=asyncio.subprocess.DEVNULL)
            try:
                await until(lambda: broker.payloads("arm/1/health") and broker.payloads("arm/1/state"), 30.0)
                assert json.loads(broker.payloads("arm/1/state")[0])["state"] == "STARTUP"
                order = {"command": "PERCH", "nonce": "n", "time": unix_now()}
                await broker.send("arm/1/command", json.dumps(order).encode())
                await until(lambda: broker.payloads("arm/1/answer"))
                answer = json.loads(broker.payloads("arm/1/answer")[-1])
                assert (answer["nonce"], answer["result"]) == ("n", "temporarily_rejected")
                assert "PERCH" in answer["reason"]
                daemon.terminate()
                assert await asyncio.wait_for(daemon.wait(), 10.0) == 0
                await until(lambda: broker.retained["arm/1/availability"] == b"offline")
            finally:
                with contextlib.suppress(ProcessLookupError):
                    daemon.kill()
                await daemon.wait()

    run(main)


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
    return port


# mosquitto


@dataclasses.dataclass
class Mosquitto:
    port: int
    folder: Path


def certificates(folder: Path) -> None:
    """An authority, a broker's and a client's certificate, as an integrator would make them."""

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=test authority",
            "-keyout", "ca.key", "-out", "ca.pem")  # fmt: skip
    (folder / "san").write_text("subjectAltName=IP:127.0.0.1\n")
    for name in ("broker", "arm"):
        openssl("req", "-newkey", "rsa:2048", "-nodes", "-subj", f"/CN={name}", "-keyout", f"{name}.key",
                "-out", f"{name}.csr")  # fmt: skip
        openssl("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial",
                "-days", "2", "-extfile", "san", "-out", f"{name}.pem")  # fmt: skip
        (folder / f"{name}.key").chmod(0o600)


@pytest.fixture(scope="module")
def mosquitto(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    program = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
    if program is None or shutil.which("openssl") is None:
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.warn("mosquitto IS NOT INSTALLED: TLS and access lists were not tested", stacklevel=1)
        pytest.skip("mosquitto IS NOT INSTALLED: TLS and access lists were not tested")
    folder = tmp_path_factory.mktemp("mosquitto")
    folder.chmod(0o755)
    certificates(folder)
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    (folder / "acl").write_text("user arm\ntopic readwrite arm/7/#\nuser broker\ntopic read arm/#\n")
    (folder / "mosquitto.conf").write_text(
        f"user root\nlistener {port} 127.0.0.1\ncafile {folder}/ca.pem\ncertfile {folder}/broker.pem\n"
        f"keyfile {folder}/broker.key\nrequire_certificate true\nuse_identity_as_username true\n"
        f"acl_file {folder}/acl\nallow_anonymous false\n"
    )
    process = subprocess.Popen([program, "-c", folder / "mosquitto.conf"], stderr=subprocess.PIPE)
    try:
        for _ in range(200):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.1):
                break
            time.sleep(0.05)
        yield Mosquitto(port, folder)
    finally:
        process.terminate()
        process.communicate()


def secure(broker: Mosquitto, **changes: Any) -> MqttConfig:
    folder = broker.folder
    config = dataclasses.replace(
        PLAIN, port=broker.port, tls=True, ca_file=f"{folder}/ca.pem", certificate_file=f"{folder}/arm.pem",
        key_file=f"{folder}/arm.key", commands=True,
    )  # fmt: skip
    return dataclasses.replace(config, **changes)


def watcher(broker: Mosquitto, name: str = "broker") -> aiomqtt.Client:
    context = ssl.create_default_context(cafile=f"{broker.folder}/ca.pem")
    context.load_cert_chain(f"{broker.folder}/{name}.pem", f"{broker.folder}/{name}.key")
    return aiomqtt.Client("127.0.0.1", broker.port, tls_context=context)


def test_mosquitto_with_tls_certificates_and_access_lists(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        async with connected(secure(mosquitto)) as (backlog, commands, said):
            await until(lambda: said)
            assert said == [f"connected to 127.0.0.1:{mosquitto.port}, MQTT 5"]
            backlog.put(Packet("state", b'{"state": "READY"}'))
            await asyncio.sleep(0.3)
            async with watcher(mosquitto) as client:
                await client.subscribe("arm/#")
                heard = {}
                async with asyncio.timeout(5.0):
                    async for message in client.messages:
                        heard[str(message.topic)] = (message.payload, message.retain)
                        if len(heard) == 2:
                            break
                assert heard["arm/7/availability"] == (b"online", True)
                assert heard["arm/7/state"] == (b'{"state": "READY"}', True)
                await client.publish("arm/7/command", b"from whom may only read", qos=1)
            async with watcher(mosquitto, "arm") as client:
                await client.publish("arm/7/command", b"from whom may write", qos=1)
            await until(lambda: commands)
            assert commands == [b"from whom may write"]

    run(main)


# paho leaves the socket of a failed handshake to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize(
    ("changes", "words"),
    [({"certificate_file": "", "key_file": ""}, ""), ({"ca_file": ""}, "certificate verify failed")],
)
def test_without_the_right_certificates_there_is_no_connection(
    mosquitto: Mosquitto, changes: dict[str, Any], words: str
) -> None:
    async def main() -> None:
        async with connected(secure(mosquitto, **changes)) as (_, _, said):
            await until(lambda: said)
            assert words in said[0]
            assert not any("connected to" in text for text in said)

    run(main)
