"""Did every abort let the bar go, and the vehicle fly on? Judged by the plant's truth, as in `verdict`."""

import math
from dataclasses import dataclass, field

from arm_companion.sim.flight import Flight, Mark
from arm_companion.sim.verdict import Verdict, after, unharmed

LET_GO_WITHIN_S = 15.0
"""From the order to the last touch of the bar: the curled arm opens in six seconds, once its load is gone."""

_SANK_M = 0.3
_FELL_M_PER_S = 0.6


@dataclass(frozen=True)
class Abort:
    """What one abort led to.

    Attributes:
        state: in which it came.
        let_go_s: from the order to the last touch of the bar; 0: the arm did not touch it.
        sank_m: how far the vehicle came below where it was.
        fastest_m_per_s: its greatest speed downwards.
    """

    state: str
    let_go_s: float
    sank_m: float
    fastest_m_per_s: float


@dataclass
class AbortVerdict(Verdict):
    """The end of a flight whose perches were aborted."""

    aborts: list[Abort] = field(default_factory=list)


def judge_aborts(flight: Flight, failure: str) -> AbortVerdict:
    """The verdict on a flight whose perches were aborted.

    Args:
        flight: what was seen.
        failure: why the operator's script ended early; empty when it went through.
    """
    aborts = [_abort(flight, mark) for mark in flight.marks]
    reasons = [failure] if failure else []
    if not aborts:
        reasons.append("nothing was aborted")
    for abort in aborts:
        if abort.let_go_s > LET_GO_WITHIN_S:
            reasons.append(f"{abort.let_go_s:.1f} s after the abort in {abort.state} the arm still touched the bar")
        if abort.sank_m > _SANK_M or abort.fastest_m_per_s > _FELL_M_PER_S:
            reasons.append(f"the vehicle fell by {abort.sank_m:.2f} m after the abort in {abort.state}")
    reasons += after(flight, perched=True) + unharmed(flight)
    verdict = AbortVerdict(not reasons, "failed" if reasons else "let go", "; ".join(dict.fromkeys(reasons)))
    verdict.states = flight.durations()
    verdict.aborts = aborts
    return verdict


def _abort(flight: Flight, mark: Mark) -> Abort:
    samples = flight.within(mark.start, mark.end)
    touches = [s.t - mark.start for s in samples if s.truth.contact_force_n > 0.0]
    if not samples:
        return Abort(mark.name, math.inf, math.inf, math.inf)
    lowest, fastest = max(s.state.position_w[2] for s in samples), max(s.state.velocity_w[2] for s in samples)
    return Abort(mark.name, max(touches, default=0.0), lowest - samples[0].state.position_w[2], fastest)
