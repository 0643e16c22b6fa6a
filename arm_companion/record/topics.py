"""The channels of a record, and the JSON schema of a dataclass that `record_codec` writes.

Every structured message is JSON with the loop time `t` (s) first; its log time is the Unix time of the same instant.
A number that is not finite is one of the strings "nan", "inf" and "-inf", which plots leave out.

The schemas keep to what Foxglove's reader takes, and it refuses all of a channel for one field that it does not: every
level is an object, a value of one kind or an array of these, never an array of arrays.
"""

import base64
import dataclasses
import enum
import json
import re
import types
import typing
from typing import Any, Final

from arm_companion.mission.facts import Commands, Facts, Notice, Severity
from arm_companion.mission.state import Phase, State
from arm_companion.record_codec import fields

FORMAT: Final = "1"
"""Version of this layout, in the metadata `arm_companion` of a record."""

METADATA: Final = "arm_companion"
FACTS: Final = "/facts"
STATE: Final = "/state"
COMMANDS: Final = "/commands"
FAILURES: Final = "/failures"
"""What a cycle's step raised; stands where its commands would."""
STARTS: Final = "/starts"
"""Where the solver starts from in the cycle of the same number, once in a while."""
TRANSITIONS: Final = "/transitions"
LOG: Final = "/log"
CONFIGURATION: Final = "/configuration"
TRUTH: Final = "/truth"
RAW: Final = "/raw/"
"""What a raw channel's name begins with; then the pipe, then /sent or /received."""

_TRANSITION = re.compile(r"([A-Z]+) -> ([A-Z]+): (.*)", re.DOTALL)
_NUMBER: Final = {"type": "number"}
_STRING: Final = {"type": "string"}
_TIME: Final = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}

_LEVELS: Final = {
    Severity.CRITICAL: 5,
    Severity.ERROR: 4,
    Severity.WARNING: 3,
    Severity.NOTICE: 2,
    Severity.INFO: 2,
}


def schema(hint: Any) -> dict[str, Any]:
    """JSON schema of a type as `record_codec` writes it."""
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (inner,) = (a for a in arguments if a is not type(None))
        return schema(inner)
    if origin in (tuple, frozenset):
        return {"type": "array", "items": schema(arguments[0])}
    if isinstance(hint, type) and issubclass(hint, enum.Flag):
        return {"type": "integer"}
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return _STRING
    if dataclasses.is_dataclass(hint):
        kind: Any = hint
        tables = {name: schema(inner) for name, inner in fields(kind).items()}
        return {"type": "object", "properties": {name: table for name, table in tables.items() if not _nested(table)}}
    return {"type": {float: "number", int: "integer", bool: "boolean"}.get(hint, "string")}


def _nested(table: dict[str, Any]) -> bool:
    """Whether it is an array of arrays, such as a matrix: it stands in the messages all the same."""
    return bool(table["type"] == "array" and table["items"]["type"] == "array")


def _timed(table: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": {"t": _NUMBER, **table["properties"]}}


SCHEMAS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    FACTS: ("arm_companion.Facts", _timed(schema(Facts))),
    # the state's own `t` is that of the step before
    STATE: ("arm_companion.State", schema(State)),
    COMMANDS: ("arm_companion.Commands", _timed(schema(Commands))),
    FAILURES: ("arm_companion.Failure", _timed({"properties": {"error": _STRING, "where": _STRING}})),
    STARTS: (
        "arm_companion.Starts",
        _timed({"properties": {name: {"type": "object"} for name in ("free", "anchored", "stiffness")}}),
    ),
    TRANSITIONS: (
        "arm_companion.Transition",
        _timed({"properties": {"before": _STRING, "after": _STRING, "cause": _STRING}}),
    ),
    LOG: (
        "foxglove.Log",
        {
            "type": "object",
            "properties": {
                "timestamp": _TIME,
                "level": {"type": "integer"},
                "message": _STRING,
                "name": _STRING,
                "file": _STRING,
                "line": {"type": "integer"},
            },
        },
    ),
    CONFIGURATION: ("arm_companion.Config", _timed({"properties": {"config": {"type": "object"}}})),
    TRUTH: (
        "arm_companion.Truth",
        _timed(
            {
                "properties": {
                    name: {"type": "array", "items": _NUMBER}
                    for name in ("position_w", "force_b", "torque_b", "tension")
                }
                | {"contact_force_n": _NUMBER, "wrap_angle": _NUMBER}
            }
        ),
    ),
}
"""Name and JSON schema of every channel but the raw ones."""

BYTES: Final = (
    "arm_companion.Bytes",
    _timed({"properties": {"data": {"type": "string", "contentEncoding": "base64"}}}),
)
"""The same of all raw channels."""


def schema_text(topic: str) -> tuple[str, bytes]:
    """Name and text of a channel's schema."""
    name, table = BYTES if topic.startswith(RAW) else SCHEMAS[topic]
    return name, json.dumps(table).encode()


def bytes_message(t: float, data: bytes) -> dict[str, Any]:
    """Bytes of a pipe as a raw channel has them."""
    return {"t": t, "data": base64.b64encode(data).decode()}


def transition(text: str) -> tuple[str, str, str] | None:
    """State before, state after and cause, when a notice tells of a transition."""
    match = _TRANSITION.fullmatch(text)
    if match is None or not {match[1], match[2]} <= Phase.__members__.keys():
        return None
    return match[1], match[2], match[3]


def log_message(unix_ns: int, notice: Notice) -> dict[str, Any]:
    """A notice as foxglove.Log."""
    seconds, nanoseconds = divmod(unix_ns, 10**9)
    return {
        "timestamp": {"sec": seconds, "nsec": nanoseconds},
        "level": _LEVELS[notice.severity],
        "message": notice.text,
        "name": "arm_companion",
        "file": "",
        "line": 0,
    }
