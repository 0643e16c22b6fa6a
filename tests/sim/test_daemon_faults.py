"""The daemon when its own cycle fails or is late: the arm holds, the link lives, and people are told."""

import asyncio
import random
from typing import Any

import pytest

from arm_companion import app
from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.mission.facts import Facts
from arm_companion.mission.state import Phase
from arm_companion.sim.judges import SCENARIOS
from arm_companion.sim.runner import fly_simulated
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


@pytest.mark.scenario
def test_cycles_that_come_late_again_and_again_overstress_no_tendon_around_a_bar(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = load("sim.toml")
    real, stalls = app.Daemon._observe, [0.0]

    async def late(daemon: app.Daemon) -> Facts:
        now = asyncio.get_running_loop().time()
        if daemon._state.phase in {Phase.CONTACT, Phase.WRAP, Phase.VERIFY} and now - stalls[-1] > 0.45:
            stalls.append(now)
            await asyncio.sleep(0.2)
        return await real(daemon)

    monkeypatch.setattr(app.Daemon, "_observe", late)
    result = run_simulated(fly_simulated(config, lambda _: None))
    assert len(stalls) > 20
    assert result.failure == ""
    tension = max(tendon.tension for record in result.records for tendon in record.facts.tendons)
    assert tension <= config.limits.tension_max_n


@pytest.mark.scenario
@pytest.mark.parametrize(("scenario", "name"), [("hang", "sim_hang.toml"), ("grasp", "sim_grasp.toml")])
def test_a_computer_that_stands_still_every_other_second_hangs_and_grasps_all_the_same(
    monkeypatch: pytest.MonkeyPatch, scenario: str, name: str
) -> None:
    config = load(name)
    real, chance, stalls = app.Daemon._observe, random.Random(1), [0.0]

    async def late(daemon: app.Daemon) -> Facts:
        now = asyncio.get_running_loop().time()
        if now > stalls[-1] and daemon._state.phase is not Phase.STARTUP:
            stalls.append(now + chance.uniform(1.0, 3.0))
            await asyncio.sleep(chance.uniform(0.15, 0.3))
        return await real(daemon)

    monkeypatch.setattr(app.Daemon, "_observe", late)
    plan = SCENARIOS[scenario]
    result = run_simulated(fly_simulated(config, lambda _: None, fly=plan.fly))
    assert len(stalls) > 40
    verdict = plan.judge(result.flight, result.failure, config)
    assert verdict.success, verdict.verdict
    tension = max(tendon.tension for record in result.records for tendon in record.facts.tendons)
    assert tension <= config.limits.tension_max_n
