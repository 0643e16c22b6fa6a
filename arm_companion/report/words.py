"""The verdict of a flight in words, from what the daemon knew; in the simulator from the truth as well."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from arm_companion.geometry.arrays import Array
from arm_companion.report.flight import RecordedFlight

_HOT_DEGC: Final = 65.0
_NEAR: Final = 0.9
_LOST: Final = "load lost"
_AT_REST: Final = frozenset({"STARTUP", "STOWED", "READY"})
_TOUCHING: Final = frozenset(
    {"CONTACT", "WRAP", "CLOSE", "VERIFY", "PERCHED", "LIFT", "CARRY", "PLACE", "UNLOAD", "RELEASE"}
    | {"LOAD_TRANSFER", "HANGING", "TAKE_BACK"}
)


@dataclass(frozen=True, slots=True)
class Verdict:
    """How it went.

    Attributes:
        grade: "good", "look" (something to look at) or "bad".
        headline: one sentence.
        points: what stands behind it.
    """

    grade: str
    headline: str
    points: tuple[str, ...]


def judge(flight: RecordedFlight) -> Verdict:
    """The verdict."""
    bad = [f"{said.text} ({said.t:.1f} s)" for said in flight.said if said.level in {"critical", "error"}]
    if flight.failed:
        count = len(flight.failed)
        first, text = flight.failed[0]
        which = (
            f"a cycle failed at {first:.1f} s" if count == 1 else f"{count} cycles failed, the first at {first:.1f} s"
        )
        bad.append(f"{which}: {text}")
    if flight.spans and flight.spans[-1].name not in _AT_REST:
        bad.append(f"the record ends in state {flight.spans[-1].name}")
    look = [f"{said.text} ({said.t:.1f} s)" for said in flight.said if said.level == "warning"]
    if flight.faults:
        look.append(f"error bits in flight: {', '.join(flight.faults)}")
    if flight.missing:
        look.append(f"{flight.missing} of {flight.cycles + flight.missing} cycles are missing in the record")
    look += flight.remarks
    look += _limits(flight)
    grade = "bad" if bad else "look" if look else "good"
    return Verdict(grade, _headline(flight), (*dict.fromkeys([*bad, *look]), *_figures(flight)))


def _headline(flight: RecordedFlight) -> str:
    for name, did in (("HANGING", "Hung"), ("PERCHED", "Perched"), ("CARRY", "Carried an object")):
        held = [span.end - span.begin for span in flight.spans if span.name == name]
        if held:
            after = [span.name for span in flight.spans[_last(flight, name) + 1 :]]
            times = "once" if len(held) == 1 else f"{len(held)} times"
            return f"{did} {times}, {sum(held):.0f} s in all, {_end(name, flight, after)}."
    tried = [span for span in flight.spans if span.name == "APPROACH"]
    if not tried:
        return "No perch or grasp was ordered."
    last = next((span for span in reversed(flight.spans) if span.name in {"UNLOAD", "DEPART", "HOLDING"}), None)
    did = "grasp" if any(span.name == "CLOSE" for span in flight.spans) else "perch"
    return f"Did not {did}: {last.cause}." if last else f"Did not {did}."


def _end(name: str, flight: RecordedFlight, after: list[str]) -> str:
    if name == "CARRY" and any(span.cause.startswith(_LOST) for span in flight.spans):
        return "and lost it"
    # where the vehicle is not ours the arm opens and is stowed
    return "and let go" if {"DEPART", "STOWING"} & set(after) else "and did not let go in this record"


def _last(flight: RecordedFlight, name: str) -> int:
    return max(i for i, span in enumerate(flight.spans) if span.name == name)


def _limits(flight: RecordedFlight) -> list[str]:
    found = []
    most = flight.most
    if most.temperature > _HOT_DEGC:
        found.append(f"a servo reached {most.temperature:.0f} °C")
    if flight.config is not None:
        wanted = flight.config.rates.cycle_hz
        rate = (flight.cycles + flight.missing) / max(flight.seconds, 1e-9)
        if flight.seconds > 1.0 and rate < _NEAR * wanted:
            found.append(f"the daemon ran {rate:.0f} cycles a second, {wanted:g} are configured: too slow a machine")
        limit = flight.config.limits
        if most.tension.value > _NEAR * limit.tension_max_n:
            found.append(f"a tendon reached {most.tension.text(1, 'N')}; the limit is {limit.tension_max_n:g} N")
        if most.force.value > _NEAR * limit.wrench_force_n:
            found.append(
                f"the predicted force reached {most.force.text(1, 'N')}; the limit is {limit.wrench_force_n:g} N"
            )
    return found


def _figures(flight: RecordedFlight) -> list[str]:
    """Numbers that every flight has."""
    flying = _where(flight, {span.name for span in flight.spans} - _AT_REST)
    error = np.linalg.norm(flight.setpoint_w - flight.position_w, axis=1)[flying]
    most = flight.most
    figures = [f"greatest tendon tension {most.tension.text(1, 'N')}, by load alone"]
    if math.isfinite(most.temperature):
        figures.append(f"hottest servo {most.temperature:.0f} °C, lowest voltage {most.voltage:.1f} V")
    figures += [
        f"greatest predicted force on the airframe {most.force.text(1, 'N')}",
        f"greatest predicted torque {most.torque.text(2, 'N m')}",
    ]
    if np.isfinite(error).any():
        figures.append(f"vehicle off its set-point by {1e3 * float(np.nanmedian(error)):.0f} mm (median)")
    if flight.truth:
        for name, states in (("free", {"READY", "APPROACH", "DEPART"}), ("in contact", set(_TOUCHING))):
            off = force_error(flight)[_where(flight, states)]
            off = off[np.isfinite(off)]
            if len(off):
                rms = math.sqrt(float(np.mean(off**2)))
                figures.append(f"predicted force against the simulator's truth, {name}: {rms:.2f} N RMS off")
    return figures


def force_error(flight: RecordedFlight) -> Array:
    """Distance of predicted and true force at each `t` (k,), N; nan where one is not known."""
    t, force = flight.truth["t"], flight.truth["force_b"]
    unknown = {"left": math.nan, "right": math.nan}
    true = np.column_stack([np.interp(flight.t, t, force[:, i], **unknown) for i in range(3)])
    error: Array = np.linalg.norm(flight.force_b - true, axis=1)
    return error


def _where(flight: RecordedFlight, names: set[str]) -> Array:
    inside = np.zeros(len(flight.t), dtype=bool)
    for span in flight.spans:
        if span.name in names:
            inside |= (flight.t >= span.begin) & (flight.t < span.end)
    return inside
