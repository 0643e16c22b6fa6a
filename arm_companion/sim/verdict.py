"""Did it perch and let go? Judged by the plant's truth, never by what the daemon says of itself."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from arm_companion.sim.flight import Flight, Mark, WrenchSeen
from arm_companion.sim.world import Sample

_HELD_SPANS = ("perched", "hanging", "carried")

_HELD_SHARE = 0.95
_HELD_WRAP_RAD = 2.0
_HELD_FORCE_N = 0.05
_AIRBORNE_M = 0.5
_CLEAR_S = 1.0
_LANDED_M = 0.15
_FELL_M_PER_S = 2.0  # no flight stack sinks or lands that fast here; a free fall does after 20 cm
_UPRIGHT = 0.7  # cosine of the tilt of a vehicle that stands on its skids


@dataclass(frozen=True)
class WrenchError:
    """Predicted against true wrench on the airframe over one span, RMS."""

    span: str
    predictions: int
    true_force_n: float
    force_error_n: float
    true_torque_nm: float
    torque_error_nm: float
    covered: float = math.nan  # share of all predictions and axes whose force is within two of its sigmas of the truth


@dataclass(frozen=True)
class Move:
    """One asked move of the anchored vehicle and what became of it."""

    name: str
    asked_m: float
    made_m: float  # along the asked direction
    error_m: float  # distance from where it was asked to be, mean
    force_n: float  # true force of the arm on the airframe, mean magnitude


@dataclass
class Verdict:
    """The end of a flight in numbers."""

    success: bool
    verdict: str
    reason: str
    states: list[tuple[str, float]] = field(default_factory=list)
    contact_force_n: tuple[float, float] = (math.nan, math.nan)  # mean and greatest while held; nan: never held
    wrap_rad: float = math.nan
    wrench: list[WrenchError] = field(default_factory=list)
    moves: list[Move] = field(default_factory=list)
    leaned_s: float = 0.0  # with nothing but the arm's mount against the bar
    hover_error_m: float = math.nan  # RMS about the mean while perched and not moved
    excursion_m: float = math.nan  # greatest distance from where it was asked to be while the arm lets go

    @property
    def held(self) -> WrenchError | None:
        """The prediction's error while the arm held something; None: it never did, or nothing valid was predicted."""
        return next((error for error in self.wrench if error.span in _HELD_SPANS), None)


def judge(flight: Flight, failure: str, *, leaning: bool = False) -> Verdict:
    """The verdict on a perch flight.

    Args:
        flight: what was seen.
        failure: why the operator's script ended early; empty when it went through.
        leaning: whether the mount of the arm may touch the bar, as in gusts: in a closed wrap it is 3 mm away from it.
    """
    reasons = [failure] if failure else []
    spans = flight.spans()
    perched = [s for name, start, end in spans if name == "PERCHED" for s in flight.within(start, end)]
    held = _held(perched)
    if not perched:
        reasons.append("never perched")
    elif held < _HELD_SHARE:
        reasons.append(f"the arm held the bar only {held:.0%} of the time it said so")
    reasons += after(flight, perched=bool(perched))
    reasons += unharmed(flight, leaning=leaning)
    verdict = Verdict(not reasons, "perched" if not reasons else "failed", "; ".join(dict.fromkeys(reasons)))
    verdict.states = flight.durations()
    if perched:
        forces = [s.truth.contact_force_n for s in perched]
        verdict.contact_force_n = (statistics.fmean(forces), max(forces))
        verdict.wrap_rad = statistics.median(s.truth.wrap_angle for s in perched)
    verdict.wrench = wrench_errors(flight, {"free": ("READY", "APPROACH", "DEPART"), "perched": ("PERCHED",)})
    verdict.excursion_m = excursion(flight)
    verdict.leaned_s = sum(b.t - a.t for a, b in pairwise(flight.samples) if a.truth.mount_only)
    still = next((mark for mark in flight.marks if mark.name == "hold"), None)
    if still is not None:
        verdict.hover_error_m = _spread(flight.within(still.start, still.end))
        verdict.moves = [_move(flight, mark, still) for mark in flight.marks if mark is not still]
    return verdict


def _held(perched: list[Sample]) -> float:
    """Share of the samples in which the arm really holds the bar."""
    if not perched:
        return 0.0
    good = [s.truth.contact_force_n > _HELD_FORCE_N and s.truth.wrap_angle > _HELD_WRAP_RAD for s in perched]
    return sum(good) / len(good)


