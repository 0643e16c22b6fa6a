"""Beside a bar or object that the arm has met: where the vehicle goes before the grip and as it opens, and its rest."""

import math

from arm_companion.mission.estimate import OBSERVER_LAG_S, strength
from arm_companion.mission.facts import Vec3
from arm_companion.mission.motion import ZERO, add, dot, rotate, scale, sub
from arm_companion.mission.parameters import column
from arm_companion.mission.situation import Situation, at
from arm_companion.mission.state import Phase

_SETTLE_S = 2.5
_RESTED_S = 0.5
_RESTLESS_S = 8.0
_AT_BAR_M = 0.03
_NEARER_M = 0.01
_ASIDE_M = 0.01
_FREE_SHARE = 0.4  # of the wrap, up to which the arm is clear of what it curls around: it touches from 0.43 on
_WAITS_SHARE = 0.36
_FORWARD_SHARE = 0.7  # of the wrap, by which the vehicle has made up the clearance


def touching(s: Situation) -> Vec3:
    """Vehicle position, height aside, at which the straight arm just touches the bar that was found, world axes.

    The vehicle is past it by what bends the arm, a cantilever up to the bar, and by what it flew while the
    force observer followed. A bar is taken where the vehicle met it, an object at its middle: held beside that, its
    weight turns the vehicle as it comes off.
    """
    arm, perch = s.parameters.model.parameters, s.config.perch
    cantilever = 3.0 * arm.EI / perch.contact_arc_m**3
    force = strength(s.state.force.residual)
    past = min(force / cantilever + OBSERVER_LAG_S * perch.reach_speed_m_per_s, perch.overreach_m)
    planned, met = s.place(0.0), s.facts.vehicle.position_w
    if s.grasping:
        met = add(planned, scale(s.ahead, dot(sub(met, planned), s.ahead)))
    x, y, _ = add(met, scale(s.ahead, -past))
    return x, y, planned[2]


def curling(s: Situation) -> Vec3:
    """Vehicle position that suits the present bend, between the bar just cleared and the full wrap, world axes.

    Tendons bend the whole arm alike, so an arm that wraps a bar curls from its base on: while it bends, the
    vehicle comes down along the arm by the length that the bar was away, and forward by the clearance. On this
    way the arm meets the bar only when the wrap closes, which keeps the vehicle from bouncing off it.
    """
    state, perch = s.state, s.config.perch
    if s.gripping:  # the straight arm has nothing to curl around
        return s.contact_w
    share = min(_share(s), 1.0)
    closed = add(s.contact_w, scale(s.straight_w, perch.contact_arc_m))
    if state.phase is Phase.RELEASE and state.anchor is not None:
        closed = s.rest
    # forward first, while the curl is still wide; and away from the bar before anything can hook into it
    forward = 1.0 if leaves(s) else _FORWARD_SHARE
    ahead = scale(s.ahead, -perch.wrap_clearance_m * max(1.0 - share / forward, 0.0))
    return add(add(s.contact_w, scale(sub(closed, s.contact_w), share)), ahead)


def leaves(s: Situation) -> bool:
    """Whether an arm below opens, and its vehicle makes away from the bar meanwhile."""
    return s.state.phase is Phase.RELEASE and s.state.perches_below


def clear(s: Situation) -> Vec3:
    """Vehicle position from which the straight arm leaves room for a curl, world axes, m."""
    return add(s.contact_w, scale(s.ahead, -s.config.perch.wrap_clearance_m))


def settled(s: Situation) -> str | None:
    """The vehicle rests just clear of the bar that it touched."""
    reference = s.state.reference
    if reference is None or s.elapsed < _SETTLE_S or reference.velocity != ZERO:
        return None
    # The blow of the bar throws it back and forth: one that passes by on its way does not rest, one in wind never will.
    # Nearer to the bar than it should be it waits on: the curl would meet the bar before it closes. Aside of the middle
    # of an object it does, too: what is heavy, and held there, leans the vehicle, and meets its place with one end.
    nearer = dot(sub(s.facts.vehicle.position_w, reference.position), s.ahead)
    if s.grasping and aside(s) > _ASIDE_M:
        return None
    near = s.elapsed > _RESTLESS_S and nearer <= _NEARER_M and at(s, reference.position, _AT_BAR_M)
    return "settled clear of the bar" if near or s.state.vigil.rested_s >= _RESTED_S else None


def settled_at_object(s: Situation) -> str | None:
    """The same of an object that is to be grasped."""
    return settled(s) if s.grasping else None


def aside(s: Situation) -> float:
    """How far beside the middle of bar or object, as it was told, the straight arm meets it, m, unsigned.

    Wind leans the vehicle, and an arm that is straight points aside with it, by half a centimetre for 1.5 degrees.
    """
    vehicle, (x, y, z) = s.facts.vehicle, s.config.mount.position_m
    reach = add((x, y, z), scale(column(s.mount.rotation, 2), s.config.perch.contact_arc_m))
    return abs(across(s, sub(add(vehicle.position_w, rotate(vehicle.attitude_wb, reach)), s.bar.point_w)))


def across(s: Situation, way: Vec3) -> float:
    """What of a way is level and across the way to bar or object, that is along it; m, signed."""
    return way[0] * s.ahead[1] - way[1] * s.ahead[0]


def is_free(s: Situation) -> bool:
    """Whether a curl has yet to reach what it closes around."""
    return _share(s) < _FREE_SHARE


def waits(s: Situation) -> bool:
    """Whether a curl that is about to reach its object waits, for a vehicle that has been carried off aside of it.

    From there on the arm holds the vehicle where it is: what is heavy, and held beside its middle, hangs askew.
    """
    about_to = s.state.phase is Phase.CLOSE and not s.gripping and _WAITS_SHARE <= _share(s) < _FREE_SHARE
    return about_to and aside(s) > _ASIDE_M


def _share(s: Situation) -> float:
    """Of the full wrap, to which the arm is told to bend now."""
    return math.hypot(*s.state.bend) / s.config.perch.wrap_bend_rad
