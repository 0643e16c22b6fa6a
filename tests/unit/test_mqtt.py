"""MQTT without a broker: payloads, what is due, the queue, options, and every way that a command is refused."""

import asyncio
import contextlib
import dataclasses
import json
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, Self

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import Config, load
from arm_companion.config.schema import MqttConfig
from arm_companion.drivers import mqtt_payloads as payloads
from arm_companion.drivers.component import Component
from arm_companion.drivers.mqtt_client import Backlog, Connection
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.drivers.mqtt_publisher import MqttPublisher
from arm_companion.errors import ConfigError, ProtocolError
from arm_companion.mission.facts import (
    Answer,
    ArmAction,
    Commands,
    Facts,
    Notice,
    Request,
    Result,
    Severity,
    VehicleState,
    WrenchSource,
)
from arm_companion.mission.facts import Order as ArmOrder
from arm_companion.protocol.mqtt import SCHEMAS, Packet, packet, read_order, topic
from tests.sim.test_component_through_autopilot import STATUS, TENDON, WRENCH

DOCS = Path(__file__).parents[2] / "docs" / "mqtt.md"
PLAIN = MqttConfig(host="127.0.0.1", vehicle="7", commands=True)
VEHICLE = VehicleState(mode="OFFBOARD", armed=True, heartbeat_age_s=0.4)
FACTS = Facts(VEHICLE, (TENDON,) * 4)
COMMANDS = Commands(ArmAction.HOLD, None, None, (), (), STATUS, WRENCH)
HEALTH = Health(12.0, 1200, 3, 0, {"autopilot": True, "ground": False})


def table(made: Packet) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(made.payload)
    return value


# payloads


@pytest.mark.parametrize(
    "made",
    [
        payloads.state(1e9, STATUS, (TENDON,) * 4, WRENCH, VEHICLE),
        payloads.wrench(1e9, WRENCH),
        payloads.tendons(1e9, (TENDON,) * 4),
        payloads.event(1e9, Notice(Severity.WARNING, "words")),
        payloads.health(1e9, HEALTH, (TENDON,) * 4, VEHICLE, 5),
    ],
    ids=lambda made: made.topic,
)
def test_every_object_has_time_units_and_the_keys_of_its_schema(made: Packet) -> None:
    value = table(made)
    schema = SCHEMAS[made.topic]
    assert value.keys() == {"version", "time", "units", *schema}
    assert value["time"] == 1e9
    assert value["units"] == {"time": "s"} | {key: unit for key, (unit, _) in schema.items() if unit}


def test_values_are_what_they_are_and_what_is_unknown_is_null() -> None:
    value = table(
        payloads.state(1e9, dataclasses.replace(STATUS, theta=math.nan, progress=255), (TENDON,) * 4, WRENCH, VEHICLE)
    )
    assert (value["theta"], value["progress"], value["delta"], value["vehicle_mode"]) == (None, None, -0.2, "OFFBOARD")
    assert "SERVOS_CONNECTED" in value["flags"]
    assert value["errors"] == []
    silent = dataclasses.replace(TENDON, silent=True)
    assert table(payloads.health(1e9, HEALTH, (silent,), VEHICLE, 5))["voltage_min"] is None
    assert table(payloads.wrench(1e9, WRENCH))["taut_margin"] is None
    assert table(payloads.wrench(1e9, WRENCH))["source"] == WrenchSource.FREE.name.lower()
    assert "SERVO_SILENT" in table(payloads.state(1e9, STATUS, (silent,), WRENCH, VEHICLE))["errors"]


def test_keys_that_the_schema_lacks_are_a_bug() -> None:
    with pytest.raises(ProtocolError, match="events"):
        packet("events", 0.0, {"text": "x"})


def test_every_topic_and_key_is_documented() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for name, schema in SCHEMAS.items():
        assert f"### {name}\n" in text
        section = text.partition(f"### {name}\n")[2].partition("\n#")[0]
        for key, (unit, meaning) in schema.items():
            assert f"| `{key}` | {unit or '-'} | {meaning} |" in section, (name, key)


