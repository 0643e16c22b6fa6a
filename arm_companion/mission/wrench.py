"""The reaction wrench of the arm on the airframe, predicted from what the phase says about its surroundings."""

import math
from contextlib import suppress

import numpy as np

from arm_companion.arm import arc, statics
from arm_companion.arm.model import ArmSolution, Hold, HoldKind
from arm_companion.arm.reaction import GRAVITY, BodyMotion, Reaction, Spread, reaction
from arm_companion.arm.tension import statics_sigma
from arm_companion.errors import ModelError
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array
from arm_companion.geometry.se3 import Pose
from arm_companion.geometry.wrench import rotation_matrix
from arm_companion.mission import carry
from arm_companion.mission.facts import StiffnessReport, Vec3, WrenchReport, WrenchSource
from arm_companion.mission.held_arm import holding_lean
from arm_companion.mission.hung_wrench import hung_wrench
from arm_companion.mission.motion import ZERO, add, scale, sub, unrotate
from arm_companion.mission.sharing import SHARING, SUSPENDED
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CALIBRATES, CARRYING, TIP, Anchor, Phase, Prediction
from arm_companion.mission.tendon_watch import Expected
from arm_companion.values import replace

_ANCHORED = frozenset({Phase.PERCHED, Phase.UNLOAD, Phase.VERIFY})
_TOUCHING = CARRYING | SUSPENDED | frozenset({Phase.CONTACT, Phase.WRAP, Phase.CLOSE, Phase.RELEASE, Phase.HOLDING})
_ZEROS_UNKNOWN = CALIBRATES | {Phase.STARTUP}
# a tip that reaches for a bar or a point may touch something at any moment
_FREE = frozenset(Phase) - _ANCHORED - _TOUCHING - TIP - _ZEROS_UNKNOWN - {Phase.REACH}
_FREE_TENSION_SPREAD = 0.05  # one sigma of the statics' tensions from the arm's parameters, relative
_HELD_TENSION_SPREAD = 0.1  # the same with a bar in the way
_HELD_TENSION_SIGMA = 1.0  # N, on top of it
_LEAST_HZ = 5.0
_RETRY_S = 0.25
# the vehicle's position since the grip is known to a few millimetres, and a wrap rolls by as much before it holds
_FELT_SIGMA = (0.1, 0.1, 1.5)  # N, world axes; down, where the thrust is not known
_WIND_SIGMA = 1.0  # N, by which the wind's force on a hovering vehicle wanders about its mean
_WIND_S = 30.0  # and how long it remembers
_SLIDE_SIGMA = (0.0, 0.0, 10.0)  # N, world axes: by how much the elastic model is off where the wrap slides
_MOMENT_SIGMA = 0.15  # N m, of what the bar passes on besides the force
_SPREAD = Spread(hold_position=0.005, hold_rotation=0.03)
_DRAG_SHARE = 0.15  # of the load's weight: what touches its cradle is dragged aside, and swings
_UPPER = np.triu_indices(6)
_NAN3: Vec3 = (math.nan, math.nan, math.nan)


def predict(s: Situation) -> Prediction:
    """The newest prediction: the last one while it is young, else a new one.

    Mechanics take milliseconds, so they run at the rate of ARM_REACTION_WRENCH and at each change of phase. To find
    that an anchored arm has no equilibrium takes a hundred times as long, so then they are asked less often, each time
    from the last equilibrium that there was. Its stiffness goes on saying what a move takes: an estimated position that
    wanders off by more than the arm could bear says nothing about the arm.
    """
    last = s.state.prediction
    period = 1.0 / max(s.config.rates.wrench_hz, _LEAST_HZ)
    if last is not None and last.wrench.source is WrenchSource.ANCHORED and math.isnan(last.wrench.force_b[0]):
        period = max(period, _RETRY_S)
    if last is not None and s.t - last.t < period - 0.5 * s.dt and s.state.since < s.t:
        return last
    free, known, found = equilibria(s)
    holding = _holding(s)
    solution = (known if found else None) if holding else free
    tip = _NAN3 if free is None else _vec3(free.tip_position)
    return Prediction(
        s.t,
        _wrench(s, solution, holding=holding),
        tip,
        s.bend,
        _lean(s, known),
        _tensions(s, free),
        free,
        known,
        _stiffness(s, solution),
    )


