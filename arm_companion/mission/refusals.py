"""Why the vehicle cannot set out for a bar or an object now, and why an arm that holds cannot be cleared."""

from arm_companion.mission import gripper
from arm_companion.mission.calibrating import vehicle_arms, vehicle_silent
from arm_companion.mission.facts import Bar, Order
from arm_companion.mission.hazards import hot, low_voltage, vehicle_lost
from arm_companion.mission.motion import norm, sub
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase

_WITHIN_M = 50.0
_LEVEL = 0.2  # sine of the steepest axis that an upright vehicle can wrap
_CLEAR = "CLEAR_ERRORS"
_SEE_TO = "see to the power and the cable"
_WAYS_ON = {
    Phase.HOLDING: "RELEASE; if it comes back to HOLDING, land, disarm, then CLEAR_ERRORS",
    Phase.HANG_HOLD: "READY, external control, RELEASE; on the ground take the servos' power away, then CLEAR_ERRORS",
}
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

    A vehicle whose motors were stopped at a bar may hang by its arm, although the autopilot says that it stands. By
    an arm that holds nothing, above or below, no vehicle hangs.
    """
    if (silent := vehicle_silent(s)) is not None:
        return f"{silent}: nobody knows whether the vehicle is armed"
    if (reason := vehicle_arms(s)) is not None:
        return f"{reason}: {_WAYS_ON[Phase.HANG_HOLD if s.arm_above else Phase.HOLDING]}"
    firm, dead = _holding(s)
    if firm:
        away = "take the servos' power away for a moment"
        return f"{_holds(firm)}: " + (f"on the ground {away}" if s.arm_above else f"RELEASE; if it still does, {away}")
    return f"{_holds(dead)}, and does not answer: {_SEE_TO}, then CLEAR_ERRORS" if dead else None


def may_hold(s: Situation) -> str | None:
    """Why servos are not brought back beside others that may hold: at the start nobody knows what."""
    firm, dead = _holding(s)
    return f"{_holds(firm or dead)}: of what does not answer {_SEE_TO}" if firm or dead else None


def mend_first(fault: str) -> str:
    """A fault of a servo or tendon, with what to do about it where its words do not say so already."""
    return fault if _CLEAR in fault else f"{fault}; mend it, then {_CLEAR}"


def not_in(order: Order, phase: Phase) -> str:
    """Why an order is refused that the table does not have for a phase, with the way out of one that holds."""
    way = _WAYS_ON.get(phase) or ("STOW or RELEASE first" if order is Order.CLEAR_ERRORS else "")
    return f"{order.name} is not possible in state {phase.name}{': ' if way else ''}{way}"


def _holds(name: str) -> str:
    return f"{name} holds, or may hold"


def _holding(s: Situation) -> tuple[str, str]:
    """What has torque and stands elsewhere than the straight arm, or open jaws, have it; silent, its last word counts.

    Returns:
        The name of the first that answers, and of the first that is silent; empty: none.
    """
    most = _LET_OUT_RAD * s.parameters.model.parameters.r
    holding = [
        (f"tendon {i + 1}", t.silent)
        for i, t in enumerate(s.facts.tendons)
        if t.torque and not (t.homed and abs(t.pull) <= most)
    ]
    if s.jaws is not None and s.jaws.torque and not gripper.stand_open(s.jaws):
        holding.append(("gripper", s.jaws.silent))
    firm, dead = (next((name for name, silent in holding if silent is which), "") for which in (False, True))
    return firm, dead
