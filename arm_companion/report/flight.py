"""What the report draws of a record: series at a rate that the eye can follow, and everything that was said."""

import itertools
import math
from array import array
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import orjson

from arm_companion.config.schema import Config
from arm_companion.config.table import from_table
from arm_companion.errors import ConfigError, RecordError
from arm_companion.geometry.arrays import Array
from arm_companion.mission.facts import ArmFault
from arm_companion.record.reader import Reader
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, FAILURES, LOG, TRUTH, transition
from arm_companion.report.extremes import Extremes

_PERIOD_NS: Final = 50_000_000
_NAN3: Final = (math.nan,) * 3
_HEAD: Final = {
    "t": 1,
    "position_w": 3,
    "setpoint_w": 3,
    "force_b": 3,
    "force_sigma": 3,
    "torque_b": 3,
    "torque_sigma": 3,
    "autopilot": 1,
    "position": 1,
    "attitude": 1,
    "ground": 1,
}
"""A drawn cycle is a row of these numbers, and behind them as many of each of these as there are tendons."""
_AGES: Final = ("autopilot", "position", "attitude", "ground")
_EACH: Final = ("tension", "tension_best", "temperature", "voltage", "servo_age")
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
    most: Extremes = field(default_factory=Extremes)
    faults: list[str] = field(default_factory=list)
    truth: dict[str, Array] = field(default_factory=dict)  # with its own "t"
    versions: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    config: Config | None = None
    cycles: int = 0
    missing: int = 0
    failed: list[tuple[float, str]] = field(default_factory=list)  # cycles: s since the first one, what was raised
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
        for item in reader.messages((FACTS, COMMANDS, FAILURES, LOG, CONFIGURATION)):
            collected.take(item.topic, item.sequence, item.unix_ns, item.data)
        if not collected.rows:
            none = (
                f"it has no cycle that did not fail: {collected.failed[0][1]}"
                if collected.failed
                else "it has no whole cycle"
            )
            raise RecordError(f"{reader.path}: {'; '.join([*reader.remarks, none])}")
        flight = collected.flight()
    except (KeyError, TypeError, ValueError) as error:
        version = reader.versions.get("version", "?")
        raise RecordError(f"{reader.path}: a record of version {version} that cannot be drawn: {error!r}") from None
    flight.versions = reader.versions
    flight.remarks = [*reader.remarks, *collected.remarks]
    if reader.part == 1:
        flight.missing += collected.first
    else:
        flight.remarks = [*reader.begins(collected.first), *flight.remarks]
    if truth is not None:
        flight.truth = _truth(truth, flight)
    return flight


class _Collected:
    """What has been read so far."""

    def __init__(self) -> None:
        self.rows: list[array[float]] = []
        self.remarks: list[str] = []
        self.first = 0  # number of the first cycle
        self.failed: list[tuple[float, str]] = []  # loop time, s; what was raised
        self._start = self._end = 0.0
        self._began_ns = self._last_ns = 0
        self._facts: tuple[int, bytes] = (-1, b"")
        self._said: list[tuple[int, str, str]] = []
        self._moves: list[tuple[float, str, str]] = []
        self._most = Extremes()
        self._config: Config | None = None
        self._cycles = self._missing = 0
        self._next: int | None = None

    def take(self, topic: str, sequence: int, unix_ns: int, data: bytes) -> None:
        """Take one message."""
        if topic == FACTS:
            self._facts = (sequence, data)
        elif topic in {COMMANDS, FAILURES}:
            if self._facts[0] == sequence:
                table = orjson.loads(data)
                self._count(sequence, unix_ns, float(table["t"]))
                if topic == COMMANDS:
                    self._cycle(unix_ns, orjson.loads(self._facts[1]), table)
                else:
                    self.failed.append((float(table["t"]), f"{table['error']} ({table['where']})"))
        elif topic == LOG:
            table = orjson.loads(data)
            self._said.append((unix_ns, _LEVELS.get(table["level"], "info"), table["message"]))
        elif self._config is None:
            try:
                self._config = from_table(orjson.loads(data)["config"], "recorded configuration")
            except ConfigError as error:
                self.remarks = [f"limits are not looked at: {error}"]

    def _count(self, sequence: int, unix_ns: int, t: float) -> None:
        self._end = t
        if self._next is None:
            self.first = self._next = sequence
            self._start, self._began_ns = t, unix_ns
        self._cycles += 1
        self._missing += sequence - self._next
        self._next = sequence + 1

    def _cycle(self, unix_ns: int, facts: dict[str, Any], commands: dict[str, Any]) -> None:
        self._follow(self._end, commands)
        self._most.see(facts, commands)
        if not self.rows or unix_ns - self._last_ns >= _PERIOD_NS:
            self._last_ns = unix_ns
            self.rows.append(_row(facts, commands))

    def _follow(self, t: float, commands: dict[str, Any]) -> None:
        """Which state it is: every cycle tells it, and the one that entered it why."""
        state = commands["status"]["state"]
        for notice in commands["notices"]:
            change = transition(notice["text"])
            if change is not None and change[1] == state:
                self._moves.append((t, state, change[2]))
        if not self._moves or self._moves[-1][1] != state:
            self._moves.append((t, state, "not in the record" if self._moves else "start of the record"))

    def flight(self) -> RecordedFlight:
        """The series."""
        count = max(len(row) - sum(_HEAD.values()) for row in self.rows) // len(_EACH)
        series = _columns(self.rows, count)
        return RecordedFlight(
            t=series["t"][:, 0] - self._start,
            position_w=series["position_w"],
            setpoint_w=series["setpoint_w"],
            force_b=series["force_b"],
            force_sigma=series["force_sigma"],
            torque_b=series["torque_b"],
            torque_sigma=series["torque_sigma"],
            tension=series["tension"],
            tension_best=series["tension_best"],
            temperature=series["temperature"],
            voltage=series["voltage"],
            servo_age=series["servo_age"],
            ages={name: series[name][:, 0] for name in _AGES},
            spans=self._spans(),
            said=[Said((ns - self._began_ns) * 1e-9, level, text) for ns, level, text in self._said],
            most=self._most,
            faults=_faults(self._most.error_bits),
            config=self._config,
            cycles=self._cycles,
            missing=self._missing,
            failed=[(t - self._start, text) for t, text in self.failed],
            began_ns=self._began_ns,
        )

    def _spans(self) -> list[Span]:
        times = [t for t, _, _ in self._moves[1:]] + [self._end]
        return [
            Span(name, t - self._start, after - self._start, cause)
            for (t, name, cause), after in zip(self._moves, times, strict=True)
        ]


