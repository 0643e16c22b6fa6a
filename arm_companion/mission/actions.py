"""What each phase does while it lasts: arm bend, vehicle reference and set-point."""

import math

import numpy as np

from arm_companion.mission import beside, calibrating, carry, gripper, pressing, reaching
from arm_companion.mission.facts import ArmAction, Setpoint, Vec3
from arm_companion.mission.hazards import astray
from arm_companion.mission.motion import (
    ZERO,
    Reference,
    add,
    clip_norm,
    follow,
    low_pass_vec,
    norm,
    ramp,
    scale,
    sub,
    yaw_of,
)
from arm_companion.mission.sharing import SHARING, SUSPENDED, begin, hung_reference, share_on, unloading
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CALIBRATES, CARRYING, TIP, PerchKind, Phase, State
from arm_companion.mission.wrench import grip
from arm_companion.values import replace

_PASSIVE = frozenset({Phase.STARTUP, Phase.STOWED, Phase.HOLDING}) | SUSPENDED
_REFERENCE_RESTS = CALIBRATES | frozenset(
    {
        Phase.READYING,
        Phase.READY,
        Phase.STOWING,
        Phase.STOWED,
        Phase.HOLDING,
        Phase.HANG_HOLD,
        Phase.CARRY,
    }
)
_FREE = frozenset({Phase.READYING, Phase.STOWING, Phase.STOWED})
_ORDER_OF_PERCH = (
    Phase.APPROACH,
    Phase.REACH,
    Phase.CONTACT,
    Phase.WRAP,
    Phase.VERIFY,
    Phase.PERCHED,
)
_ORDER_OF_HANG = (*_ORDER_OF_PERCH[:-1], Phase.LOAD_TRANSFER, Phase.HANGING)
_ORDER_OF_GRASP = (*_ORDER_OF_PERCH[:3], Phase.CLOSE, Phase.VERIFY, Phase.LIFT, Phase.CARRY)
_ORDER_OF_RELEASE = (Phase.UNLOAD, Phase.RELEASE, Phase.DEPART, Phase.STOWING, Phase.STOWED)
_ORDER_OF_LEAVING = (Phase.TAKE_BACK, *_ORDER_OF_RELEASE)
_ORDER_OF_SETTING_DOWN = (Phase.PLACE, Phase.RELEASE, Phase.DEPART, Phase.STOWING, Phase.STOWED)
_CURLS = (Phase.WRAP, Phase.CLOSE)
_WITH_CURL = (*_CURLS, Phase.RELEASE)
_FLIES = frozenset({Phase.APPROACH, Phase.REACH, Phase.CONTACT, Phase.LIFT, Phase.DEPART})
"""Phases in which nothing holds the vehicle: a change of speed that it is not told of it makes late, and overshoots."""

_WITH_LOAD = CARRYING | frozenset({Phase.VERIFY})
_NUDGE_M_PER_S = 0.01
_ACCELERATION = 0.4
_GENTLY = 0.2
_YAW_RATE = 0.6
_FAR_FACTOR = 3.0
_STILL_FAR_M = 0.5
_REST_S = 5.0
_AT_REST_M = 0.002
_TIGHT_SHARE = 0.8  # of the tension limit, at which a wrap is tight enough; reading and servo overshoot have the rest
_AT_BEND_RAD = 1e-6
_TIGHTEN_SHARE = 0.5  # of the bend's speed, beyond the full wrap
_BEND_AHEAD_RAD = 0.25  # three times what servos lag by while they curl the arm
_BEHIND_CURL_M = 0.1  # a wrap in still air is followed within 5 cm
_LEAN_RATE = 1.0  # m/s^3
_LOAD_RATE = 4.0  # m/s^3, of a load that comes on or goes off


def prepare(s: Situation) -> State:
    """Memory at the entry of the present phase."""
    if s.state.phase in SUSPENDED:
        return begin(s)
    if s.state.phase in CALIBRATES:
        return calibrating.prepare(s)
    state = _not_nearer(s) if s.state.phase is Phase.DEPART else _prepare(s)
    if s.grasping:
        state = carry.prepare(s.remembering(state))
    return gripper.begin(s.remembering(state))


