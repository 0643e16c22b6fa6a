"""What the daemon does in a cycle that raises: the pilot wins there too."""

import asyncio
import dataclasses
from types import SimpleNamespace

import pytest

from arm_companion.app import Daemon
from arm_companion.clock import Tick
from arm_companion.mission.facts import ArmAction, Control, Setpoint, VehicleState
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase
from tests.unit.conftest import HOVER
from tests.unit.mission_rig import BENT, T0, memory

SETPOINT = Setpoint((2.0, 0.0, -2.0), (0.3, 0.0, 0.0), (0.0, 0.0, 7.0), 0.0)
OURS = dataclasses.replace(HOVER)


class Sky:
    """An autopilot, and the set-points that it was sent."""

    def __init__(self) -> None:
        self.vehicle: VehicleState = OURS
        self.sent: list[Setpoint] = []

    def state(self, _: float) -> VehicleState:
        return self.vehicle

    def send(self, setpoint: Setpoint, _: float) -> None:
        self.sent.append(setpoint)


@pytest.mark.parametrize(
    "taken",
    [
        {"control": Control.PILOT, "mode": "POSCTL"},
        {"control": Control.FAILSAFE, "mode": "LAND"},
        {"armed": False},
    ],
)
def test_the_last_set_point_is_repeated_only_while_the_vehicle_is_ours_and_never_after(
    taken: dict[str, object], parameters: Parameters, hovering: object
) -> None:
    _, commands = step(memory(Phase.PERCHED), hovering(BENT), T0 + 0.01, parameters)  # type: ignore[operator]
    assert commands.arm is not ArmAction.LIMP
    daemon, sky = Daemon.__new__(Daemon), Sky()
    daemon._last = dataclasses.replace(commands, setpoint=SETPOINT)
    daemon._state, daemon.failures = memory(Phase.PERCHED), 2
    daemon._component = SimpleNamespace(status=None, notify=lambda _: None)  # type: ignore[assignment]
    daemon._autopilot = sky  # type: ignore[assignment]
    tick = Tick(T0, T0, 0)
    asyncio.run(daemon._fall_back(tick))
    assert [one.velocity_w for one in sky.sent] == [(0.0, 0.0, 0.0)]
    for vehicle in (dataclasses.replace(OURS, **taken), OURS):  # type: ignore[arg-type]
        sky.vehicle = vehicle
        asyncio.run(daemon._fall_back(tick))
    assert len(sky.sent) == 1
