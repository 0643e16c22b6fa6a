"""The field page without sockets: who is let in, who gets what, what the daemon tells it, and ABORT on its way in."""

import asyncio
import dataclasses
import json
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import Config, load
from arm_companion.config.schema import PageConfig
from arm_companion.drivers.component import Component
from arm_companion.drivers.field_page import FieldPage
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.errors import ConfigError
from arm_companion.mission.facts import Answer, Facts, Notice, Result, Severity, VehicleState
from arm_companion.mission.facts import Order as ArmOrder
from arm_companion.mission.mission import step
from arm_companion.mission.outline import outline
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import State
from arm_companion.page.audience import Audience
from arm_companion.page.gate import Gate
from arm_companion.record.reader import Reader
from arm_companion.record.replay import Cycle, cycles
from tests.unit.test_mqtt import COMMANDS, HEALTH

GOLDEN = Path(__file__).parents[1] / "golden" / "perch.mcap"
CONFIG = dataclasses.replace(Config(), page=PageConfig(host="127.0.0.1"))
PARAMETERS = Parameters(CONFIG, RodModel(ArmParameters.of(CONFIG.arm)))
TOKEN = "a token that nobody guesses"


# who is let in


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "127.0.0.1", "localhost:9000", "[::1]:8080", "10.0.0.7:80", "Drone:80"]
)
def test_addresses_localhost_and_our_names_are_ours(host: str) -> None:
    assert Gate("", ["drone"]).knows_host(host)


@pytest.mark.parametrize(
    "host", ["", "evil.example", "evil.example:8080", "127.0.0.1.evil.example", "localhost.evil", "::1", "[::1",
             "a:b:c", "127.0.0.1:x", "user@127.0.0.1", "drone@evil", "127.0.0.1 evil"]
)  # fmt: skip
def test_a_name_that_somebody_else_made_is_not(host: str) -> None:
    """DNS rebinding: evil.example points at 127.0.0.1, and its page would be of the same origin as ours."""
    assert not Gate("", ["drone"]).knows_host(host)


def test_only_our_own_page_may_change_something() -> None:
    gate, host = Gate(""), "127.0.0.1:8080"
    assert gate.from_our_page({"host": host, "origin": f"http://{host}", "sec-fetch-site": "same-origin"})
    assert gate.from_our_page({"host": host, "origin": f"http://{host}"}), "an older browser"
    for headers in (
        {"host": host},
        {"host": host, "origin": "null"},
        {"host": host, "origin": "http://evil.example"},
        {"host": host, "origin": "http://127.0.0.1:9999"},
        {"host": host, "origin": f"http://{host}", "sec-fetch-site": "same-site"},
        {"origin": "http://"},
    ):
        assert not gate.from_our_page(headers), headers


def test_the_cookie_lets_in_and_nothing_else_does() -> None:
    gate = Gate(TOKEN)
    pair = gate.cookie.partition(";")[0]
    assert gate.admits({"cookie": f"other=1; {pair}"})
    assert TOKEN not in gate.cookie
    assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in gate.cookie.split(";")}
    assert Gate(TOKEN).admits({"cookie": pair}), "also after a restart"
    for cookie in ("", "arm_companion_page=", f"arm_companion_page={TOKEN}", pair[:-1], pair + "0", "[=;;\x00", "é=é"):
        assert not gate.admits({"cookie": cookie}), cookie
    assert not Gate("another token, as long").admits({"cookie": pair})
    assert Gate("").admits({})


@given(st.text(max_size=40))
def test_no_text_breaks_the_gate_or_opens_it(text: str) -> None:
    gate = Gate(TOKEN)
    assert not gate.is_token(text)
    assert not gate.admits({"cookie": text})
    assert not gate.from_our_page({"host": "127.0.0.1", "origin": text})
    gate.knows_host(text)
    assert not Gate("").is_token(text), "where there is no token, none is right"


# who gets what