def equilibria(s: Situation) -> tuple[ArmSolution | None, ArmSolution | None, bool]:
    """The free arm, None where none was found; the last anchored one while something is, and whether it is of now."""
    if s.state.phase in CALIBRATES:  # of tendons that are slack, and whose zeros are looked for, nothing follows
        return None, None, False
    last = s.state.prediction
    free = None
    with suppress(ModelError):
        free = _free(s, None if last is None else last.free)
    if not _holding(s):
        return free, None, False
    known = None if last is None else last.anchored
    try:
        return free, anchored(s, s.state.position, known), True
    except ModelError:
        return free, known, False


def _holding(s: Situation) -> bool:
    """Whether the arm is an anchor for the vehicle."""
    return s.state.phase in _ANCHORED and s.state.anchor is not None and not s.grasping


def _free(s: Situation, start: ArmSolution | None) -> ArmSolution:
    """The arm as it hangs with nothing at its tip but what it carries.

    Raises:
        ModelError: no equilibrium was found.
    """
    pulls, gravity = np.asarray(s.pulls), np.asarray(s.gravity_a)
    return s.parameters.model.free(pulls, gravity, payload=carry.payload(s), start=start)


def _tensions(s: Situation, free: ArmSolution | None) -> tuple[Expected, ...]:
    """What the statics say of the tendons' tensions.

    Of a free arm the rod model knows them. Where a bar may be in the way, the unloaded arm's are what a tendon has
    at least, roughly: a bar makes the tendon that grips it tighter and leaves the others about alone.
    """
    arm, zero_sigma = s.parameters.model.parameters, s.facts.calibration.zero_sigma
    if s.state.phase in _FREE:
        if free is None:
            return ()
        tension, spread, extra = free.tension, _FREE_TENSION_SPREAD, 0.0
    elif s.state.phase in _ZEROS_UNKNOWN:
        return ()
    else:
        tension = statics.stretch_tension(arm, np.asarray(s.bend), np.asarray(s.pulls))
        spread, extra = _HELD_TENSION_SPREAD, _HELD_TENSION_SIGMA
    return tuple(
        Expected(tau, math.hypot(statics_sigma(tau, k, zero_sigma, spread), extra), exact=s.state.phase in _FREE)
        for tau, k in zip(tension.tolist(), arm.k_T.tolist(), strict=True)
    )


def grip(s: Situation) -> Anchor:
    """The anchor for a grip that has just been taken.

    The hovering vehicle carries no load then, so the part between base and bar has the bend that its tendons
    alone give it: an arc with the moment `sum r tau (cos phi, sin phi)` all along.
    """
    attitude, tension = s.facts.vehicle.attitude_wb, s.state.tension
    model = s.parameters.model
    arm, length = model.parameters, s.config.perch.free_arc_m
    u = arm.H.T @ np.asarray(tension) * (length / arm.EI)
    R_as, p_as = arc.tip_rotation(u), arc.tip_position(u, length)
    section, bar = so3.to_quaternion(R_as), s.bar
    free = Anchor(s.state.position, attitude, tension, _vec3(p_as), section, (), bar.radius, bar.axis_w)
    try:
        held = model.anchor(_hold(s, free), np.asarray(s.pulls), np.asarray(tension), np.asarray(s.gravity_a))
    except ModelError:
        return free
    return replace(free, beyond=() if held.beyond is None else tuple(float(b) for b in held.beyond))


def anchored(s: Situation, position_w: Vec3, start: ArmSolution | None) -> ArmSolution:
    """The arm between the bar and an airframe at `position_w` with the present attitude.

    Args:
        s: the cycle.
        position_w: of the vehicle, m.
        start: a neighbouring solution, which saves most of the time.

    Raises:
        ModelError: nothing is anchored, or no equilibrium was found.
    """
    anchor = s.state.anchor
    if anchor is None or not anchor.beyond:
        raise ModelError("nothing is anchored")
    then = Pose.of_quaternion(anchor.attitude_wb, np.asarray(anchor.position_w)) @ s.mount
    now = Pose.of_quaternion(s.facts.vehicle.attitude_wb, np.asarray(position_w)) @ s.mount
    hold = _hold(s, anchor).seen_from(now.inverse() @ then)
    return s.parameters.model.held(np.asarray(s.pulls), hold, np.asarray(s.gravity_a), start=start)


def _hold(s: Situation, anchor: Anchor) -> Hold:
    """The grip in base axes of the moment in which it was taken.

    A closed wrap rolls and turns on the bar but stays on it: what holds is the point on the bar's axis.
    """
    x, y = s.towards_bar_a
    radius = s.bar.radius if anchor.bar_radius is None else anchor.bar_radius
    centre = radius + s.config.perch.disk_radius_m
    return Hold(
        s.config.perch.free_arc_m,
        Pose.of_quaternion(anchor.section_attitude_as, np.asarray(anchor.section_position_a)),
        HoldKind.PINNED,
        pivot=np.array((centre * x, centre * y, 0.0)),
        beyond=np.asarray(anchor.beyond) if anchor.beyond else None,
    )