def _prepare(s: Situation) -> State:
    """What perch and grasp have in common, and the anchor perch's own."""
    state = s.state
    match state.phase:
        case Phase.READYING | Phase.STOWING | Phase.RELEASE:
            # from where the arm really is, so that torque coming on never jerks it
            bend = s.bend if _at_rest(s) else state.bend
            return replace(_of_this_bar(s), bend=bend, bend_goal=(0.0, 0.0), pulls=())
        case Phase.HOLDING | Phase.STOWED:
            return replace(_of_this_bar(s), bend=s.bend, bend_goal=s.bend, pulls=(), course=None)
        case Phase.APPROACH:
            faces = s.remembering(replace(state, heading=s.heading_to_bar()))
            way = sub(faces.place(s.config.perch.standoff_m), s.facts.vehicle.position_w)
            return replace(
                faces.state,
                contact_w=faces.place(0.0),  # the way back is from this one, whatever is told then
                way_m=norm(way),
                anchor=None,
                rest=None,
                offset=ZERO,
                reference=state.reference or _here(s),
                tries=state.tries + 1,
            )
        case Phase.REACH:
            force = replace(state.force, tared_s=0.0, since_s=0.0, above_s=0.0)
            return replace(state, force=force, contact_w=s.place(0.0))
        case Phase.CONTACT:
            return replace(state, contact_w=beside.touching(s))
        case Phase.WRAP | Phase.CLOSE:
            x, y = s.towards_bar_a
            theta = s.config.perch.wrap_bend_rad
            return replace(state, bend_goal=(theta * x, theta * y))
        case Phase.VERIFY:
            return replace(
                state,
                anchor=grip(s),
                offset=ZERO,
                bend_goal=state.bend,
            )
        case Phase.PERCHED if state.anchor is not None:
            place = state.anchor.position_w
            return replace(state, rest=place, reference=Reference(place, ZERO, state.heading))
        case Phase.UNLOAD:
            return replace(state, offset=ZERO, bend_goal=state.bend)
    return state


def _not_nearer(s: Situation) -> State:
    """Memory at the entry of DEPART: what ends an approach far before the stand-off is no reason to go on to it."""
    before = s.state.contact_w
    least = s.config.perch.standoff_m + _STILL_FAR_M
    if before is None or norm(sub(s.facts.vehicle.position_w, before)) <= least:
        return s.state
    return replace(s.state, contact_w=None)


def _of_this_bar(s: Situation) -> State:
    """Memory at the entry of a phase in which the arm is free, or lets go, or holds whatever it may be around."""
    if s.state.phase in _FREE:
        return replace(s.state, contact_w=None, anchor=None, rest=None)
    return s.state if s.grasping else s.without_far_bar()  # a load is let go wherever it has been carried to


def act(s: Situation) -> tuple[State, ArmAction, tuple[float, ...] | None]:
    """One cycle of the present phase: the bend and the reference move on.

    Returns:
        Memory, what the servos do, and their goals (m of tendon taken in) when they are driven.
    """
    settled = carry.settle(s) if s.grasping else replace(s.state, rest=_rest(s), sharing=share_on(s))
    s = s.remembering(settled)
    state = reaching.move(s) if s.state.phase in TIP else replace(s.state, reference=_reference(s), lean=_lean(s))
    if state.phase in _PASSIVE:
        return state, ArmAction.HOLD, None
    if state.phase in CALIBRATES:
        return calibrating.act(s.remembering(state))
    if _tight_enough(s):
        state = replace(state, bend_goal=state.bend)
    elif _loose(s):
        state = replace(state, bend_goal=_tighter(s))
    speed = 0.0 if _ahead_of_the_others(s) or beside.waits(s) else s.config.perch.bend_speed_rad_per_s
    bend = _bend_towards(state.bend, state.bend_goal, speed * s.stride)
    if not s.parameters.admits(state.bend, bend):
        bend = state.bend
    pulls = state.pulls
    if bend != state.bend or not pulls:
        goal = s.parameters.model.pull_for_bend(np.asarray(bend), _pretension(s, math.hypot(*bend)))
        pulls = tuple(float(pull) for pull in goal)
    return replace(state, bend=bend, pulls=pulls), ArmAction.DRIVE, pulls


def _tight_enough(s: Situation) -> bool:
    """Whether a wrap ends before its full bend, because a tendon comes close to its limit.

    A bar thicker, or a backbone stiffer, than believed: the pull test says whether this grip holds.
    """
    if s.state.phase not in _CURLS or s.at_bend_goal:
        return False
    return max(s.state.tension, default=0.0) >= _TIGHT_SHARE * s.config.limits.tension_max_n


