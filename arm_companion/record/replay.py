"""Recorded facts through today's code, and every command compared bit for bit."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import orjson

from arm_companion.arm import compiled
from arm_companion.arm.model import ArmModel
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import Config
from arm_companion.config.table import from_table
from arm_companion.errors import RecordError, in_words
from arm_companion.mission.facts import Facts
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import State
from arm_companion.record.reader import Item, Reader
from arm_companion.record.starts import started
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, FAILURES, STARTS, STATE, transition
from arm_companion.record_codec import build, plain

Change = Callable[[Config], Config]

_QUANTITIES: Final = {
    "predicted force": ("N", ("wrench", "force_b")),
    "predicted torque": ("N m", ("wrench", "torque_b")),
    "tendon goal": ("m", ("pulls",)),
    "vehicle set-point": ("m", ("setpoint", "position_w")),
}


class Written(NamedTuple):
    """One cycle as it stands in the record."""

    number: int
    facts: bytes
    state: bytes
    commands: bytes
    """Empty: its step raised."""
    starts: bytes = b""
    """Where the solver starts, which stands with one cycle now and then."""
    failure: bytes = b""
    """What its step raised."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """One cycle as recorded; only the facts are needed in any case, so the rest stays text."""

    number: int
    t: float  # loop time, s
    facts: Facts
    state: bytes
    commands: bytes
    starts: bytes = b""
    failure: str = ""
    where: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """A cycle whose step raised in flight."""

    cycle: int
    seconds: float  # since the first cycle
    recorded: str
    where: str
    now: str
    """What today's code raises there; empty: nothing."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a replay first left the record."""

    cycle: int
    seconds: float  # since the first cycle
    field: str
    recorded: Any
    now: Any


@dataclass(frozen=True, slots=True)
class Moved:
    """A change of state."""

    seconds: float
    before: str
    after: str
    cause: str


@dataclass(frozen=True, slots=True)
class Greatest:
    """Greatest difference of a quantity over a flight."""

    value: float
    unit: str
    seconds: float


@dataclass(slots=True)
class Outcome:
    """What a replay found."""

    begins: int = 0  # number of the first cycle, counted over the whole flight
    cycles: int = 0
    same: int = 0
    failures: list[tuple[int, str]] = field(default_factory=list)  # cycle, and what today's code raised
    failed: list[Failed] = field(default_factory=list)  # in flight
    gaps: list[tuple[int, int]] = field(default_factory=list)  # cycles that are missing: first, how many
    first: Difference | None = None
    why: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    recorded: list[Moved] = field(default_factory=list)
    now: list[Moved] = field(default_factory=list)
    greatest: dict[str, Greatest] = field(default_factory=dict)
    seconds: float = 0.0  # of flight

    @property
    def identical(self) -> bool:
        """Every command of every cycle is the same, bit for bit; what failed in flight fails in the same words."""
        return self.same == self.cycles


def replay(reader: Reader, *, change: Change | None = None, mechanics: str = "") -> Outcome:
    """Run a record through today's `step`, from the first cycle's memory on.

    The facts stay as they were: after a first difference the world does not answer to the other commands.

    Args:
        reader: the record.
        change: makes another configuration of each recorded one.
        mechanics: "numpy" or "numba" instead of what the record was made with.

    Raises:
        RecordError: it has no cycle, or facts that this version cannot read.
        ConfigError: its configuration is not one of this version, or `change` refuses.
    """
    outcome = Outcome(why=_reasons(reader.versions))
    if change is not None:
        outcome.why.insert(0, "the configuration is another one")
    wanted = mechanics or reader.versions.get("mechanics", "numpy")
    runner = Runner(outcome, change, mechanics_of(wanted, reader.versions.get("mechanics", ""), outcome.why))
    for found in cycles(reader):
        if isinstance(found, Cycle):
            runner.take(found)
        else:
            runner.configure(found)
    outcome.remarks += [*reader.begins(outcome.begins), *reader.remarks]
    if not outcome.cycles:
        raise RecordError(f"{reader.path}: {'; '.join([*reader.remarks, 'it has no whole cycle'])}")
    if outcome.identical:
        outcome.why.clear()
    return outcome


def cycles(reader: Reader) -> Iterator[Cycle | Config]:
    """The cycles of a record, and the configurations between them.

    Raises:
        RecordError: facts are not what this version knows.
        ConfigError: so is a configuration.
    """
    for found in written(reader):
        if isinstance(found, Config):
            yield found
            continue
        try:
            yield cycle_of(found)
        except (KeyError, ValueError) as error:
            known = reader.versions.get("version", "?")
            raise RecordError(
                f"{reader.path}: cycle {found.number} cannot be read, the record is of version {known}: {error}"
            ) from None


