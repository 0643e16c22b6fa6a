"""Reports to a file and back: JSON lines, or CSV for spreadsheets."""

import csv
import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, TextIO, TypeAlias

from arm_companion.errors import ProtocolError
from arm_companion.ground.reports import REPORTS, Payload, Report, Status, Tendon, Tendons, Wrench, as_json
from arm_companion.ground.texts import Text

Entry: TypeAlias = Report | Text

FORMATS: Final = ("jsonl", "csv")
_AXES: Final = ("x", "y", "z")
_VECTORS: Final = frozenset({"tip_position", "force", "torque", "force_sigma", "torque_sigma"}) | frozenset(
    {"centre_of_mass", "centre_of_mass_sigma"}
)
_TEXT: Final = "STATUSTEXT"


def format_of(path: Path) -> str:
    """csv for *.csv, else jsonl."""
    return "csv" if path.suffix.lower() == ".csv" else "jsonl"


class Recording:
    """Writes reports as they come, a whole line at a time.

    A JSON line has `received` (Unix time, s), `message`, and the report's fields; what is not known is null. CSV has
    the same fields as columns: vectors as _x, _y, _z, and one row for each tendon; what does not apply is empty.

    Args:
        stream: open for writing; CSV wants newline="".
        form: jsonl or csv.
    """

    def __init__(self, stream: TextIO, form: str) -> None:
        self.written = 0
        self._stream = stream
        self._csv: Any = None
        if form == "csv":
            self._csv = csv.DictWriter(stream, _columns(), restval="", lineterminator="\n")
            self._csv.writeheader()

    def put(self, received: float, entry: Entry) -> None:
        """Write one report.

        Raises:
            OSError: the disk is full, or the reader of a pipe is gone.
        """
        line = {"received": round(received, 6), **_as_json(entry)}
        if self._csv is None:
            self._stream.write(json.dumps(line) + "\n")
        else:
            self._csv.writerows(_rows(line))
        self._stream.flush()
        self.written += 1


def read_jsonl(stream: TextIO) -> Iterator[tuple[float, Entry]]:
    """What a `Recording` has written as JSON lines: time received (Unix, s) and report.

    A last line without its end, as after a power cut, is left out.

    Raises:
        ProtocolError: with the number of a line that is none of ours.
    """
    for number, line in enumerate(stream, 1):
        if not line.endswith("\n"):
            return
        try:
            fields = json.loads(line)
            received = float(fields.pop("received"))
            entry = _from_json(fields)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"line {number} is not one of a record: {error}") from None
        yield received, entry


def _as_json(entry: Entry) -> dict[str, Any]:
    return {"message": _TEXT, **dataclasses.asdict(entry)} if isinstance(entry, Text) else as_json(entry)


def _from_json(fields: dict[str, Any]) -> Entry:
    name = fields.pop("message")
    if name == _TEXT:
        return Text(**fields)
    if name == Tendons.MESSAGE:
        return Tendons(_number(fields["time"]), tuple(Tendon(**_known(t)) for t in fields["tendons"]))
    if name not in REPORTS:
        raise ValueError(f"unknown message {name!r}")
    if name == Status.MESSAGE:
        progress = fields.pop("progress")
        return Status(**_known(fields), progress=progress)
    return Payload(**_known(fields)) if name == Payload.MESSAGE else Wrench(**_known(fields))


def _known(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: _value(value) for name, value in fields.items()}


def _value(value: Any) -> Any:
    return tuple(_value(entry) for entry in value) if isinstance(value, list) else _number(value)


def _number(value: Any) -> Any:
    return math.nan if value is None else value


def _columns() -> list[str]:
    columns = ["received", "message", "time"]
    for kind in (Status, Wrench, Tendon, Text, Payload):
        for field in dataclasses.fields(kind):
            names = [f"{field.name}_{axis}" for axis in _AXES] if field.name in _VECTORS else [field.name]
            columns += [name for name in names if name not in columns]
    return columns


def _rows(line: dict[str, Any]) -> Iterator[dict[str, Any]]:
    tendons = line.pop("tendons", None)
    if tendons is not None:
        yield from ({**line, **{k: _cell(v) for k, v in tendon.items()}} for tendon in tendons)
        return
    row: dict[str, Any] = {}
    for name, value in line.items():
        if name in _VECTORS:
            row.update({f"{name}_{axis}": _cell(v) for axis, v in zip(_AXES, value, strict=True)})
        else:
            row[name] = _cell(value)
    yield row


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, list):
        return " ".join(str(entry) for entry in value)
    return int(value) if isinstance(value, bool) else value
