"""The daemon with the plant's arm below a vehicle that stands disarmed, and a ground station."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import load
from arm_companion.protocol import control_table as ct
from arm_companion.protocol.dialect import mav
from arm_companion.record.recorder import MemoryRecorder
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.base import Opener
from tests.conftest import MavlinkPeer
from tests.sim.bench_arm import BenchArm

CALIBRATE = mav.MAV_CMD_ARM_CALIBRATE
IN_PROGRESS = mav.MAV_RESULT_IN_PROGRESS
SHIFTS = (0.004, -0.003, 0.006, 0.001)


class OnTheGround:
    """What is simulated, and what its ground station hears.

    Args:
        directory: where calibrations are kept.
        settings: of the configuration.
    """

    def __init__(self, directory: Path, *settings: str) -> None:
        brisk = ("vehicle.system_id=1", "calibration.take_up_m_per_s=0.014", "rates.wrench_hz=5")
        self.config = load("sim.toml", (f"calibration.directory={directory}", *brisk, *settings))
        self.arm = BenchArm(self.config, SHIFTS)
        self.recorder = MemoryRecorder()
        self.ground, self.vehicle = MavlinkPeer(255, 190), MavlinkPeer(1, 1)
        self.armed = False
        self.beats = True
        self.pulled: list[float] = []
        self.before: list[float] = []  # where the servos were

    async def _beat(self) -> None:
        while True:
            if self.beats:
                self.vehicle.heartbeat(mav.MAV_AUTOPILOT_PX4, 0, armed=self.armed)
            self.ground.send(mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3))
            self.pulled.append(max(self.arm.plant.tensions()))
            await asyncio.sleep(0.25)

    def run(self, script: Callable[[], Awaitable[None]]) -> Daemon:
        """The same in simulated time; the daemon after its end."""
        return run_simulated(self.alive(script))

    async def alive(self, script: Callable[[], Awaitable[None]], ground: Opener | None = None) -> Daemon:
        """Let all live while a script runs; with `ground`, the station is elsewhere."""
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        async with self.arm.served() as bus:
            pipes = {"autopilot": self.vehicle.pipe.opener(0), "ground": ground or self.ground.pipe.opener(0)}
            daemon = Daemon(self.config, Openers(pipes, bus.opener(1)), clock, ServiceManager(""), self.recorder)
            await self.ground.open()
            await self.vehicle.open()
            stop = asyncio.Event()
            async with asyncio.TaskGroup() as group:
                beating = group.create_task(self._beat())
                running = group.create_task(daemon.run(stop))
                await asyncio.sleep(1.0)
                self.before = list(self.arm.servos.positions())
                try:
                    await script()
                finally:
                    stop.set()
                    await running
                    beating.cancel()
        return daemon

    async def order(self, *parameters: float, command: int = CALIBRATE, seconds: float = 200.0) -> int:
        """The final result."""
        before = len(self.acks(command))
        self.ground.command(command, *parameters)
        await self.until(lambda: any(a.result != IN_PROGRESS for a in self.acks(command)[before:]), seconds)
        return int(self.acks(command)[-1].result)

    async def until(self, holds: Callable[[], bool], seconds: float = 60.0) -> None:
        async with asyncio.timeout(seconds):
            while not holds():  # noqa: ASYNC110 - what it waits for is a message
                await asyncio.sleep(0.05)

    async def begun(self, progress: int = 5) -> None:
        """Under way, a tendon being taken up."""
        self.ground.command(CALIBRATE, 1, 1)
        await self.until(lambda: any(a.progress >= progress for a in self.acks(CALIBRATE)))

    def acks(self, command: int) -> list[Any]:
        return [ack for ack in self.ground.all("COMMAND_ACK") if ack.command == command]

    @property
    def text(self) -> str:
        return "".join(message.text for message in self.ground.all("STATUSTEXT"))

    @property
    def state(self) -> str:
        return str(self.ground.all("ARM_STATUS")[-1].state_name)

    @property
    def torque(self) -> list[int]:
        return [servo.peek(ct.TORQUE_ENABLE) for servo in self.arm.servos.servos]