def _wrench(s: Situation, solution: ArmSolution | None, *, holding: bool) -> WrenchReport:
    """ARM_REACTION_WRENCH: a number only where the model stands for it."""
    if holding:
        source = WrenchSource.ANCHORED
    else:
        source = WrenchSource.CONTACT if _touches(s) else WrenchSource.FREE
        if carry.payload(s) is not None:
            source = WrenchSource.PAYLOAD
    if solution is None or not s.vehicle_fresh:
        return _nothing(source)
    vehicle = s.facts.vehicle
    try:
        found = reaction(
            solution,
            s.mount,
            np.asarray(s.gravity_a),
            _motion(s, holding=holding),
            spread=_spread(s, solution),
            age=max(vehicle.position_age_s, vehicle.attitude_age_s),
        )
    except ModelError:
        return _nothing(source)
    if holding:
        found = _weigh(found, s)
    elif (load := carry.payload(s)) is not None:
        found = _gripped(found, s, load.mass)
    # how the bar pushes on an arm that touches but does not hold is not known
    report = _report(found, source, valid=source is not WrenchSource.CONTACT and _shape_known(s))
    return hung_wrench(s, report, solution.moments.mass) if s.state.phase in SHARING else report


def _motion(s: Situation, *, holding: bool) -> BodyMotion:
    """Of the airframe: a vehicle tilts to accelerate, and what hangs on it feels thrust then, and not the tilt.

    Up and down none is told: our set-points go up and down gently, and the tilt says nothing of it.
    """
    vehicle = s.facts.vehicle
    rate = np.asarray(vehicle.rate_b)
    if holding:  # it stands still, and what is felt is the arm
        return BodyMotion(rate=rate)
    north, east = s.state.force.acceleration(vehicle, s.config.vehicle.mass_kg)
    return BodyMotion(so3.from_quaternion(vehicle.attitude_wb).T @ np.array((north, east, 0.0)), rate)


def _shape_known(s: Situation) -> bool:
    """Whether every tendon is where it says: of a silent servo nobody knows, nor of one that lost its turns."""
    return all(tendon.homed and not tendon.silent for tendon in s.facts.tendons)


def _touches(s: Situation) -> bool:
    """Whether something unknown may be pushing on the arm."""
    return s.state.phase in _TOUCHING or (s.grasping and s.state.phase in _ANCHORED)


def _spread(s: Situation, solution: ArmSolution) -> Spread:
    """What the prediction rests on; of a load, its weight."""
    if carry.payload(s) is None:
        return _SPREAD
    sigma = s.state.load.sigma(s.config.vehicle.mass_kg) / max(solution.moments.mass, 1e-6)
    return replace(_SPREAD, mass=math.hypot(_SPREAD.mass, sigma))


def _gripped(found: Reaction, s: Situation, mass: float) -> Reaction:
    """With what is not known of a load besides its weight: where in the grip it sits, and what it drags along.

    Its weight turns about another place then, and so does what is not known of the force: under a vehicle that hovers
    level nothing else turns it about the vertical.
    """
    weight_b = mass * np.asarray(unrotate(s.facts.vehicle.attitude_wb, (0.0, 0.0, GRAVITY)))
    R, place = s.mount.rotation, np.square(carry.grip_sigma_a(s))
    force, torque = found.sigma[:3] ** 2, found.sigma[3:] ** 2
    if carry.may_touch(s):
        drag = (_DRAG_SHARE * s.state.load.mass * GRAVITY) ** 2 * np.array((1.0, 1.0, 0.0))
        lever = np.square(so3.hat(s.mount.position + R[:, 2] * s.parameters.model.parameters.L))
        force, torque = force + drag, torque + lever @ drag
    torque = torque + np.square(so3.hat(weight_b) @ R) @ place + np.square(so3.hat(np.sqrt(force))) @ (R**2 @ place)
    return replace(found, sigma=np.sqrt(np.concatenate((force, torque))))


