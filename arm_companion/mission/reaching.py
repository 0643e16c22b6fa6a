"""REACH: the tip to a point in the world, the way shared between vehicle and arm, and the tip kept there.

The plan (`arm.reach`) is made once, at the order. Vehicle and bend then glide to it, and the tip that they would have
if the vehicle were exactly where it is asked to be is where the tip shall be in every cycle. The arm is fast and the
vehicle is not: in each cycle the bend is found anew that brings the tip there from where the vehicle really is, with
its real attitude and with what gravity does to the arm.

An arc's tips are a surface, so the arm makes up two directions of three: both level ones when it hangs straight. What
lies across the surface stays the vehicle's.
"""

import math

import numpy as np

from arm_companion.arm import arc, reach
from arm_companion.errors import CommandRejected
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array
from arm_companion.mission.facts import Control, Request, Vec3
from arm_companion.mission.glide import Glide, glide, there
from arm_companion.mission.motion import (
    ZERO,
    Reference,
    add,
    low_pass,
    low_pass_vec,
    norm,
    scale,
    sub,
    wrap_angle,
    yaw_of,
)
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import TIP, Phase, Reach, State
from arm_companion.values import replace

WITHIN_S = 0.5
"""So long the tip has to be at its point."""

_BEND_SPEED_SHARE = 0.5  # of the bend's speed for the plan's own way: the rest is for making up
_BEND_ACCELERATION = 1.0  # rad/s^2
_HERE_S = 0.3  # the velocity tells what is faster than that, the position what is slower
_AHEAD_S = 0.08  # until a bend that is asked for is there
_SAG_S = 0.3
_ERROR_S = 0.2
_UNKNOWN_S = 0.5  # without a solution of the mechanics, after which nobody knows where the tip is
_BESIDE_M = 0.1  # as far as a pilot's hover is from where the vehicle was at the order
_BESIDE_RAD = 0.1
_SOLVER_STEPS = 3
_STOP_S = 0.02  # of the way on: a reference that moves in steps brakes a little later
_TO_PLAN = 1e-3  # weight of the plan's bend against the tip's place, each in lengths of the arm
_TIGHT_SHARE = 0.8  # of the tension limit, that a free bend may take


# --- the plan ---


def bend_limit(s: Situation) -> float:
    """Greatest bend of a free arm that keeps the limits of bend, tension and displacement, rad."""
    limits, arm = s.config.limits, s.parameters.model.parameters
    tension = _TIGHT_SHARE * limits.tension_max_n
    swing = min(tension - s.config.arm.tendons.pretension_n, 0.5 * (tension - limits.tension_min_n))
    stretch = tension / float(arm.k_T.min())
    most = min(limits.bend_max_rad, swing / s.tension_swing(1.0), (limits.pull_max_m - stretch) / arm.r)
    return max(most, 0.0)


def plan(s: Situation, request: Request) -> State:
    """Memory with the way to the point of a REACH.

    Raises:
        CommandRejected: the point cannot be reached, with the limit that is in the way.
    """
    kind, north, east, down = (*request.parameters, 0.0, 0.0, 0.0, 0.0)[:4]
    target: Vec3 = (north, east, down)
    alone = bool(kind) or not s.external
    if not alone and (not s.facts.vehicle.armed or s.facts.vehicle.landed):
        raise CommandRejected("the vehicle is not flying")
    if not alone and not s.state.streaming:
        raise CommandRejected("the pilot had the vehicle: order READY first")
    running = s.state.reach if s.state.phase in TIP else None
    start, heading = _start(s, running)
    shape = Glide.rest((*s.state.bend, 0.0)) if running is None else running.shape
    arm = reach.Arm(s.mount, s.parameters.model.parameters.L, s.parameters.model.parameters.L)
    options, now = s.config.reach, np.array(shape.position[:2])
    limits = reach.Limits(
        bend_limit(s),
        options.move_max_m,
        -options.height_min_m,
        options.clearance_m,
        s.parameters.keep_out,
    )
    point, vehicle = (
        np.array(target),
        np.array(_stop(start, options.acceleration_m_per_s2) if alone else start.position),
    )
    try:
        if alone:
            found = reach.alone(point, vehicle, heading, arm, now, limits, options.tolerance_m)
        else:
            found = reach.split(point, vehicle, heading, arm, now, options.vehicle_weight, limits)
    except reach.OutOfReach as out:
        raise CommandRejected(f"{out}{_why_alone(s, kind)}") from None
    x, y = found.bend.tolist()
    tip = vehicle + arm.offset(now, heading)
    goal = Reach(
        target,
        _vec3(found.vehicle),
        (x, y),
        alone,
        float(np.linalg.norm(point - tip)),
        start,
        shape,
        s.facts.vehicle.position_w if running is None else running.here_w,
        sag_a=ZERO if running is None else running.sag_a,
    )
    # a new point on the way to another has all of the time
    since = s.t if s.state.phase is Phase.TIP_MOVE else s.state.since
    return replace(s.state, reach=goal, heading=heading, since=since)


