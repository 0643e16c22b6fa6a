"""Did it hang and leave again? Judged by the plant's truth: who carried the weight, and what touched what."""

import math
import statistics

from arm_companion.sim.flight import Flight
from arm_companion.sim.verdict import Verdict, after, excursion, unharmed, wrench_errors
from arm_companion.sim.world import Sample

_CARRIED_SHARE = 0.6  # of the weight that the bar carries in a vehicle that hangs
_HUNG_S = 10.0
_GAP_S = 0.2  # a swing takes load off the bar for moments
_FELL_M_PER_S = 0.6
_SANK_M = 0.2


def judge_hang(flight: Flight, failure: str, weight_n: float) -> Verdict:
    """The verdict on a hang flight.

    Args:
        flight: what was seen.
        failure: why the operator's script ended early; empty when it went through.
        weight_n: of the vehicle as it is in the plant.
    """
    reasons = [failure] if failure else []
    hung = _longest(flight.samples, weight_n)
    lasted = hung[-1].t - hung[0].t if hung else 0.0
    if lasted < _HUNG_S:
        reasons.append(f"the bar carried the vehicle for {lasted:.1f} s only")
    elif (fell := _fell(hung)) is not None:
        reasons.append(fell)
    reasons += after(flight, perched=bool(hung))
    reasons += unharmed(flight)
    verdict = Verdict(not reasons, "hung" if not reasons else "failed", "; ".join(dict.fromkeys(reasons)))
    verdict.states = flight.durations()
    if hung:
        forces = [s.truth.contact_force_n for s in hung]
        verdict.contact_force_n = (statistics.fmean(forces), max(forces))
        verdict.wrap_rad = statistics.median(s.truth.wrap_angle for s in hung)
    verdict.excursion_m = excursion(flight)
    verdict.wrench = wrench_errors(flight, {"free": ("READY", "APPROACH", "DEPART"), "hanging": ("HANGING",)})
    return verdict


def carried_share(sample: Sample, weight_n: float) -> float:
    """Share of the weight that the bar carries; it pushes the arm up, which is negative in NED."""
    return -sample.truth.contact_net_w[2] / weight_n


def _longest(samples: list[Sample], weight_n: float) -> list[Sample]:
    """The longest run of samples in which the bar carries the vehicle; short gaps do not end it."""
    best: list[Sample] = []
    run: list[Sample] = []
    last = -math.inf
    for sample in samples:
        if carried_share(sample, weight_n) < _CARRIED_SHARE:
            continue
        if sample.t - last > _GAP_S:
            run = []
        run.append(sample)
        last = sample.t
        if len(run) > len(best):
            best = run
    return best


def _fell(hung: list[Sample]) -> str | None:
    fastest = max(s.state.velocity_w[2] for s in hung)
    if fastest > _FELL_M_PER_S:
        return f"the hanging vehicle fell with {fastest:.1f} m/s"
    sank = max(s.state.position_w[2] for s in hung) - hung[0].state.position_w[2]
    return f"the hanging vehicle sank by {sank:.2f} m" if sank > _SANK_M else None
