"""The two experiments drawn as the paper lays them out, and a loading test beside its fit."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arm_companion.arm.identification import Fit, LoadingTest
from arm_companion.experiments.perching import Travel
from arm_companion.experiments.stiffness_test import Curve

_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.grid": True,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.6,
}
# The paper's straight arm is black.
_BENDS = ("#000000", "#1d4ed8", "#0f766e", "#b45309", "#7c3aed", "#be185d", "#4d7c0f")
_X, _Y, _Z = "#1d4ed8", "#0f766e", "#b45309"


def stiffness_test(curves: Sequence[Curve], path: Path) -> None:
    """Deflection against load: (a) inward radial loading, (b) outward, one colour for each bend."""
    with mpl.rc_context({**_STYLE, "axes.spines.right": False}):
        figure = Figure(figsize=(5.2, 7.2), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axis, inward, title in zip(panels, (True, False), ("(a) inward", "(b) outward"), strict=True):
            side = [c for c in curves if c.inward is inward]
            for colour, curve in zip(_BENDS * 9, side, strict=False):
                _loop(axis, curve, colour)
            axis.set_title(f"{title} radial loading", loc="left")
            axis.set_ylabel("tip deflection, mm")
        panels[0].legend(title="bend", fontsize=8, frameon=False)
        panels[1].set_xlabel("load, N   (solid: loading, dotted: unloading)")
        _save(figure, path)


def _loop(axis: Axes, curve: Curve, colour: str) -> None:
    label: str | None = f"{curve.bend_deg:g} deg"
    cycles = {r.cycle for r in curve.readings}
    for cycle in sorted(cycles):
        for loading, line in ((True, "-"), (False, ":")):
            part = [r for r in curve.readings if r.cycle == cycle and r.loading is loading]
            if not part:
                continue
            force, deflection = [r.force for r in part], [1e3 * r.deflection for r in part]
            axis.plot(force, deflection, line, color=colour, lw=1.1, marker="o", ms=2.5, label=label)
            label = None


def perching(travels: Sequence[Travel], path: Path) -> None:
    """Reaction force and torque against time, one column for each travel, the travel dashed in red on the right."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(5.2 * len(travels), 6.2), layout="constrained")
        panels = figure.subplots(2, len(travels), sharex="col", squeeze=False)
        for column, (travel, letter) in enumerate(zip(travels, "abcdefgh", strict=False)):
            upper, lower = panels[:, column]
            upper.set_title(f"({letter}) motion in the {travel.axis} direction", loc="left")
            _components(upper, travel, [s.force for s in travel.samples], "F")
            _components(lower, travel, [s.torque for s in travel.samples], "M")
            upper.set_ylabel("force on the carrier, N")
            lower.set_ylabel("torque on the carrier, N m")
            lower.set_xlabel("time, s")
        _save(figure, path)


def _components(axis: Axes, travel: Travel, values: Sequence[tuple[float, ...]], letter: str) -> None:
    time = [s.time for s in travel.samples]
    for i, (name, colour) in enumerate((("x", _X), ("y", _Y), ("z", _Z))):
        axis.plot(time, [v[i] for v in values], color=colour, lw=1.4, label=f"{letter}{name}")
    axis.legend(fontsize=8, frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    right = axis.twinx()
    right.plot(time, [1e3 * s.travel for s in travel.samples], "--", color="#dc2626", lw=1.2)
    right.set_ylabel("travel, mm", color="#dc2626")
    right.tick_params(axis="y", colors="#dc2626")
    right.grid(visible=False)


def calibration(test: LoadingTest, fit: Fit, path: Path) -> None:
    """Measured against fitted for every kind of measurement, and what is left over."""
    channels = [name for name in fit.scatter if any(n == name for n in fit.channels)]
    with mpl.rc_context({**_STYLE, "axes.spines.right": False}):
        figure = Figure(figsize=(4.6 * len(channels), 6.2), layout="constrained")
        panels = figure.subplots(2, len(channels), squeeze=False)
        names = np.array(fit.channels)
        for column, channel in enumerate(channels):
            here = names == channel
            measured, predicted = fit.measured[here], fit.predicted[here]
            unit, scale = ("N", 1.0) if channel == "tension" else ("mm", 1e3)
            upper, lower = panels[:, column]
            ends = scale * np.array((measured.min(), measured.max()))
            upper.plot(ends, ends, color="#9aa5b1", lw=0.8)
            upper.plot(scale * predicted, scale * measured, "o", color=_X, ms=3)
            upper.set_title(f"{channel}: {len(measured)} values of {len(test.readings)} readings", loc="left")
            upper.set_xlabel(f"fitted, {unit}")
            upper.set_ylabel(f"measured, {unit}")
            lower.axhline(0.0, color="#9aa5b1", lw=0.8)
            lower.axhspan(-2 * scale * fit.scatter[channel], 2 * scale * fit.scatter[channel], color="#e0e7ff", lw=0)
            lower.plot(np.array(fit.rows)[here], scale * (measured - predicted), "o", color=_Z, ms=3)
            lower.set_xlabel("reading")
            lower.set_ylabel(f"measured less fitted, {unit}\n(band: two sigma)")
        _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=140)
