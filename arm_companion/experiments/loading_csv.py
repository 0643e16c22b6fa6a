"""A measured loading test as CSV text: read strictly, refused with the line that is wrong.

One row is one reading, in the order of time. Columns, in any order; an empty cell was not measured or not applied:

    run                          readings of one run stand together; its first one is before the load
    theta_deg, delta_deg         commanded bend of the unloaded arm, or instead of them
    pull_1_m, pull_2_m, ...      tendon goals, one for each tendon
    force_x_n, _y_n, _z_n        dead force on the tip, base axes
    follower_x_n, _y_n, _z_n     force that turns with the end disk, its axes (the paper's pulley: x, inward positive)
    x_m, y_m, z_m                measured tip position, base axes
    dx_m, dy_m, dz_m             measured displacement of the tip since the run's first reading, base axes
    tension_1_n, ...             measured tendon tension

Base axes: z from base to tip of the straight arm, x through tendon 1 of the paper's numbering.
"""

import csv
import io
import math

import numpy as np

from arm_companion.arm.identification import Reading
from arm_companion.arm.model import ArmModel
from arm_companion.errors import ArmError
from arm_companion.experiments.case import bend
from arm_companion.geometry.arrays import Array

_XYZ = ("x", "y", "z")
_PUSHES = -1.0  # N
_LOADED = 200.0  # times EI / L^2, the load that bends an arm by about a radian
_TORN = 1000.0  # N
_REACH = 1.2  # times the length; farther away no tip can be, so the unit must be another


class DataError(ArmError):
    """A measurement file is unusable; the message says at which line and why."""

    def __init__(self, line: int, reason: str) -> None:
        self.line = line
        super().__init__(f"line {line}: {reason}")


def parse(text: str, model: ArmModel) -> tuple[Reading, ...]:
    """The readings.

    Args:
        text: of the whole file.
        model: of the arm as configured; its goals are those that were commanded where the file has bends.

    Raises:
        DataError: for the first line that cannot be used.
    """
    n = model.parameters.n
    reader = csv.reader(io.StringIO(text), strict=True)
    try:
        lines = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise DataError(reader.line_num, str(error)) from None
    if not lines:
        raise DataError(1, "the file is empty")
    header = [name.strip() for name in lines[0][1]]
    by_bend = _check_header(header, n)
    readings: list[Reading] = []
    closed: set[str] = set()
    for line, cells in lines[1:]:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise DataError(line, f"{len(cells)} cells under {len(header)} columns")
        row = _Row(line, {name: cell.strip() for name, cell in zip(header, cells, strict=True)})
        run = row.cells["run"]
        if not run:
            raise DataError(line, "run has no name")
        if readings and readings[-1].run != run:
            closed.add(readings[-1].run)
        if run in closed:
            raise DataError(line, f"run {run!r} goes on after another began")
        readings.append(_reading(row, run, model, by_bend=by_bend))
    if not readings:
        raise DataError(lines[-1][0], "no readings under the header")
    return tuple(readings)


def _check_header(header: list[str], n: int) -> bool:
    """Whether bends were commanded, else goals."""
    pulls = [f"pull_{i}_m" for i in range(1, n + 1)]
    known = {"run", "theta_deg", "delta_deg", *pulls, *(f"tension_{i}_n" for i in range(1, n + 1))}
    for axis in _XYZ:
        known |= {f"force_{axis}_n", f"follower_{axis}_n", f"{axis}_m", f"d{axis}_m"}
    for name in header:
        if name not in known:
            raise DataError(1, f"unknown column {name!r} for an arm of {n} tendons (known: {', '.join(sorted(known))})")
        if header.count(name) > 1:
            raise DataError(1, f"column {name!r} stands there twice")
    if "run" not in header:
        raise DataError(1, "column 'run' is missing")
    by_bend = "theta_deg" in header
    given = [name for name in pulls if name in header]
    if by_bend and given:
        raise DataError(1, "theta_deg and pull_..._m are both there: one command is enough")
    if not by_bend and given != pulls:
        raise DataError(1, f"neither theta_deg nor all of {', '.join(pulls)} are there")
    if not any(name.startswith("tension") or name.lstrip("d") in ("x_m", "y_m", "z_m") for name in header):
        raise DataError(1, "nothing is measured: no x_m, dx_m, ..., or tension_1_n, ... column")
    return by_bend


class _Row:
    """Cells of one line by column."""

    def __init__(self, line: int, cells: dict[str, str]) -> None:
        self.line, self.cells = line, cells

    def number(self, name: str, absent: float) -> float:
        """A finite number, or `absent` for an empty cell or a missing column."""
        text = self.cells.get(name, "")
        if not text:
            return absent
        try:
            value = float(text)
        except ValueError:
            raise DataError(self.line, f"{name} = {text!r} is no number") from None
        if not math.isfinite(value):
            raise DataError(self.line, f"{name} = {text} is not finite")
        return value

    def required(self, name: str) -> float:
        """A finite number that must be there."""
        value = self.number(name, math.nan)
        if math.isnan(value):
            raise DataError(self.line, f"{name} is empty")
        return value

    def vector(self, pattern: str, absent: float) -> Array:
        """Three components, x, y and z for the star."""
        return np.array([self.number(pattern.replace("*", axis), absent) for axis in _XYZ])


def _reading(row: _Row, run: str, model: ArmModel, *, by_bend: bool) -> Reading:
    parameters = model.parameters
    tendons = range(1, parameters.n + 1)
    if by_bend:
        pull = model.pull_for_bend(bend(row.required("theta_deg"), row.number("delta_deg", 0.0)))
    else:
        pull = np.array([row.required(f"pull_{i}_m") for i in tendons])
    position, shift = row.vector("*_m", math.nan), row.vector("d*_m", math.nan)
    for values, reach in ((position, parameters.L), (shift, 2 * parameters.L)):
        farthest = float(np.nanmax(np.abs(values), initial=0.0))
        if farthest > _REACH * reach:
            raise DataError(row.line, f"a tip {farthest:g} m away is beyond an arm of {parameters.L:g} m: metres?")
    dead, follower = row.vector("force_*_n", 0.0), row.vector("follower_*_n", 0.0)
    largest = float(np.abs((dead, follower)).max())
    if largest > _LOADED * parameters.EI / parameters.L**2:
        raise DataError(row.line, f"a load of {largest:g} N would crush this arm: newtons?")
    tension = np.array([row.number(f"tension_{i}_n", math.nan) for i in tendons])
    if float(np.nanmin(tension, initial=0.0)) < _PUSHES:
        raise DataError(row.line, "a tendon cannot push: its tension is negative by more than noise")
    if (highest := float(np.nanmax(tension, initial=0.0))) > _TORN:
        raise DataError(row.line, f"a tension of {highest:g} N would tear any tendon: newtons?")
    return Reading(run, pull, dead, follower, position, shift, tension)
