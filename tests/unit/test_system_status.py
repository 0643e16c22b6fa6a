"""What our heartbeat says of the arm: MAV_STATE from the status of a cycle."""

import dataclasses
from typing import Any

import pytest

from arm_companion.drivers.system_status import UNHEALTHY, SystemStatus, in_trouble, system_status
from arm_companion.mission.facts import ArmFault, ArmFlag, CalibrationState, StatusReport
from arm_companion.mission.state import MOVES_VEHICLE, Phase

WELL = StatusReport("stowed", "STOWED", Phase.STOWED.value, 255, ArmFlag.NONE, ArmFault.NONE, 0, 0, (0, 0, 0), 0, 0)
NOT_OURS = [fault for fault in ArmFault if not fault & UNHEALTHY]


def told(phase: Phase = Phase.STOWED, **changes: Any) -> SystemStatus:
    report = dataclasses.replace(WELL, state=phase.name, state_number=phase.value, **changes)
    return system_status(report, active=phase in MOVES_VEHICLE)


def test_a_well_arm_boots_stands_by_and_is_active() -> None:
    assert told(Phase.STARTUP) is SystemStatus.BOOT
    assert told(Phase.STOWED) is told(Phase.READY) is told(Phase.HOLDING) is SystemStatus.STANDBY
    assert told(Phase.PERCHED, flags=ArmFlag.ANCHORED) is told(Phase.APPROACH) is SystemStatus.ACTIVE
    assert told(calibration=CalibrationState.RUNNING) is SystemStatus.CALIBRATING


@pytest.mark.parametrize("fault", list(UNHEALTHY), ids=lambda fault: fault.name)
def test_an_arm_that_is_not_well_is_critical_and_an_emergency_while_it_holds_something(fault: ArmFault) -> None:
    for free in (Phase.STARTUP, Phase.STOWED, Phase.APPROACH):
        assert told(free, error_bits=fault) is SystemStatus.CRITICAL
    assert told(Phase.WRAP, error_bits=fault, flags=ArmFlag.CONTACT) is SystemStatus.EMERGENCY
    assert told(Phase.HANGING, error_bits=fault, flags=ArmFlag.ANCHORED) is SystemStatus.EMERGENCY
    for may_hold in (Phase.HOLDING, Phase.HANG_HOLD):
        assert told(may_hold, error_bits=fault) is SystemStatus.EMERGENCY


@pytest.mark.parametrize("fault", NOT_OURS, ids=lambda fault: fault.name)
def test_what_others_do_and_what_a_perch_came_to_is_not_the_arms_health(fault: ArmFault) -> None:
    assert told(error_bits=fault) is SystemStatus.STANDBY
    assert told(Phase.WRAP, error_bits=fault, flags=ArmFlag.CONTACT) is SystemStatus.ACTIVE


def test_a_cycle_that_failed_is_trouble_even_before_any_succeeded() -> None:
    assert in_trouble(None) is in_trouble(WELL) is SystemStatus.CRITICAL
    assert in_trouble(dataclasses.replace(WELL, flags=ArmFlag.CONTACT)) is SystemStatus.EMERGENCY


def test_the_values_are_mavlinks() -> None:
    assert [status.value for status in SystemStatus] == [1, 2, 3, 4, 5, 6]
