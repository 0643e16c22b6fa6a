"""MAVSDK, with nothing of ours but the dialect's XML, finds the component, hears it and commands it."""

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync, MavlinkMessage

from arm_companion.mission.facts import Order
from arm_companion.protocol.dialect import XML, mav

pytestmark = pytest.mark.realtime

Serve = Callable[[], AbstractAsyncContextManager[Any]]


@asynccontextmanager
async def station(port: int) -> AsyncIterator[tuple[Any, MavlinkDirectAsync]]:
    """A MAVSDK ground station that has found our component and knows our messages."""
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        async with asyncio.timeout(10.0):
            while not (systems := await mavsdk.get_systems()):  # noqa: ASYNC110 - MAVSDK's threads set no event
                await asyncio.sleep(0.05)
        direct = MavlinkDirectAsync(systems[0])
        try:
            await direct.load_custom_xml(XML.read_text(encoding="utf-8"))
            yield systems[0], direct
        finally:
            direct.destroy()


async def first(direct: MavlinkDirectAsync, name: str) -> dict[str, Any]:
    """Fields of the next message of a type."""
    stream = direct.subscribe_message(name)
    try:
        async with asyncio.timeout(5.0):
            message = await anext(stream)
    finally:
        await stream.aclose()
    assert (message.system_id, message.component_id) == (1, 192)
    fields: dict[str, Any] = json.loads(message.fields_json)
    return fields


def message(name: str, **fields: Any) -> MavlinkMessage:
    return MavlinkMessage(name, 245, 190, 1, 192, json.dumps({"message_name": name, **fields}))


async def command(direct: MavlinkDirectAsync, id_: int, param1: float = 0.0) -> int:
    """MAV_RESULT of a command that MAVSDK sends, repeats and waits for by itself."""
    parameters = {f"param{i}": 0.0 for i in range(2, 8)}
    ack = await direct.send_command(
        message(
            "COMMAND_LONG",
            target_system=1,
            target_component=192,
            command=id_,
            confirmation=0,
            param1=param1,
            **parameters,
        )
    )
    return int(json.loads(ack.fields_json)["result"])


def test_the_component_is_found_heard_and_commanded(serve: Serve) -> None:
    async def main() -> None:
        async with serve() as harness, station(harness.port) as (system, direct):
            assert await system.get_system_id() == 1
            assert await system.component_ids() == [192]
            assert not await system.has_autopilot()

            status, tendons, wrench = await asyncio.gather(
                *(first(direct, name) for name in ("ARM_STATUS", "ARM_TENDONS", "ARM_REACTION_WRENCH"))
            )
            assert (status["behaviour"], status["state_name"]) == (mav.ARM_BEHAVIOUR_PERCH, "PERCHED")
            assert status["theta"] == pytest.approx(4.6)
            assert tendons["tension"] == pytest.approx([18.5] * 4)
            assert tendons["goal"] == [None] * 4  # NaN: not known
            assert wrench["force"] == pytest.approx([1.5, -2.5, 3.5])
            assert wrench["torque"] == pytest.approx([0.1, 0.2, 0.3])
            assert wrench["taut_margin"] is None

            assert await command(direct, mav.MAV_CMD_ARM_PERCH) == mav.MAV_RESULT_ACCEPTED
            assert await command(direct, mav.MAV_CMD_ARM_PERCH, 5.0) == mav.MAV_RESULT_DENIED
            assert [r.order for r in harness.requests] == [Order.PERCH]

            await direct.send_message(
                message(
                    "ARM_TARGET",
                    target_system=1,
                    target_component=192,
                    time_usec=0,
                    kind=mav.ARM_TARGET_KIND_BAR,
                    frame=mav.MAV_FRAME_LOCAL_NED,
                    position=[3.0, 0.5, -2.0],
                    axis=[0.0, 1.0, 0.0],
                    q=[0.0] * 4,
                    radius=0.015,
                    position_covariance=[0.0] * 6,
                    direction_sigma=0.0,
                )
            )
            async with asyncio.timeout(3.0):
                while not harness.bars:  # noqa: ASYNC110 - the harness only collects
                    await asyncio.sleep(0.01)
            (bar,) = harness.bars
            assert bar.point_w == pytest.approx((3.0, 0.5, -2.0))
            assert bar.axis_w == pytest.approx((0.0, 1.0, 0.0))
            assert math.isclose(bar.radius, 0.015, rel_tol=1e-6)

    asyncio.run(main())