# what is due


def simulated(test: Callable[[Clock], Awaitable[None]]) -> None:
    async def main() -> None:
        await test(Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S))

    run_simulated(main())


def drained(publisher: MqttPublisher) -> list[str]:
    found = []
    while (made := publisher.take()) is not None:
        found.append(made.topic)
    return found


def test_messages_come_at_their_rates_and_a_new_state_at_once() -> None:
    async def test(clock: Clock) -> None:
        config = MqttConfig(host="x", state_hz=1.0, wrench_hz=5.0, tendons_hz=0.0, health_hz=0.5)
        publisher = MqttPublisher(config, clock)
        for _ in range(1000):
            publisher.publish(clock.now(), FACTS, COMMANDS, lambda: HEALTH)
            await asyncio.sleep(0.01)
        heard = drained(publisher)
        counts = {name: heard.count(name) for name in SCHEMAS}
        assert (counts["state"], counts["wrench"], counts["tendons"], counts["health"]) == (10, 50, 0, 5)
        publisher.publish(clock.now(), FACTS, COMMANDS, lambda: HEALTH)
        drained(publisher)
        other = dataclasses.replace(COMMANDS, status=dataclasses.replace(STATUS, state="APPROACH"))
        publisher.publish(clock.now(), FACTS, other, lambda: HEALTH)
        assert drained(publisher) == ["state"]

    simulated(test)


def test_the_queue_is_bounded_and_the_oldest_goes() -> None:
    async def test(clock: Clock) -> None:
        publisher = MqttPublisher(MqttConfig(host="x", queue_length=8), clock)
        for i in range(20):
            publisher.put(Packet("wrench", str(i).encode()))
        assert publisher.dropped == 12
        first = publisher.take()
        assert first is not None
        assert first.payload == b"12"

    simulated(test)


def test_telemetry_that_fails_never_reaches_the_cycle_and_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    async def test(clock: Clock) -> None:
        def broken() -> Health:
            raise RuntimeError("no health")

        publisher = MqttPublisher(MqttConfig(host="x", health_hz=10.0), clock)
        for _ in range(100):
            publisher.publish(clock.now(), FACTS, COMMANDS, broken)
            await asyncio.sleep(0.01)
        assert "state" in drained(publisher)

    simulated(test)
    assert sum("telemetry failed" in record.message for record in caplog.records) == 1


def test_without_aiomqtt_it_says_so_and_the_daemon_goes_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)

    async def test(clock: Clock) -> None:
        await MqttPublisher(MqttConfig(host="x"), clock).run()

    simulated(test)
    assert "arm-companion[mqtt]" in caplog.text


