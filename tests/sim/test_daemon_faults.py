"""The daemon when its own cycle fails or is late: the arm holds, the link lives, and people are told."""

import asyncio
import random
from collections.abc import Callable
from typing import Any

import pytest

from arm_companion import app
from arm_companion.clock import run_simulated
from arm_companion.config import Config, load
from arm_companion.mission.facts import Facts
from arm_companion.mission.state import Phase
from arm_companion.sim.judges import SCENARIOS
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.world import World
from arm_companion.supervisor import ServiceManager


@pytest.mark.scenario
def test_an_exception_in_the_cycle_holds_the_arm_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    config = load("sim.toml")
    calls = 0
    real = app.step

    def sometimes(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if 300 <= calls < 330:
            raise RuntimeError("a bug")
        return real(*arguments)

    def end_soon(world: World) -> None:
        world.at(6.0, lambda w: w.autopilot.fail())

    fed: list[ServiceManager] = []

    def feed(manager: ServiceManager) -> None:
        fed.append(manager)

    monkeypatch.setattr(ServiceManager, "alive", feed)
    monkeypatch.setattr(app, "step", sometimes)
    result = run_simulated(fly_simulated(config, lambda _: None, end_soon))
    assert result.cycles - len(result.records) == 30, "failed cycles are not recorded, all others are"
    assert len(fed) == len(result.records), "only a cycle that completed feeds the watchdog"
    assert any("cycle failed" in text and "hold" in text for _, text in result.flight.texts)
    before, after = result.records[298], result.records[299]
    assert after.t - before.t > 0.25, "the cycle goes on after the failure"
    assert [t.pull for t in after.facts.tendons] == pytest.approx([t.pull for t in before.facts.tendons], abs=5e-4)
    assert all(t.torque and t.ready for t in after.facts.tendons), "the arm held, and follows again"


def stand_still(monkeypatch: pytest.MonkeyPatch, pause: Callable[[Phase, float], float]) -> list[float]:
    """Make cycles late by what `pause` says of phase and time, s; returns the times at which it happened."""
    real, at = app.Daemon._observe, []

    async def late(daemon: app.Daemon) -> Facts:
        now = asyncio.get_running_loop().time()
        if seconds := pause(daemon._state.phase, now):
            at.append(now)
            await asyncio.sleep(seconds)
        return await real(daemon)

    monkeypatch.setattr(app.Daemon, "_observe", late)
    return at


def assert_within_limits(result: Result, config: Config) -> None:
    tension = max(tendon.tension for record in result.records for tendon in record.facts.tendons)
    assert tension <= config.limits.tension_max_n


@pytest.mark.scenario
def test_cycles_that_come_late_again_and_again_overstress_no_tendon_around_a_bar(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config, due = load("sim.toml"), 0.0

    def pause(phase: Phase, now: float) -> float:
        nonlocal due
        if phase not in {Phase.CONTACT, Phase.WRAP, Phase.VERIFY} or now < due:
            return 0.0
        due = now + 0.45
        return 0.2

    stalls = stand_still(monkeypatch, pause)
    result = run_simulated(fly_simulated(config, lambda _: None))
    assert len(stalls) > 20
    assert result.failure == ""
    assert_within_limits(result, config)


@pytest.mark.scenario
@pytest.mark.parametrize(
    ("scenario", "name", "autopilot"),
    [("perch", "sim.toml", "ardupilot"), ("hang", "sim_hang.toml", "px4"), ("grasp", "sim_grasp.toml", "px4")],
)
def test_a_computer_that_stands_still_every_other_second_perches_hangs_and_grasps_all_the_same(
    monkeypatch: pytest.MonkeyPatch, scenario: str, name: str, autopilot: str
) -> None:
    """With ArduPilot each late set-point once made the force that was fed forward anew, and more of it every time."""
    config, chance, due = load(name, [f'vehicle.autopilot="{autopilot}"']), random.Random(1), 0.0

    def pause(phase: Phase, now: float) -> float:
        nonlocal due
        if phase is Phase.STARTUP or now < due:
            return 0.0
        due = now + chance.uniform(1.0, 3.0)
        return chance.uniform(0.15, 0.3)

    stalls = stand_still(monkeypatch, pause)
    plan = SCENARIOS[scenario]
    result = run_simulated(fly_simulated(config, lambda _: None, fly=plan.fly))
    assert len(stalls) > 40
    verdict = plan.judge(result.flight, result.failure, config)
    assert verdict.success, verdict.verdict
    assert_within_limits(result, config)
    for move in (move for move in verdict.moves if move.name == "pull x"):
        assert move.error_m < 0.004
