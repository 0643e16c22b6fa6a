"""What carrying does in each cycle: the load is weighed, lifted with a push of its own, and set down again."""

import math

import numpy as np

from arm_companion.arm.model import Payload
from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission import beside, gripper
from arm_companion.mission.facts import PayloadReport, Vec3
from arm_companion.mission.grasp import LIGHT_SHARE, above, lies_down, low
from arm_companion.mission.motion import ZERO, add, low_pass, low_pass_vec, norm, scale, sub
from arm_companion.mission.payload import ROTOR_LAG_S, Found, Load, interrupted, watch_load, weigh
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CARRYING, Anchor, Phase, State
from arm_companion.values import replace

_UNTOUCHED = frozenset(
    {
        Phase.STOWED,
        Phase.READYING,
        Phase.READY,
        Phase.APPROACH,
        Phase.REACH,
        Phase.CONTACT,
        Phase.DEPART,
        Phase.STOWING,
    }
)
"""Phases in which the rotors lift the vehicle alone."""

_ARDUPILOT_LAG_S = 0.08  # of the 2 Hz low-pass between the thrust that ArduPilot tells and its motors
_COMES_OFF_S = 1.5  # until the vehicle that goes back from the touch has taken the arm away
_NEAR_GROUND_M = 0.1
_SLOWLY = 0.3  # share of the speed there
_ABOVE_M = 0.03
_STEADY_S = 2.5  # until a vehicle that the closing arm has pulled about rests again
_FOLLOW_S = 0.5
_TOUCHING_SHARE = 0.7
_ALONE_SHARE = 0.9  # of the load: with less, something else carries the rest
_TEST_SHARE = 0.2  # of the lifting speed: where the load comes on by the lift alone, it does so within millimetres
_COMES_ON_S = 4.0  # in which the push of a test lift would grow to the heaviest object
_ROSE_M = 0.008  # beyond what an estimate wanders by meanwhile
_CATCH_UP = 4.0  # 1/s
_LOOSE_SHARE = 0.75  # of the tension with which the arm carried; with less it has lost what it held
_LOOSE_LIGHT_SHARE = 0.8  # of the load, under which it counts as gone from an arm that is loose
_GONE_SHARE = 0.35  # the same where it may have met something; less would find a lost one too late
_PROPPED_SHARE = 0.85  # of the load, under which something else carries part of it; weighing errs by 6 %
_AGAIN_M = 0.1  # that a load is lifted off what it met
_GRIP_S = 1.0
_GRIP_SIGMA = (0.015, 0.03, 0.015)  # m, base axes: along the bend, along the object's axis, along the arm


def track_load(s: Situation) -> Load:
    """The load after this cycle; a mean begins anew with every lift."""
    load = _lifted(s)
    if not s.external:
        load = replace(load, before=0.0)  # a flight stack that is flown by somebody else begins anew
    if s.state.phase is not Phase.VERIFY or not s.grasping:
        return replace(load, found=None, found_s=0.0)
    if s.elapsed < _steady_s(s) and not math.isnan(load.now):
        load = replace(load, before=max(load.now, 0.0))
    found = _found(s, load.now)
    return replace(load, found=found, found_s=load.found_s + s.dt if found is load.found else 0.0)


def _found(s: Situation, now: float) -> Found | None:
    if math.isnan(now):
        return None
    grasp = s.config.grasp
    if now > grasp.mass_max_kg:
        return Found.TOO_MUCH
    return Found.ENOUGH if now >= grasp.mass_min_kg else Found.LITTLE