# options


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["mqtt.vehicle=a/b"], "no name for a topic"),
        (["mqtt.vehicle=#"], "no name for a topic"),
        (['mqtt.vehicle=""'], "no name for a topic"),
        (["mqtt.certificate_file=x"], "go together"),
        (["mqtt.password_file=x"], "needs user_file"),
        (["mqtt.ca_file=x"], "need tls"),
        (["mqtt.port=70000"], "0 to 65535"),
        (["mqtt.queue_length=1"], "8 to 10000"),
        (["mqtt.protocol=4"], "one of auto"),
        (["mqtt.host=broker", "mqtt.commands=true"], "need tls"),
        (["mqtt.host=broker", "mqtt.commands=true", "mqtt.tls=true"], "password_file or"),
        (["mqtt.topic=x"], "unknown key"),
    ],
)
def test_options_that_do_not_fit_are_refused(settings: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load("sim.toml", settings)


def test_commands_are_off_by_default_and_so_is_all_of_it() -> None:
    assert not Config().mqtt.host
    assert not Config().mqtt.commands
    assert MqttConfig().broker_port == 1883
    assert MqttConfig(tls=True).broker_port == 8883


def test_files_that_are_missing_or_open_to_others_are_refused(tmp_path: Path) -> None:
    user, password = tmp_path / "user", tmp_path / "password"
    user.write_text("arm")
    config = MqttConfig(host="x", user_file=str(user), password_file=str(password))

    async def test(clock: Clock) -> None:
        with pytest.raises(ConfigError, match="password: No such file"):
            MqttPublisher(config, clock)
        password.write_text("secret")
        password.chmod(0o644)
        with pytest.raises(ConfigError, match="others may use it"):
            MqttPublisher(config, clock)
        password.chmod(0o600)
        MqttPublisher(config, clock)

    simulated(test)


# commands


@given(st.binary(max_size=300) | st.text(max_size=200).map(str.encode))
def test_no_bytes_break_the_reader(payload: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        read_order(payload)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)


@given(st.fixed_dictionaries({}, optional=dict.fromkeys(("command", "parameters", "nonce", "time", "version"), _JSON)))
def test_what_is_read_is_well_formed(value: dict[str, Any]) -> None:
    try:
        order = read_order(json.dumps(value).encode())
    except ProtocolError:
        return
    assert order.command
    assert 1 <= len(order.nonce) <= 64
    assert all(map(math.isfinite, (*order.parameters, order.time)))


def test_a_bottomless_nesting_and_a_giant_are_no_command() -> None:
    for payload in (b"[" * 1000, b"{" * 1024, b" " * 2000, b'{"time": 1e999}'):
        with pytest.raises(ProtocolError):
            read_order(payload)


class Desk:
    """The component with commands over MQTT, and what was answered."""

    def __init__(self, clock: Clock, commanders: tuple[int, ...] = (254,), **options: Any) -> None:
        base = Config()
        self.clock = clock
        self.component = Component([], dataclasses.replace(base.vehicle, commanders=commanders), clock)
        self.publisher = MqttPublisher(dataclasses.replace(PLAIN, **options), clock, self.component.commands)
        self.component.hearers.append(self.publisher.event)
        commands = self.publisher._commands
        assert commands is not None
        self._commands = commands

    def send(
        self, command: str = "READY", nonce: str = "1", *parameters: float, age: float = 0.0
    ) -> list[dict[str, Any]]:
        time = self.clock.unix(self.clock.now()) - age
        order = {"command": command, "nonce": nonce, "time": time, "parameters": parameters}
        return self.raw(json.dumps(order).encode())

    def raw(self, payload: bytes) -> list[dict[str, Any]]:
        self._commands.take(payload)
        return self.answers()

    def answers(self) -> list[dict[str, Any]]:
        found = []
        while (made := self.publisher.take()) is not None:
            if made.topic == "answer":
                found.append(table(made))
        return found

    def requests(self) -> list[Request]:
        return self.component.take()[0]


def at_a_desk(test: Callable[[Desk], Awaitable[None]], **options: Any) -> None:
    async def main(clock: Clock) -> None:
        desk = Desk(clock, **options)
        await asyncio.sleep(20.0)
        await test(desk)

    simulated(main)


def test_a_command_becomes_a_request_and_its_fate_an_answer() -> None:
    async def test(desk: Desk) -> None:
        assert desk.send("JOG", "a", 1.0, 0.5, 0.1) == []
        (request,) = desk.requests()
        assert (request.order, request.parameters) == (ArmOrder.JOG, (1.0, 0.5, 0.1))
        desk.component.answer(Answer(request.id, Result.IN_PROGRESS, progress=40))
        (progress,) = desk.answers()
        assert (progress["result"], progress["progress"], progress["nonce"]) == ("in_progress", 40, "a")
        desk.component.answer(Answer(request.id, Result.FAILED, "the bar is not there"))
        (end,) = desk.answers()
        assert (end["result"], end["command"]) == ("failed", "JOG")
        assert "the bar is not there" in end["reason"]
        assert desk.send("JOG", "b", 1.0, 0.5, 0.1) == [], "and another one may come"

    at_a_desk(test)


@pytest.mark.parametrize(
    ("command", "order", "parameters"),
    [("CALIBRATE", ArmOrder.CALIBRATE, (1.0, 1.0)), ("REACH", ArmOrder.REACH, (0.0, 3.0, 0.5, -1.5))],
)
def test_the_later_orders_of_the_ground_come_by_mqtt_too(
    command: str, order: ArmOrder, parameters: tuple[float, ...]
) -> None:
    async def test(desk: Desk) -> None:
        assert desk.send(command, "a", *parameters) == []
        (request,) = desk.requests()
        assert (request.order, request.parameters) == (order, parameters)

    at_a_desk(test)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("READY", "n"), "s old"),
        (("FIRE", "n"), "no such command"),
        (("JOG", "n", 1.0, 99.0, 0.0), "outside"),
        (("JOG", "n", 1.5), "not a whole number"),
        (("PERCH", "n", 2.0), "outside 0 to 1"),
    ],
)
def test_a_command_that_is_wrong_or_old_is_denied_with_the_reason(words: tuple[Any, ...], reason: str) -> None:
    async def test(desk: Desk) -> None:
        (answer,) = desk.send(*words, age=6.0 if reason == "s old" else 0.0)
        assert answer["result"] == "denied"
        assert reason in answer["reason"]
        assert desk.requests() == []

    at_a_desk(test)


