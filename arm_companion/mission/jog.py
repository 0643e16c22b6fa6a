"""Jogging: single moves and streamed set-points, turned into goals that stay within the limits. Pure."""

import math

import numpy as np

from arm_companion.errors import CommandRejected, LimitViolated
from arm_companion.mission.facts import Notice, Order, Request, SetpointKind, Severity, Vec3
from arm_companion.mission.machine import OrderRow
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, State
from arm_companion.values import replace

BEND, TIP, VEHICLE = 1, 2, 3
"""ARM_JOG_KIND."""


def cannot_jog_vehicle(s: Situation) -> str | None:
    """Why the anchored vehicle cannot be moved now."""
    return None if s.external else "the vehicle is not ours to move"


ORDERS: tuple[OrderRow[Phase, Situation], ...] = (
    OrderRow(Order.JOG, frozenset({Phase.PERCHED}), Phase.PERCHED, frozenset({Phase.PERCHED}), cannot_jog_vehicle),
    OrderRow(Order.JOG, frozenset({Phase.READY}), Phase.READY, frozenset({Phase.READY})),
)


def jog(s: Situation, request: Request) -> State:
    """Memory with the goal of one move.

    Raises:
        CommandRejected: kind, value or size does not fit.
    """
    kind, x, y, z = (*request.parameters, 0.0, 0.0, 0.0, 0.0)[:4]
    if s.state.phase is Phase.PERCHED and kind == VEHICLE:
        if (size := math.hypot(x, y, z)) > s.config.perch.jog_max_m:
            raise CommandRejected(f"a move of {size:.3f} m is over {s.config.perch.jog_max_m:g} m")
        return replace(s.state, offset=(x, y, z))
    if s.state.phase is Phase.READY and kind in (BEND, TIP):
        goal = _bend(s, x, y) if kind == BEND else _bend_for_tip(s, (x, y, z))
        return replace(s.state, bend_goal=goal, streamed=False)
    raise CommandRejected(f"jog kind {kind:g} is not possible in state {s.state.phase.name}")


def follow_stream(s: Situation, notices: list[Notice]) -> State:
    """Memory with the goal of the newest streamed set-point; when the stream ends the arm stays where it is.

    A set-point that is out of reach changes nothing, and is told once in a phase.
    """
    state, wanted = s.state, s.facts.arm_setpoint
    if state.phase is not Phase.READY:
        return replace(state, streamed=False) if state.streamed else state
    if wanted is None:
        return replace(state, bend_goal=state.bend, streamed=False) if state.streamed else state
    try:
        if wanted.kind is SetpointKind.TIP:
            goal = _bend_for_tip(s, wanted.tip_a)
        else:
            goal = _bend(s, wanted.theta, wanted.delta)
    except CommandRejected as rejected:
        reason = f"set-point ignored: {rejected.reason}"
        if _IGNORED in state.warned:
            return state
        notices.append(Notice(Severity.WARNING, reason))
        return replace(state, warned=state.warned | {_IGNORED})
    return replace(state, bend_goal=goal, streamed=True)


_IGNORED = "set-point ignored"


def _bend(s: Situation, theta: float, delta: float) -> tuple[float, float]:
    """Bend u, rad, of an arc's `theta` and `delta`, within the limit."""
    if abs(theta) > s.config.limits.bend_max_rad:
        raise CommandRejected(f"a bend of {theta:.2f} rad is over {s.config.limits.bend_max_rad:g} rad")
    bend, keep_out = np.array((theta * math.cos(delta), theta * math.sin(delta))), s.parameters.keep_out
    if keep_out is not None and (depth := -keep_out.clearance(bend)) > 0.0:
        raise CommandRejected(f"a bend of {theta:.2f} rad is {depth * 100:.1f} cm inside the keep-out cone")
    return float(bend[0]), float(bend[1])


def _bend_for_tip(s: Situation, tip_a: Vec3) -> tuple[float, float]:
    """Bend u, rad, that brings the unloaded tip to a point, m, base axes."""
    try:
        x, y = s.parameters.model.bend_for_tip(np.asarray(tip_a)).tolist()
    except LimitViolated as limit:
        raise CommandRejected(f"out of reach: {limit}") from None
    theta = math.hypot(x, y)
    return _bend(s, theta, math.atan2(y, x))
