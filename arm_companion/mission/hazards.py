"""What can go wrong: guards that give their reason in words. The perch's table says what follows in which phase.

What lasts before it counts has its timer in `vigil`.
"""

import math

from arm_companion.mission.facts import Control
from arm_companion.mission.motion import norm, sub
from arm_companion.mission.situation import Situation

_SLIP_M = 0.12
_ASTRAY_S = 1.0
_DOUBTFUL_S = 1.0
_BLIND_S = 0.5
_UNHEARD_S = 5.0  # longer than servos take to be set up
_GROUND_LOST_S = 5.0
_TIGHT_S = 0.1
_ROCKS_RAD_PER_S = 0.3  # root mean square; what is held well stays under 0.2, in gusts too
_CALM_S = 2.0  # from the closing of the arm, which pulls the vehicle about
_FAR_OVER = 1.15  # times the limit; a reading's noise is a twelfth of it, one sigma
_OVERRUN_S = 0.1  # the longest step that a cycle believes


# --- the vehicle ---


def pilot_takes_over(s: Situation) -> str | None:
    """The autopilot left our mode: whoever did it, the vehicle is theirs."""
    if s.external or s.facts.vehicle.control is Control.FAILSAFE:
        return None
    return f"the pilot has the vehicle (mode {s.facts.vehicle.mode})"


def failsafe(s: Situation) -> str | None:
    """The autopilot is in an emergency and flies by itself."""
    return f"autopilot failsafe (mode {s.facts.vehicle.mode})" if s.facts.vehicle.control is Control.FAILSAFE else None


def disarmed(s: Situation) -> str | None:
    """The motors stand. Of an autopilot that has not been heard yet, nobody knows."""
    vehicle = s.facts.vehicle
    return "the vehicle is disarmed" if not vehicle.armed and vehicle.heartbeat_age_s < math.inf else None


def motors_stopped(s: Situation) -> str | None:
    """The motors stopped in this cycle; a vehicle that stood before is let go when a person says so."""
    return disarmed(s) if s.state.armed else None


def vehicle_lost(s: Situation) -> str | None:
    """State or heartbeat of the vehicle is too old."""
    v = s.facts.vehicle
    if s.vehicle_fresh:
        return None
    age = max(v.position_age_s, v.attitude_age_s)
    return f"vehicle state is {age:.2f} s old, heartbeat {v.heartbeat_age_s:.1f} s"


# --- the arm ---


def servo_fault(s: Situation) -> str | None:
    """A servo is silent, reports a hardware error, or no longer knows its turns."""
    return s.servo_fault


def servo_limp(s: Situation) -> str | None:
    """A tendon's servo that is well has no torque: asked in phases alone in which all of them hold or move the arm."""
    limp = next((i for i, tendon in enumerate(s.facts.tendons) if not tendon.torque), None)
    return None if limp is None or s.servo_fault is not None else f"tendon {limp + 1}: servo has no torque"


def unheard_at_start(s: Situation) -> str | None:
    """What the arm does now is not known, because a servo stays silent that the daemon waits for at its start."""
    if s.state.vigil.unheard_s <= _UNHEARD_S:
        return None
    return s.servo_fault or "the autopilot, which moves the gripper, is not heard"


def tendon_broken(s: Situation) -> str | None:
    """A tendon carries nothing where the statics say that it must."""
    return next((watched.broken for watched in s.state.watch if watched.broken), None)


def tendon_jumped(s: Situation) -> str | None:
    """A tendon's tension does not fit its displacement."""
    return next((watched.jumped for watched in s.state.watch if watched.jumped), None)


def grip_lost(s: Situation) -> str | None:
    """The vehicle is far from where the grip would have kept it."""
    return f"grip lost: vehicle moved {s.slipped:.2f} m" if s.slipped > _SLIP_M else None


def overstressed(s: Situation) -> str | None:
    """A tendon carries more than its limit: far more, or for longer than a reading's noise and a closing wrap's jerk.

    What is over the limit is let out from its first cycle on (`Tendons.goals`); this decides whether to give up.
    """
    most, limit = max(s.tensions), s.config.limits.tension_max_n
    if most <= limit or (most <= _FAR_OVER * limit and s.state.vigil.tight_s < _TIGHT_S):
        return None
    return f"tendon tension {most:.1f} N is over {limit:g} N"