def _why_alone(s: Situation, kind: float) -> str:
    return "" if kind or s.external else "; the vehicle is not ours to move"


def _start(s: Situation, running: Reach | None) -> tuple[Glide, float]:
    """The vehicle from where its way begins, and its heading; a way that is being made is gone on from."""
    reference, vehicle = s.state.reference, s.facts.vehicle
    if reference is None or not s.external:
        return Glide.rest(vehicle.position_w), yaw_of(vehicle.attitude_wb)
    start = Glide.rest(reference.position) if running is None else running.vehicle
    return start, reference.yaw


def _stop(g: Glide, acceleration: float) -> Vec3:
    """Where a reference comes to rest that brakes now, m."""
    velocity = g.lead.velocity
    return add(g.lead.position, scale(velocity, 0.5 * norm(velocity) / acceleration + _STOP_S))


# --- each cycle ---


def move(s: Situation) -> State:
    """Memory after a cycle of TIP_MOVE or TIP_HOLD: reference, bend to ask for, and the tip's error."""
    state, goal = s.state, s.state.reach
    if goal is None or not s.vehicle_fresh or s.dt <= 0.0:
        return _still(s)
    if s.external and state.control is not Control.EXTERNAL:
        s = s.remembering(_given_back(s, goal))
        state, goal = s.state, s.state.reach or goal
    goal = _glide_on(s, _observe(s, goal))
    state = replace(state, reach=goal, bend_goal=_bend(s, goal))
    if not (s.external and s.wants_stream):
        return replace(_still(s.remembering(state)), reference=_here(s))
    reference = Reference(goal.vehicle.position, goal.vehicle.velocity, state.heading)
    return replace(state, reference=reference, lean=goal.vehicle.acceleration)


def _given_back(s: Situation, goal: Reach) -> State:
    """Memory in the cycle in which a vehicle that a pilot flew becomes ours: set-points begin where it is.

    From beside the plan's place it glides there. Anywhere else it stays, and the tip does what it can.
    """
    vehicle = s.facts.vehicle
    yaw = yaw_of(vehicle.attitude_wb)
    near = norm(sub(vehicle.position_w, goal.vehicle_w)) <= _BESIDE_M
    here = replace(goal, vehicle=Glide.rest(vehicle.position_w), here_w=vehicle.position_w)
    if near and abs(wrap_angle(yaw - s.state.heading)) <= _BESIDE_RAD:
        return replace(s.state, reach=here)
    return replace(s.state, heading=yaw, reach=replace(here, vehicle_w=vehicle.position_w))


def _still(s: Situation) -> State:
    reference = s.state.reference
    return replace(s.state, reference=None if reference is None else replace(reference, velocity=ZERO), lean=ZERO)


def _here(s: Situation) -> Reference:
    vehicle = s.facts.vehicle
    return Reference(vehicle.position_w, ZERO, yaw_of(vehicle.attitude_wb))


def _glide_on(s: Situation, goal: Reach) -> Reach:
    """The plan's own way, one step on."""
    options, dt = s.config.reach, s.dt
    speed = _BEND_SPEED_SHARE * s.config.perch.bend_speed_rad_per_s
    shape = glide(goal.shape, (*goal.bend, 0.0), speed=speed, acceleration=_BEND_ACCELERATION, dt=dt)
    vehicle = glide(
        goal.vehicle,
        goal.vehicle_w,
        speed=min(options.speed_m_per_s, s.config.limits.vehicle_speed_m_per_s),
        acceleration=options.acceleration_m_per_s2,
        dt=dt,
    )
    return replace(goal, shape=shape, vehicle=vehicle)