def written(reader: Reader) -> Iterator[Written | Config]:
    """The same, with the cycles still as text.

    Raises:
        ConfigError: a configuration is not what this version knows.
    """
    parts: dict[str, Item] = {}
    for item in reader.messages((FACTS, STATE, COMMANDS, FAILURES, CONFIGURATION, STARTS)):
        if item.topic == CONFIGURATION:
            yield from_table(orjson.loads(item.data)["config"], f"configuration of {reader.path.name}")
            continue
        parts[item.topic] = item
        whole = item.topic in {COMMANDS, FAILURES}
        if whole and FACTS in parts and parts[FACTS].sequence == item.sequence:
            state = parts[STATE].data if STATE in parts else b""
            begin = parts.pop(STARTS, None)
            starts = begin.data if begin is not None and begin.sequence == item.sequence else b""
            ends = (item.data, starts) if item.topic == COMMANDS else (b"", starts, item.data)
            yield Written(item.sequence, parts[FACTS].data, state, *ends)


def cycle_of(text: Written) -> Cycle:
    """The cycle that a text tells of.

    Raises:
        KeyError, ValueError: its facts are not what this version knows.
    """
    table = orjson.loads(text.facts)
    t = float(table.pop("t"))
    failure = orjson.loads(text.failure) if text.failure else {"error": "", "where": ""}
    facts = build(Facts, table)
    return Cycle(text.number, t, facts, text.state, text.commands, text.starts, failure["error"], failure["where"])


class Runner:
    """Memory and parameters of a replay while it runs.

    Attributes:
        parameters: as configured last; None before that.
        state: memory after the last cycle; None before the first.
        start: loop time of the first cycle, s.
    """

    def __init__(self, outcome: Outcome, change: Change | None, fast: bool) -> None:
        self._outcome = outcome
        self._change = change
        self._fast = fast
        self._next = 0
        self.parameters: Parameters | None = None
        self.state: State | None = None
        self.start = 0.0

    def configure(self, config: Config) -> None:
        """From here on with this configuration."""
        if self._change is not None:
            config = self._change(config)
        old = self.parameters
        model: ArmModel
        if old is not None and old.config.arm == config.arm:
            model = old.model
        else:
            model = RodModel(ArmParameters.of(config.arm), fast=self._fast)
        self.parameters = Parameters(config, model)

    def take(self, cycle: Cycle) -> None:
        """Run one cycle and compare."""
        outcome = self._outcome
        if self.parameters is None:
            raise RecordError("the record has no configuration before its first cycle")
        if self.state is None or cycle.number != self._next:
            self._resume(cycle, self.parameters)
        self._next = cycle.number + 1
        outcome.cycles += 1
        seconds = outcome.seconds = cycle.t - self.start
        state = self.state or State()
        raised = ""
        try:
            after, commands = step(state, cycle.facts, cycle.t, self.parameters)
        except Exception as error:  # noqa: BLE001 - as in the daemon: the cycle fails, the next one comes
            raised = in_words(error)
            outcome.failures.append((cycle.number, raised))
        if cycle.failure:  # the daemon's memory stayed as it was, and the facts that follow are of that
            self.state = state
            self._compare_failure(cycle, seconds, raised)
            return
        if raised:
            self._note_first(cycle, seconds, "", "commands", raised)
            outcome.recorded += _moves(orjson.loads(cycle.commands), seconds)
            return
        self.state = after
        now = orjson.dumps({"t": cycle.t} | plain(commands))
        if now == cycle.commands:
            outcome.same += 1
            if commands.notices:
                moves = _moves(plain(commands), seconds)
                outcome.recorded += moves
                outcome.now += moves
            return
        self._compare(cycle, orjson.loads(cycle.commands), orjson.loads(now), seconds)

    def _resume(self, cycle: Cycle, parameters: Parameters) -> None:
        """Memory as recorded: at the first cycle, and where some are missing."""
        if self.state is None:
            self.start = self.start or cycle.t
            self._outcome.begins = cycle.number
        else:
            self._outcome.gaps.append((self._next, cycle.number - self._next))
        try:
            self.state = build(State, orjson.loads(cycle.state)) if cycle.state else self.state or State()
            if cycle.starts:
                self.state = started(self.state, cycle.starts, parameters.model)
        except ValueError as error:
            raise RecordError(f"cycle {cycle.number}: memory of another version: {error}") from None
        if cycle.number and self.state.prediction is not None and not cycle.starts:
            self._outcome.why.append(
                "cycles are missing, and where the solver starts behind them: last bits may differ after the gap"
            )

    def _compare_failure(self, cycle: Cycle, seconds: float, now: str) -> None:
        outcome = self._outcome
        outcome.failed.append(Failed(cycle.number, seconds, cycle.failure, cycle.where, now))
        if now == cycle.failure:
            outcome.same += 1
        else:
            self._note_first(cycle, seconds, "failure", cycle.failure, now or "none")

    def _compare(self, cycle: Cycle, recorded: dict[str, Any], now: dict[str, Any], seconds: float) -> None:
        outcome = self._outcome
        outcome.recorded += _moves(recorded, seconds)
        outcome.now += _moves(now, seconds)
        different = next(differences(recorded, now), None)
        if different is None:  # only the text differs, as with another version of the writer
            outcome.same += 1
            return
        self._note_first(cycle, seconds, *different)
        for name, (unit, path) in _QUANTITIES.items():
            distance = _distance(_at(recorded, path), _at(now, path))
            if distance > 0.0 and (name not in outcome.greatest or distance > outcome.greatest[name].value):
                outcome.greatest[name] = Greatest(distance, unit, seconds)

    def _note_first(self, cycle: Cycle, seconds: float, path: str, recorded: Any, now: Any) -> None:
        if self._outcome.first is None:
            self._outcome.first = Difference(cycle.number, seconds, path or "commands", recorded, now)


