"""The calibration that the ground station orders, cycle by cycle, on an arm that is a few lines of arithmetic."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from arm_companion.config.schema import Config
from arm_companion.mission.facts import (
    Answer,
    ArmAction,
    ArmFault,
    CalibrationState,
    Facts,
    Order,
    Request,
    Result,
)
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase, State
from arm_companion.record_codec import dumps, loads
from tests.unit.calibration_bench import CALIBRATE, ON_GROUND, START, ZEROS, Bench, Change, resumed
from tests.unit.mission_rig import DT, SETUP, T0, Run, ask, memory
from tests.unit.test_procedures import hanging


@pytest.fixture(scope="module")
def brisk(parameters: Parameters) -> Parameters:
    """The shipped arm, which takes its tendons up faster than it should."""
    calibration = dataclasses.replace(parameters.config.calibration, take_up_m_per_s=0.014)
    return Parameters(dataclasses.replace(parameters.config, calibration=calibration), parameters.model)


@dataclasses.dataclass(repr=False)  # it is megabytes long
class Way:
    """One whole calibration, and where everything was on the way."""

    bench: Bench
    first: State
    stops: list[tuple[State, np.ndarray, list[bool]]]


@pytest.fixture(scope="module")
def way(brisk: Parameters) -> Way:
    bench = Bench(brisk)
    first, stops = bench.run.state, []
    bench.order()
    for cycle in range(12_000):
        if bench.zeros:
            break
        if cycle % 50 == 0:
            stops.append((bench.run.state, bench.wound.copy(), list(bench.torque)))
        bench.cycle()
    bench.for_a_while(0.1)  # a disk takes its time
    assert bench.phase is Phase.CALIBRATING
    bench.kept = ""
    bench.cycle()
    return Way(bench, first, stops)


def test_the_zeros_are_found_and_the_order_ends_when_they_are_stored(way: Way) -> None:
    bench = way.bench
    assert bench.run.phases == [Phase.STOWED, Phase.CALIBRATING, Phase.STOWED]
    assert bench.results() == [Result.ACCEPTED]
    (found,) = bench.zeros
    error = np.array([zero.ticks for zero in found]) * SETUP.m_per_tick * np.array(SETUP.directions) - ZEROS
    assert np.all(np.abs(error) < 4.0 * np.array([zero.sigma for zero in found]))
    assert max(abs(error[0] + error[2]), abs(error[1] + error[3])) / 2 < 0.0001
    assert bench.torque == [False] * 4
    told = [text for text in bench.run.texts if "ticks from before" in text]
    assert [f"{zero.ticks:+d} ticks" in text for zero, text in zip(found, told, strict=True)] == [True] * 4


def test_progress_grows_from_0_to_99_and_the_status_says_that_it_runs(way: Way) -> None:
    told = [answer.progress for answer in way.bench.answers]
    assert told[0] == 0
    assert told == sorted(told)
    assert told[-2:] == [99, 100]
    assert len(told) > 20
    running = [c.status for c in way.bench.run.said if c.status.state == "CALIBRATING"]
    assert {status.calibration for status in running} == {CalibrationState.RUNNING}
    assert {status.behaviour for status in running} == {"calibrate"}
    assert not any(status.error_bits & (ArmFault.MODEL | ArmFault.TENDON_SLACK) for status in running)


def test_goals_never_jump_and_slack_is_told_to_nobody(way: Way, brisk: Parameters) -> None:
    fastest = 2.0 * brisk.config.calibration.take_up_m_per_s * DT
    goals = [c.pulls for c in way.bench.run.said if c.pulls is not None]
    assert max(np.abs(np.diff(np.array(goals), axis=0)).max(), np.abs(goals[0] - START).max()) < fastest + 1e-12
    assert not any("slack:" in text for text in way.bench.run.texts)


def test_the_same_facts_make_the_same_commands_whatever_was_calculated_in_between(way: Way, brisk: Parameters) -> None:
    """As a replay does it; and a second one in between, so that nothing can hide outside the memory."""
    state, other = way.first, way.first
    t = way.first.t
    for facts, said in zip(way.bench.facts, way.bench.run.said, strict=True):
        t += DT
        before = state
        state, commands = step(state, facts, t, brisk)
        assert commands == said
        assert commands.zeros == said.zeros
        if len(state.course.answers if state.course else ()) != len(before.course.answers if before.course else ()):
            other, _ = step(way.first, facts, T0 + DT, brisk)
            assert step(before, facts, t, brisk)[1] == said
    assert other.phase in (Phase.STOWED, Phase.CALIBRATING)


def test_memory_on_the_way_is_small_plain_text(way: Way) -> None:
    for state, _, _ in way.stops[::5]:
        text = dumps(state)
        assert len(text) < 6000
        assert dumps(loads(State, text)) == text


def test_a_mission_whose_readings_are_gone_gives_up(way: Way, brisk: Parameters) -> None:
    state, wound, torque = way.stops[40]
    bench = resumed(brisk, loads(State, dumps(state)), wound, torque)
    bench.for_a_while(0.05)
    assert "not remembered" in bench.run.texts[0]
    assert bench.results() == [Result.FAILED]


# What refuses it.

REFUSALS: dict[str, Change] = {
    "the vehicle is armed": lambda f: dataclasses.replace(f, vehicle=dataclasses.replace(f.vehicle, armed=True)),
    "not on the ground": lambda f: dataclasses.replace(f, vehicle=dataclasses.replace(f.vehicle, landed=False)),
    "has not been heard": lambda f: dataclasses.replace(
        f, vehicle=dataclasses.replace(f.vehicle, heartbeat_age_s=math.inf)
    ),
    "heartbeat 9.0 s old": lambda f: dataclasses.replace(
        f, vehicle=dataclasses.replace(f.vehicle, heartbeat_age_s=9.0)
    ),
    "nowhere to keep": lambda f: dataclasses.replace(f, workshop=None),
    "does not answer; mend it": lambda f: tendon(f, 2, silent=True),
    "lost its turns": lambda f: tendon(f, 1, homed=False),
    "hardware error 0x20": lambda f: tendon(f, 0, error_bits=0x20),
    "lets go at": lambda f: tendon(f, 3, temperature=70.0),
    "servo supply 9.7 V": lambda f: tendon(f, 3, voltage=9.7),
}


def tendon(facts: Facts, i: int, **changes: object) -> Facts:
    found = list(facts.tendons)
    found[i] = dataclasses.replace(found[i], **changes)  # type: ignore[arg-type]
    return dataclasses.replace(facts, tendons=tuple(found))


@pytest.mark.parametrize("words", REFUSALS)
def test_it_is_refused_for_now_with_the_reason(words: str, brisk: Parameters) -> None:
    bench = Bench(brisk)
    bench.for_a_while(1.2, REFUSALS[words])
    bench.order(REFUSALS[words])
    (answer,) = bench.answers
    assert (answer.result, bench.phase) == (Result.TEMPORARILY_REJECTED, Phase.STOWED)
    assert words in answer.reason
    assert bench.run.said[-1].arm is ArmAction.HOLD


@pytest.mark.parametrize("phase", [p for p in Phase if p is not Phase.STOWED], ids=lambda p: p.name)
def test_it_begins_in_no_other_state(phase: Phase, brisk: Parameters) -> None:
    bench = Bench(brisk)
    bench.run = Run(memory(phase, armed=False, control=ON_GROUND.control), brisk)
    bench.order()
    first = bench.answers[0]
    assert first.result is Result.TEMPORARILY_REJECTED
    assert first.reason.startswith(f"CALIBRATE is not possible in state {phase.name}")


def changed(parameters: Parameters, change: Callable[[Config], Config]) -> Parameters:
    return Parameters(change(parameters.config), parameters.model)


def test_coupled_tendons_and_limits_that_are_too_narrow_are_refused(brisk: Parameters) -> None:
    coupling = tuple(tuple(1.0 if i == j else 0.1 for j in range(4)) for i in range(4))
    for parameters, words in (
        (
            changed(brisk, lambda c: dataclasses.replace(c, servos=dataclasses.replace(c.servos, coupling=coupling))),
            "coupled",
        ),
        (
            changed(brisk, lambda c: dataclasses.replace(c, limits=dataclasses.replace(c.limits, pull_max_m=0.03))),
            "pull_max_m",
        ),
    ):
        bench = Bench(parameters)
        bench.order()
        assert words in bench.answers[0].reason


def test_another_order_that_is_under_way_is_not_ended_by_it(brisk: Parameters) -> None:
    bench = Bench(brisk)
    bench.cycle(lambda f: ask(tendon(f, 1, homed=False), Order.CLEAR_ERRORS))
    bench.order(lambda f: tendon(f, 1, homed=False))
    assert bench.answers[-1].reason == "CLEAR_ERRORS is under way"
    assert bench.results() == [Result.TEMPORARILY_REJECTED]


def test_while_it_runs_nothing_else_is_taken_but_ways_to_end_it(way: Way, brisk: Parameters) -> None:
    for order in Order:
        bench = resumed(brisk, *way.stops[30])
        bench.cycle(lambda f, order=order: ask(f, order, *((0.0,) if order is Order.FEEDFORWARD else CALIBRATE)))
        ends = order in (Order.ABORT, Order.STOW)
        assert (bench.phase is Phase.EASING) == ends, order
        if not ends and order is not Order.FEEDFORWARD:
            assert bench.answers[-1].result is Result.TEMPORARILY_REJECTED


# What ends it.


def given_up(bench: Bench, error: ArmFault, words: str, change: Change = lambda facts: facts) -> None:
    """It fails with these words, goes back to where it was, and stores nothing."""
    bench.until(Phase.EASING, change=change)
    assert any(words in text for text in bench.run.texts), bench.run.texts
    assert bench.run.said[-1].status.error_bits & error
    bench.until(Phase.STOWED, change=change)
    assert bench.results() == [Result.FAILED]
    assert words in bench.answers[-1].reason


ENDS: dict[str, tuple[Change, ArmFault]] = {
    "the vehicle is armed": (REFUSALS["the vehicle is armed"], ArmFault.CALIBRATION_FAILED),
    "not on the ground": (REFUSALS["not on the ground"], ArmFault.CALIBRATION_FAILED),
    "heartbeat 9.0 s": (REFUSALS["heartbeat 9.0 s old"], ArmFault.VEHICLE_LOST),
    "tendon 3: servo does not answer": (lambda f: tendon(f, 2, silent=True), ArmFault.SERVO_FAULT),
    "tendon 2: servo lost its turns": (lambda f: tendon(f, 1, homed=False), ArmFault.SERVO_FAULT),
    "tension 60.0 N": (lambda f: tendon(f, 0, tension=60.0), ArmFault.TENDON_OVER_TENSION),
    "lets go at": (REFUSALS["lets go at"], ArmFault.OVERHEAT),
    "servo supply 9.7 V": (REFUSALS["servo supply 9.7 V"], ArmFault.LOW_VOLTAGE),
}


@pytest.mark.parametrize("words", ENDS)
@pytest.mark.parametrize("held", [False, True])
def test_what_goes_wrong_on_the_way_takes_the_tendons_back(words: str, held: bool, way: Way, brisk: Parameters) -> None:
    change, error = ENDS[words]
    state, wound, torque = way.stops[45]
    assert state.course is not None
    bench = resumed(
        brisk, dataclasses.replace(state, course=dataclasses.replace(state.course, held=held)), wound, torque
    )
    given_up(bench, error, words, change)
    assert bench.zeros == []
    assert bench.wound == pytest.approx(START, abs=1e-9)
    assert bench.torque == [held] * 4


def test_an_abort_cancels_it_and_a_stow_waits_until_it_is_back(way: Way, brisk: Parameters) -> None:
    bench = resumed(brisk, *way.stops[45])
    running = bench.run.state.running
    assert running is not None
    bench.cycle(lambda f: dataclasses.replace(f, requests=(Request(901, Order.ABORT),)))
    told = [(a.request, a.result) for a in bench.answers]
    assert told == [(running.request, Result.CANCELLED), (901, Result.ACCEPTED)]
    assert bench.run.said[-1].status.error_bits & ArmFault.OPERATOR_ABORT
    bench.cycle(lambda f: dataclasses.replace(f, requests=(Request(902, Order.STOW),)))
    bench.until(Phase.STOWED)
    assert bench.answers[-1] == Answer(902, Result.ACCEPTED, progress=100)
    assert bench.wound == pytest.approx(START, abs=1e-9)


def test_an_arm_whose_servos_do_not_turn_is_refused(brisk: Parameters) -> None:
    bench = Bench(brisk)
    bench.stuck = {2}
    bench.order()
    given_up(bench, ArmFault.CALIBRATION_FAILED, "the servo of tendon 3 does not follow")


def test_an_arm_that_moves_nothing_is_refused(brisk: Parameters) -> None:
    """All tendons are off: servos turn, and nothing pulls."""
    bench = Bench(brisk, lambda _: np.zeros(4))
    bench.order()
    given_up(bench, ArmFault.CALIBRATION_FAILED, "tendon 1 (servo 1) does not pull within 80 mm")


def test_a_tendon_that_is_caught_is_refused(brisk: Parameters) -> None:
    """Caught 20 mm too early: alone it seems taut, and all together it pulls while the others do not."""
    free = hanging(ZEROS)

    def caught(wound: np.ndarray) -> np.ndarray:
        tension = free(wound)
        tension[1] = max(tension[1], 3000.0 * (float(wound[1]) + 0.012))
        return tension

    bench = Bench(brisk, caught)
    bench.order()
    given_up(bench, ArmFault.CALIBRATION_FAILED, "together")
    assert max(caught(bench.wound)) < brisk.config.limits.tension_max_n


def test_torque_that_does_not_come_on_is_told(brisk: Parameters) -> None:
    bench = Bench(brisk)
    bench.order()
    given_up(
        bench,
        ArmFault.CALIBRATION_FAILED,
        "tendon 4 does not switch its torque on",
        lambda f: tendon(f, 3, torque=False),
    )


@pytest.mark.parametrize(("kept", "words"), [("no space left", "no space left"), (None, "not stored within 30 s")])
def test_a_result_that_cannot_be_stored_is_none(kept: str | None, words: str, way: Way, brisk: Parameters) -> None:
    bench = resumed(brisk, *way.stops[-1])
    bench.kept = kept
    given_up(bench, ArmFault.CALIBRATION_FAILED, words)
    assert len(bench.zeros) == 1
    assert bench.wound == pytest.approx(START, abs=1e-9)


def test_it_does_not_go_on_for_ever(way: Way, brisk: Parameters) -> None:
    state, wound, torque = way.stops[20]
    bench = resumed(brisk, dataclasses.replace(state, since=state.t - 900.5), wound, torque)
    given_up(bench, ArmFault.TIMEOUT, "calibrating took more than 900 s")


HAPPENS = st.lists(
    st.tuples(st.sampled_from([*ENDS, "abort", "stow", "nothing"]), st.floats(0.02, 1.5)), min_size=1, max_size=3
)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stop=st.integers(0, 10_000), happens=HAPPENS)
def test_whenever_it_is_disturbed_it_ends_stowed_with_one_answer_and_the_tendons_where_they_were(
    stop: int, happens: list[tuple[str, float]], way: Way, brisk: Parameters
) -> None:
    bench = resumed(brisk, *way.stops[stop % len(way.stops)])
    running = bench.run.state.running
    assert running is not None
    for i, (name, seconds) in enumerate(happens):
        if name in ("abort", "stow"):
            bench.cycle(lambda f, name=name, i=i: ask(f, Order[name.upper()], request=900 + i))
        change: Change = ENDS[name][0] if name in ENDS else lambda facts: facts
        bench.for_a_while(seconds, change)
    bench.cycle(lambda f: ask(f, Order.ABORT, request=999))
    bench.until(Phase.STOWED, seconds=25.0)
    ends = [a for a in bench.answers if a.request == running.request and a.result is not Result.IN_PROGRESS]
    assert len(ends) == 1
    assert ends[0].result in (Result.CANCELLED, Result.FAILED)
    assert bench.wound == pytest.approx(START, abs=1e-9)
    assert bench.torque == [False] * 4
    assert bench.run.state.course is None
