"""The paper's experiments as tables, CSV rows and JSON; names at this border carry their units."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from arm_companion.experiments.perching import Sample, Travel
from arm_companion.experiments.stiffness_test import Curve, Reading

_XYZ = ("x", "y", "z")
_SAME_MM = 5e-4  # what three decimals do not show


def side(inward: bool) -> str:
    """The paper's word for the direction of the load."""
    return "inward" if inward else "outward"


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Rows with the keys of the first as header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)


def _spread(name: str, unit: str, values: Sequence[float], places: Sequence[str] = _XYZ) -> dict[str, float]:
    return {f"{name}_{place}_{unit}": value for place, value in zip(places, values, strict=True)}


def _tendons(values: Sequence[float]) -> dict[str, float]:
    return _spread("tension", "n", values, [str(i + 1) for i in range(len(values))])


def stiffness_rows(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """One row for every reading."""
    return [
        {
            "theta_deg": r.bend_deg,
            "direction": side(r.inward),
            "cycle": r.cycle,
            "loading": int(r.loading),
            "force_n": r.force,
            "deflection_m": r.deflection,
            **_spread("d", "m", r.shift),
            "turn_deg": r.turn_deg,
            **_tendons(r.tension),
            **_spread("base_force", "n", r.base_force),
            **_spread("base_moment", "nm", r.base_moment),
            "residual": r.residual,
        }
        for c in curves
        for r in c.readings
    ]


def stiffness_json(curves: Sequence[Curve], findings: Sequence[str]) -> dict[str, Any]:
    """Everything, SI units."""
    return {
        "experiment": "stiffness-test",
        "curves": [
            {
                "theta_deg": c.bend_deg,
                "direction": side(c.inward),
                "initial_stiffness_n_per_m": _number(c.initial),
                "stiffness_n_per_m": _number(c.stiffness),
                "hysteresis_m": c.hysteresis,
                "refusal": c.refusal or None,
                "readings": [_reading(r) for r in c.readings],
            }
            for c in curves
        ],
        "findings": list(findings),
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def _reading(r: Reading) -> dict[str, Any]:
    return {
        "cycle": r.cycle,
        "loading": r.loading,
        "force_n": r.force,
        "deflection_m": r.deflection,
        "shift_m": list(r.shift),
        "turn_deg": r.turn_deg,
        "tension_n": list(r.tension),
        "base_force_n": list(r.base_force),
        "base_moment_nm": list(r.base_moment),
        "residual": r.residual,
    }


def stiffness_table(curves: Sequence[Curve], findings: Sequence[str]) -> str:
    """Deflection by load and bend, first loading and last unloading, and what follows."""
    lines: list[str] = []
    for inward in (True, False):
        part = [c for c in curves if c.inward is inward]
        lines.append(f"{side(inward)} radial loading: tip deflection in mm (loading / unloading of the last cycle)")
        lines.append(f"{'load, N':>10}" + "".join(f"{f'{c.bend_deg:g} deg':>18}" for c in part))
        forces = sorted({r.force for c in part for r in c.readings})
        lines += [f"{force:>10.4f}" + "".join(f"{_cell(c, force):>18}" for c in part) for force in forces]
        lines.append(f"{'N/m':>10}" + "".join(f"{c.stiffness:>18.3f}" for c in part))
        lines.append(f"{'initial':>10}" + "".join(f"{c.initial:>18.3f}" for c in part))
        lines.append("")
    return "\n".join([*lines, *findings])


def _cell(curve: Curve, force: float) -> str:
    last = max((r.cycle for r in curve.readings), default=1)
    up, down = (
        [1e3 * r.deflection for r in curve.readings if r.force == force and r.loading is loading and r.cycle == last]
        for loading in (True, False)
    )
    if up and down and abs(up[0] - down[0]) >= _SAME_MM:
        return f"{up[0]:.3f} / {down[0]:.3f}"
    both = up or down
    return f"{both[0]:.3f}" if both else "-"


def perching_rows(travels: Sequence[Travel]) -> list[dict[str, Any]]:
    """One row for every position of the carrier."""
    return [
        {
            "axis": s.axis,
            "time_s": s.time,
            "travel_m": s.travel,
            **_spread("force", "n", s.force),
            **_spread("torque", "nm", s.torque),
            **_spread("tip_force", "n", s.tip_force),
            **_spread("tip_moment", "nm", s.tip_moment),
            **_tendons(s.tension),
            "taut_margin_m": s.taut_margin,
            "residual": s.residual,
        }
        for t in travels
        for s in t.samples
    ]


def perching_json(travels: Sequence[Travel], findings: Sequence[str]) -> dict[str, Any]:
    """Everything, SI units."""
    return {
        "experiment": "perching",
        "travels": [
            {"axis": t.axis, "refusal": t.refusal or None, "samples": [_sample(s) for s in t.samples]} for t in travels
        ],
        "findings": list(findings),
    }


def _sample(s: Sample) -> dict[str, Any]:
    return {
        "time_s": s.time,
        "travel_m": s.travel,
        "base_force_n": list(s.force),
        "base_moment_nm": list(s.torque),
        "tip_force_n": list(s.tip_force),
        "tip_moment_nm": list(s.tip_moment),
        "tension_n": list(s.tension),
        "taut_margin_m": s.taut_margin,
        "residual": s.residual,
    }


def perching_table(travels: Sequence[Travel], findings: Sequence[str]) -> str:
    """Force and torque on the way out by millimetre of travel, and what follows."""
    lines: list[str] = []
    for t in travels:
        lines.append(f"motion along {t.axis}: on the carrier, base axes")
        names = ("travel, mm", "Fx, N", "Fy, N", "Fz, N", "Mx, N m", "My, N m", "Mz, N m", "slack, mm")
        lines.append("".join(f"{name:>11}" for name in names))
        turned = max(range(len(t.samples)), key=lambda i: abs(t.samples[i].travel), default=-1)
        for s in t.samples[: turned + 1]:
            if abs(1e3 * s.travel - round(1e3 * s.travel)) > 1e-6:
                continue
            numbers = [*s.force, *s.torque]
            lines.append(
                f"{1e3 * s.travel:>11.1f}"
                + "".join(f"{round(value, 4) + 0.0:>11.4f}" for value in numbers)
                + f"{1e3 * s.taut_margin:>11.3f}"
            )
        lines.append("")
    return "\n".join([*lines, *findings])