def test_a_slow_viewer_gets_the_newest_of_each_and_every_sentence() -> None:
    async def main() -> None:
        counts: list[int] = []
        audience = Audience(counts.append)
        audience.put("events", "before")
        audience.put("state", "old")
        viewer = audience.join()
        for i in range(30):
            audience.put("state", str(i))
            audience.put("events", f"said {i}")
        found = await viewer.take(1.0)
        assert [payload for topic, payload in found if topic == "state"] == ["29"]
        assert [payload for topic, payload in found if topic == "events"] == [
            "before",
            *(f"said {i}" for i in range(30)),
        ]
        assert await viewer.take(1.0) == []
        for i in range(1000):
            audience.put("answer", str(i))
        assert len(await viewer.take(1.0)) <= 100, "and no more memory than that"
        audience.leave(viewer)
        audience.leave(viewer)
        assert counts == [1, 0, 0]
        audience.put("setup", "what lasts")
        found = await audience.join().take(1.0)
        assert ("answer", "999") not in found, "an answer is for who asked"
        assert ("setup", "what lasts") in found
        assert {topic for topic, _ in found} == {"setup", "events"}, "no state of who knows when, as if it were new"

    run_simulated(main())


# what the daemon tells


def with_page(
    test: Callable[[FieldPage, Component, Clock], Awaitable[None]], commanders: tuple[int, ...] = (), **page: Any
) -> None:
    async def main() -> None:
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        config = dataclasses.replace(CONFIG, page=PageConfig(host="127.0.0.1", **page))
        component = Component([], dataclasses.replace(config.vehicle, commanders=commanders), clock)
        made = FieldPage(config, clock, component.commands)
        component.hearers.append(made.event)
        await asyncio.sleep(10.0)
        await test(made, component, clock)

    run_simulated(main())


def told(page: FieldPage) -> list[tuple[str, dict[str, Any]]]:
    found = []
    while (entry := page.take()) is not None:
        found.append((entry.topic, json.loads(entry.payload)))
    return found


def cycle(clock: Clock) -> Situation:
    return Situation(State(), Facts(VehicleState(), ()), clock.now(), PARAMETERS)


def test_it_is_told_five_times_a_second_while_somebody_looks_and_sentences_always() -> None:
    async def test(page: FieldPage, component: Component, clock: Clock) -> None:
        async def fly(seconds: int) -> list[str]:
            for _ in range(100 * seconds):
                page.publish(clock.now(), cycle(clock), COMMANDS, lambda: HEALTH)
                await asyncio.sleep(0.01)
            return [topic for topic, _ in told(page)]

        assert await fly(1) == []
        component.notify(Notice(Severity.WARNING, "servo 2 is silent"))
        assert told(page)[0][1]["text"] == "servo 2 is silent"
        page._hear("viewers", "1")
        topics = await fly(2)
        assert [topics.count(name) for name in ("state", "wrench", "tendons", "arm", "health")] == [10, 10, 10, 10, 2]
        page._hear("gone", "")
        assert await fly(1) == []

    with_page(test)


def test_limits_that_the_ground_changes_are_those_that_are_shown() -> None:
    async def test(page: FieldPage, _component: Component, _clock: Clock) -> None:
        limits = dataclasses.replace(CONFIG.limits, tension_max_n=30.0, wrench_force_n=7.0)
        page.configure(dataclasses.replace(CONFIG, limits=limits))
        ((topic, now),) = told(page)
        assert topic == "limits"
        for shown in (now, page._settings["setup"]):
            assert (shown["tension_max"], shown["force_max"]) == (30.0, 7.0)

    with_page(test)


def test_what_fails_in_it_never_reaches_the_cycle(caplog: pytest.LogCaptureFixture) -> None:
    def broken() -> Health:
        raise RuntimeError("no health")

    async def test(page: FieldPage, _: Component, clock: Clock) -> None:
        page._hear("viewers", "1")
        for _ in range(5):
            page.publish(clock.now(), cycle(clock), COMMANDS, broken)
        assert [topic for topic, _ in told(page)] == ["state", "wrench", "tendons", "arm"]

    with_page(test)
    assert "page: telemetry failed" in caplog.text


def test_abort_goes_the_way_of_any_order_and_its_fate_comes_back() -> None:
    async def test(page: FieldPage, component: Component, _: Clock) -> None:
        page._hear("abort", "0123456789")
        page._hear("abort", "0123456789")
        (request,) = component.take()[0]
        assert request.order is ArmOrder.ABORT
        component.answer(Answer(request.id, Result.IN_PROGRESS, progress=30))
        component.answer(Answer(request.id, Result.ACCEPTED))
        answers = [values for topic, values in told(page) if topic == "answer"]
        assert [a["result"] for a in answers if a["nonce"] == "0123456789"][-2:] == ["in_progress", "accepted"]

    with_page(test)


