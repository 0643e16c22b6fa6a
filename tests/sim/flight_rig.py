"""The stand-in with a rigid body on one side and in-memory links with clients on the other, in simulated time."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass, replace
from typing import Any

from arm_companion.clock import ticks
from arm_companion.config.schema import Config
from arm_companion.protocol.dialect import mav
from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.sim.autopilot_flavours import Mode
from arm_companion.sim.operator_link import OperatorLink
from arm_companion.transport.memory import MemoryPipe
from tests.sim.rigid_body import RigidBody

STEP_S = 0.004
HEIGHT_M = 1.2
"""Of the take-off, unless configured otherwise, and of set-points."""


def config(**sim: Any) -> Config:
    plain = Config()
    return replace(plain, sim=replace(plain.sim, **sim))


World = Callable[[AutopilotStandIn, RigidBody], Coroutine[Any, Any, None]]


async def stand(autopilot: AutopilotStandIn, body: RigidBody) -> None:
    """For tests without a flight: the body stands still, and the stand-in looks at it ten times a second."""
    async for _ in ticks(0.1):
        autopilot.control(body.state(), 0.1)


async def fly(autopilot: AutopilotStandIn, body: RigidBody) -> None:
    """Let the body and the stand-in run against each other until cancelled."""
    async for _ in ticks(STEP_S):
        rotors = autopilot.control(body.state(), STEP_S)
        body.step(rotors, STEP_S)


def setpoint(
    x: float = 0.0,
    y: float = 0.0,
    z: float = -HEIGHT_M,
    *,
    yaw: float = 0.0,
    mask: int = 0,
    frame: int = 1,
    **rest: float,
) -> Any:
    """SET_POSITION_TARGET_LOCAL_NED to the autopilot, complete unless masked."""
    fields = dict.fromkeys(("vx", "vy", "vz", "afx", "afy", "afz", "yaw_rate"), 0.0) | rest
    mask |= mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    return mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, x=x, y=y, z=z, yaw=yaw, **fields)


@dataclass
class Rig:
    autopilot: AutopilotStandIn
    body: RigidBody
    companion: OperatorLink  # any MAVLink client will do: 1/192, on the companion port
    operator: OperatorLink  # 255/190 on the ground port
    pipes: tuple[MemoryPipe, MemoryPipe]

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def heartbeat(self) -> Any:
        return self.operator.latest("HEARTBEAT")

    async def stream(self, message: Any, seconds: float, hz: float = 20.0) -> None:
        """Send a set-point again and again."""
        for _ in range(round(seconds * hz)):
            self.companion.send(message)
            await asyncio.sleep(1.0 / hz)

    async def take_off(self) -> None:
        """Arm, climb, and hover in the stack's holding mode."""
        await self.operator.wait_for(lambda o: o.latest("LOCAL_POSITION_NED") is not None, 60.0)
        assert await self.operator.command(mav.MAV_CMD_NAV_TAKEOFF) == mav.MAV_RESULT_ACCEPTED
        assert await self.operator.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,)) == mav.MAV_RESULT_ACCEPTED
        await self.operator.wait_for(lambda o: self.autopilot.mode is Mode.HOLD, 12.0)
        await asyncio.sleep(1.0)

    async def go_external(self, message: Any) -> int:
        """Stream for 1.2 s and ask for OFFBOARD; the caller goes on streaming."""
        await self.stream(message, 1.2)
        asked = asyncio.create_task(self.mode(6))
        await self.stream(message, 0.5)
        return await asked

    async def mode(self, main: int, sub: int = 0) -> int:
        return await self.operator.command(mav.MAV_CMD_DO_SET_MODE, (1.0, main, sub))


@contextlib.asynccontextmanager
async def rig(flavour: str = "px4", ready_s: float | None = 1.0, world: World = fly, **sim: Any) -> AsyncIterator[Rig]:
    autopilot = AutopilotStandIn(config(**{"takeoff_height_m": HEIGHT_M} | sim), flavour, ready_s=ready_s)
    body = RigidBody()
    companion_pipe, ground_pipe = MemoryPipe(), MemoryPipe()
    companion = OperatorLink([companion_pipe.opener(1)], (1, 192))
    operator = OperatorLink([ground_pipe.opener(1)])
    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(autopilot.run(companion_pipe.opener(0), ground_pipe.opener(0))),
            group.create_task(world(autopilot, body)),
            group.create_task(companion.run()),
            group.create_task(operator.run()),
        ]
        try:
            yield Rig(autopilot, body, companion, operator, (companion_pipe, ground_pipe))
        finally:
            for task in tasks:
                task.cancel()