def _row(facts: dict[str, Any], commands: dict[str, Any]) -> "array[float]":
    """What is drawn of a cycle; what is not finite stands as text in the record."""
    vehicle, wrench, setpoint, tendons = facts["vehicle"], commands["wrench"], commands["setpoint"], facts["tendons"]
    best = [x["tension"] for x in commands["tensions"]]
    numbers = (
        commands["t"],
        *(vehicle["position_w"] if isinstance(vehicle["position_age_s"], float) else _NAN3),
        *(setpoint["position_w"] if setpoint else _NAN3),
        *(wrench["force_b"] if wrench["valid"] else _NAN3),
        *wrench["force_sigma"],
        *(wrench["torque_b"] if wrench["valid"] else _NAN3),
        *wrench["torque_sigma"],
        *(vehicle[f"{name}_age_s"] for name in ("heartbeat", "position", "attitude")),
        facts["ground_age_s"],
        *(_heard(x, "tension") for x in tendons),
        *(best if len(best) == len(tendons) else (math.nan,) * len(tendons)),
        *(_heard(x, "temperature") for x in tendons),
        *(_heard(x, "voltage") for x in tendons),
        *(x["age_s"] for x in tendons),
    )
    return array("d", map(float, numbers))


def _columns(rows: "list[array[float]]", count: int) -> dict[str, Array]:
    """The rows by name, each (k, width); where a row has fewer tendons than `count` the rest is nan."""
    width = sum(_HEAD.values())
    head = np.array([row[:width] for row in rows])
    each = np.full((len(rows), len(_EACH), count), math.nan)
    for i, row in enumerate(rows):
        own = np.array(row[width:]).reshape(len(_EACH), -1)
        each[i, :, : own.shape[1]] = own
    ends = itertools.accumulate(_HEAD.values())
    found = {name: head[:, end - wide : end] for (name, wide), end in zip(_HEAD.items(), ends, strict=True)}
    return found | {name: each[:, i, :] for i, name in enumerate(_EACH)}


def _heard(tendon: dict[str, Any], name: str) -> Any:
    """A servo's value, once there has been one."""
    return tendon[name] if isinstance(tendon["age_s"], float) else math.nan


def _faults(bits: int) -> list[str]:
    """Names of error bits."""
    return [fault.name.replace("_", " ").lower() for fault in ArmFault if fault.name and fault.value & bits]


def _truth(reader: Reader, flight: RecordedFlight) -> dict[str, Array]:
    """The plant's truth as far as it belongs to this flight; none, and a remark, when it does not."""
    items = list(itertools.islice(reader.messages((TRUTH,)), 0, None, 5))
    flight.remarks += reader.remarks
    t = np.array([(item.unix_ns - flight.began_ns) * 1e-9 for item in items])
    of_this = np.flatnonzero((t >= 0.0) & (t <= flight.seconds))  # a part of a record has a part of its truth
    if not len(of_this):
        flight.remarks.append(f"{reader.path.name} has no truth of this flight")
        return {}
    rows = [orjson.loads(items[i].data) for i in of_this]
    found = {name: np.array([row[name] for row in rows], dtype=float) for name in rows[0] if name != "t"}
    return found | {"t": t[of_this]}