def after(flight: Flight, *, perched: bool) -> list[str]:
    """What is wrong with the end: still at the bar, or not on the ground, or on the ground by a fall."""
    if not flight.samples:
        return ["nothing was measured"]
    reasons = []
    last = flight.within(flight.end - _CLEAR_S, flight.end) or flight.samples[-1:]  # on a machine that stood still
    if perched and any(s.truth.contact_force_n > 0.0 for s in last):
        reasons.append("the arm did not let go of the bar")
    if (
        math.hypot(flight.samples[-1].state.velocity_w[2]) > _LANDED_M
        or flight.samples[-1].state.position_w[2] < -_LANDED_M
    ):
        reasons.append("the vehicle did not land")
    if (fastest := max(s.state.velocity_w[2] for s in flight.samples)) > _FELL_M_PER_S:
        reasons.append(f"the vehicle fell with {fastest:.1f} m/s")
    _, x, y, _ = flight.samples[-1].state.attitude_wb
    if 1.0 - 2.0 * (x * x + y * y) < _UPRIGHT:
        reasons.append("the vehicle lies on its side")
    return reasons


def excursion(flight: Flight) -> float:
    """Greatest distance of the vehicle from where it was asked to be while the arm lets go for the last time, m.

    All of RELEASE, of which the arm holds the bar for the first third and uncurls in the air for the rest; what the
    departure adds is how the autopilot accelerates. nan without one.
    """
    spans = [(start, end) for name, start, end in flight.spans() if name == "RELEASE"]
    if not spans:
        return math.nan
    asked = [(s, place) for s in flight.within(*spans[-1]) if (place := flight.asked_at(s.t)) is not None]
    return max((math.dist(s.state.position_w, place) for s, place in asked), default=math.nan)


def unharmed(flight: Flight, *, leaning: bool = False) -> list[str]:
    """What must never happen: the airframe, but its mount where it may lean, touches bar or ground while it flies.

    Nor may anything, the arm too, reach into a propeller.
    """
    reasons = []
    touching = [
        s
        for s in flight.samples
        if s.state.position_w[2] < -_AIRBORNE_M and s.truth.body_contact and not (leaning and s.truth.mount_only)
    ]
    if touching:
        reasons.append(f"the airframe touched something in flight at {touching[0].t - flight.samples[0].t:.1f} s")
    if (struck := next((s for s in flight.samples if s.truth.rotor_contact), None)) is not None:
        reasons.append(f"a propeller struck something at {struck.t - flight.samples[0].t:.1f} s")
    return reasons


def wrench_errors(flight: Flight, kinds: Mapping[str, Sequence[str]]) -> list[WrenchError]:
    """The error of the prediction in each kind of span that has any.

    Args:
        flight: what was seen.
        kinds: name of the kind -> the states that it consists of.
    """
    found = (_wrench_error(flight, name, states) for name, states in kinds.items())
    return [error for error in found if error is not None]


def _wrench_error(flight: Flight, name: str, states: Sequence[str]) -> WrenchError | None:
    inside = [(start, end) for state, start, end in flight.spans() if state in states and end > start]
    pairs: list[tuple[WrenchSeen, Sample]] = []
    for seen in flight.wrenches:
        sample = flight.sample_at(seen.t)
        if seen.valid and sample is not None and any(a <= seen.t <= b for a, b in inside):
            pairs.append((seen, sample))
    if not pairs:
        return None
    return WrenchError(
        name,
        len(pairs),
        _rms([math.dist(s.truth.force_b, (0, 0, 0)) for _, s in pairs]),
        _rms([math.dist(w.force_b, s.truth.force_b) for w, s in pairs]),
        _rms([math.dist(s.truth.torque_b, (0, 0, 0)) for _, s in pairs]),
        _rms([math.dist(w.torque_b, s.truth.torque_b) for w, s in pairs]),
        statistics.fmean(
            abs(told - true) <= 2.0 * sigma
            for w, s in pairs
            for told, true, sigma in zip(w.force_b, s.truth.force_b, w.force_sigma, strict=True)
        ),
    )


def _move(flight: Flight, mark: Mark, still: Mark) -> Move:
    origin = _mean_position(flight.within(still.start, still.end))
    samples = flight.within(mark.start, mark.end)
    asked = math.hypot(*mark.asked_w)
    along = [
        sum(a * (p - o) for a, p, o in zip(mark.asked_w, s.state.position_w, origin, strict=True)) for s in samples
    ]
    target = tuple(o + a for o, a in zip(origin, mark.asked_w, strict=True))
    return Move(
        mark.name,
        asked,
        statistics.fmean(along) / asked if along else math.nan,
        statistics.fmean(math.dist(s.state.position_w, target) for s in samples) if samples else math.nan,
        statistics.fmean(math.hypot(*s.truth.force_b) for s in samples) if samples else math.nan,
    )


def _mean_position(samples: list[Sample]) -> tuple[float, ...]:
    return (
        tuple(statistics.fmean(s.state.position_w[i] for s in samples) for i in range(3))
        if samples
        else (math.nan,) * 3
    )


def _spread(samples: list[Sample]) -> float:
    centre = _mean_position(samples)
    return _rms([math.dist(s.state.position_w, centre) for s in samples])


def _rms(values: list[float]) -> float:
    return math.sqrt(statistics.fmean(v * v for v in values)) if values else math.nan
