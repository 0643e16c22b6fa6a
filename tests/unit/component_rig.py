"""A component on two links, with an autopilot and a ground station at their far ends, in simulated time."""

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config.schema import Config, LinkConfig, MavlinkConfig, RatesConfig, VehicleConfig
from arm_companion.drivers.component import Component
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.settings import Settings
from arm_companion.drivers.standard_services import Power
from arm_companion.drivers.telemetry import Telemetry
from arm_companion.protocol.dialect import mav
from tests.conftest import MavlinkPeer

GCS = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3)


@dataclass
class ServiceRig:
    component: Component
    telemetry: Telemetry
    settings: Settings
    links: list[MavlinkLink]
    autopilot: MavlinkPeer
    ground: MavlinkPeer
    powers: list[Power]

    def results(self, peer: MavlinkPeer | None = None) -> list[tuple[int, int]]:
        return [(m.command, m.result) for m in (peer or self.ground).all("COMMAND_ACK")]

    def words(self, peer: MavlinkPeer | None = None) -> str:
        """Every text, long ones put together again."""
        text = ""
        for message in (peer or self.ground).all("STATUSTEXT"):
            text += message.text + ("" if message.id and len(message.text) == 50 else " | ")
        return text


@contextlib.asynccontextmanager
async def service_rig(
    *, links: dict[str, dict[str, Any]] | None = None, mavlink: dict[str, Any] | None = None, **vehicle: Any
) -> AsyncIterator[ServiceRig]:
    """Args: options of [links.autopilot] and [links.ground], of [mavlink] and of [vehicle]."""
    clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
    config = dataclasses.replace(Config(), vehicle=VehicleConfig(**vehicle), mavlink=MavlinkConfig(**(mavlink or {})))
    peers = {"autopilot": MavlinkPeer(1, 1), "ground": MavlinkPeer(255, 190)}
    made = []
    for name, peer in peers.items():
        options = {"url": "", "role": name} | (links or {}).get(name, {})
        section = LinkConfig(**options)
        made.append(MavlinkLink(name, section.role, peer.pipe.opener(0), config.vehicle, config=section))
    settings = Settings(config)
    powers: list[Power] = []
    component = Component(
        made,
        config.vehicle,
        clock,
        mavlink=config.mavlink,
        limits=config.limits,
        settings=settings,
        on_power=powers.append,
    )
    telemetry = Telemetry(made, RatesConfig(), clock)
    for peer in peers.values():
        await peer.open()
    tasks = [asyncio.create_task(r) for r in (*(link.run() for link in made), component.run())]
    try:
        await asyncio.sleep(0.01)
        yield ServiceRig(component, telemetry, settings, made, peers["autopilot"], peers["ground"], powers)
    finally:
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(isinstance(end, asyncio.CancelledError) for end in ends), ends
    assert [link.counters.handler_errors for link in made] == [0, 0]


def serve(body: Callable[[ServiceRig], Coroutine[Any, Any, None]], **options: Any) -> None:
    """Run a test body against a rig."""

    async def main() -> None:
        async with service_rig(**options) as rig:
            await body(rig)

    run_simulated(main())
