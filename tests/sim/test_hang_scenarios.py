"""Hang flights in simulated time: plant, autopilot stand-in, servos and daemon, joined by bytes alone."""

import functools
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.mission.load import CARRYING
from arm_companion.sim.hang_verdict import carried_share, judge_hang
from arm_companion.sim.mjcf import GRAVITY
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.scenario import Operator
from arm_companion.sim.verdict import Verdict

CONFIG = load("sim_hang.toml")
WEIGHT_N = GRAVITY * CONFIG.vehicle.mass_kg


def fly(script: Callable[[Operator], Coroutine[Any, Any, str]]) -> tuple[Result, Verdict]:
    result = run_simulated(fly_simulated(CONFIG, lambda _: None, fly=script))
    return result, judge_hang(result.flight, result.failure, WEIGHT_N)


@functools.cache
def disarmed() -> tuple[Result, Verdict]:
    """One flight for all who look at it: it hangs with idle motors, then with none, is armed again and leaves."""
    return fly(Operator.fly_hang_disarmed)


def phases(result: Result) -> list[str]:
    seen = [record.state.phase.name for record in result.records]
    return [name for i, name in enumerate(seen) if i == 0 or seen[i - 1] != name]


@pytest.mark.scenario
def test_it_hangs_by_the_bar_loses_its_motors_is_armed_again_takes_its_load_back_and_lands() -> None:
    result, verdict = disarmed()
    assert verdict.success, verdict.reason
    passed = iter(phases(result))
    wanted = ("VERIFY", "LOAD_TRANSFER", "HANGING", "HANG_HOLD", "TAKE_BACK", "UNLOAD", "RELEASE", "DEPART", "STOWED")
    assert all(name in passed for name in wanted)


@pytest.mark.scenario
def test_with_motors_that_stand_the_bar_carries_all_of_it_and_nothing_opens() -> None:
    result, _ = disarmed()
    stands = [r for r in result.records if r.state.phase.name == "HANG_HOLD" and not r.facts.vehicle.armed]
    assert stands[-1].t - stands[0].t > 5.0
    assert all(r.commands.pulls is None and r.commands.setpoint is None for r in stands[1:])
    still = result.flight.within(stands[0].t + 3.0, stands[-1].t)
    carried = [carried_share(sample, WEIGHT_N) for sample in still]
    assert sum(carried) / len(carried) == pytest.approx(1.0, abs=0.03)
    assert not any(sample.truth.rotor_contact for sample in result.flight.samples)


@pytest.mark.scenario
def test_while_the_arm_carries_its_tensions_stay_within_the_limit() -> None:
    result, verdict = disarmed()
    assert max(max(sample.truth.tension) for sample in result.flight.samples) < 1.05 * CONFIG.limits.tension_max_n
    hung = [r for r in result.records if r.state.phase in CARRYING]
    assert hung
    assert not any(suspect.fault for r in hung[::50] for suspect in r.state.watch)
    hanging = {error.span: error for error in verdict.wrench}["hanging"]
    assert hanging.force_error_n < 0.15 * hanging.true_force_n
