"""Gusts, and perches that are taken back: the wind itself, the verdict on aborts, and the flights."""

import dataclasses
import io
import json
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure as MatplotlibFigure
from rich.console import Console

from arm_companion.__main__ import main
from arm_companion.cli import sim as cli
from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.abort_verdict import LET_GO_WITHIN_S, judge_aborts
from arm_companion.sim.figure import _draw_contact, _draw_moves
from arm_companion.sim.flight import Flight, Mark
from arm_companion.sim.mishaps import ABORTED_IN, fly_aborts, fly_in_gusts, fly_one_abort
from arm_companion.sim.ports import PlantTruth, RigidState, RotorCommand
from arm_companion.sim.progress import show_verdict
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.scenario import Operator
from arm_companion.sim.verdict import judge
from arm_companion.sim.wind import Wind
from arm_companion.sim.world import Sample, World

STEADY = (1.0, -0.5, 0.2)
LEVEL = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)


def strength(wind: tuple[float, float, float]) -> float:
    return math.dist(wind, STEADY)


@given(st.integers(0, 1000), st.floats(0.1, 10.0))
def test_gusts_come_and_go_level_and_smooth_and_never_exceed_their_peak(seed: int, peak: float) -> None:
    wind, step = Wind(STEADY, peak, seed), 0.02
    seen = [wind.at(i * step) for i in range(3000)]
    blown = [strength(w) for w in seen]
    assert max(blown) <= peak + 1e-9
    assert max(blown) > 0.3 * peak, "a minute has several gusts"
    assert min(blown) == 0.0, "and pauses"
    assert all(w[2] == STEADY[2] for w in seen)
    # the steepest gust is the shortest: peak pi / length
    assert max(abs(b - a) for a, b in pairwise(blown)) <= peak * math.pi / 0.8 * step + 1e-9


def test_the_wind_is_drawn_from_its_seed_and_is_steady_without_gusts() -> None:
    def blow(gust: float, seed: int) -> list[tuple[float, float, float]]:
        wind = Wind(STEADY, gust, seed)
        return [wind.at(0.1 * i) for i in range(300)]

    assert blow(3.0, 7) == blow(3.0, 7) != blow(3.0, 8)
    assert set(blow(0.0, 7)) == {STEADY}


def test_a_gust_pushes_the_vehicle_in_the_plant() -> None:
    config = load("sim.toml", ("sim.gust_m_per_s=8.0",))
    world = World(config)
    hover = RotorCommand(config.vehicle.mass_kg * 9.81, ZERO)
    pushed = []
    for _ in range(5000):
        world.plant.blow(world.wind.at(world.plant.time))
        world.plant.step(hover, (0.0,) * 4)
        pushed.append(math.hypot(*world.plant.state().velocity_w[:2]))
    assert max(pushed) > 0.2


def sample(t: float, touch: float = 0.0, down: float = -2.0, sinking: float = 0.0) -> Sample:
    state = RigidState((0.0, 0.0, down), (0.0, 0.0, sinking), LEVEL, ZERO, (0.0, 0.0, -9.81))
    truth = PlantTruth(ZERO, ZERO, touch, ZERO, 0.0, (4.0,) * 4, ZERO, body_contact=False, rotor_contact=False)
    return Sample(t, state, truth)


def aborted(touch_until: float, *, falls: bool = False) -> Flight:
    """An abort at 10 s; afterwards the vehicle lands."""
    samples = [sample(0.1 * i, touch=5.0 if 0.1 * i < 10.0 + touch_until else 0.0) for i in range(600)]
    if falls:
        samples[120] = sample(12.0, down=-1.0, sinking=2.0)
    samples += [sample(60.0 + 0.1 * i, down=0.0) for i in range(20)]
    marks = [Mark("WRAP", 10.0, 40.0, ZERO)]
    return Flight(samples, [(0.0, "WRAP"), (10.0, "UNLOAD"), (30.0, "STOWED")], marks=marks, end=62.0)