def _weigh(found: Reaction, s: Situation) -> Reaction:
    """Model and motion, each axis by its variance: a millimetre is half a newton, but the vehicle feels a tenth.

    What the vehicle feels comes from the force observer, north and east. The longer ago that was tared, the more wind
    may be in it; that is in the sigma alone, since a model that is off by 1 to 2 N and wanders by as much in every
    simulated perch makes the force worse where it is given the weight (0.35 N off became 0.93, 0.14 in gusts 0.52),
    even with its offset learnt at the grip. Down, where a wrap slides on its bar rather
    than stretch, it is the arm's weight and what the rotors lift beyond the vehicle's; as far as their thrust is not
    known, the arm's weight less our own push, give or take what the bar's friction holds. The bar passes on a moment
    besides the force that nothing measures; it is only in the sigma.
    """
    R_wb = so3.from_quaternion(s.facts.vehicle.attitude_wb)
    model = R_wb @ found.wrench[:3]
    model_variance = R_wb**2 @ found.sigma[:3] ** 2 + np.square(_SLIDE_SIGMA)
    down, down_variance = _carried(s)
    weight = s.parameters.model.parameters.mass * GRAVITY  # of the whole arm: the wrap's, too, was the rotors' before
    north, east, _ = add((*s.state.force.residual, 0.0), _unseen(s))
    felt = np.array((north, east, weight + down))
    felt_variance = np.array((*np.square(_FELT_SIGMA[:2]), down_variance))
    share = felt_variance / (felt_variance + model_variance)
    force = R_wb.T @ (share * model + (1.0 - share) * felt)
    felt_variance[:2] += _wind_variance(s)
    sigma = np.sqrt(R_wb.T**2 @ (share**2 * model_variance + (1.0 - share) ** 2 * felt_variance))
    arm = s.mount.position
    lever = np.sqrt(np.square(so3.hat(arm)) @ sigma**2)
    return replace(
        found,
        wrench=np.concatenate((force, so3.cross(arm, force))),
        sigma=np.concatenate((sigma, np.hypot(lever, _MOMENT_SIGMA))),
    )


def _unseen(s: Situation) -> Vec3:
    """Force of the arm against our own push, N, world axes, as far as the observers have yet to see it."""
    return scale(sub(s.state.felt, s.state.lean), s.config.vehicle.mass_kg)


def _wind_variance(s: Situation) -> float:
    """Of what the wind has changed since the bias was found, N^2: a stiff arm takes it up, and the tilt tells nothing.

    The wind's force wanders about its mean and forgets where it was, so its change since then grows at first and then
    stays twice its own variance.
    """
    return 2.0 * _WIND_SIGMA**2 * -math.expm1(-s.state.force.bias_age_s / _WIND_S)


def _carried(s: Situation) -> tuple[float, float]:
    """Force of the bar on the arm, N, down, and its variance: our own push turned round, and what the rotors tell."""
    push, load, mass = -s.config.vehicle.mass_kg * s.state.lean[2], s.state.load, s.config.vehicle.mass_kg
    variance = _FELT_SIGMA[2] ** 2
    if math.isnan(load.now):
        return push, variance
    share = variance / (variance + (load.sigma_now(mass) * GRAVITY) ** 2)
    return push + share * (load.now * GRAVITY + _unseen(s)[2] - push), (1.0 - share) * variance


def _lean(s: Situation, solution: ArmSolution | None) -> Vec3:
    """Acceleration that holds the vehicle at its reference against the anchored arm, m/s^2, world axes.

    From the force at the *reference*: a force measured where the vehicle is would cancel the arm's own
    stiffness, which is positive feedback.
    """
    reference, anchor = s.state.reference, s.state.anchor
    if s.state.phase is not Phase.PERCHED or reference is None or anchor is None:
        return ZERO
    move = sub(reference.position, s.rest)
    return holding_lean(s, solution, move) if any(move) else ZERO


def _stiffness(s: Situation, solution: ArmSolution | None) -> StiffnessReport | None:
    """Tip compliance in body axes; None without a solution, or at a singular one."""
    if solution is None:
        return None
    try:
        C = solution.compliance
    except ModelError:
        return None
    R = rotation_matrix(s.mount)
    C = R @ C @ R.T
    C = 0.5 * (C + C.T)
    return StiffnessReport(tuple(C[_UPPER].tolist()))


def _nothing(source: WrenchSource) -> WrenchReport:
    return WrenchReport(_NAN3, _NAN3, _NAN3, _NAN3, source, valid=False, taut_margin=math.nan, residual=math.nan)


def _report(found: Reaction, source: WrenchSource, *, valid: bool) -> WrenchReport:
    return WrenchReport(
        _vec3(found.wrench[:3]),
        _vec3(found.wrench[3:]),
        _vec3(found.sigma[:3]),
        _vec3(found.sigma[3:]),
        source,
        valid=valid and found.valid,
        taut_margin=found.taut_margin,
        residual=found.residual,
    )


def _vec3(v: Array) -> Vec3:
    x, y, z = v.tolist()
    return x, y, z
