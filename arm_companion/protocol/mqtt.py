"""What goes over MQTT: topics, JSON objects with time and units, and the reader of commands. Pure.

Every object has `version`, `time` (Unix seconds) and `units` (of the keys that have one). Numbers are SI. What is not
known is null: JSON has no NaN.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from arm_companion.errors import ProtocolError

VERSION: Final = 1
ONLINE: Final = b"online"
OFFLINE: Final = b"offline"
LONGEST_COMMAND: Final = 1024
"""Bytes; a command has about a hundred."""

_LONGEST_NONCE: Final = 64
_MOST_PARAMETERS: Final = 7

SCHEMAS: Final[Mapping[str, Mapping[str, tuple[str, str]]]] = MappingProxyType(
    {
        "state": {
            "behaviour": ("", "what the arm is at: stowed, ready, perch, ..."),
            "state": ("", "state of the machine within it"),
            "progress": ("%", "of the behaviour; null: not known"),
            "flags": ("", "names of ARM_FLAG that hold"),
            "errors": ("", "names of ARM_ERROR that stand"),
            "theta": ("rad", "bend of the arm"),
            "delta": ("rad", "direction of the bend"),
            "goal_theta": ("rad", "bend that is asked for"),
            "goal_delta": ("rad", "direction that is asked for"),
            "tip": ("m", "position of the tip in base axes: x, y, z"),
            "calibration": ("", "of the tendons: unknown, missing, stale, running, valid"),
            "vehicle_mode": ("", "flight mode as the autopilot's tools call it"),
            "vehicle_armed": ("", "whether the motors may turn"),
        },
        "wrench": {
            "force": ("N", "of the arm on the airframe, body axes: x, y, z"),
            "torque": ("N m", "about the airframe's centre of mass, body axes: x, y, z"),
            "force_sigma": ("N", "one sigma of force"),
            "torque_sigma": ("N m", "one sigma of torque"),
            "source": ("", "situation that is assumed: free, contact, anchored, payload"),
            "valid": ("", "whether the prediction may be used"),
            "taut_margin": ("m", "way until the arm is taut; null: does not apply"),
        },
        "tendons": {
            "pull": ("m", "length taken in, of each tendon"),
            "speed": ("m/s", "rate of pull"),
            "tension": ("N", "estimate"),
            "tension_sigma": ("N", "one sigma of tension"),
            "load": ("1", "share of the servo's full load, positive when pulling"),
            "temperature": ("degC", "of the servo"),
            "voltage": ("V", "at the servo"),
            "silent": ("", "whether the servo does not answer"),
            "torque": ("", "whether its torque is on"),
            "errors": ("", "hardware-error bits"),
        },
        "events": {
            "severity": ("", "critical, error, warning, notice, info"),
            "text": ("", "one sentence for people"),
        },
        "health": {
            "uptime": ("s", "since the daemon's start"),
            "cycles": ("", "since the start"),
            "missed_cycles": ("", "cycles that came too late"),
            "failed_cycles": ("", "cycles that ended in an exception"),
            "dropped": ("", "messages that were dropped from the queue here"),
            "links": ("", "by name: whether it is open"),
            "autopilot_age": ("s", "since its last heartbeat; null: never heard"),
            "voltage_min": ("V", "lowest at any servo; null: not known"),
            "temperature_max": ("degC", "highest of any servo; null: not known"),
        },
        "answer": {
            "nonce": ("", "of the command"),
            "command": ("", "its name"),
            "result": ("", "accepted, in_progress, temporarily_rejected, denied, failed, cancelled, unsupported"),
            "progress": ("%", "while it is in progress; null: not known"),
            "reason": ("", "in words, when it was not accepted"),
        },
    }
)  # fmt: skip
"""By topic, of each key: unit and meaning. Lists of `tendons` are in the tendons' order."""

RETAINED: Final = frozenset({"state", "health", "availability"})
"""Topics whose newest message the broker keeps for who comes later."""

ASSURED: Final = frozenset({"events", "answer", "availability"})
"""Topics that are sent with QoS 1: each message counts. The others come again soon."""

_UNITS: Final = {
    topic: {key: unit for key, (unit, _) in keys.items() if unit} | {"time": "s"} for topic, keys in SCHEMAS.items()
}


@dataclass(frozen=True, slots=True)
class Packet:
    """One message for the broker; `topic` is what follows arm/NAME/."""

    topic: str
    payload: bytes

    @property
    def retain(self) -> bool:
        """Whether the broker keeps it."""
        return self.topic in RETAINED

    @property
    def qos(self) -> int:
        """MQTT's quality of service."""
        return 1 if self.topic in ASSURED else 0


@dataclass(frozen=True, slots=True)
class Order:
    """A command as it came over MQTT, well-formed and not judged yet."""

    command: str
    parameters: tuple[float, ...]
    nonce: str
    time: float  # Unix time at which it was given, s


def topic(vehicle: str, name: str) -> str:
    """The whole topic."""
    return f"arm/{vehicle}/{name}"


def packet(name: str, unix_s: float, values: Mapping[str, Any]) -> Packet:
    """A message of a schema.

    Args:
        name: topic, a key of `SCHEMAS`.
        unix_s: time of what it tells.
        values: exactly the schema's keys.

    Raises:
        ProtocolError: keys are missing or too many.
    """
    if values.keys() != SCHEMAS[name].keys():
        raise ProtocolError(f"mqtt {name}: keys are {sorted(values)}, not {sorted(SCHEMAS[name])}")
    whole = {"version": VERSION, "time": round(unix_s, 6), "units": _UNITS[name], **_plain(dict(values))}
    return Packet(name, json.dumps(whole, allow_nan=False, separators=(",", ":")).encode())


def _plain(value: Any) -> Any:
    """Without NaN and infinities, and with floats as short as a 32-bit one deserves."""
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def read_order(payload: bytes) -> Order:
    """A command: `{"command": "READY", "parameters": [...], "nonce": "...", "time": ...}`.

    Raises:
        ProtocolError: it is not well-formed; the message says what is wrong.
    """
    if len(payload) > LONGEST_COMMAND:
        raise ProtocolError(f"it has {len(payload)} bytes, over {LONGEST_COMMAND}")
    try:
        table = json.loads(payload)
    except (ValueError, RecursionError):  # UnicodeDecodeError is a ValueError
        raise ProtocolError("it is no JSON") from None
    if not isinstance(table, dict) or not table.keys() <= {"command", "parameters", "nonce", "time", "version"}:
        raise ProtocolError("it is no object with command, parameters, nonce and time")
    if table.get("version", VERSION) != VERSION:
        raise ProtocolError("its version is another")
    command, nonce, time = table.get("command"), table.get("nonce"), table.get("time")
    parameters = table.get("parameters", [])
    if not isinstance(command, str) or not command:
        raise ProtocolError("command is no name")
    if not isinstance(nonce, str) or not 1 <= len(nonce) <= _LONGEST_NONCE:
        raise ProtocolError(f"nonce is no text of 1 to {_LONGEST_NONCE} characters")
    if not isinstance(time, int | float) or not _is_number(time):
        raise ProtocolError("time is no number")
    if not isinstance(parameters, list) or len(parameters) > _MOST_PARAMETERS or not all(map(_is_number, parameters)):
        raise ProtocolError(f"parameters are no list of at most {_MOST_PARAMETERS} numbers")
    return Order(command, tuple(map(float, parameters)), nonce, float(time))


def _is_number(value: object) -> bool:
    """Finite, and as a float too: JSON's whole numbers have no end."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300  # false for NaN and infinities too