def _loose(s: Situation) -> bool:
    """Whether a wrap has come to its full bend, or beyond, without the tension of a grip."""
    return (
        s.state.phase is Phase.WRAP
        and s.at_bend_goal
        and math.hypot(*s.state.bend) >= s.config.perch.wrap_bend_rad - _AT_BEND_RAD
        and max(s.state.tension, default=0.0) < s.grip_needed
    )


def _tighter(s: Situation) -> tuple[float, float]:
    """The next goal of a wrap that bends on until it grips, up to the limit of any bend; slowly, for tension jumps."""
    theta = math.hypot(*s.state.bend)
    step = _TIGHTEN_SHARE * s.config.perch.bend_speed_rad_per_s * s.stride
    scale = min(theta + step, max(s.config.limits.bend_max_rad, theta)) / theta
    return (scale * s.state.bend[0], scale * s.state.bend[1])


def _ahead_of_the_others(s: Situation) -> bool:
    """Whether the commanded curl has to wait, for servos that turn late or a vehicle that does not follow a wrap.

    Bending on regardless would end in a jerk of servos that catch up, or in a bar that pulls the vehicle over. An
    arm that lets go waits for its servos alone: the vehicle may be what holds it up. For one that has failed nobody
    waits: the others open the arm as far as they can.
    """
    reference, phase = s.state.reference, s.state.phase
    if phase not in _WITH_CURL or reference is None:
        return False
    if s.bend_error > _BEND_AHEAD_RAD and s.servo_fault is None:
        return True
    behind = norm(sub(reference.position, s.facts.vehicle.position_w))
    return phase in _CURLS and (behind > _BEHIND_CURL_M or not s.vehicle_fresh)


def _pretension(s: Situation, theta: float) -> float:
    """Co-contraction, N: enough that the outer tendon of a bend `theta` keeps the least tension."""
    return max(s.config.arm.tendons.pretension_n, s.tension_swing(theta) + s.config.limits.tension_min_n)


def setpoint(s: Situation) -> Setpoint | None:
    """The set-point that leaves now; None when the vehicle is not ours.

    Before the switch to external control the stream already runs at the vehicle's own position, because PX4
    accepts the switch only then.
    """
    reference = s.state.reference
    if not (s.state.streaming and s.wants_stream and s.facts.vehicle.armed) or reference is None:
        return None
    if s.state.phase in TIP:
        return Setpoint(reference.position, reference.velocity, s.state.lean, reference.yaw, s.state.lean)
    path = reference.acceleration if s.state.phase in _FLIES else ZERO
    return Setpoint(reference.position, reference.velocity, add(path, s.state.lean), reference.yaw, path)


def progress(s: Situation) -> int:
    """Per cent of the running order, from the phases passed."""
    if s.state.phase is Phase.TIP_MOVE:
        return reaching.progress(s)
    if s.state.course is not None and s.state.phase is Phase.CALIBRATING:
        return s.state.course.progress
    orders: tuple[tuple[Phase, ...], ...] = (_ORDER_OF_PERCH, _ORDER_OF_RELEASE)
    if s.grasping:
        orders = (_ORDER_OF_GRASP, _ORDER_OF_SETTING_DOWN, *orders)
    elif s.state.kind is PerchKind.HANG:
        orders = (_ORDER_OF_HANG, _ORDER_OF_LEAVING)
    for order in orders:
        if s.state.phase in order:
            return round(100 * order.index(s.state.phase) / (len(order) - 1))
    return 100 if s.state.phase is Phase.READY else 0


def _at_rest(s: Situation) -> bool:
    return s.at_bend_goal or not all(tendon.torque for tendon in s.facts.tendons)


def _here(s: Situation) -> Reference:
    vehicle = s.facts.vehicle
    return Reference(vehicle.position_w, ZERO, yaw_of(vehicle.attitude_wb))


def _reference(s: Situation) -> Reference | None:
    """The vehicle's reference after this cycle."""
    state = s.state
    if not state.streaming:
        return state.reference
    if not s.vehicle_fresh:  # frozen, and at rest: acting on old state is worse than waiting
        return None if state.reference is None else state.reference.still
    if not (s.external and s.wants_stream):
        return _here(s)
    reference = state.reference or _here(s)
    if state.phase in _REFERENCE_RESTS:
        if astray(s) is not None:
            return _here(s)  # a vehicle that follows again stays where it is
        return reference.still
    if state.phase in SHARING:
        return hung_reference(s, reference)
    if state.phase in _WITH_CURL:
        place = beside.curling(s)
        if state.phase is Phase.RELEASE and (state.contact_w is None or s.far(place)):
            return reference.still  # nobody knows where the bar was met
        place = pressing.not_back_down(s, place, reference.position)
        return Reference(place, (0.0, 0.0, _leaving(s, place[2] - reference.position[2])), state.heading)
    goal, speed = _goal(s)
    # an arm that is wrapped is not turned in by a heading of another place: after a restart nobody knows the bar's
    keeps = state.phase is Phase.UNLOAD and state.anchor is None
    return follow(
        reference,
        goal,
        reference.yaw if keeps else state.heading,
        speed=speed,
        acceleration=_GENTLY if state.phase in (Phase.REACH, Phase.CONTACT) else _ACCELERATION,
        yaw_rate=_YAW_RATE,
        dt=s.dt,
    )