def test_the_verdict_on_an_abort_is_the_plants() -> None:
    good = judge_aborts(aborted(6.0), "")
    assert good.success, good.reason
    assert good.aborts[0].let_go_s == pytest.approx(6.0, abs=0.11)
    late = judge_aborts(aborted(LET_GO_WITHIN_S + 1.0), "")
    assert not late.success
    assert "still touched the bar" in late.reason
    fell = judge_aborts(aborted(6.0, falls=True), "")
    assert "fell by 1.00 m" in fell.reason
    assert not judge_aborts(Flight(aborted(6.0).samples, [(0.0, "STOWED")], end=62.0), "").success
    assert "no answer" in judge_aborts(aborted(6.0), "no answer").reason


@pytest.mark.parametrize(("lost_s", "code"), [(0.0, 1), (0.1, 1), (3.0, cli.TOO_SLOW)])
def test_a_failure_on_a_machine_that_fell_behind_has_an_exit_code_of_its_own(
    lost_s: float, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flown = Result(aborted(6.0), "", lost_s=lost_s)  # it never perched
    monkeypatch.setattr(cli, "_real_time", lambda *_: flown)
    assert main(["sim", "perch", "--output", str(tmp_path), "--json"]) == code
    said = capsys.readouterr()
    assert ("fell 3.0 s behind real time" in said.err) is (code == cli.TOO_SLOW)
    assert json.loads(said.out.splitlines()[-1])["lost_s"] == lost_s


@pytest.mark.scenario
def test_a_perch_that_is_aborted_lets_go_in_whatever_state_it_is() -> None:
    config = load("sim.toml")
    result = run_simulated(fly_simulated(config, lambda _: None, fly=fly_aborts))
    verdict = judge_aborts(result.flight, result.failure)
    assert verdict.success, verdict.reason
    assert [abort.state for abort in verdict.aborts] == list(ABORTED_IN)
    touched = {abort.state for abort in verdict.aborts if abort.let_go_s > 0.0}
    assert {"VERIFY", "PERCHED"} <= touched
    assert "APPROACH" not in touched


@pytest.mark.scenario
def test_an_abort_in_mid_air_ends_at_home() -> None:
    config = load("sim.toml", ("sim.seed=6",))
    assert ABORTED_IN[6 % len(ABORTED_IN)] == "APPROACH"
    result = run_simulated(fly_simulated(config, lambda _: None, fly=fly_one_abort))
    verdict = judge_aborts(result.flight, result.failure)
    assert verdict.success, verdict.reason
    assert [(a.state, a.let_go_s) for a in verdict.aborts] == [("APPROACH", 0.0)]


@pytest.mark.scenario
def test_a_vehicle_perches_in_gusts_and_stays_perched_in_them() -> None:
    config = load("sim_gust.toml")
    result = run_simulated(fly_simulated(config, lambda _: None, fly=fly_in_gusts))
    verdict = judge(result.flight, result.failure, leaning=True)
    assert verdict.success, verdict.reason
    assert max(max(s.truth.tension) for s in result.flight.samples) < 1.05 * config.limits.tension_max_n


@pytest.mark.scenario
def test_an_abort_in_a_state_that_never_came_is_none() -> None:
    config = load("sim.toml", ("sim.seed=3", "sim.bar.position_m=[3.1, 0.0, -2.0]"))
    assert ABORTED_IN[3 % len(ABORTED_IN)] == "WRAP"
    result = run_simulated(fly_simulated(config, lambda _: None, fly=fly_one_abort))
    verdict = judge_aborts(result.flight, result.failure)
    assert not verdict.success
    assert verdict.aborts == []
    assert "ended before WRAP" in verdict.reason


def test_the_table_of_aborts_shows_no_force_that_nobody_measured() -> None:
    stream = io.StringIO()
    show_verdict("Aborted perches", judge_aborts(aborted(6.0), ""), Console(file=stream, width=200), [])
    assert "abort in WRAP" in stream.getvalue()
    assert "contact force" not in stream.getvalue()


@pytest.mark.parametrize("how", ["fails", "no disk"])
def test_a_flight_leaves_nothing_of_an_earlier_one_and_its_verdict_whatever_the_disk_does(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly(*_: object) -> Result:
        if how == "fails":
            raise LinkError("no port")
        (tmp_path / "events.log").mkdir()
        return Result(aborted(6.0), "")

    for name in ("perch.png", "events.log", "daemon.log", "record.mcap"):
        (tmp_path / name).write_text("of the day before", encoding="utf-8")
    monkeypatch.setattr(cli, "_simulated", fly)
    assert main(["sim", "perch", "--simulated", "--output", str(tmp_path)]) == 1
    assert not any(path.is_file() and b"day before" in path.read_bytes() for path in tmp_path.iterdir())
    out, err = capsys.readouterr()
    assert ("verdict: failed" in out) is (how == "no disk")
    assert ("no port" if how == "fails" else "Is a directory") in err


def test_a_world_for_people_is_not_simulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "world", "--simulated", "--output", str(tmp_path)]) == 2
    assert "leave out --simulated" in capsys.readouterr().err