def _lifted(s: Situation) -> Load:
    state = s.state
    if not s.vehicle_fresh:
        return interrupted(state.load)
    lag = ROTOR_LAG_S + (_ARDUPILOT_LAG_S if s.config.vehicle.autopilot == "ardupilot" else 0.0)
    mass, lifted = s.config.vehicle.mass_kg, _surely_lifted(s)
    load = watch_load(state.load, s.facts.vehicle, mass, s.dt, lifted=lifted, lag_s=lag)
    if state.phase not in CARRYING:
        return replace(load, grip=0.0, light_s=0.0, propped_s=0.0)
    # before it is weighed, what the test lift found at least
    little = _gone_share(s) * load.mass if load.known else LIGHT_SHARE * s.config.grasp.mass_min_kg
    light = load.now < little
    propped = state.phase is Phase.PLACE and load.known and little <= load.now < _PROPPED_SHARE * load.mass
    load = replace(
        load,
        grip=low_pass(load.grip, max(s.tensions, default=0.0), s.dt, _GRIP_S),
        light_s=load.light_s + s.dt if light else 0.0,
        propped_s=load.propped_s + s.dt if propped else 0.0,
    )
    return weigh(load, s.dt) if state.phase is not Phase.PLACE and not light else load


def _surely_lifted(s: Situation) -> float | None:
    """What the rotors lift besides the vehicle, kg, so that they may be learnt from; None: nobody knows."""
    state = s.state
    if s.gripping and state.phase in (Phase.CONTACT, Phase.CLOSE):
        return None  # the tip may stand on the object
    if state.phase in _UNTOUCHED:
        return None if _just_met(s) else 0.0
    if state.phase is Phase.CLOSE and beside.is_free(s):
        return 0.0
    if state.phase is Phase.CARRY and state.load.settled and not state.load.light_s:
        return state.load.mass  # whatever the rotors need more from now on is the battery's fault
    return None


def _gone_share(s: Situation) -> float:
    """Of a load that is known, under which it counts as off the arm."""
    placing = s.state.phase is Phase.PLACE
    if s.gripping:
        if placing and low(s):
            return _TOUCHING_SHARE  # what touches down is let go before the vehicle sways about it
        return _LOOSE_LIGHT_SHARE if gripper.is_shut(s) else LIGHT_SHARE
    loose = max(s.tensions, default=0.0) < _LOOSE_SHARE * s.state.load.grip
    if placing and not low(s):
        return LIGHT_SHARE if loose else _GONE_SHARE  # what meets something on its way down is not lost
    return _LOOSE_LIGHT_SHARE if loose else LIGHT_SHARE


def _just_met(s: Situation) -> bool:
    """Whether the arm may still lie against what it met, which carries a tenth of a newton and more of it."""
    if s.state.phase is Phase.REACH:
        return s.state.force.above_s > 0.0
    return s.state.phase is Phase.CONTACT and s.elapsed < _COMES_OFF_S


def prepare(s: Situation) -> State:
    """Memory at the entry of the present phase of a grasp, after what it has in common with a perch."""
    state = s.state
    match state.phase:
        case Phase.APPROACH:  # from here on the way back is known, whatever comes
            return replace(state, contact_w=s.place(0.0))
        case Phase.CONTACT if s.gripping:
            return gripper.touching(s)
        case Phase.VERIFY:  # from here the object is lifted, and here it is set down again
            place = gripper.lifted_from(s) if s.gripping else state.position
            anchor = Anchor(place, s.facts.vehicle.attitude_wb, state.tension)
            test = (0.0, 0.0, -s.config.grasp.verify_lift_m)
            reference = None if state.reference is None else replace(state.reference, position=place)
            return replace(state, anchor=anchor, rest=place, offset=test, bend_goal=state.bend, reference=reference)
        case Phase.LIFT:  # what the object weighs is found anew
            load = replace(state.load, mass=0.0, weighed_s=0.0, light_s=0.0, propped_s=0.0)
            return replace(state, offset=sub(_up(s), s.probe), load=load)
        case Phase.PLACE:
            return replace(state, way_m=_way_down(s))
        case Phase.RELEASE if state.anchor is not None:  # of a closed arm, wherever that is: out as it came in
            closed = state.position  # where it rests on the object, and not where it was asked to sink to
            arc = 0.0 if s.gripping else s.config.perch.contact_arc_m
            contact = sub(closed, scale(s.straight_w, arc))
            return replace(state, contact_w=contact, anchor=None)
    return state


