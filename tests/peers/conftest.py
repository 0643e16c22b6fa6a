"""The MAVLink side of the daemon on a real socket, with a mission that finishes whatever it is asked."""

import asyncio
import contextlib
import math
import socket
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, ticks
from arm_companion.config import Config
from arm_companion.config.schema import RatesConfig, VehicleConfig
from arm_companion.drivers.component import Component
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.settings import Settings
from arm_companion.drivers.telemetry import Telemetry
from arm_companion.mission.facts import (
    Answer,
    Bar,
    Request,
    Result,
    StatusReport,
    TendonState,
    WrenchReport,
    WrenchSource,
)
from arm_companion.transport.urls import open_url

HOST = "127.0.0.1"
STATUS = StatusReport("perch", "PERCHED", 9, 100, 0, 0, 4.6, 0.1, (0.01, 0.02, 0.1), 4.6, 0.1)
TENDON = TendonState(0.01, 0.0, 18.5, 0.4, 0.12, 31.0, 11.8, 0, silent=False, age_s=0.01, torque=True)
WRENCH = WrenchReport(
    (1.5, -2.5, 3.5),
    (0.1, 0.2, 0.3),
    (0.5, 0.5, 0.5),
    (0.05, 0.05, 0.05),
    WrenchSource.ANCHORED,
    valid=True,
    taut_margin=math.nan,
    residual=1e-9,
)


@dataclass
class Harness:
    """A component at 1/192 that calls a ground station."""

    port: int
    component: Component
    link: MavlinkLink
    requests: list[Request] = field(default_factory=list)
    bars: list[Bar] = field(default_factory=list)

    async def cycles(self, telemetry: Telemetry) -> None:
        """What the daemon does in each cycle, with every request in progress for 0.2 s."""
        running: list[tuple[float, Request]] = []
        async for tick in ticks(0.01):
            requests, bar = self.component.take()
            for request in requests:
                self.requests.append(request)
                running.append((tick.now + 0.2, request))
                self.component.answer(Answer(request.id, Result.IN_PROGRESS, progress=10))
            if bar is not None:
                self.bars.append(bar)
            for end, request in list(running):
                if tick.now >= end:
                    running.remove((end, request))
                    self.component.answer(Answer(request.id, Result.ACCEPTED))
            telemetry.publish(tick.now, STATUS, (TENDON,) * 4, WRENCH)


@pytest.fixture
def serve() -> Callable[[], contextlib.AbstractAsyncContextManager[Harness]]:
    """Run a component that sends to a free port of this machine."""

    @contextlib.asynccontextmanager
    async def running() -> AsyncIterator[Harness]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((HOST, 0))
            port = int(probe.getsockname()[1])
        vehicle = VehicleConfig()
        settings = Settings(Config())
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        link = MavlinkLink("ground", "ground", open_url(f"udpout:{HOST}:{port}"), vehicle)
        component = Component([link], vehicle, clock, settings=settings)
        harness = Harness(port, component, link)
        parts = (link.run(), component.run(), harness.cycles(Telemetry([link], RatesConfig(), clock)))
        tasks = [asyncio.create_task(part) for part in parts]
        try:
            yield harness
        finally:
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.sleep(0.01)  # for the socket to go
        assert all(isinstance(end, asyncio.CancelledError) for end in ends), ends

    return running
