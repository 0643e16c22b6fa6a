"""Why the vehicle cannot set out for a bar or an object now, and why an arm that holds cannot be cleared."""

from arm_companion.mission import gripper
from arm_companion.mission.calibrating import vehicle_arms, vehicle_silent
from arm_companion.mission.facts import Bar
from arm_companion.mission.hazards import hot, low_voltage, vehicle_lost
from arm_companion.mission.motion import norm, sub
from arm_companion.mission.situation import Situation

_WITHIN_M = 50.0
_LEVEL = 0.2  # sine of the steepest axis that an upright vehicle can wrap
_LET_OUT_RAD = 0.25  # bend that a tendon's displacement stands for, up to which the arm is clear of what it held


def cannot_set_out(s: Situation, target: Bar, name: str, *, wraps: bool = True) -> str | None:
    """Why the way to `target`, called `name`, cannot begin, to wrap it or not; None when it can."""
    vehicle = s.facts.vehicle
    if (lost := vehicle_lost(s)) is not None:
        return lost
    if not vehicle.armed or vehicle.landed:
        return "the vehicle is not flying"
    if not s.external:
        return f"the autopilot is in {vehicle.mode or 'an unknown mode'}: switch it to external set-points first"
    if not s.state.streaming:
        return "the pilot had the vehicle: order READY first"
    if (distance := norm(sub(target.point_w, vehicle.position_w))) > _WITHIN_M:
        return f"the {name} is {distance:.0f} m away; at most {_WITHIN_M:g} m are allowed"
    if abs(target.axis_w[2]) > _LEVEL:
        return f"the {name} is not level"
    return hot(s) or low_voltage(s) or (_wraps_into_keep_out(s) if wraps else None)


def _wraps_into_keep_out(s: Situation) -> str | None:
    """The full wrap would take the arm where propellers or landing gear are: a matter of the configuration."""
    depth = -s.parameters.wrap_clearance
    return f"the full wrap is {depth * 100:.1f} cm inside the keep-out cone" if depth > 0.0 else None


def cannot_clear(s: Situation) -> str | None:
    """Why the servos of an arm that was left holding cannot be brought back now.

    A vehicle whose motors were stopped at a bar may hang by its arm, although the autopilot says that it stands.
    """
    if s.arm_above:
        return "an arm above may carry the vehicle"
    if (reason := vehicle_silent(s) or vehicle_arms(s)) is not None:
        return reason
    held = may_hold(s)
    return None if held is None else f"{held}: RELEASE; if it still does, take the servos' power away for a moment"


def may_hold(s: Situation) -> str | None:
    """What has torque and stands elsewhere than the straight arm, or open jaws, have it; silent, its last word counts.

    Returns:
        The first of them in words.
    """
    most = _LET_OUT_RAD * s.parameters.model.parameters.r
    holding = [
        f"tendon {i + 1}" for i, t in enumerate(s.facts.tendons) if t.torque and not (t.homed and abs(t.pull) <= most)
    ]
    if s.jaws is not None and s.jaws.torque and not gripper.stand_open(s.jaws):
        holding.append("gripper")
    return f"{holding[0]} holds, or may hold" if holding else None