def settle(s: Situation) -> State:
    """Memory while a closed arm rests on its object: the set-point follows the vehicle, so nothing winds up.

    Up to a push that lifts no object yet: PX4's height wanders by a centimetre within half a second.
    """
    state, grasp = s.state, s.config.grasp
    if state.phase is not Phase.VERIFY or state.anchor is None or not s.vehicle_fresh:
        return state
    pushed_s = _COMES_ON_S * grasp.mass_min_kg / grasp.mass_max_kg if _comes_on(s) else 0.0
    if s.elapsed >= _steady_s(s) + pushed_s:
        return state
    rest = low_pass_vec(s.rest, state.position, s.dt, _FOLLOW_S)
    return replace(state, rest=rest, anchor=replace(state.anchor, position_w=rest))


def goal(s: Situation) -> tuple[Vec3, float]:
    """Where the reference goes with a load, and how fast."""
    grasp = s.config.grasp
    if s.state.phase is Phase.VERIFY:
        x, y, z = s.rest
        if s.elapsed < _steady_s(s):
            return s.rest, grasp.lift_speed_m_per_s
        if _comes_on(s):
            return (x, y, min(z, s.state.position[2])), grasp.lift_speed_m_per_s
        return add(s.rest, s.state.offset), _test_speed(s)
    if s.state.phase is Phase.LIFT:
        return add(s.probe, s.state.offset), grasp.lift_speed_m_per_s
    if s.state.feedforward and s.state.reference is not None and _touching_down(s):
        return s.state.reference.position, grasp.lift_speed_m_per_s
    down, here = s.setting_down, s.facts.vehicle.position_w
    # aside of its place it waits in the air; what lies there with one end already, and holds it aside, goes on down
    if norm((down[0] - here[0], down[1] - here[1], 0.0)) > _ABOVE_M and not lies_down(s):
        return (down[0], down[1], s.state.reference.position[2] if s.state.reference else here[2]), (
            grasp.lift_speed_m_per_s
        )
    share = _SLOWLY if s.probe[2] - here[2] < _NEAR_GROUND_M else 1.0
    return down, share * grasp.lift_speed_m_per_s


def _up(s: Situation) -> Vec3:
    """Vehicle position to lift to: above where the object was taken; lifted again, above what it met as well."""
    x, y, _ = s.setting_down
    z = s.probe[2] - s.config.grasp.lift_height_m
    return x, y, min(z, s.facts.vehicle.position_w[2] - _AGAIN_M) if s.state.load.propped_s else z


def _test_speed(s: Situation) -> float:
    """Of the reference in a test lift, m/s: slow, but not left behind by an object that breaks free."""
    fast = s.config.grasp.lift_speed_m_per_s
    if s.gripping or s.state.reference is None:
        return fast
    above = max(s.state.reference.position[2] - s.state.position[2], 0.0)
    return min(_TEST_SHARE * fast + _CATCH_UP * above, fast)


def _way_down(s: Situation) -> float:
    """Way of setting down, m; the last of it, flown slowly, for as much as it takes."""
    reference, down = s.state.reference, s.setting_down
    x, y, z = sub(down, s.facts.vehicle.position_w if reference is None else reference.position)
    slow = _NEAR_GROUND_M + down[2] - s.probe[2]
    return math.hypot(x, y) + max(z, 0.0) + slow * (1.0 / _SLOWLY - 1.0)


def _touching_down(s: Situation) -> bool:
    """Whether some of the load is off, near the height at which it was taken: the push does the rest."""
    load = s.state.load
    return low(s) and load.known and load.now < _TOUCHING_SHARE * load.mass


def may_touch(s: Situation) -> bool:
    """Whether what is carried may touch what it lay on."""
    load = s.state.load
    return s.state.phase is Phase.PLACE and (low(s) or load.now < _ALONE_SHARE * load.mass)


