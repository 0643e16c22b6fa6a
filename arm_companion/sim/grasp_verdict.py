"""Was the object picked up, carried and set down? Judged by the plant's truth, as in `verdict`."""

import math
import statistics
from dataclasses import dataclass, field
from itertools import pairwise

from arm_companion.config.schema import Config
from arm_companion.sim.flight import CARRIED, WITH, WITHOUT, Flight
from arm_companion.sim.flight_control import GRAVITY
from arm_companion.sim.verdict import Verdict, after, excursion, unharmed, wrench_errors
from arm_companion.sim.world import Sample

PLACED_WITHIN_M = 0.05
"""From where the object lay to where it lies in the end, that still counts as put back."""

_HELD_SHARE = 0.95
_LIFTED_SHARE = 0.7
_STILL_M = 0.003
_ASKED_UP_M = 0.002
_LOADED_SHARE = 1.0 / 3.0  # of the object's weight
_CLEAR_S = 1.0
_FELL_M_PER_S = 0.5  # it is set down at a fifth of that
_SETTLED_S = 2.0
_PICK_UP = ("VERIFY", "LIFT")


@dataclass(frozen=True)
class PickUp:
    """How well the vehicle kept to what it was asked while the load came on, up to the carrying.

    From when it is asked up or a third of the load is on the arm, whichever comes first.

    Attributes:
        name: with or without feed-forward.
        error_m: distance from the height asked, RMS: the load pulls down, and the feed-forward pushes up.
        worst_m: greatest distance below it.
        aside_m: distance from the place asked, RMS: what swings when the object comes free, which nothing compensates.
        seconds: of this.
    """

    name: str
    error_m: float
    worst_m: float
    aside_m: float
    seconds: float


@dataclass
class GraspVerdict(Verdict):
    """The end of a flight that grasps."""

    pick_ups: list[PickUp] = field(default_factory=list)
    mass_kg: float = math.nan  # true
    weighed_kg: float = math.nan  # last valid estimate while carried
    weighed_sigma_kg: float = math.nan
    placed_m: float = math.nan  # from where the object lay to where it lies

    @property
    def mass_error(self) -> float:
        """Estimated less true mass, relative; nan: never weighed."""
        return self.weighed_kg / self.mass_kg - 1.0 if self.mass_kg else math.nan


def judge_grasp(flight: Flight, failure: str, config: Config) -> GraspVerdict:
    """The verdict on a flight that grasps.

    Args:
        flight: what was seen.
        failure: why the operator's script ended early; empty when it went through.
        config: of the world as it was.
    """
    reasons = [failure] if failure else []
    carried = [s for mark in flight.marks if mark.name == CARRIED for s in flight.within(mark.start, mark.end)]
    if not carried:
        reasons.append("never carried")
    elif (held := statistics.fmean(_in_the_air(s, flight, config) for s in carried)) < _HELD_SHARE:
        reasons.append(f"the object was in the air only {held:.0%} of the time it was said to be carried")
    placed = _moved(flight)
    if carried and not placed <= PLACED_WITHIN_M:
        reasons.append(f"the object lies {placed * 100:.1f} cm from where it was")
    reasons += _dropped(flight)
    reasons += _left_alone(flight) if carried else []
    reasons += after(flight, perched=bool(carried)) + unharmed(flight)
    verdict = GraspVerdict(not reasons, "failed" if reasons else "grasped", "; ".join(dict.fromkeys(reasons)))
    verdict.states = flight.durations()
    if carried:
        forces = [s.truth.contact_force_n for s in carried]
        verdict.contact_force_n = (statistics.fmean(forces), max(forces))
        verdict.wrap_rad = statistics.median(s.truth.wrap_angle for s in carried)
    kinds = {"free": ("READY", "APPROACH", "DEPART"), "carried": ("LIFT", "CARRY", "PLACE")}
    verdict.wrench = wrench_errors(flight, kinds)
    verdict.excursion_m = excursion(flight)
    verdict.pick_ups = _pick_ups(flight, config.sim.object.mass_kg)
    verdict.mass_kg, verdict.placed_m = config.sim.object.mass_kg, placed
    weights = [seen for seen in flight.payloads if seen.valid]
    if weights:
        verdict.weighed_kg, verdict.weighed_sigma_kg = weights[-1].mass, weights[-1].sigma
    return verdict


def _in_the_air(sample: Sample, flight: Flight, config: Config) -> bool:
    """Whether the arm holds the object clear of its cradles, about as high as asked."""
    first, now = flight.samples[0].truth.object_position_w, sample.truth.object_position_w
    if first is None or now is None or sample.truth.object_supported:
        return False
    return first[2] - now[2] > _LIFTED_SHARE * config.grasp.lift_height_m and sample.truth.contact_force_n > 0.0


def _moved(flight: Flight) -> float:
    """From where the object lay to where it lies at the end, m."""
    if not flight.samples:
        return math.nan
    first, last = flight.samples[0].truth.object_position_w, flight.samples[-1].truth.object_position_w
    return math.nan if first is None or last is None else math.dist(first, last)


def _dropped(flight: Flight) -> list[str]:
    """What is wrong with an object that fell, wherever it came to lie."""
    fastest = 0.0
    for a, b in pairwise(flight.samples):
        above, below = a.truth.object_position_w, b.truth.object_position_w
        if above is not None and below is not None and b.t > a.t:
            fastest = max(fastest, (below[2] - above[2]) / (b.t - a.t))
    return [f"the object fell with {fastest:.1f} m/s"] if fastest > _FELL_M_PER_S else []


def _left_alone(flight: Flight) -> list[str]:
    """What is wrong after the arm let go for the last time: the object is touched, or still moves."""
    departs = [end for name, _, end in flight.spans() if name == "DEPART"]
    after = flight.within(departs[-1], flight.end) if departs else []
    if not after:
        return ["the arm did not leave the object"]
    reasons = []
    if any(s.truth.contact_force_n > 0.0 for s in after):
        reasons.append("the object was touched after it was set down")
    last = [s.truth.object_position_w for s in flight.within(flight.end - _CLEAR_S, flight.end)]
    if any(a is not None and b is not None and math.dist(a, b) > _STILL_M for a in last[:1] for b in last):
        reasons.append("the object does not lie still")
    return reasons


def _pick_ups(flight: Flight, mass: float) -> list[PickUp]:
    """Both of them, of an object of so many kg."""
    found = []
    spans = flight.spans()
    for mark in flight.marks:
        inside = [(a, b) for name, a, b in spans if name in _PICK_UP and mark.start <= a < mark.end]
        if mark.name not in (WITH, WITHOUT) or not inside:
            continue
        start, end = inside[0][0], inside[-1][1]
        during = flight.within(start, end + _SETTLED_S)
        asked = [(s, place) for s in during if (place := flight.asked_at(s.t)) is not None]
        if not asked:
            continue
        loaded = min(s.truth.force_b[2] for s, _ in asked) + _LOADED_SHARE * mass * GRAVITY
        top = asked[0][1][2] - _ASKED_UP_M
        begins = (i for i, (s, place) in enumerate(asked) if place[2] < top or s.truth.force_b[2] > loaded)
        samples = asked[next(begins, len(asked)) :]
        if not samples:
            continue
        below = [s.state.position_w[2] - place[2] for s, place in samples]
        aside = [math.dist(s.state.position_w[:2], place[:2]) for s, place in samples]
        found.append(PickUp(mark.name, _rms(below), max(below), _rms(aside), end - samples[0][0].t))
    return found


def _rms(values: list[float]) -> float:
    return math.sqrt(statistics.fmean(v * v for v in values))
