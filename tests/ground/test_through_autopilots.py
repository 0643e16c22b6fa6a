"""The ground side's protocols against the real daemon, through both autopilots' stand-ins, in simulated time."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import load
from arm_companion.ground.arm import Arm
from arm_companion.ground.channel import Channel
from arm_companion.ground.commands import CommandFailed
from arm_companion.ground.reports import Status, Tendons, Wrench
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.record.recorder import Recorder
from arm_companion.sim.servo_emulator import EmulatedBus
from arm_companion.sim.world import World
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.base import Transport
from arm_companion.transport.memory import MemoryPipe

STATION = (245, 190)


class Ground:
    """A station on the autopilot's ground port, with our codec where MAVSDK would be."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.codec = MavlinkCodec(*STATION)
        self.channel = Channel(self.send, STATION)
        self.arm = Arm(self.channel)
        self.transport: Transport | None = None

    async def send(self, message: Message) -> None:
        self.sent.append(message.get_type())
        assert self.transport is not None
        self.transport.write(self.codec.encode(message))

    def receive(self, data: bytes) -> None:
        for message in self.codec.feed(data):
            self.channel.receive(message)

    async def run(self, pipe: MemoryPipe) -> None:
        self.transport = await pipe.opener(1)(self.receive)
        while True:
            beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
            self.transport.write(self.codec.encode(beat))
            await asyncio.sleep(1.0)


@contextlib.asynccontextmanager
async def flying(flavour: str) -> AsyncIterator[Ground]:
    """The daemon, the world, and a station that hears only what the autopilot forwards."""
    config = load("sim.toml", [f"vehicle.autopilot={flavour}"])
    companion, pipe, servos = MemoryPipe(), MemoryPipe(), MemoryPipe()
    nobody = MemoryPipe()
    world = World(config)
    openers = Openers(
        {n: companion.opener(1) if link.role == "autopilot" else nobody.opener(0) for n, link in config.links.items()},
        servos.opener(1),
    )
    clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
    daemon = Daemon(config, openers, clock, ServiceManager(""), Recorder())
    bus, ground, stop = EmulatedBus(world.servos, config.servos), Ground(), asyncio.Event()
    parts = (
        world.run(),
        world.autopilot.run(companion.opener(0), pipe.opener(0)),
        bus.serve_memory(servos.opener(0)),
        daemon.run(stop),
        ground.run(pipe),
    )
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        yield ground
    finally:
        stop.set()
        await asyncio.sleep(0.5)
        for task in tasks:
            task.cancel()
        ends: list[Any] = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(end is None or isinstance(end, asyncio.CancelledError) for end in ends), ends


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_everything_passes_a_stock_autopilot(flavour: str) -> None:
    async def main() -> None:
        async with flying(flavour) as ground:
            arm = ground.arm
            await ground.channel.wait_heard(5.0)
            assert arm.system == 1
            await arm.first(Tendons)
            assert arm.way == "tunnel"
            async for status in arm.stream(Status):
                if status.state != "STARTUP":
                    break
            with pytest.raises(CommandFailed, match="PERCH is not possible in state STOWED"):
                await arm.perch()
            await arm.ready(timeout=20.0)

            before = ground.channel.counters[Wrench.MESSAGE]
            await asyncio.sleep(3.0)
            assert ground.channel.counters[Wrench.MESSAGE] - before == pytest.approx(60, abs=1)  # 20 Hz, none lost

            ground.sent.clear()
            parameters = await arm.parameters.read_all()
            assert len(parameters) == parameters[0].count > 10
            assert ground.sent == ["PARAM_REQUEST_LIST"]  # no loss at the first try

            ground.sent.clear()
            await arm.target_bar((3.0, 0.0, -2.0), (0.0, 1.0, 0.0), 0.03)
            await ground.channel.wait_for(
                lambda: arm.status is not None and "target_known" in arm.status.flags, 2.0, "the bar was not taken"
            )
            assert ground.sent == ["TUNNEL"]

            await arm.take_control()
            await ground.channel.wait_for(lambda: arm.status is not None and arm.status.control == STATION, 2.0, "")
            await arm.release_control()
            assert ground.channel.silence < 2.0

    run_simulated(main())