def push(s: Situation) -> Vec3:
    """Acceleration to ask for that holds the load up, m/s^2, world axes.

    Once weighed, the load is what it is. While it comes on or goes off, it is what the rotors lift at this moment;
    that is no feedback of a held arm's force, since nothing but the object's own weight is behind it, and never
    more than may be lifted.
    """
    load, grasp = s.state.load, s.config.grasp
    if s.state.phase is Phase.VERIFY and s.elapsed < _steady_s(s):
        return ZERO  # it would lift the object before the vehicle is asked up
    if load.known and s.state.phase in (Phase.LIFT, Phase.CARRY):
        mass = load.mass
    elif math.isnan(load.now):
        mass = load.mass if load.known and s.state.phase in CARRYING else 0.0
    else:
        most = load.mass if load.known and s.state.phase is Phase.PLACE else grasp.mass_max_kg
        mass = min(max(load.now, _pluck(s), 0.0), most)
    # ArduPilot follows the acceleration that it measures, and so makes what is asked on any curve
    curve = None if s.config.vehicle.autopilot == "ardupilot" else load.curve
    gain = 1.0 if curve is None else curve.gain
    pushed = max(mass - load.before, 0.0)  # the rest its integrator has taken on by itself, and keeps
    return (0.0, 0.0, -pushed * GRAVITY / s.config.vehicle.mass_kg / gain)


def _steady_s(s: Situation) -> float:
    """How long a closed arm rests before the test lift. One whose tip alone is held does not: `gripper.pluck`."""
    return 0.0 if s.gripping else _STEADY_S


def _pluck(s: Situation) -> float:
    """Load, kg, that the push of a test lift is for whatever is felt so far, until the vehicle rises."""
    if s.state.phase is not Phase.VERIFY:
        return 0.0
    if s.gripping:
        return gripper.pluck(s)
    return s.config.grasp.mass_max_kg * (s.elapsed - _STEADY_S) / _COMES_ON_S if _comes_on(s) else 0.0


def _comes_on(s: Situation) -> bool:
    """Whether a wrapped arm takes its load by the push alone: an object that still lies holds the vehicle down.

    Asked up meanwhile it would come away from where it is asked to be, and the flight stack's integrator wind up.
    """
    if s.gripping or not s.state.feedforward or math.isnan(s.state.load.now):
        return False
    since = s.elapsed - _STEADY_S
    return 0.0 <= since < _COMES_ON_S and above(s) <= _ROSE_M


def payload(s: Situation) -> Payload | None:
    """What the arm carries, for the mechanics; None while it is not known.

    A closed arm is a circle around the object, so the object's middle is at its centre: one radius from the tip,
    towards the side to which the arm is bent. A gripper has it between its jaws.
    """
    load = s.state.load
    if s.state.phase not in CARRYING or not load.known:
        return None
    x, y = s.towards_bar_a
    coming_off = s.state.phase is Phase.PLACE and math.isfinite(load.now)
    mass = min(load.mass, load.now) if coming_off else load.mass
    if s.gripping:
        return Payload(max(mass, 0.0), np.array((0.0, 0.0, s.config.gripper.depth_m)))
    return Payload(max(mass, 0.0), _loop_radius(s) * np.array((x, y, 0.0)))


def report(s: Situation) -> PayloadReport | None:
    """ARM_PAYLOAD of this cycle; None while nothing is carried."""
    load = s.state.load
    if s.state.phase not in CARRYING or not load.weighed_s:
        return None
    x, y = s.towards_bar_a
    R, radius = s.mount.rotation, _loop_radius(s)
    place = (radius * x, radius * y, 0.0)
    if s.gripping:
        place = (0.0, 0.0, s.parameters.model.parameters.L + s.config.gripper.depth_m)
    centre = s.mount.position + R @ place
    spread = grip_sigma_a(s)
    sigma = [math.sqrt(sum((R[i, j] * spread[j]) ** 2 for j in range(3))) for i in range(3)]
    return PayloadReport(
        load.mass,
        load.sigma(s.config.vehicle.mass_kg),
        (float(centre[0]), float(centre[1]), float(centre[2])),
        (sigma[0], sigma[1], sigma[2]),
        valid=load.known,
    )


def grip_sigma_a(s: Situation) -> Vec3:
    """One sigma of where the middle of what is carried sits, m, base axes."""
    x, y = s.towards_bar_a
    along, across, down = _GRIP_SIGMA
    return math.hypot(along * x, across * y), math.hypot(along * y, across * x), down


def _loop_radius(s: Situation) -> float:
    """Radius of the closed arm's middle line, m."""
    return s.parameters.model.parameters.L / s.config.perch.wrap_bend_rad
