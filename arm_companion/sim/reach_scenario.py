"""The tip goes to points in the world, one after the other; the plant says where it really was."""

import asyncio
import math
import statistics
from dataclasses import dataclass, field
from functools import partial

from arm_companion.protocol.dialect import mav
from arm_companion.sim.flight import AT_POINT, Flight, Mark, Vec3
from arm_companion.sim.scenario import Operator
from arm_companion.sim.verdict import Verdict, after, unharmed, wrench_errors

POINTS: tuple[Vec3, ...] = (
    (0.1, 0.0, -1.85),  # nearly under the vehicle
    (0.5, 0.3, -1.9),
    (-0.4, 0.6, -1.5),  # low
    (0.8, -0.7, -2.2),  # high, and far
    (0.0, 0.0, -1.8),
)
"""Where the tip is asked to be, m, world axes."""

KEPT_S = 4.0
"""How long it is kept at each point."""

_OFF_M = 0.03
"""Median distance from the point that still counts: 2 cm as the daemon knows it, and an estimate of position errs."""
_WORST_M = 0.06


@dataclass(frozen=True)
class PointReached:
    """How one point was reached.

    Attributes:
        asked_w: where the tip was asked to be, m.
        took_s: from the order until the tip was there by the daemon's word.
        off_m: median distance of the plant's tip from the point while it was kept there; nan: it never was.
        worst_m: the greatest.
    """

    asked_w: Vec3
    took_s: float
    off_m: float
    worst_m: float


@dataclass
class ReachVerdict(Verdict):
    """The end of a flight in which the tip went to points."""

    points: list[PointReached] = field(default_factory=list)


async def fly_reach(operator: Operator, points: tuple[Vec3, ...] = POINTS, kept_s: float = KEPT_S) -> str:
    """Reach one point after the other, and stay at each. Returns why it failed, or an empty string."""
    return await operator.fly(*(partial(_reach, operator, point, kept_s) for point in points))


async def _reach(operator: Operator, point: Vec3, kept_s: float) -> None:
    operator.say(f"REACH {', '.join(f'{x:g}' for x in point)}")
    start = asyncio.get_running_loop().time()
    together = float(mav.ARM_REACH_KIND_TOGETHER)
    await operator.order(mav.MAV_CMD_ARM_REACH, "REACH", 60.0, together, *point)
    operator.mark("to a point", start, point)
    start = asyncio.get_running_loop().time()
    await asyncio.sleep(kept_s)
    operator.mark(AT_POINT, start, point)


def judge_reach(flight: Flight, failure: str) -> ReachVerdict:
    """The verdict on a flight in which the tip went to points.

    Args:
        flight: what was seen.
        failure: why the operator's script ended early; empty when it went through.
    """
    ways = [mark for mark in flight.marks if mark.name != AT_POINT]
    points = [_point(flight, mark, way) for mark, way in zip(flight.places, ways, strict=False)]
    reasons = [failure] if failure else []
    if not points:
        reasons.append("no point was reached")
    for i, point in enumerate(points, 1):
        if not (point.off_m <= _OFF_M and point.worst_m <= _WORST_M):
            reasons.append(
                f"at point {i} the tip was {1e3 * point.off_m:.0f} mm off, at worst {1e3 * point.worst_m:.0f}"
            )
    reasons += after(flight, perched=False) + unharmed(flight)
    verdict = ReachVerdict(not reasons, "failed" if reasons else "reached", "; ".join(dict.fromkeys(reasons)))
    verdict.states = flight.durations()
    verdict.points = points
    verdict.wrench = wrench_errors(flight, {"free": ("READY", "TIP_MOVE", "TIP_HOLD")})
    return verdict


def _point(flight: Flight, mark: Mark, way: Mark) -> PointReached:
    off = [math.dist(s.truth.tip_position_w, mark.asked_w) for s in flight.within(mark.start, mark.end)]
    if not off:
        return PointReached(mark.asked_w, mark.start - way.start, math.nan, math.nan)
    return PointReached(mark.asked_w, mark.start - way.start, statistics.median(off), max(off))