def test_abort_needs_no_control_but_an_allowed_system_and_can_be_left_out() -> None:
    async def stranger(page: FieldPage, component: Component, _: Clock) -> None:
        page._hear("abort", "0123456789")
        assert component.take()[0] == []
        (answer,) = [values for topic, values in told(page) if topic == "answer"]
        assert answer["result"] == "denied"
        assert "system 253 may not command the arm" in answer["reason"]

    async def without(page: FieldPage, component: Component, _: Clock) -> None:
        page._hear("abort", "0123456789")
        assert component.take()[0] == []

    with_page(stranger, commanders=(255,))
    with_page(without, abort=False)


# the drawing


def test_the_line_is_the_rod_and_a_held_one_goes_around_its_bar() -> None:
    state, parameters, kinds = State(), None, set()
    for found in cycles(Reader(GOLDEN)):
        if not isinstance(found, Cycle):
            parameters = Parameters(found, RodModel(ArmParameters.of(found.arm)))
            continue
        assert parameters is not None
        state, _ = step(state, found.facts, found.t, parameters)
        s = Situation(state, found.facts, found.t, parameters)
        prediction = state.prediction
        if prediction is None or (prediction.anchored or prediction.free) is None or found.number % 7:
            continue
        seen = outline(s)
        line = np.array(seen.backbone_b)
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        assert length == pytest.approx(parameters.model.parameters.L, rel=0.02)
        assert line[0] == pytest.approx(s.mount.position)
        kinds.add(seen.held)
        if seen.held and seen.bar is not None and prediction.anchored is not None:
            radius = seen.bar.radius + parameters.config.perch.disk_radius_m
            away = np.linalg.norm(np.cross(line[-16:] - np.array(seen.bar.point_b), seen.bar.axis_b), axis=1)
            assert away == pytest.approx(radius, rel=0.1)
        elif prediction.free is not None:
            assert line == pytest.approx(s.mount @ prediction.free.detail.line())
            shape = s.mount @ prediction.free.shape(200)
            for point in line:
                assert float(np.linalg.norm(shape - point, axis=1).min()) < 1e-3
        if kinds == {True, False} and seen.held:
            break
    assert kinds == {True, False}


def test_without_a_prediction_or_a_vehicle_there_is_nothing_to_draw() -> None:
    seen = outline(Situation(State(), Facts(VehicleState(), ()), 1.0, PARAMETERS))
    assert (seen.backbone_b, seen.held, seen.bar) == ((), False, None)
    assert not math.isfinite(VehicleState().position_age_s)


# options


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["page.host=0.0.0.0"], "needs a token_file"),
        (["page.host=::"], "needs a token_file"),
        (["page.host=192.168.1.5"], "needs a token_file"),
        (["page.host=drone.example"], "no IP address"),
        (["page.host=127.0.0.1", "page.port=0"], "1 to 65535"),
        (["page.host=127.0.0.1", "page.rate_hz=100"], "0.5 to 20"),
        (["page.host=127.0.0.1", 'page.names=["a b"]'], "no host name"),
        (["page.tokens=x"], "unknown key"),
    ],
)
def test_options_that_do_not_fit_are_refused(settings: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load("sim.toml", settings)


def test_it_is_off_by_default_and_loopback_needs_no_token() -> None:
    assert not Config().page.host
    for host in ("127.0.0.1", "::1", "localhost", "127.0.0.2"):
        assert load("sim.toml", [f"page.host={host}"]).page.host == host


def test_a_token_that_others_can_read_or_guess_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "token"

    def made() -> None:
        with_page(lambda *_: asyncio.sleep(0.0), token_file=str(file))

    with pytest.raises(ConfigError, match="No such file"):
        made()
    file.write_text("short\n")
    file.chmod(0o600)
    with pytest.raises(ConfigError, match="5 characters"):
        made()
    file.write_text(TOKEN)
    made()
    file.chmod(0o644)
    with pytest.raises(ConfigError, match="others may use it"):
        made()
