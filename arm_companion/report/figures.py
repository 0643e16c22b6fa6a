"""The report's pictures: small enough to be read on a phone, one question each."""

import io
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arm_companion.geometry.arrays import Array
from arm_companion.report.flight import RecordedFlight

_INK: Final = "#1f2933"
_COLOURS: Final = ("#c2410c", "#0f766e", "#1d4ed8", "#7e22ce", "#a16207", "#be185d")
_SHADES: Final = ("#f1f5f9", "#ffffff")
_PERCHED: Final = "#fef3c7"
_STYLE: Final[Any] = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
}


class Picture(NamedTuple):
    """A PNG with what it shows."""

    name: str
    title: str
    caption: str
    png: bytes


def pictures(flight: RecordedFlight) -> list[Picture]:
    """All pictures that the record has data for."""
    truth = "; thin: the simulator's truth" if flight.truth else ""
    plans: list[tuple[str, str, str, Callable[[Axes, RecordedFlight], None], bool]] = [
        ("force", "Force of the arm on the airframe", f"Predicted, with one sigma{truth}. Body axes.", _force, True),
        ("torque", "Torque of the arm on the airframe", f"Predicted, with one sigma{truth}. Body axes.", _torque, True),
        (
            "tensions",
            "Tendon tensions",
            f"By load and statics; pale: by load alone{'; dotted: the truth' if flight.truth else ''}.",
            _tensions,
            flight.tension.shape[1] > 0,
        ),
        ("position", "Vehicle", "Where it was; dotted: where it was asked to be. World axes.", _position, True),
        ("error", "Vehicle off its set-point", "While set-points were sent.", _error, True),
        (
            "temperature",
            "Servo temperatures",
            "As the servos report them.",
            _temperature,
            flight.temperature.shape[1] > 0,
        ),
        ("links", "Age of the newest message", "Each line is one source; higher is worse.", _links, True),
        (
            "servos",
            "Servo bus",
            "Age of each servo's newest answer, and the voltage.",
            _servos,
            flight.voltage.shape[1] > 0,
        ),
    ]
    return [Picture(name, title, caption, _draw(flight, plan)) for name, title, caption, plan, there in plans if there]


def _draw(flight: RecordedFlight, plan: Callable[[Axes, RecordedFlight], None]) -> bytes:
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axis = figure.subplots()
        for i, span in enumerate(flight.spans):
            colour = _PERCHED if span.name in ("PERCHED", "HANGING") else _SHADES[i % 2]
            axis.axvspan(span.begin, span.end, color=colour, lw=0, zorder=0)
        axis.grid(axis="y", color="#e5e7eb", lw=0.6)
        axis.set_xlabel("time, s")
        plan(axis, flight)
        axis.set_xlim(0.0, max(flight.seconds, 1e-3))
        stream = io.BytesIO()
        figure.savefig(stream, dpi=140, format="png")
        return stream.getvalue()


def _legend(axis: Axes) -> None:
    """Above the picture: within it no corner stays free of lines."""
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, borderaxespad=0.2)


def _vector(axis: Axes, flight: RecordedFlight, value: Array, sigma: Array, true: str) -> None:
    for i, name in enumerate("xyz"):
        if flight.truth:
            axis.plot(flight.truth["t"], flight.truth[true][:, i], color=_COLOURS[i], lw=0.5, alpha=0.6)
        axis.fill_between(
            flight.t, value[:, i] - sigma[:, i], value[:, i] + sigma[:, i], color=_COLOURS[i], alpha=0.2, lw=0
        )
        axis.plot(flight.t, value[:, i], color=_COLOURS[i], lw=1.2, label=name)
    finite = value[np.isfinite(value)]
    if finite.size:  # a band that is wide for a moment must not squeeze all the rest
        low, high = float(finite.min()), float(finite.max())
        margin = 0.35 * max(high - low, 1e-3)
        axis.set_ylim(low - margin, high + margin)
    _legend(axis)


def _force(axis: Axes, flight: RecordedFlight) -> None:
    _vector(axis, flight, flight.force_b, flight.force_sigma, "force_b")
    axis.set_ylabel("force, N")


def _torque(axis: Axes, flight: RecordedFlight) -> None:
    _vector(axis, flight, flight.torque_b, flight.torque_sigma, "torque_b")
    axis.set_ylabel("torque, N m")


def _tensions(axis: Axes, flight: RecordedFlight) -> None:
    for i in range(flight.tension.shape[1]):
        colour = _COLOURS[i % len(_COLOURS)]
        axis.plot(flight.t, flight.tension[:, i], color=colour, lw=0.6, alpha=0.35)
        axis.plot(flight.t, flight.tension_best[:, i], color=colour, lw=1.2, label=f"tendon {i + 1}")
        if flight.truth:
            axis.plot(flight.truth["t"], flight.truth["tension"][:, i], color=colour, lw=1.0, ls=":")
    axis.set_ylabel("tension, N")
    _legend(axis)


def _position(axis: Axes, flight: RecordedFlight) -> None:
    for i, (name, sign) in enumerate((("north", 1.0), ("east", 1.0), ("up", -1.0))):
        axis.plot(flight.t, sign * flight.position_w[:, i], color=_COLOURS[i], lw=1.2, label=name)
        axis.plot(flight.t, sign * flight.setpoint_w[:, i], color=_COLOURS[i], lw=1.0, ls=":")
    axis.set_ylabel("position, m")
    _legend(axis)


def _error(axis: Axes, flight: RecordedFlight) -> None:
    error = np.linalg.norm(flight.setpoint_w - flight.position_w, axis=1)
    axis.plot(flight.t, 1e3 * error, color=_COLOURS[0], lw=1.2)
    finite = error[np.isfinite(error)]
    if finite.size:
        axis.set_ylim(0.0, 1.1e3 * max(float(np.percentile(finite, 99.0)), 1e-3))
    axis.set_ylabel("distance, mm")


def _temperature(axis: Axes, flight: RecordedFlight) -> None:
    for i in range(flight.temperature.shape[1]):
        axis.plot(flight.t, flight.temperature[:, i], color=_COLOURS[i % len(_COLOURS)], label=f"servo {i + 1}")
    axis.set_ylabel("temperature, °C")
    _legend(axis)


def _links(axis: Axes, flight: RecordedFlight) -> None:
    for i, (name, age) in enumerate(flight.ages.items()):
        axis.plot(
            flight.t, np.where(np.isfinite(age), np.maximum(age, 1e-4), np.nan), color=_COLOURS[i], lw=1.0, label=name
        )
    axis.set_yscale("log")
    axis.set_ylabel("age, s")
    _legend(axis)


def _servos(axis: Axes, flight: RecordedFlight) -> None:
    for i in range(flight.servo_age.shape[1]):
        age = flight.servo_age[:, i]
        axis.plot(
            flight.t,
            1e3 * np.where(np.isfinite(age), age, np.nan),
            color=_COLOURS[i % len(_COLOURS)],
            lw=0.8,
            label=f"servo {i + 1}",
        )
    axis.set_ylabel("age, ms")
    _legend(axis)
    right = axis.twinx()
    right.plot(flight.t, np.fmin.reduce(flight.voltage, axis=1), color=_INK, lw=1.0, ls="--")
    right.set_ylabel("lowest voltage, V (dashed)")
    right.spines["right"].set_visible(True)