def test_the_future_and_the_time_before_the_start_are_refused() -> None:
    async def test(desk: Desk) -> None:
        assert "future" in desk.send(age=-6.0)[0]["reason"]
        assert "before this daemon" in desk.send(age=30.0)[0]["reason"]
        assert desk.requests() == []

    at_a_desk(test)


def test_a_replay_does_nothing_and_gets_the_same_answer() -> None:
    async def test(desk: Desk) -> None:
        time = desk.clock.unix(desk.clock.now())
        payload = json.dumps({"command": "READY", "nonce": "once", "time": time}).encode()
        desk.raw(payload)
        (request,) = desk.requests()
        assert desk.raw(payload) == [], "under way: nothing to tell yet"
        desk.component.answer(Answer(request.id, Result.ACCEPTED))
        (first,) = desk.answers()
        assert desk.raw(payload) == [first]
        await asyncio.sleep(4.0)
        assert desk.raw(payload) == [first]
        assert "used before" in desk.send("STOW", "once")[0]["reason"]
        assert desk.raw(payload) == [first]
        await asyncio.sleep(20.0)
        desk.send("STOW", "another")  # by now the first nonce need not be known any more
        assert "s old" in desk.raw(payload)[0]["reason"]
        assert [request.order for request in desk.requests()] == [ArmOrder.STOW]

    at_a_desk(test)


def test_the_same_checks_as_over_mavlink() -> None:
    async def test(desk: Desk) -> None:
        (answer,) = desk.send()
        assert answer["result"] == "denied"
        assert "system 254 may not command the arm" in answer["reason"]
        assert desk.requests() == []

    at_a_desk(test, commanders=(255,))


def test_the_same_command_twice_is_one_at_a_time_and_safety_is_always_taken() -> None:
    async def test(desk: Desk) -> None:
        desk.send("JOG", "a", 1.0, 0.5, 0.1)
        (answer,) = desk.send("JOG", "b", 1.0, 0.2, 0.1)
        assert "under way" in answer["reason"]
        for i in range(2000):
            desk.send("READY", f"flood {i}")
        desk.requests()
        desk.send("ABORT", "now")
        desk.send("ABORT", "now again")
        assert [request.order for request in desk.requests()] == [ArmOrder.ABORT]

    at_a_desk(test)


