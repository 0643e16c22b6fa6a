"""From what the daemon knows to MQTT's objects, whose keys are in `protocol.mqtt.SCHEMAS`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from arm_companion.drivers.telemetry import status_message
from arm_companion.mission.facts import (
    Notice,
    StatusReport,
    TendonState,
    TensionEstimate,
    VehicleState,
    WrenchReport,
)
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mqtt import Packet, packet

_UNKNOWN_PROGRESS: Final = 255


@dataclass(frozen=True, slots=True)
class Health:
    """How the daemon itself does."""

    uptime_s: float
    cycles: int
    missed: int
    failures: int
    links: Mapping[str, bool]  # by name: open


def state(
    unix_s: float,
    status: StatusReport,
    tendons: Sequence[TendonState],
    wrench: WrenchReport,
    vehicle: VehicleState,
) -> Packet:
    """`state`: what the arm does. Flags and errors are those of ARM_STATUS."""
    shown = status_message(0, status, tendons, wrench)
    values = {
        "behaviour": status.behaviour,
        "state": status.state,
        "progress": progress(status.progress),
        "flags": _names("ARM_FLAG", shown.flags),
        "errors": _names("ARM_ERROR", shown.errors),
        "theta": status.theta,
        "delta": status.delta,
        "goal_theta": status.goal_theta,
        "goal_delta": status.goal_delta,
        "tip": status.tip_position_a,
        "calibration": status.calibration.name.lower(),
        "vehicle_mode": vehicle.mode,
        "vehicle_armed": vehicle.armed,
    }
    return packet("state", unix_s, values)


def wrench(unix_s: float, report: WrenchReport) -> Packet:
    """`wrench`: predicted reaction wrench on the airframe."""
    values = {
        "force": report.force_b,
        "torque": report.torque_b,
        "force_sigma": report.force_sigma,
        "torque_sigma": report.torque_sigma,
        "source": report.source.name.lower(),
        "valid": report.valid,
        "taut_margin": report.taut_margin,
    }
    return packet("wrench", unix_s, values)


def tendons(unix_s: float, states: Sequence[TendonState], tensions: Sequence[TensionEstimate] = ()) -> Packet:
    """`tendons`: lists in the tendons' order; `tensions` replace what the loads alone give."""
    estimates = tensions or [TensionEstimate(t.tension, t.tension_sigma) for t in states]
    values: dict[str, Any] = {
        "pull": [t.pull for t in states],
        "speed": [t.speed for t in states],
        "tension": [e.tension for e in estimates],
        "tension_sigma": [e.sigma for e in estimates],
        "load": [t.load for t in states],
        "temperature": [t.temperature for t in states],
        "voltage": [t.voltage for t in states],
        "silent": [t.silent for t in states],
        "torque": [t.torque for t in states],
        "errors": [t.error_bits for t in states],
    }
    return packet("tendons", unix_s, values)


def event(unix_s: float, notice: Notice) -> Packet:
    """`events`: one sentence for people."""
    return packet("events", unix_s, {"severity": notice.severity.name.lower(), "text": notice.text})


def health(unix_s: float, report: Health, states: Sequence[TendonState], vehicle: VehicleState, dropped: int) -> Packet:
    """`health`: how daemon, links and servos do."""
    heard = [t for t in states if not t.silent]
    values = {
        "uptime": report.uptime_s,
        "cycles": report.cycles,
        "missed_cycles": report.missed,
        "failed_cycles": report.failures,
        "dropped": dropped,
        "links": dict(report.links),
        "autopilot_age": vehicle.heartbeat_age_s,
        "voltage_min": min((t.voltage for t in heard), default=math.nan),
        "temperature_max": max((t.temperature for t in heard), default=math.nan),
    }
    return packet("health", unix_s, values)


def progress(per_cent: int) -> int | None:
    """Per cent; None: not known."""
    return None if per_cent == _UNKNOWN_PROGRESS else per_cent


def _names(enum: str, bits: int) -> list[str]:
    return [
        entry.name.removeprefix(f"{enum}_")
        for bit, entry in sorted(mav.enums[enum].items())
        if bits & bit == bit and bit & (bit - 1) == 0 and bit
    ]
