"""How the vehicle's weight goes from its motors to an arm above, and back.

The thrust is taken down by an acceleration in the set-point while the reference stays with the vehicle: both
autopilots add it behind their position and velocity loops, which then have nothing to integrate. What the motors
really do is read from their throttle, since an autopilot's idea of its hover thrust may drift while something else
carries it. docs/adr/0018 says why neither a lowered position nor a disarm is used.
"""

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import Vec3
from arm_companion.mission.motion import ZERO, Reference, add, dot, follow, low_pass, low_pass_vec, norm, ramp, sub
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, Sharing, State
from arm_companion.values import replace

SHARING = frozenset({Phase.LOAD_TRANSFER, Phase.HANGING, Phase.TAKE_BACK})
"""Phases in which we say how much of the weight the motors carry."""

SUSPENDED = SHARING | {Phase.HANG_HOLD}
"""Phases in which the arm may be all that keeps the vehicle from falling."""

_HOVERING = frozenset({Phase.APPROACH, Phase.REACH})
_LETS_GO = frozenset({Phase.UNLOAD, Phase.RELEASE})
_HOVER_S = 2.0  # the hover's throttle is a mean over so long
_PLACE_S = 3.0  # a slip is a move away from where the vehicle was on the mean of so long
_CARRIED_S = 1.0
_DROPPED_SHARE = 0.7  # of hover thrust, under which the vehicle falls by 3 m/s^2, or leans on the arm
_DROPPED_S = 0.2
_LEAST_THROTTLE = 0.25  # with which a vehicle may fly whose hover's throttle nobody knows
_TRIM_PER_S = 0.3  # of the throttle's miss, slower than any autopilot's own loops
_TRIM_MAX = 2.0  # m/s^2
_URGENT = 4.0  # times faster when something is wrong
_LIFT_M = 0.10  # over where it hung, beyond which the set-point does not rise
_ROSE_M = 0.04  # a vehicle that rose by so much hangs no more, whatever its throttle
_OFF_THE_GROUND_M = 0.3  # an autopilot that thinks it has landed takes off to a set-point so high
_CLIMB_M_PER_S2 = 0.6
_BELOW_GRIP_M = 0.02  # a closing wrap draws the arm's mount up beside the bar: it is opened from so much lower


# --- what is known of the load ---


def throttle_known(s: Situation) -> bool:
    """Whether the autopilot tells what its motors do."""
    return s.facts.vehicle.throttle_age_s <= s.config.hang.throttle_timeout_s


def motor_share(s: Situation) -> float | None:
    """Thrust of the motors, share of the free hover's; None when nobody knows."""
    hover = s.state.sharing.hover
    return s.facts.vehicle.throttle / hover if hover > 0.0 and throttle_known(s) else None


def sunk(s: Situation) -> float:
    """How far the vehicle is below where it was when its load began to move, m."""
    return s.state.position[2] - s.state.sharing.first


def slid(s: Situation) -> float:
    """The greater of the vehicle's moves down and along the bar within the last seconds, m: swinging is no slip."""
    away = sub(s.state.position, s.state.sharing.place)
    return max(away[2], abs(dot(away, s.held_axis_w)))


def keep_sharing(s: Situation) -> Sharing:
    """What is known of the load after this cycle."""
    load, vehicle, hang = s.state.sharing, s.facts.vehicle, s.config.hang
    if s.state.phase in _HOVERING and throttle_known(s) and vehicle.armed and not vehicle.landed:
        known = load.hover > 0.0
        hover = low_pass(load.hover, vehicle.throttle, s.dt, _HOVER_S) if known else vehicle.throttle
        return replace(load, hover=hover)
    if s.state.phase not in SHARING:
        return replace(load, dropped_s=load.dropped_s + s.dt if _motors_drop(s) else 0.0)
    away = sub(s.state.position, load.place)
    rests = load.share == load.step and norm(away) < hang.rest_m
    return replace(
        load,
        place=low_pass_vec(load.place, s.state.position, s.dt, _PLACE_S),
        rested_s=load.rested_s + s.dt if rests else 0.0,
        carried_s=load.carried_s + s.dt if _motors_carry(s) else 0.0,
    )


def _motors_carry(s: Situation) -> bool:
    """Whether the motors carry the vehicle: by their throttle, else because it has risen off the arm.

    A height drifts by as much, so nothing has risen with motors that idle, nor in the hands of a pilot whose throttle
    is not told.
    """
    if s.state.sharing.share < 1.0 or not s.facts.vehicle.armed or s.facts.vehicle.landed:
        return False
    share = motor_share(s)
    if share is not None:
        return share >= s.config.hang.carried_share
    lifts = s.facts.vehicle.throttle >= _LEAST_THROTTLE if throttle_known(s) else s.external and s.state.streaming
    return lifts and -sunk(s) >= _ROSE_M


