"""One picture of a flight: where it went, what the tendons did, what the arm put on the airframe."""

import math
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arm_companion.config.schema import Config
from arm_companion.sim.flight import Flight

_INK = "#1f2933"
_X, _Y, _Z = "#c2410c", "#0f766e", "#1d4ed8"
_TRUTH = "#9aa5b1"
_SHADES = ("#f1f5f9", "#ffffff")
_PERCHED = "#fef3c7"


def draw(flight: Flight, config: Config, title: str, path: Path) -> None:
    """Write the figure as PNG."""
    style: Any = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": _INK}
    with mpl.rc_context(style):
        figure = Figure(figsize=(11, 9.5), layout="constrained")
        axes = figure.subplots(5, 1, sharex=True, height_ratios=[1.3, 1.2, 1.0, 1.3, 1.3])
        start = flight.samples[0].t if flight.samples else 0.0  # as in the verdict's reasons and the list of events
        for axis in axes:
            _shade(axis, flight, start)
        _name_states(axes[0], flight, start)
        _draw_position(axes[0], flight, config, start)
        if config.sim.object.mass_kg:
            _draw_load(axes[1], flight, config, start)
        elif flight.places:
            _draw_tip(axes[1], flight, start)
        else:
            _draw_moves(axes[1], flight, start)
        _draw_tendons(axes[2], flight, config, start)
        _draw_force(axes[3], flight, start)
        _draw_contact(axes[4], flight, start)
        axes[-1].set_xlabel("time, s")
        figure.suptitle(title, fontsize=12, fontweight="bold", color=_INK)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)


def _shade(axis: Axes, flight: Flight, start: float) -> None:
    for i, (name, a, b) in enumerate(flight.spans()):
        axis.axvspan(
            a - start, b - start, color=_PERCHED if name in ("PERCHED", "HANGING") else _SHADES[i % 2], lw=0, zorder=0
        )
    axis.margins(x=0)
    axis.grid(axis="y", color="#e5e7eb", lw=0.6)


def _name_states(axis: Axes, flight: Flight, start: float) -> None:
    total = max(flight.end - start, 1e-9)
    last = -1.0
    for name, a, b in flight.spans():
        middle = (0.5 * (a + b) - start) / total
        if b - a < 0.012 * total or middle - last < 0.012:
            continue
        last = middle
        axis.text(middle, 1.02, name.lower(), rotation=38, fontsize=7.5, color=_INK, transform=axis.transAxes)


def _draw_position(axis: Axes, flight: Flight, config: Config, start: float) -> None:
    t = [s.t - start for s in flight.samples]
    x, _, z = config.sim.object.position_m if config.sim.object.mass_kg else config.sim.bar.position_m
    for i, (name, colour) in enumerate((("north", _X), ("east", _Y), ("up", _Z))):
        sign = -1.0 if name == "up" else 1.0
        axis.plot(t, [sign * s.state.position_w[i] for s in flight.samples], color=colour, lw=1.2, label=name)
    axis.axhline(x, color=_X, lw=0.8, ls=":")
    axis.axhline(-z, color=_Z, lw=0.8, ls=":")
    axis.set_ylabel("vehicle, m\n(dotted: bar or object)")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def _draw_moves(axis: Axes, flight: Flight, start: float) -> None:
    axis.set_ylabel("move while\nheld, mm")
    perched = [(a, b) for name, a, b in flight.spans() if name in ("PERCHED", "HANGING")]
    if not perched:
        axis.text(0.5, 0.5, "never perched", transform=axis.transAxes, ha="center", color=_INK)
        return
    # from where it hovers before it is asked to move; in a scenario that asks for no moves, from where it is on average
    hold = next(((mark.start, mark.end) for mark in flight.marks if mark.name in ("hold", "hang")), perched[0])
    held = flight.within(*hold)
    origin = [sum(s.state.position_w[i] for s in held) / max(len(held), 1) for i in range(3)]
    samples = flight.within(perched[0][0], perched[-1][1])
    t = [s.t - start for s in samples]
    for i, (name, colour) in enumerate((("north", _X), ("east", _Y), ("down", _Z))):
        axis.plot(t, [1e3 * (s.state.position_w[i] - origin[i]) for s in samples], color=colour, lw=1.0, label=name)
    for mark in flight.marks:
        for asked, colour in zip(mark.asked_w, (_X, _Y, _Z), strict=True):
            if asked:
                axis.plot([mark.start - start, mark.end - start], [1e3 * asked] * 2, color=colour, lw=3, alpha=0.35)
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def _draw_tip(axis: Axes, flight: Flight, start: float) -> None:
    """How far the tip is from the point at which it is to be kept."""
    for place in flight.places:
        samples = flight.within(place.start, place.end)
        off = [1e3 * math.dist(s.truth.tip_position_w, place.asked_w) for s in samples]
        axis.plot([s.t - start for s in samples], off, color=_INK, lw=1.0)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("tip off its\npoint, mm")