def test_each_of_two_stows_under_way_gets_its_answer() -> None:
    async def test(desk: Desk) -> None:
        desk.send("STOW", "first")
        (request,) = desk.requests()
        desk.send("STOW", "second")
        assert desk.requests() == []
        desk.component.answer(Answer(request.id, Result.ACCEPTED))
        assert [(a["nonce"], a["result"]) for a in desk.answers()] == [("first", "accepted"), ("second", "accepted")]
        assert [a["result"] for a in desk.send("STOW", "first")] == ["accepted"]

    at_a_desk(test)


def test_control_can_be_taken_and_malformed_orders_are_answered() -> None:
    async def test(desk: Desk) -> None:
        (answer,) = desk.send("CONTROL", "c", 1.0)
        assert answer["result"] == "accepted"
        assert desk.component.access.holder == (254, 190)
        (answer,) = desk.raw(b"nonsense")
        assert (answer["result"], answer["nonce"]) == ("denied", "")

    at_a_desk(test)


def test_notices_become_events() -> None:
    async def test(desk: Desk) -> None:
        desk.component.notify(Notice(Severity.ERROR, "servo 2 is silent"))
        made = desk.publisher.take()
        assert made is not None
        assert made.topic == "events"
        assert (table(made)["severity"], table(made)["text"]) == ("error", "servo 2 is silent")
        assert (made.qos, made.retain) == (1, False)
        assert topic("7", "events") == "arm/7/events"

    at_a_desk(test)


class _Library:
    """aiomqtt on Python 3.11: each call ends in `wait_for`, which loses a cancellation that comes with the outcome."""

    def __init__(self, slow: str, *, loses: bool, fails: bool = False) -> None:
        self.slow = slow  # the call whose answer is waited for
        self.loses = loses  # the answer comes with the cancellation
        self.fails = fails  # and is that it failed, as does all that follows
        self.gone = False
        self.asked = asyncio.Event()
        self.published: list[tuple[str, bytes]] = []

    async def _answer(self, call: str) -> None:
        if self.gone:
            raise aiomqtt.MqttError("connection refused")
        if call == self.slow:
            self.slow = ""
            self.asked.set()
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                if not self.loses:
                    raise
                if self.fails:
                    self.gone = True
                    raise aiomqtt.MqttError("connection refused") from None

    async def __aenter__(self) -> Self:
        await self._answer("connect")
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def publish(self, name: str, payload: bytes, **_: object) -> None:
        self.published.append((name.rsplit("/", 1)[-1], payload))
        await self._answer(name.rsplit("/", 1)[-1])

    async def subscribe(self, *_: object, **__: object) -> None:
        await self._answer("subscribe")

    @property
    async def messages(self) -> AsyncIterator[object]:
        await asyncio.Event().wait()
        yield None


@pytest.mark.parametrize("fails", [False, True], ids=["answers", "fails"])
@pytest.mark.parametrize("slow", ["connect", "availability", "subscribe", "state"])
def test_a_cancellation_that_the_library_loses_ends_the_connection_all_the_same(
    slow: str, fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        library, backlog = _Library(slow, loses=True, fails=fails), Backlog(10)
        backlog.put(Packet("state", b"1"))
        connection = Connection(MqttConfig(host="localhost", vehicle="7", commands=True), backlog, print, print)
        monkeypatch.setattr(connection, "_client", lambda _: library)
        task = asyncio.create_task(connection.run())
        await library.asked.wait()
        task.cancel()
        done, _ = await asyncio.wait({task}, timeout=5.0)
        assert done, "it goes on"
        assert task.cancelled()
        if not (fails and slow == "connect"):  # then it never was there
            assert library.published[-1] == ("availability", b"offline")

    run_simulated(main())


def test_one_who_is_cancelled_while_it_says_hello_says_goodbye(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        library = _Library("availability", loses=False)
        connection = Connection(MqttConfig(host="localhost", vehicle="7"), Backlog(10), print, print)
        monkeypatch.setattr(connection, "_client", lambda _: library)
        task = asyncio.create_task(connection.run())
        await library.asked.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert library.published == [("availability", b"online"), ("availability", b"offline")]

    run_simulated(main())