def carried(s: Situation) -> bool:
    """Whether the motors have carried the vehicle for long enough to let go."""
    return s.state.sharing.carried_s >= _CARRIED_S


def _motors_drop(s: Situation) -> bool:
    """Whether the motors do not carry the vehicle while the arm lets go of the bar; not judged without a throttle."""
    if s.state.phase not in _LETS_GO or not throttle_known(s):
        return False
    share = motor_share(s)
    return s.facts.vehicle.throttle < _DROPPED_SHARE * _LEAST_THROTTLE if share is None else share < _DROPPED_SHARE


def dropped(s: Situation) -> bool:
    """Whether the motors have let the vehicle down for so long that it is no manoeuvre."""
    return s.state.sharing.dropped_s >= _DROPPED_S


# --- what is done about it ---


def begin(s: Situation) -> State:
    """Memory at the entry of the present phase, which is one of SUSPENDED."""
    state, load, position = s.without_far_bar(), s.state.sharing, s.state.position
    fresh = replace(load, rested_s=0.0, carried_s=0.0)
    match state.phase:
        case Phase.LOAD_TRANSFER:
            load = replace(fresh, share=1.0, step=1.0, trim=0.0, place=position, first=position[2])
            rest = add(s.probe, (0.0, 0.0, _BELOW_GRIP_M))
            return replace(state, sharing=_next_step(s, load, -1.0), rest=rest)
        case Phase.TAKE_BACK:
            load = replace(fresh, place=position, first=position[2])
            return replace(state, sharing=_next_step(s, load, 1.0))
        case Phase.HANG_HOLD:
            load = replace(fresh, share=1.0, step=1.0, trim=0.0)
            return replace(state, sharing=load, bend=s.bend, bend_goal=s.bend, pulls=())
    return replace(state, sharing=fresh)


def share_on(s: Situation) -> Sharing:
    """The shares after this cycle: towards the present step's, and on to the next one once the vehicle rests."""
    load, hang = s.state.sharing, s.config.hang
    if s.state.phase not in SHARING:
        return load
    urgent = s.state.phase is Phase.TAKE_BACK and bool(s.state.errors)
    if urgent:
        load = replace(load, step=1.0)
    elif load.rested_s >= hang.rest_s and s.state.phase is not Phase.HANGING:
        load = _next_step(s, load, -1.0 if s.state.phase is Phase.LOAD_TRANSFER else 1.0)
    share = ramp(load.share, load.step, hang.share_per_s * (_URGENT if urgent else 1.0), s.dt)
    trim = load.trim
    if share == 1.0:
        trim = 0.0
    elif (measured := motor_share(s)) is not None:
        trim += _TRIM_PER_S * (measured - share) * GRAVITY * s.dt
    return replace(load, share=share, trim=min(max(trim, -_TRIM_MAX), _TRIM_MAX))


def _next_step(s: Situation, load: Sharing, way: float) -> Sharing:
    """The load with the next step's share, down (-1) or up (+1); a new step has not rested yet."""
    hang = s.config.hang
    stride = (1.0 - hang.idle_share) / hang.steps
    step = load.step + way * stride
    if step < hang.idle_share + 0.5 * stride:
        step = hang.idle_share
    elif step > 1.0 - 0.5 * stride:
        step = 1.0
    return load if step == load.step else replace(load, step=step, rested_s=0.0)


def unloading(s: Situation) -> Vec3:
    """Acceleration, m/s^2, world axes, that leaves the motors their share of the weight; never more than gravity."""
    load = s.state.sharing
    return (0.0, 0.0, min(max((1.0 - load.share) * GRAVITY + load.trim, 0.0), GRAVITY))


def hung_reference(s: Situation, before: Reference) -> Reference:
    """Where the vehicle is asked to be while the arm has a share of its weight.

    With the vehicle itself, so that no loop winds up; once its motors are asked for all of the weight, slowly up,
    until they have it.
    """
    state = s.state
    if s.facts.vehicle.landed and state.phase is Phase.TAKE_BACK:
        x, y, z = state.position
        return Reference((x, y, z - _OFF_THE_GROUND_M), ZERO, before.yaw)
    if state.phase is not Phase.TAKE_BACK or state.sharing.share < 1.0:
        return Reference(state.position, ZERO, before.yaw)
    x, y, _ = state.sharing.place if state.anchor is None else s.rest
    top = state.sharing.first - _LIFT_M
    if before.position[2] < top:  # it has just left what it thought was the ground
        before = Reference(state.position, ZERO, before.yaw)
    return follow(
        before,
        (x, y, top),
        before.yaw,
        speed=s.config.hang.lift_m_per_s,
        acceleration=_CLIMB_M_PER_S2,
        yaw_rate=0.0,
        dt=s.dt,
    )