def differences(recorded: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Path, recorded value and present value of everything that differs between two JSON values.

    A record leaves nothing out: what it does not have did not exist when it was made, and is no difference while
    nothing is asked by it.
    """
    if isinstance(recorded, dict) and isinstance(now, dict):
        for key in [*recorded, *(key for key in now if key not in recorded and now[key] is not None)]:
            below = f"{path}.{key}" if path else key
            yield from differences(recorded.get(key, "(absent)"), now.get(key, "(absent)"), below)
    elif isinstance(recorded, list) and isinstance(now, list) and len(recorded) == len(now):
        for i, (a, b) in enumerate(zip(recorded, now, strict=True)):
            yield from differences(a, b, f"{path}[{i}]")
    elif recorded != now or _sign(recorded) != _sign(now):
        yield path, recorded, now


def _sign(value: Any) -> float:
    return math.copysign(1.0, value) if isinstance(value, float) else 0.0


def _moves(commands: dict[str, Any], seconds: float) -> list[Moved]:
    found = (transition(notice["text"]) for notice in commands["notices"])
    return [Moved(seconds, *change) for change in found if change is not None]


def _at(table: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        table = table.get(key) if isinstance(table, dict) else None
    return table


def _distance(a: Any, b: Any) -> float:
    """Euclidean distance of two lists of numbers; 0 where one is absent or not finite."""
    if not isinstance(a, list) or not isinstance(b, list) or len(a) != len(b):
        return 0.0
    if any(isinstance(x, str) for x in (*a, *b)):
        return 0.0
    return math.dist(a, b)


def mechanics_of(wanted: str, recorded: str, why: list[str]) -> bool:
    """Whether to run compiled mechanics."""
    fast = wanted == "numba"
    if fast:
        try:
            compiled.load(compiling=False)
        except compiled.NotCompiled as reason:
            why.append(f"it flew on compiled mechanics, and here they run on NumPy: {reason}")
            return False
    if recorded and recorded != wanted:
        why.append(f"it flew with mechanics on {recorded}, and this replay asks for {wanted}")
    return fast


def _reasons(versions: dict[str, str]) -> list[str]:
    """What is different here from where the record was made, as far as it can change bits."""
    from arm_companion.record.versions import versions as versions_here  # noqa: PLC0415 - reads the processor

    here = versions_here(Config())
    names = ("version", "python", "numpy", "numba", "machine", "processor")
    return [
        f"{name}: recorded with {versions[name]}, now {here.get(name, 'none')}"
        for name in names
        if name in versions and versions[name] != here.get(name)
    ]


def summary(outcome: Outcome) -> dict[str, Any]:
    """The outcome for `--json`."""
    return json.loads(orjson.dumps(outcome)) | {"identical": outcome.identical}  # type: ignore[no-any-return]