def _leaving(s: Situation, step: float) -> float:
    """Velocity down of a reference that moves by `step`, m, in this cycle from a bar, as the arm opens, m/s: upwards.

    What the bar carried of the arm is the vehicle's again then, which sinks by it, and the mount has 5 mm to spare.
    """
    if not beside.leaves(s) or s.dt <= 0.0:
        return 0.0
    return max(min(step, 0.0) / s.dt, -s.config.perch.reach_speed_m_per_s)


def _goal(s: Situation) -> tuple[Vec3, float]:
    """Where the reference goes in a phase that moves the vehicle, and how fast."""
    perch = s.config.perch
    if s.grasping and s.state.phase in _WITH_LOAD:
        return carry.goal(s)
    if s.gripping and s.state.phase in (Phase.REACH, Phase.CONTACT):
        return gripper.goal(s)
    anchor = s.state.anchor.position_w if s.state.anchor else s.facts.vehicle.position_w
    match s.state.phase:
        case Phase.APPROACH:
            return s.place(perch.standoff_m), perch.approach_speed_m_per_s
        case Phase.DEPART:
            return s.standoff, s.speed_back
        case Phase.CONTACT:
            return beside.clear(s), perch.reach_speed_m_per_s
        case Phase.REACH:
            hurry = 1.0 if s.near_bar else _FAR_FACTOR
            return s.place(-perch.overreach_m), hurry * perch.reach_speed_m_per_s
        case Phase.VERIFY:
            return add(anchor, scale(s.ahead, -perch.verify_pull_m)), perch.verify_pull_m
        case Phase.UNLOAD:
            return pressing.eased(s), _NUDGE_M_PER_S
        case phase:
            speed = perch.jog_speed_m_per_s if phase is Phase.PERCHED else _NUDGE_M_PER_S
            return add(s.rest, s.state.offset), speed


def _rest(s: Situation) -> Vec3 | None:
    """Where the anchored vehicle stays by itself, followed slowly while no move is asked for.

    So nothing winds up against the bar while the arm settles and the position's own estimate wanders.
    """
    state = s.state
    moving = state.offset != ZERO or (
        state.reference is not None and norm(sub(state.reference.position, s.rest)) > _AT_REST_M
    )
    if state.phase is not Phase.PERCHED or moving or not s.vehicle_fresh:
        return state.rest
    return low_pass_vec(s.rest, state.position, s.dt, _REST_S)


def _lean(s: Situation) -> Vec3:
    """The acceleration fed forward, moved towards what the prediction asks for; zero where it asks for nothing."""
    if s.state.phase in SHARING and s.external and s.vehicle_fresh:
        return unloading(s)
    prediction = s.state.prediction
    wanted = ZERO
    if s.state.phase is Phase.PERCHED and s.state.feedforward and prediction is not None:
        wanted = clip_norm(add(prediction.lean, (0.0, 0.0, pressing.trim(s))), s.config.limits.feedforward_m_per_s2)
    rate = _LEAN_RATE
    if s.grasping:
        if s.state.phase is Phase.HOLDING:  # what it held up is gone
            return ZERO
        if s.state.phase in _WITH_LOAD and s.state.feedforward:
            wanted, rate = clip_norm(carry.push(s), s.config.limits.feedforward_m_per_s2), _LOAD_RATE
    return add(s.state.lean, clip_norm(sub(wanted, s.state.lean), rate * s.dt))


def _bend_towards(bend: tuple[float, float], goal: tuple[float, float], most: float) -> tuple[float, float]:
    way = (goal[0] - bend[0], goal[1] - bend[1], 0.0)
    distance = norm(way)
    if distance <= most:
        return goal
    share = ramp(0.0, 1.0, most / distance, 1.0)
    return (bend[0] + share * way[0], bend[1] + share * way[1])
