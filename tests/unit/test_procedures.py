"""Guided calibrations without a bus: the procedures are data, and a few lines of arithmetic carry them out."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.tension import LoadCurve
from arm_companion.config import Config
from arm_companion.errors import ModelError, NoSolution
from arm_companion.procedures.actions import (
    Action,
    Ask,
    AskNumber,
    Engage,
    Keep,
    Move,
    Procedure,
    Release,
    Sample,
    Say,
    Trace,
)
from arm_companion.procedures.take_up import balanced, combine, knee
from arm_companion.procedures.tendon_zeros import Found, Options, Refused, Setup, Zero, least_slack, procedure
from arm_companion.protocol.control_table import TICK_RAD
from arm_companion.workshop.tension_gain import STANDARD_GRAVITY, Bench, Reading, describe, fit
from arm_companion.workshop.tension_gain import procedure as tension_procedure

ARM = ArmParameters.of(Config().arm)
M_PER_TICK = TICK_RAD * 0.01
CURVE = LoadCurve(150.0, 12.0, 0.1, 0.0, 5.0, 1.5, 0.02)
DIRECTIONS = (1, -1, 1, -1)
SETUP = Setup(ARM, (CURVE,) * 4, DIRECTIONS, (11, 12, 13, 14), M_PER_TICK, 45.0, Options(speed=0.012))
PERIOD_S = 0.01
Force = Callable[[np.ndarray], np.ndarray]


class Arithmetic:
    """Servos and an arm for a procedure.

    Args:
        tensions: (n,) N at wound lengths (n,) m.
        noise: one sigma of a load.
    """

    def __init__(self, tensions: Force, noise: float = 0.01) -> None:
        self.tensions = tensions
        self.noise = noise
        self.rng = np.random.default_rng(5)
        self.origin = (2000, 3000, -500, 70_000)
        self.wound = np.zeros(4)
        self.torque = False
        self.asked: list[str] = []
        self.kept: list[Any] = []
        self.numbers: list[float | None] = []
        self.no_to = "nothing"

    def perform(self, action: Action) -> Any:
        match action:
            case Ask(text):
                self.asked.append(text)
                return self.no_to not in text
            case AskNumber(text):
                self.asked.append(text)
                return self.numbers.pop(0)
            case Engage():
                self.torque = True
                return self.origin
            case Release():
                self.torque = False
            case Keep(value):
                self.kept.append(value)
            case Move():
                assert self.torque
                return self.move(action)
        return None

    def move(self, action: Move) -> Trace:
        start, goal = self.wound, np.asarray(action.wound)
        steps = max(1, math.ceil(float(np.abs(goal - start).max()) / action.speed / PERIOD_S))
        samples: list[Sample] = []
        for k in range(1, steps + 1):
            before, self.wound = self.wound, start + k / steps * (goal - start)
            way = np.sign(self.wound - before)
            load = (self.tensions(self.wound) + 5.0 * way) / 150.0 + self.rng.normal(0.0, self.noise, 4)
            volts, warm = (12.0,) * 4, (31.0,) * 4
            samples.append(Sample(tuple(self.wound.tolist()), tuple(load.tolist()), volts, warm))
            if action.stop is not None and len(samples) >= 12:
                recent = [action.stop.of(sample.load) for sample in samples[-12:]]
                if sum(recent) / 12 > action.stop.load:
                    return Trace(tuple(samples), stopped=True)
        return Trace(tuple(samples))

    def run(self, steps: Procedure[Any]) -> Any:
        answer: Any = None
        while True:
            try:
                action = steps.send(answer)
            except StopIteration as end:
                return end.value
            answer = self.perform(action)


def hanging(zeros: np.ndarray) -> Force:
    """The unloaded arm with its zeros there, m wound up; opposite tendons are two springs on a third, the backbone."""
    k, soft = float(ARM.k_T[0]), ARM.EI / ARM.L / ARM.r**2  # N/m: a tendon alone bends the arm

    def pair(a: float, b: float) -> tuple[float, float]:
        """Tensions of two opposite tendons that are wound past their knees by a and b, m."""
        bend = (a - b) / (2.0 + soft / k)  # r u, both taut
        if min(a - bend, b + bend) < 0.0:
            first, alone = a > b, max(a, b, 0.0) / (1.0 / k + 1.0 / soft)
            return (alone, 0.0) if first else (0.0, alone)
        return k * (a - bend), k * (b + bend)

    def tensions(wound: np.ndarray) -> np.ndarray:
        q = (wound - zeros + ARM.T0 / ARM.k_T).tolist()
        (t0, t2), (t1, t3) = pair(q[0], q[2]), pair(q[1], q[3])
        return np.array((t0, t1, t2, t3))

    return tensions


def errors(bench: Arithmetic, found: tuple[Zero, ...], zeros: np.ndarray) -> np.ndarray:
    """Of zeros that were found (n,), m."""
    wound = [d * (zero.ticks - o) * M_PER_TICK for zero, o, d in zip(found, bench.origin, DIRECTIONS, strict=True)]
    return np.asarray(wound) - zeros


ZEROS = np.array((0.003, -0.002, 0.006, 0.001))


def test_the_zeros_are_found_and_the_torque_is_off_at_the_end() -> None:
    bench = Arithmetic(hanging(ZEROS))
    found = bench.run(procedure(SETUP))
    error = errors(bench, found, ZEROS)
    sigma = np.array([zero.sigma for zero in found])
    assert np.all(np.abs(error) < 4.0 * sigma)
    assert np.all(sigma < 0.0012)
    assert abs(error[0] + error[2]) / 2 < 0.0001, "how tight opposite tendons are: 0.1 mm is 0.3 N"
    assert abs(error[1] + error[3]) / 2 < 0.0001
    assert not bench.torque
    assert [zero.friction for zero in found] == pytest.approx([5.0] * 4, abs=0.3)


def test_every_step_says_what_it_does_before_it_does_it() -> None:
    bench = Arithmetic(hanging(ZEROS))
    bench.run(procedure(SETUP))
    assert "Torque comes on" in bench.asked[0]
    assert all(any(f"tendon {i} (servo 1{i})" in text for text in bench.asked) for i in (1, 2, 3, 4))
    assert all(any(f"bent towards tendon {i}" in text for text in bench.asked) for i in (1, 2, 3, 4))


def test_a_second_run_goes_on_where_the_first_was_interrupted() -> None:
    bench = Arithmetic(hanging(ZEROS))
    bench.run(procedure(SETUP))
    again = Arithmetic(hanging(ZEROS))
    half: tuple[Found, ...] = bench.kept[1]
    assert len(half) == 2
    resumed = again.run(procedure(SETUP, half))
    assert [len(kept) for kept in again.kept] == [3, 4]
    assert np.all(np.abs(errors(again, resumed, ZEROS)) < 4.0 * np.array([zero.sigma for zero in resumed]))


def test_a_tendon_that_never_pulls_is_refused_by_name() -> None:
    def broken(wound: np.ndarray) -> np.ndarray:
        pull = np.array((wound - ZEROS).tolist())
        pull[2] = -1.0
        return np.where(np.arange(4) == 2, 0.0, hanging(np.zeros(4))(pull))

    with pytest.raises(Refused, match=r"tendon 3 \(servo 13\) does not pull within"):
        Arithmetic(broken).run(procedure(SETUP))


@pytest.mark.parametrize("pretension", [0.0, 1.0])
def test_a_pretension_that_no_servo_feels_is_refused_before_anything_moves(pretension: float) -> None:
    """After all tendons had been taken up it was called a caught tendon."""
    loose = dataclasses.replace(ARM, tendons=tuple(dataclasses.replace(t, T0=pretension) for t in ARM.tendons))
    bench = Arithmetic(hanging(ZEROS))
    with pytest.raises(Refused, match="pretension_n"):
        bench.run(procedure(dataclasses.replace(SETUP, arm=loose)))
    assert not bench.asked


def test_an_arm_that_bends_elsewhere_is_refused() -> None:
    bench = Arithmetic(hanging(ZEROS))
    bench.no_to = "bent towards tendon 2"
    with pytest.raises(Refused, match=r"tendon 2 .* pulls elsewhere"):
        bench.run(procedure(SETUP))


def test_tendons_that_are_taut_to_begin_with_are_let_out_further() -> None:
    zeros = np.array((-0.025, -0.024, -0.025, -0.024))
    bench = Arithmetic(hanging(zeros))
    found = bench.run(procedure(dataclasses.replace(SETUP, options=Options(speed=0.012, travel=0.09))))
    assert np.all(np.abs(errors(bench, found, zeros)) < 0.004)


def test_slack_must_let_the_arm_bend() -> None:
    assert least_slack(ARM, 3.0) == pytest.approx(0.0175, abs=0.001)
    assert Options().slack > least_slack(ARM, Options().threshold)


# The fits.


@settings(max_examples=40)
@given(st.floats(-0.004, 0.004), st.floats(0.5, 3.0), st.floats(-0.05, 0.05), st.integers(0, 10_000))
def test_a_knee_is_found_within_its_sigma(at: float, slope: float, offset: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    w = np.concatenate((np.linspace(-0.01, 0.015, 400), np.linspace(0.015, -0.01, 400)))
    inwards = np.arange(800) < 400
    load = offset + np.where(inwards, 0.03, -0.03) + slope * np.maximum(w - at, 0.0) + rng.normal(0.0, 0.005, 800)
    found = knee(w.tolist(), load.tolist(), inwards.tolist())
    assert abs(found.at - at) < 5.5 * found.sigma
    assert found.sigma < 0.0025  # the flattest slope, the noisiest draw
    assert found.friction == pytest.approx(0.03, abs=0.004)
    assert found.noise == pytest.approx(0.005, rel=0.2)


@pytest.mark.parametrize("slope", [0.0, -2.0])
def test_a_load_that_does_not_rise_has_no_knee(slope: float) -> None:
    w = np.linspace(0.0, 0.02, 100)
    load = slope * np.maximum(w - 0.01, 0.0)
    with pytest.raises(NoSolution):
        knee([*w, *w], [*load, *load], [True] * 100 + [False] * 100)


@given(st.integers(3, 8), st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8))
def test_what_bends_nothing_and_what_bends_together_give_the_zeros(n: int, truth: list[float]) -> None:
    angles = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    H = 0.02 * np.column_stack((np.cos(angles), np.sin(angles)))
    N = balanced(H)
    assert N.shape == (n, n - 2)
    assert np.allclose(N.T @ H, 0.0, atol=1e-12)
    zeros = np.asarray(truth[:n])
    found, sigma = combine(zeros, np.full(n, 0.5), N, N.T @ zeros, np.full(n - 2, 0.01))
    assert found == pytest.approx(zeros)
    assert np.all(sigma <= 0.5 + 1e-12)


# Tension.


def series(masses: tuple[float, ...], friction: float = 5.0, gain: float = 150.0, noise: float = 0.0) -> list[Reading]:
    rng = np.random.default_rng(3)
    return [
        Reading(m * 9.81, d, 0.01 + (m * 9.81 + d * friction) / gain + float(rng.normal(0.0, noise)), 0.01, 12.0)
        for m in masses
        for d in (1, -1)
    ]


def test_known_tensions_give_gain_friction_and_offset() -> None:
    found = fit(series((0.0, 0.5, 1.0, 2.0)))
    assert (found.curve.gain, found.curve.friction, found.curve.offset) == pytest.approx((150.0, 5.0, 0.01))
    assert found.scatter == pytest.approx(0.0, abs=1e-9)


def test_the_intervals_hold_the_truth_and_shrink_with_the_noise() -> None:
    loose, tight = fit(series((0.2, 0.5, 1.0, 2.0), noise=0.002)), fit(series((0.2, 0.5, 1.0, 2.0), noise=0.0002))
    assert loose.gain[0] < 150.0 < loose.gain[1]
    assert tight.gain[1] - tight.gain[0] < 0.3 * (loose.gain[1] - loose.gain[0])
    assert "gain" in describe(loose)


@pytest.mark.parametrize(
    ("readings", "reason"),
    [
        (series((0.5, 1.0)), "at least 3 tensions"),
        (series((0.1, 0.15, 0.2)), "apart"),
        (series((0.5, 1.0, 2.0), gain=-150.0), "does not grow"),
        (series((0.5, 1.0, 2.0), friction=-5.0), "directions"),
        (series((0.5, 1.0, 2.0))[::2], "the way out"),
        (series((0.5, 1.0, 1.5, 2.0))[::2], "the way out"),
    ],
)
def test_a_series_that_cannot_be_right_is_refused(readings: list[Reading], reason: str) -> None:
    with pytest.raises(ModelError, match=reason):
        fit(readings)


def test_a_scales_reading_that_cannot_be_is_not_dropped_in_silence() -> None:
    class Scale(Arithmetic):
        strokes = 0

        def perform(self, action: Action) -> Any:
            if isinstance(action, Say):
                self.asked.append(action.text)
            if isinstance(action, Ask) and "one more stroke" in action.text:
                self.strokes += 1
                return self.strokes <= 2
            return super().perform(action)

    bench = Scale(lambda _: np.zeros(4))
    bench.numbers = [math.nan, None, 1e9, -2.0]
    with pytest.raises(Refused, match="at least 3 tensions"):
        bench.run(tension_procedure(1, "tendon 2 (servo 12)", 4, Bench(scale=True)))
    assert [text.split(":")[0] for text in bench.asked if "does not count" in text] == [
        f"{known} N is not between 0 and 45 N" for known in ("nan", "1e+09", "-2")
    ]


def test_weights_are_asked_for_until_an_empty_line_and_absurd_ones_again() -> None:
    bench = Arithmetic(lambda _: np.zeros(4))
    bench.numbers = [0.5, 900.0, -1.0, 1.0, 2.0, None]
    bench.tensions = lambda _: np.full(4, masses[min(hung(), 2)] * STANDARD_GRAVITY)
    masses = (0.5, 1.0, 2.0)

    def hung() -> int:
        return {5: 0, 2: 1, 1: 2}.get(len(bench.numbers), 0)

    found = bench.run(tension_procedure(1, "tendon 2 (servo 12)", 4, Bench()))
    assert found.curve.gain == pytest.approx(150.0, rel=0.02)
    assert found.curve.friction == pytest.approx(5.0, abs=0.2)
    assert found.readings == 6
    assert not bench.torque
