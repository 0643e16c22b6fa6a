"""One picture of what was heard: bend, tendon tensions, predicted force and torque, and the states above them."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arm_companion.errors import ArmError
from arm_companion.ground.recording import Entry
from arm_companion.ground.reports import Status, Tendons, Wrench

_INK: Final = "#1f2933"
_COLOURS: Final = ("#c2410c", "#0f766e", "#1d4ed8", "#7e22ce")
_SHADES: Final = ("#f1f5f9", "#ffffff")


def draw(entries: Iterable[tuple[float, Entry]], path: Path, title: str = "") -> None:
    """Write a PNG.

    Args:
        entries: time received (Unix, s) and report, in order.
        path: of the PNG.
        title: above it.

    Raises:
        ArmError: there is nothing to draw.
    """
    heard = list(entries)
    statuses = [(t, e) for t, e in heard if isinstance(e, Status)]
    wrenches = [(t, e) for t, e in heard if isinstance(e, Wrench)]
    tendons = [(t, e) for t, e in heard if isinstance(e, Tendons)]
    if not (statuses or wrenches or tendons):
        raise ArmError("nothing to draw: no report of the arm in it")
    start = heard[0][0]
    style: Any = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": _INK}
    with mpl.rc_context(style):
        figure = Figure(figsize=(10, 8), layout="constrained")
        axes = figure.subplots(4, 1, sharex=True)
        _draw_states(axes, statuses, start)
        _draw_bend(axes[0], statuses, start)
        _draw_tensions(axes[1], tendons, start)
        for axis, of in ((axes[2], "force"), (axes[3], "torque")):
            _draw_vector(axis, wrenches, of, start)
        axes[-1].set_xlabel("time, s")
        figure.suptitle(title, fontsize=11, color=_INK)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, format="png")


def _draw_states(axes: Sequence[Axes], statuses: list[tuple[float, Status]], start: float) -> None:
    spans: list[list[Any]] = []
    for t, status in statuses:
        if not spans or spans[-1][0] != status.state:
            spans.append([status.state, t - start, t - start])
        spans[-1][2] = t - start
    for i, (name, begin, end) in enumerate(spans):
        until = spans[i + 1][1] if i + 1 < len(spans) else end
        for axis in axes:
            axis.axvspan(begin, until, color=_SHADES[i % 2], lw=0, zorder=0)
        above = axes[0].get_xaxis_transform()
        axes[0].text(begin, 1.02, name.lower(), transform=above, fontsize=7.5, color=_INK, rotation=30)
    for axis in axes:
        axis.margins(x=0)
        axis.grid(axis="y", color="#e5e7eb", lw=0.6)


def _legend(axis: Axes) -> None:
    """Beside the picture: within it no corner stays free of lines, and above it are the states."""
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, frameon=False)


def _draw_bend(axis: Axes, statuses: list[tuple[float, Status]], start: float) -> None:
    t = [t - start for t, _ in statuses]
    axis.plot(t, [math.degrees(s.theta) for _, s in statuses], color=_COLOURS[0], label="bend")
    axis.plot(t, [math.degrees(s.goal_theta) for _, s in statuses], color=_COLOURS[0], ls=":", label="asked")
    axis.set_ylabel("bend, deg")
    _legend(axis)


def _draw_tensions(axis: Axes, reports: list[tuple[float, Tendons]], start: float) -> None:
    by_tendon: dict[int, list[tuple[float, float]]] = {}
    for t, report in reports:
        for tendon in report.tendons:
            by_tendon.setdefault(tendon.index, []).append((t - start, tendon.tension))
    for index, points in sorted(by_tendon.items()):
        colour = _COLOURS[index % len(_COLOURS)]
        axis.plot([t for t, _ in points], [n for _, n in points], color=colour, label=f"tendon {index + 1}", lw=1)
    axis.set_ylabel("tension, N")
    if by_tendon:
        _legend(axis)


def _draw_vector(axis: Axes, wrenches: list[tuple[float, Wrench]], of: str, start: float) -> None:
    """Three components with one sigma; what may not be used is left out."""
    t = [t - start for t, _ in wrenches]
    for i, name in enumerate("xyz"):
        values = [getattr(w, of)[i] if of in w.validity else math.nan for _, w in wrenches]
        sigmas = [getattr(w, f"{of}_sigma")[i] for _, w in wrenches]
        axis.plot(t, values, color=_COLOURS[i], label=name, lw=1)
        lower = [v - s for v, s in zip(values, sigmas, strict=True)]
        upper = [v + s for v, s in zip(values, sigmas, strict=True)]
        axis.fill_between(t, lower, upper, color=_COLOURS[i], alpha=0.15, lw=0)
    axis.set_ylabel(f"{of}, {'N' if of == 'force' else 'N m'} (body)")
    if wrenches:
        _legend(axis)