def _observe(s: Situation, goal: Reach) -> Reach:
    """Where vehicle and tip are, after this cycle."""
    vehicle, dt, prediction = s.facts.vehicle, s.dt, s.state.prediction
    here = add(goal.here_w, scale(vehicle.velocity_w, dt))
    measured = add(vehicle.position_w, scale(vehicle.velocity_w, vehicle.position_age_s))
    here = low_pass_vec(here, measured, dt, _HERE_S)
    sag, error, unknown = goal.sag_a, goal.error_m, goal.unknown_s + dt
    if prediction is not None and math.isfinite(prediction.tip_a[0]):
        length = s.parameters.model.parameters.L
        now = sub(prediction.tip_a, _vec3(arc.tip_position(prediction.bend, length)))
        sag = low_pass_vec(sag, now, dt, _SAG_S)
        tip_a = arc.tip_position(s.bend, length) + sag
        tip = here + so3.from_quaternion(vehicle.attitude_wb) @ (s.mount.position + s.mount.rotation @ tip_a)
        away, unknown = math.dist(tip, goal.target_w), 0.0
        error = away if math.isinf(error) else low_pass(error, away, dt, _ERROR_S)
    if unknown > _UNKNOWN_S:
        error = math.inf
    there_now = not unknown and error <= s.config.reach.tolerance_m and settled(goal)
    within = goal.within_s + dt if there_now else 0.0
    return replace(goal, here_w=here, sag_a=sag, error_m=error, within_s=within, unknown_s=unknown)


def settled(goal: Reach) -> bool:
    """Whether the plan's own way is over."""
    return there(goal.shape, (*goal.bend, 0.0)) and there(goal.vehicle, goal.vehicle_w)


def _bend(s: Situation, goal: Reach) -> tuple[float, float]:
    """The bend, rad, that brings the tip to where the plan has it now, from where the vehicle really is."""
    planned = np.array(goal.shape.position[:2])
    most = s.config.reach.correction_max_rad
    if most <= 0.0:
        return _pair(planned)
    vehicle = s.facts.vehicle
    length, mount = s.parameters.model.parameters.L, s.mount
    arm = reach.Arm(mount, length, length)
    tip_w = np.array(goal.vehicle.position) + arm.offset(planned, s.state.heading)
    soon = add(goal.here_w, scale(vehicle.velocity_w, _AHEAD_S))
    R_bw = so3.from_quaternion(vehicle.attitude_wb).T
    tip_a = mount.rotation.T @ (R_bw @ (tip_w - soon) - mount.position) - goal.sag_a
    bend = _solved(tip_a, np.array(s.state.bend), planned, length)
    bend = planned + _clipped(bend - planned, most)
    return _pair(_clipped(bend, max(bend_limit(s), float(np.linalg.norm(planned)))))


def _solved(tip_a: Array, start: Array, planned: Array, length: float) -> Array:
    """The bend u (2,) whose tip is nearest to `tip_a` (3,), by Gauss-Newton; of equals the one nearer to the plan."""
    u = start
    for _ in range(_SOLVER_STEPS):
        J = arc.jacobian(u, length)[:3] / length
        off = (tip_a - arc.tip_position(u, length)) / length
        (a, b), (_, c) = (J.T @ J).tolist()
        x, y = (J.T @ off + _TO_PLAN * (planned - u)).tolist()
        a, c = a + _TO_PLAN, c + _TO_PLAN
        u = u + np.array((c * x - b * y, a * y - b * x)) / (a * c - b * b)
    return u


def _clipped(u: Array, most: float) -> Array:
    size = float(np.linalg.norm(u))
    return u if size <= most else u * (most / size)


def _pair(u: Array) -> tuple[float, float]:
    return float(u[0]), float(u[1])


def _vec3(v: Array) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])


def progress(s: Situation) -> int:
    """Per cent of the tip's way to its point."""
    goal = s.state.reach
    if goal is None or not math.isfinite(goal.error_m) or goal.way_m <= 0.0:
        return 0
    return round(100.0 * min(max(1.0 - goal.error_m / goal.way_m, 0.0), 0.99))


def tip_error(s: Situation) -> str:
    """How far the tip is from its point, in words."""
    goal = s.state.reach
    if goal is None or not math.isfinite(goal.error_m):
        return "where the tip is, is not known"
    return f"tip {goal.error_m * 1e3:.0f} mm from its point"
