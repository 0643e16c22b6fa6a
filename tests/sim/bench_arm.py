"""An arm on the bench: plant and servos in simulated time, with tendon zeros that nobody has told the program."""

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator, Sequence

from arm_companion.clock import ticks
from arm_companion.config.schema import Config
from arm_companion.protocol.control_table import TICK_RAD
from arm_companion.sim.plant import Plant
from arm_companion.sim.ports import RotorCommand
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator
from arm_companion.transport.memory import MemoryPipe

_PERIOD_S = 0.004
_STILL = RotorCommand(0.0, (0.0, 0.0, 0.0))


class BenchArm:
    """The plant on its skids, servos that stand at the configuration's zeros, and the true zeros elsewhere.

    Args:
        config: of the arm.
        shifts: of each tendon, m: by how much the true zero lies further in than the configured one.
    """

    def __init__(self, config: Config, shifts: Sequence[float]) -> None:
        self.config = dataclasses.replace(config, sim=dataclasses.replace(config.sim, step_s=_PERIOD_S))
        self.plant = Plant(self.config)
        self.servos = ServoEmulator(config.servos, seed=7)
        self._m_per_tick = TICK_RAD * config.arm.pulley_radius_m
        servos = config.servos
        self.zeros = [
            zero + direction * shift / self._m_per_tick
            for zero, direction, shift in zip(servos.zero_ticks, servos.directions, shifts, strict=True)
        ]

    async def run(self) -> None:
        radius = self.config.arm.pulley_radius_m
        async for _ in ticks(_PERIOD_S):
            self.servos.advance(_PERIOD_S, [radius * tension for tension in self.plant.tensions()])
            self.plant.step(_STILL, self.pulls())

    def pulls(self) -> list[float]:
        return [
            direction * (position - zero) * self._m_per_tick
            for position, zero, direction in zip(
                self.servos.positions(), self.zeros, self.config.servos.directions, strict=True
            )
        ]

    @contextlib.asynccontextmanager
    async def served(self) -> AsyncIterator[MemoryPipe]:
        """Alive, with end 1 of a pipe to its bus."""
        pipe = MemoryPipe()
        bus = EmulatedBus(self.servos, self.config.servos)
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(self.run()), group.create_task(bus.serve_memory(pipe.opener(0)))]
            await bus.wait_ready()
            try:
                yield pipe
            finally:
                for task in tasks:
                    task.cancel()
