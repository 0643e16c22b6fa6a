"""A flight stack in lock-step with the plant, and the real daemon beside it or not, all on the simulated loop.

The load of the machine makes such a flight slower, and nothing else: time stands still while anybody computes.
"""

import asyncio
import contextlib
import itertools
import math
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import Config, load
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.record.recorder import MemoryRecorder
from arm_companion.sim import sitl
from arm_companion.sim.operator_link import OperatorLink
from arm_companion.sim.servo_emulator import EmulatedBus
from arm_companion.sim.world import World
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.memory import MemoryPipe

T = TypeVar("T")
ARM, AUTOPILOT = (1, 192), (1, 1)
GUIDED, LOITER = 4, 5
OFFBOARD = 6


class Tap:
    """Listens on a pipe, both ways, without changing anything."""

    def __init__(self) -> None:
        self._codec = MavlinkCodec(255, 1)
        self.heard: list[tuple[float, Any]] = []

    def __call__(self, data: bytes) -> bytes:
        now = asyncio.get_running_loop().time()
        self.heard += [(now, message) for message in self._codec.feed(data)]
        return data

    def times(self, name: str, source: tuple[int, int], since: float = 0.0) -> list[float]:
        """Loop times at which messages of one name passed."""
        return [
            t
            for t, m in self.heard
            if t >= since and m.get_type() == name and (m.get_srcSystem(), m.get_srcComponent()) == source
        ]


def gaps_p99(times: list[float]) -> float:
    """99th percentile of the gaps, s."""
    gaps = sorted(b - a for a, b in itertools.pairwise(times))
    return gaps[math.ceil(0.99 * len(gaps)) - 1]


@dataclass
class Rig:
    """What a test can look at and do."""

    stack: str
    config: Config
    world: World
    ground: OperatorLink
    companion: Tap
    recorder: MemoryRecorder
    daemon: Daemon | None
    parts: list["asyncio.Task[None]"]

    async def until(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Wait for what must come; a part that has ended, such as a flight stack that crashed, ends this too."""
        try:
            async with asyncio.timeout(timeout_s):
                while not condition():
                    for part in self.parts:
                        if part.done():
                            part.result()
                    await asyncio.sleep(0.05)
        except TimeoutError:
            said = [text.text for text in self.ground.texts[-5:]]
            raise AssertionError(f"{otherwise}; last said: {said}") from None

    async def order(self, command: int, *parameters: float, target: tuple[int, int] = AUTOPILOT) -> int:
        """A command's final result."""
        padded = [*parameters, *[0.0] * (7 - len(parameters))]
        return await self.ground.command(command, padded, target=target, timeout=30.0)

    async def arm_when_ready(self) -> float:
        """Seconds until it let itself be armed."""
        loop = asyncio.get_running_loop()
        start = loop.time()
        while await self.order(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) != mav.MAV_RESULT_ACCEPTED:
            assert loop.time() - start < 90.0, [text.text for text in self.ground.texts[-5:]]
            await asyncio.sleep(1.0)
        return loop.time() - start

    def mode(self) -> int:
        """Custom mode of the last heartbeat."""
        return int(self.ground.latest("HEARTBEAT").custom_mode)  # type: ignore[union-attr]  # after the first

    def external(self) -> bool:
        """GUIDED or OFFBOARD."""
        return self.mode() == GUIDED if self.stack == "ardupilot" else (self.mode() >> 16) & 0xFF == OFFBOARD

    def height(self) -> float:
        """True height over the start, m."""
        return -self.world.plant.state().position_w[2]


def fly(
    stack: str,
    log: Path,
    test: Callable[[Rig], Coroutine[Any, Any, T]],
    *,
    daemon: bool = True,
    scripts: Sequence[Path] = (),
) -> T:
    """Run a test against a freshly started flight stack, which knows its position from satellites."""
    config = load("sim.toml", [f'vehicle.autopilot="{stack}"', 'sim.sitl_position="satellites"'])

    async def main(running: sitl.Sitl) -> T:
        async with _rig(running, stack, config, daemon=daemon) as rig:
            return await test(rig)

    with sitl.running(stack, sitl.binary(stack, None), config, log, simulated=True, scripts=scripts) as running:
        return run_simulated(main(running))


@contextlib.asynccontextmanager
async def _rig(running: sitl.Sitl, stack: str, config: Config, *, daemon: bool) -> AsyncIterator[Rig]:
    tap = Tap()
    companion, ground, servos, nobody = MemoryPipe(fault=tap), MemoryPipe(), MemoryPipe(), MemoryPipe()
    world = World(config, running)
    link = OperatorLink([ground.opener(1)])
    bus, stop = EmulatedBus(world.servos, config.servos), asyncio.Event()
    parts = [
        world.run(),
        running.run(companion.opener(0), ground.opener(0)),
        bus.serve_memory(servos.opener(0)),
        link.run(),
    ]
    real, recorder = None, MemoryRecorder()
    if daemon:
        openers = Openers(
            {
                name: companion.opener(1) if one.role == "autopilot" else nobody.opener(0)
                for name, one in config.links.items()
            },
            servos.opener(1),
        )
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        real = Daemon(config, openers, clock, ServiceManager(""), recorder)
        parts.append(real.run(stop))
    tasks = [asyncio.create_task(part) for part in parts]
    failed = asyncio.create_task(asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION))
    try:
        yield Rig(stack, config, world, link, tap, recorder, real, tasks)
    finally:
        stop.set()
        failed.cancel()
        for task in tasks:
            task.cancel()
        await asyncio.gather(failed, *tasks, return_exceptions=True)
