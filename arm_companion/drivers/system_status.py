"""MAV_STATE of our heartbeat: what a ground station, or a program, needs to know of the arm before anything else.

SYS_STATUS is not sent: docs/adr/0030-no-sys-status.md.
"""

import enum
from typing import Final

from arm_companion.mission.facts import ArmFault, ArmFlag, CalibrationState, StatusReport
from arm_companion.mission.state import Phase
from arm_companion.protocol.dialect import mav


class SystemStatus(enum.IntEnum):
    """MAV_STATE, as our heartbeat tells it."""

    BOOT = mav.MAV_STATE_BOOT
    CALIBRATING = mav.MAV_STATE_CALIBRATING
    STANDBY = mav.MAV_STATE_STANDBY
    ACTIVE = mav.MAV_STATE_ACTIVE
    CRITICAL = mav.MAV_STATE_CRITICAL
    EMERGENCY = mav.MAV_STATE_EMERGENCY


UNHEALTHY: Final = (
    ArmFault.SERVO_SILENT
    | ArmFault.SERVO_FAULT
    | ArmFault.OVERHEAT
    | ArmFault.OVERLOAD
    | ArmFault.LOW_VOLTAGE
    | ArmFault.TENDON_OVER_TENSION
    | ArmFault.TENDON_BROKEN
    | ArmFault.TENSION_DISAGREES
    | ArmFault.MODEL
    | ArmFault.NOT_CALIBRATED
)
"""Errors of the arm itself. The autopilot's and the pilot's are told by them; a grip that failed is a result."""

_TOUCHES: Final = ArmFlag.CONTACT | ArmFlag.ANCHORED
_MAY_HOLD: Final = frozenset({Phase.HOLDING.value, Phase.HANG_HOLD.value})


def system_status(report: StatusReport, *, active: bool) -> SystemStatus:
    """What the heartbeat says.

    Args:
        report: what the arm is doing.
        active: a behaviour is under way that moves the vehicle.
    """
    if report.error_bits & UNHEALTHY:
        return in_trouble(report)
    if report.calibration is CalibrationState.RUNNING:
        return SystemStatus.CALIBRATING
    if report.state_number == Phase.STARTUP.value:
        return SystemStatus.BOOT
    return SystemStatus.ACTIVE if active else SystemStatus.STANDBY


def in_trouble(report: StatusReport | None) -> SystemStatus:
    """What the heartbeat says of an arm that is not well: worse while the vehicle, or a load, depends on it.

    Args:
        report: the last one; None: there was none yet.
    """
    if report is not None and (report.flags & _TOUCHES or report.state_number in _MAY_HOLD):
        return SystemStatus.EMERGENCY
    return SystemStatus.CRITICAL