def test_the_operator_shows_whole_sentences_and_none_again_and_again() -> None:
    said: list[str] = []
    flight = Flight()
    watchers: list[Callable[[Any], None]] = []
    link: Any = SimpleNamespace(watch=watchers.append)
    Operator(link, load("sim.toml"), flight, said.append)

    def text(source: int, words: str, id_: int = 0, chunk: int = 0) -> None:
        message = mav.MAVLink_statustext_message(mav.MAV_SEVERITY_WARNING, words.encode(), id_, chunk)
        message.get_header().srcSystem, message.get_header().srcComponent = 1, source
        watchers[0](message)

    async def main() -> None:
        long = "REACH -> DEPART: no contact 6 cm past where the bar should be"
        for _ in range(3):
            text(1, "Arming denied: estimator not ready")
        text(192, long[:50], 7, 0)
        text(1, "another speaks in between")
        text(192, long[50:], 7, 1)
        assert said == [
            "“Arming denied: estimator not ready”",
            "“another speaks in between”",
            f"“{long}”",
        ]
        assert [words for _, words in flight.texts].count("Arming denied: estimator not ready") == 3

    run_simulated(main())


def test_no_move_is_no_negative_one() -> None:
    stream = io.StringIO()
    verdict = dataclasses.replace(judge_aborts(aborted(6.0), ""), hover_error_m=-0.00001)
    show_verdict("Aborted perches", verdict, Console(file=stream, width=200), [])
    assert "-0.0 mm" not in stream.getvalue()
    assert "0.0 mm" in stream.getvalue()


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert main(["sim", "perch", "--simulated", "--output", str(tmp_path / "file")]) == 78
    assert "--output" in capsys.readouterr().err


def test_the_picture_of_a_perch_without_moves_shows_what_it_did_on_the_bar() -> None:
    flight = aborted(6.0)
    flight.states = [(0.0, "READY"), (2.0, "PERCHED"), (5.0, "STOWED")]
    axis = MatplotlibFigure().subplots()
    _draw_moves(axis, flight, 0.0)
    assert not axis.texts, "it was perched"
    assert [line.get_label() for line in axis.lines] == ["north", "east", "down"]


def test_no_contact_is_a_line_at_zero_and_time_has_no_margin() -> None:
    axis = MatplotlibFigure().subplots()
    axis.margins(x=0)
    flight = aborted(6.0)
    flight.samples[:] = [s for s in flight.samples if not s.truth.contact_force_n]
    _draw_contact(axis, flight, 0.0)
    assert axis.get_ylim() == (0.0, 1.0)
    assert axis.get_xlim() == (flight.samples[0].t, flight.samples[-1].t)
