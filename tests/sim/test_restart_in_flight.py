"""The daemon dies while the arm holds the bar and is started again: plant, autopilot and servos go on meanwhile."""

import asyncio
import contextlib
from typing import Any

import pytest

from arm_companion.app import Daemon
from arm_companion.clock import run_simulated, ticks
from arm_companion.config import load
from arm_companion.mission.facts import ArmAction, ArmFault, Order
from arm_companion.mission.state import Phase
from arm_companion.sim import runner
from arm_companion.sim.world import World

_HELD_S = 3.0
_GONE_S = 2.0


class Reborn:
    """A daemon that is cut off a while after it has perched, and another one that starts in its place."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self._arguments, self._named = arguments, named
        self.cycles = self.missed = 0

    def _make(self) -> Daemon:
        return Daemon(*self._arguments, **self._named)

    async def run(self, stop: asyncio.Event) -> None:
        first = self._make()
        running = asyncio.create_task(first.run(asyncio.Event()))
        async for _ in ticks(0.1):
            if first._state.phase is Phase.PERCHED or stop.is_set():
                break
        await asyncio.sleep(_HELD_S)
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
        await asyncio.sleep(_GONE_S)
        await self._make().run(stop)


@pytest.mark.scenario
def test_a_daemon_that_restarts_while_perched_finds_the_arm_holding_and_lets_go_only_when_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    worlds: list[World] = []
    monkeypatch.setattr(runner, "Daemon", Reborn)
    result = run_simulated(runner.fly_simulated(load("sim.toml"), lambda _: None, worlds.append))
    records = result.records
    born = next(i for i in range(1, len(records)) if records[i].t - records[i - 1].t > 0.5 * _GONE_S)
    assert records[born - 1].state.phase is Phase.PERCHED
    after = records[born:]
    told = next(i for i, record in enumerate(after) if any(r.order is Order.RELEASE for r in record.facts.requests))
    assert {record.state.phase for record in after[:told]} <= {Phase.STARTUP, Phase.HOLDING}
    assert after[told].state.phase is Phase.HOLDING
    assert after[told].state.errors & ArmFault.RESTARTED
    for record in after[:told]:
        assert (record.commands.arm, record.commands.setpoint) == (ArmAction.HOLD, None)
    held = result.flight.within(records[born - 1].t, after[told].t)
    assert min(sample.truth.contact_force_n for sample in held) > 0.0, "it held while nobody looked"
    assert Phase.RELEASE in {record.state.phase for record in after[told:]}
    assert Phase.STOWED in {record.state.phase for record in after[told:]}