def wrench_over_limit(s: Situation) -> str | None:
    """The arm is predicted to push or twist the airframe harder than it may."""
    prediction, limits = s.state.prediction, s.config.limits
    if prediction is None or not prediction.wrench.valid:
        return None
    force, torque = norm(prediction.wrench.force_b), norm(prediction.wrench.torque_b)
    if force > limits.wrench_force_n:
        return f"{force:.1f} N on the airframe is over {limits.wrench_force_n:g} N"
    if torque > limits.wrench_moment_nm:
        return f"{torque:.2f} N m on the airframe is over {limits.wrench_moment_nm:g} N m"
    return None


def rocks(s: Situation) -> str | None:
    """The vehicle rocks about what the arm has closed around, and does not come to rest.

    Close above its grip it is a pendulum upside down, which the autopilot holds upright with loops that are made for
    free flight. The arm's stiffness helps as long as the grip does not give: thrown far enough, it goes on for ever.
    """
    rate = math.sqrt(s.state.vigil.rocking)
    if s.elapsed < _CALM_S or rate <= _ROCKS_RAD_PER_S:
        return None
    return f"the vehicle rocks about what the arm holds, at {math.degrees(rate):.0f} deg/s"


# --- the vehicle's path ---


def estimator_jumped(s: Situation) -> str | None:
    """The autopilot's position jumped in this cycle: where the bar is, nobody knows until it is told again."""
    vigil = s.state.vigil
    return f"the vehicle's position jumped by {vigil.leap_m:.2f} m" if vigil.jumped_at == s.t > 0.0 else None


def astray(s: Situation) -> str | None:
    """The vehicle does not follow the set-points, though it says that it takes them."""
    reference = s.state.reference
    if s.state.vigil.astray_s <= _ASTRAY_S or reference is None:
        return None
    away = norm(sub(reference.position, s.facts.vehicle.position_w))
    return f"the vehicle does not follow: {away:.1f} m from its set-point"


# --- what comes before a servo's own fault ---


def hot(s: Situation) -> str | None:
    """A servo is close to the temperature at which it lets go."""
    if s.state.vigil.hot_s <= _DOUBTFUL_S:
        return None
    name, hottest = max(s.servos, key=lambda pair: pair[1].temperature)
    return f"{name}: servo at {hottest.temperature:.0f} degC lets go at {s.config.servos.temperature_limit_c}"


def low_voltage(s: Situation) -> str | None:
    """The servos' supply is close to its limit."""
    if s.state.vigil.low_s <= _DOUBTFUL_S:
        return None
    least = min(servo.voltage for _, servo in s.servos)
    return f"servo supply {least:.1f} V, least {s.config.servos.voltage_min_v:g} V"


# --- what is told and changes nothing ---


def slack(s: Situation) -> str | None:
    """A tendon is surely under its least tension."""
    if s.state.vigil.slack_s <= _DOUBTFUL_S:
        return None
    i, least = min(enumerate(s.tensions), key=lambda pair: pair[1])
    return f"tendon {i + 1} slack: {least:.1f} N"


def model_blind(s: Situation) -> str | None:
    """The mechanics have no solution: the wrench is not valid, and moves are made with the last stiffness."""
    return "the arm's mechanics have no solution" if s.state.vigil.blind_s > _BLIND_S else None


def ground_lost(s: Situation) -> str | None:
    """No ground station that may command has been heard for a while, though one was."""
    age = s.facts.ground_age_s
    return f"ground station silent for {_GROUND_LOST_S:g} s" if _GROUND_LOST_S < age < math.inf else None


def overrun(s: Situation) -> str | None:
    """This cycle came so late that nothing moves on by all the time that has passed: see `Situation.dt`, `stride`."""
    late = s.t - s.state.t if s.state.t else 0.0
    return "the control cycle is late" if late > _OVERRUN_S else None