def _draw_load(axis: Axes, flight: Flight, config: Config, start: float) -> None:
    """Height of the object, and what it is said to weigh."""
    seen = [(s.t - start, s.truth.object_position_w) for s in flight.samples if s.truth.object_position_w is not None]
    if seen:
        axis.plot([t for t, _ in seen], [1e3 * (seen[0][1][2] - p[2]) for _, p in seen], color=_INK, lw=1.0)
    axis.set_ylabel("object over its\ncradles, mm")
    right = axis.twinx()
    right.axhline(1e3 * config.sim.object.mass_kg, color=_X, lw=0.8, ls=":")
    valid = [p for p in flight.payloads if p.valid]
    right.errorbar(
        [p.t - start for p in valid],
        [1e3 * p.mass for p in valid],
        [1e3 * p.sigma for p in valid],
        fmt=".",
        color=_X,
        ms=3.0,
        lw=0.6,
    )
    right.set_ylabel("weighed, g\n(dotted: true)", color=_X)
    right.spines["right"].set_visible(True)


def _draw_tendons(axis: Axes, flight: Flight, config: Config, start: float) -> None:
    t = [s.t - start for s in flight.samples]
    for i, angle in enumerate(config.arm.tendons.angles_deg):
        colour = (_X, _Y, _Z, "#7c3aed")[i % 4]
        axis.plot(
            t,
            [s.truth.tension[i] for s in flight.samples],
            color=colour,
            lw=1.0,
            label=f"{i + 1} at {angle:g}°",
        )
        axis.plot(
            [seen.t - start for seen in flight.tendons],
            [seen.tension[i] for seen in flight.tendons],
            color=colour,
            lw=0.5,
            alpha=0.5,
        )
    axis.set_ylabel("tendon tension, N\n(thin: estimated)")
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.0, ncols=4, fontsize=8, frameon=False)


def _draw_force(axis: Axes, flight: Flight, start: float) -> None:
    t = [s.t - start for s in flight.samples]
    for i, (name, colour) in enumerate((("x", _X), ("y", _Y), ("z", _Z))):
        axis.plot(t, [s.truth.force_b[i] for s in flight.samples], color=colour, lw=0.7, alpha=0.45)
        seen = [w for w in flight.wrenches if w.valid]
        axis.plot(
            [w.t - start for w in seen],
            [w.force_b[i] for w in seen],
            ".",
            color=colour,
            ms=2.5,
            label=f"{name} predicted",
        )
    axis.set_ylabel("force on the airframe, N\n(line: true, dots: predicted)")
    axis.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.0,
        ncols=3,
        fontsize=8,
        markerscale=3,
        frameon=False,
    )


def _draw_contact(axis: Axes, flight: Flight, start: float) -> None:
    t = [s.t - start for s in flight.samples]
    axis.plot(t, [s.truth.contact_force_n for s in flight.samples], color=_INK, lw=0.9)
    axis.set_ylabel("contact force, N")
    axis.set_ylim(bottom=0.0, top=max(1.0, axis.get_ylim()[1]))  # none at all is a line at zero
    right = axis.twinx()
    right.plot(t, [s.truth.wrap_angle for s in flight.samples], color=_X, lw=0.9)
    right.set_ylabel("wrap angle, rad", color=_X)
    right.margins(x=0)  # it shares the time, which has none
    right.set_ylim(bottom=0.0, top=max(1.0, right.get_ylim()[1]))
    right.spines["right"].set_visible(True)
