"""What the report draws of a record: series at a rate that the eye can follow, and everything that was said."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import orjson

from arm_companion.config.schema import Config
from arm_companion.config.table import from_table
from arm_companion.errors import ConfigError, RecordError
from arm_companion.geometry.arrays import Array
from arm_companion.mission.facts import ArmFault
from arm_companion.mission.state import MOVES_VEHICLE
from arm_companion.record.reader import Reader
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, LOG, TRANSITIONS, TRUTH

_PERIOD_NS: Final = 50_000_000
_FLYING: Final = frozenset(phase.name for phase in MOVES_VEHICLE)
_NAN3: Final = [float("nan")] * 3
_LEVELS: Final = {5: "critical", 4: "error", 3: "warning"}


@dataclass(frozen=True, slots=True)
class Said:
    """A sentence for people."""

    t: float  # s since the first cycle
    level: str  # "critical", "error", "warning" or "info"
    text: str


@dataclass(frozen=True, slots=True)
class Span:
    """A state passed."""

    name: str
    begin: float  # s since the first cycle
    end: float
    cause: str


@dataclass
class RecordedFlight:
    """Series over `t` (k,), s since the first cycle; body axes FRD, world NED; n tendons."""

    t: Array
    position_w: Array  # (k, 3), m
    setpoint_w: Array  # (k, 3), m; nan where none was sent
    force_b: Array  # (k, 3), N; nan where the prediction was not valid
    force_sigma: Array  # (k, 3), N
    torque_b: Array  # (k, 3), N m
    torque_sigma: Array  # (k, 3), N m
    tension: Array  # (k, n), N, by load
    tension_best: Array  # (k, n), N, by load and statics
    temperature: Array  # (k, n), degC
    voltage: Array  # (k, n), V
    servo_age: Array  # (k, n), s
    ages: dict[str, Array]  # (k,), s: heartbeat, position, attitude, ground
    spans: list[Span] = field(default_factory=list)
    said: list[Said] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    truth: dict[str, Array] = field(default_factory=dict)  # with its own "t"
    versions: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    config: Config | None = None
    cycles: int = 0
    missing: int = 0
    began_ns: int = 0

    @property
    def seconds(self) -> float:
        """Length of the flight."""
        return float(self.t[-1])


def read(reader: Reader, truth: Reader | None = None) -> RecordedFlight:
    """Read a record for drawing.

    Raises:
        RecordError: it has no whole cycle, or not the fields of this version.
    """
    collected = _Collected()
    try:
        for item in reader.messages((FACTS, COMMANDS, LOG, TRANSITIONS, CONFIGURATION)):
            collected.take(item.topic, item.sequence, item.unix_ns, item.data)
        if not collected.rows:
            raise RecordError(f"{reader.path}: {'; '.join([*reader.remarks, 'it has no whole cycle'])}")
        flight = collected.flight()
    except (KeyError, TypeError, ValueError) as error:
        version = reader.versions.get("version", "?")
        raise RecordError(f"{reader.path}: a record of version {version} that cannot be drawn: {error!r}") from None
    flight.versions = reader.versions
    flight.remarks = list(reader.remarks)
    if truth is not None:
        flight.truth = _truth(truth, collected.start)
    return flight


class _Collected:
    """What has been read so far."""

    def __init__(self) -> None:
        self.start = 0.0
        self.rows: list[dict[str, Any]] = []
        self._begun = False
        self._began_ns = self._last_ns = 0
        self._facts: tuple[int, bytes] = (-1, b"")
        self._said: list[tuple[int, str, str]] = []
        self._moves: list[tuple[float, str, str]] = []
        self._config: Config | None = None
        self._config_error = ""
        self._cycles = self._missing = 0
        self._next: int | None = None
        self._first_state = ""

    def take(self, topic: str, sequence: int, unix_ns: int, data: bytes) -> None:
        """Take one message."""
        if topic == FACTS:
            self._facts = (sequence, data)
        elif topic == COMMANDS:
            self._cycle(sequence, unix_ns, data)
        elif topic == LOG:
            table = orjson.loads(data)
            self._said.append((unix_ns, _LEVELS.get(table["level"], "info"), table["message"]))
        elif topic == TRANSITIONS:
            table = orjson.loads(data)
            self._moves.append((float(table["t"]), table["after"], table["cause"]))
        elif self._config is None:
            try:
                self._config = from_table(orjson.loads(data)["config"], "recorded configuration")
            except ConfigError as error:
                self._config_error = str(error)

    def _cycle(self, sequence: int, unix_ns: int, data: bytes) -> None:
        self._cycles += 1
        self._missing += 0 if self._next is None else sequence - self._next
        self._next = sequence + 1
        if self._begun and unix_ns - self._last_ns < _PERIOD_NS:
            return
        if self._facts[0] != sequence:
            return
        facts, commands = orjson.loads(self._facts[1]), orjson.loads(data)
        if not self._begun:
            self._begun = True
            self.start, self._began_ns = float(facts["t"]), unix_ns
            self._first_state = commands["status"]["state"]
        self._last_ns = unix_ns
        self.rows.append({"facts": facts, "commands": commands})

    def flight(self) -> RecordedFlight:
        """The series."""
        facts = [row["facts"] for row in self.rows]
        commands = [row["commands"] for row in self.rows]
        vehicle = [f["vehicle"] for f in facts]
        wrench = [c["wrench"] for c in commands]
        return RecordedFlight(
            t=_array([f["t"] for f in facts]) - self.start,
            position_w=_array([v["position_w"] for v in vehicle]),
            setpoint_w=_array([c["setpoint"]["position_w"] if c["setpoint"] else _NAN3 for c in commands]),
            force_b=_array([w["force_b"] if w["valid"] else _NAN3 for w in wrench]),
            force_sigma=_array([w["force_sigma"] for w in wrench]),
            torque_b=_array([w["torque_b"] if w["valid"] else _NAN3 for w in wrench]),
            torque_sigma=_array([w["torque_sigma"] for w in wrench]),
            tension=_array([[x["tension"] for x in f["tendons"]] for f in facts]),
            tension_best=_array([[x["tension"] for x in c["tensions"]] for c in commands]),
            temperature=_array([[_heard(x, "temperature") for x in f["tendons"]] for f in facts]),
            voltage=_array([[_heard(x, "voltage") for x in f["tendons"]] for f in facts]),
            servo_age=_array([[x["age_s"] for x in f["tendons"]] for f in facts]),
            ages={
                "autopilot": _array([v["heartbeat_age_s"] for v in vehicle]),
                "position": _array([v["position_age_s"] for v in vehicle]),
                "attitude": _array([v["attitude_age_s"] for v in vehicle]),
                "ground": _array([f["ground_age_s"] for f in facts]),
            },
            spans=self._spans(float(facts[-1]["t"])),
            said=[Said((ns - self._began_ns) * 1e-9, level, text) for ns, level, text in self._said],
            faults=_faults(commands),
            config=self._config,
            cycles=self._cycles,
            missing=self._missing,
            began_ns=self._began_ns,
        )

    def _spans(self, end: float) -> list[Span]:
        # where recording began with the phase already entered there is no cause
        first = self._moves[0] if self._moves else None
        moves = list(self._moves)
        if first is None or first[0] > self.start:
            moves.insert(0, (self.start, self._first_state, "start of the record"))
        times = [t for t, _, _ in moves[1:]] + [end]
        return [
            Span(name, t - self.start, after - self.start, cause)
            for (t, name, cause), after in zip(moves, times, strict=True)
        ]


def _array(values: list[Any]) -> Array:
    """Rows of numbers; what is not finite stands as text in the record, ragged rows are filled with nan."""
    width = max((len(v) for v in values if isinstance(v, list)), default=0)
    if width:
        values = [v if len(v) == width else [*v, *[float("nan")] * (width - len(v))] for v in values]
    try:
        return np.array(values, dtype=float)
    except ValueError:
        numbers = [[float(x) for x in v] if isinstance(v, list) else float(v) for v in values]
        return np.array(numbers, dtype=float)


def _heard(tendon: dict[str, Any], name: str) -> Any:
    """A servo's value, once there has been one."""
    return tendon[name] if isinstance(tendon["age_s"], float) else float("nan")


def _faults(commands: list[dict[str, Any]]) -> list[str]:
    """Names of all error bits that were seen while the arm flew a perch."""
    bits = 0
    for table in commands:
        if table["status"]["state"] in _FLYING:
            bits |= table["status"]["error_bits"]
    return [fault.name.replace("_", " ").lower() for fault in ArmFault if fault.name and fault.value & bits]


def _truth(reader: Reader, start: float) -> dict[str, Array]:
    rows = [orjson.loads(item.data) for item in reader.messages((TRUTH,))][::5]
    if not rows:
        return {}
    return {
        name: np.array([row[name] for row in rows], dtype=float) - (start if name == "t" else 0.0) for name in rows[0]
    }
