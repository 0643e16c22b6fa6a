"""The rows that the grasp adds to the table: close around an object, lift it, carry it, set it down.

The way to the object and back is the perch's own (`perch`). What is carried is let go in two ways only: set down,
when the rotors say that the load is off; or from HOLDING, when a person says so.
"""

import math

from arm_companion.mission import beside, gripper
from arm_companion.mission.facts import ArmFault, Order
from arm_companion.mission.hazards import (
    astray,
    disarmed,
    estimator_jumped,
    failsafe,
    pilot_takes_over,
    vehicle_lost,
)
from arm_companion.mission.machine import OrderRow, Transition
from arm_companion.mission.motion import arrived, norm, sub
from arm_companion.mission.payload import Found
from arm_companion.mission.refusals import cannot_set_out
from arm_companion.mission.situation import Situation, at
from arm_companion.mission.state import CARRYING, Phase
from arm_companion.mission.tries import or_fail

Row = Transition[Phase, Situation]
Ask = OrderRow[Phase, Situation]

LIGHT_SHARE = 0.5
"""Of the weighed load, under which it counts as gone."""

_DROPPED_S = 0.1
_SET_DOWN_S = 0.4
_AT_GROUND_M = 0.04  # what lay down was off the arm at up to 3 cm, what stood on one end at over 5
_LOWEST_M = 0.02
_HELD_ASIDE_M = 0.015
_EARLY_M = 0.07  # an end that hangs 30 degrees low meets its cradle 6 cm early, and lies down as the arm goes on
_SWUNG_M = 0.045  # up to 13 degrees askew swing the vehicle by 3 cm, 15 and more by over 5
_SWINGS_S = 2.5
_PROPPED_S = 0.2
_RISEN_SHARE = 0.6
_SETTLE_S = 1.0
_JUDGED_S = 6.0
_LASTS_S = 0.5  # as an object breaks free of what it lay in, the vehicle jumps, and one reading may say anything
_UNKNOWN_S = 3.0  # after a gap in what the autopilot tells, a second passes until the load is known again
_LIFTED_M = 0.08
_STILL_S = 2.0
_NO_LEAN = 0.15  # m/s^2
_DOWN = 0.98  # z of the arm's base axis in body axes, of an arm whose gripper comes from above

_SINKING = frozenset({Phase.LIFT, Phase.PLACE})


# --- guards: what goes wrong ---


def taken_over_while_setting_down(s: Situation) -> str | None:
    """The autopilot left our mode in this cycle; who sets down by hand had it before, and is left to it."""
    return pilot_takes_over(s) if s.pilot_took_over else None


def dropped(s: Situation) -> str | None:
    """The load has left the arm, in the air."""
    load = s.state.load
    if load.light_s < _DROPPED_S or (s.state.phase is Phase.PLACE and (lies_down(s) or not s.external)):
        return None
    return f"load lost: {load.mass:.2f} kg were carried, {max(load.now, 0.0):.2f} kg are left"


def not_closed(s: Situation) -> str | None:
    """The arm is wrapped as far as allowed, yet no tendon carries the tension of a closed one; or so the gripper."""
    perch = s.config.perch
    if s.gripping:
        return gripper.not_closed(s)
    if (
        not s.at_bend_goal
        or s.elapsed < perch.wrap_bend_rad / perch.bend_speed_rad_per_s + _SETTLE_S
        or closed(s) is not None
    ):
        return None
    return f"closed around nothing: {max(s.state.tension):.1f} N, {s.config.grasp.grip_tension_n:g} N are needed"


def held_aside(s: Situation) -> str | None:
    """The arm has closed, but beside the middle of its object: gusts and the blow of the arm carry a vehicle off.

    A heavy one would hang by it like a scale out of balance: 300 g held 3 cm aside hang 45 degrees askew.
    """
    if s.gripping or closed(s) is None or (aside := beside.aside(s)) <= _HELD_ASIDE_M:
        return None
    return f"closed {aside * 100:.1f} cm beside the middle"


def hangs_askew(s: Situation) -> str | None:
    """The load has swung the vehicle along its axis as it came off what it lay in: it is held beside its middle.

    It turns the arm, a soft hinge about the vehicle's forward axis, and rolls the vehicle until the flight stack has
    taken the torque on. Where the middle is told wrong, nothing else shows it.
    """
    reference = s.state.reference
    if s.gripping or reference is None or not s.external or not s.vehicle_fresh or s.elapsed > _SWINGS_S:
        return None
    if (swung := abs(beside.across(s, sub(s.facts.vehicle.position_w, reference.position)))) < _SWUNG_M:
        return None
    return f"the load may hang askew: it swung the vehicle {swung * 100:.1f} cm aside as it came off"


def lift_failed(s: Situation) -> str | None:
    """The test lift went up with nothing, or pulled more than may be lifted."""
    load, grasp = s.state.load, s.config.grasp
    if not s.grasping or s.elapsed < _SETTLE_S:
        return None
    if load.found is None:
        return "test lift failed: the thrust is not known" if load.found_s >= _UNKNOWN_S else None
    if load.found is Found.ENOUGH or load.found_s < _LASTS_S:
        return None
    if load.found is Found.TOO_MUCH:
        return f"test lift failed: {load.now:.2f} kg and more, at most {grasp.mass_max_kg:g} kg are lifted"
    return f"test lift failed: {max(load.now, 0.0):.2f} kg on the arm" if s.elapsed > _JUDGED_S and risen(s) else None


def nothing_below(s: Situation) -> str | None:
    """The vehicle has gone down as far as it may, and the load is still on the arm.

    It need not rest there: a load that hangs beside what it lay on, and swings, moves the vehicle about.
    """
    reference, load = s.state.reference, s.state.load
    if reference is None or not s.external or s.elapsed < _STILL_S or load.light_s or math.isnan(load.now):
        return None
    as_low = abs(reference.position[2] - s.facts.vehicle.position_w[2]) <= _LOWEST_M
    return "nothing found to set the load down on" if as_low and arrived(reference, s.setting_down) else None


def met_early(s: Situation) -> str | None:
    """Something carries part of the load, well above where it was taken: it hangs askew, or not above its place.

    Going on would turn it out of the arm, or push it off what it met. Or something carries all of it, lower, but
    still above its place: it stands on one end there. A pilot who sets down by hand knows where.
    """
    load = s.state.load
    carried_s = load.light_s if lies_down(s) else load.propped_s
    if not s.external or low(s) or carried_s < _PROPPED_S:
        return None
    return (
        f"the load met something {above(s) * 100:.0f} cm above where it was taken: "
        f"{load.now:.2f} of {load.mass:.2f} kg are left on the arm"
    )


def takes_too_long(s: Situation) -> str | None:
    """Lifting or setting down lasts longer than its way needs; a pilot may have climbed far above the pick-up."""
    grasp = s.config.grasp
    way = s.state.way_m if s.state.phase is Phase.PLACE else grasp.lift_height_m
    limit = s.config.perch.state_timeout_s + way / grasp.lift_speed_m_per_s
    return f"{s.state.phase.name.lower()} took more than {limit:.0f} s" if s.elapsed > limit else None


# --- guards: what goes well ---


def closed(s: Situation) -> str | None:
    """Some tendon carries a closed arm's tension with the wrap complete; or the gripper holds something."""
    if s.gripping:
        return gripper.closed(s)
    most = max(s.state.tension)
    done = s.at_bend_goal and most >= s.config.grasp.grip_tension_n
    return f"closed with {most:.1f} N" if done else None


def lift_passed(s: Situation) -> str | None:
    """The vehicle has gone up, and its rotors lift more than itself."""
    load = s.state.load
    held = load.found is Found.ENOUGH and load.found_s >= _LASTS_S
    if not s.grasping or s.elapsed < _SETTLE_S or not held or not risen(s):
        return None
    return f"test lift passed: {load.now:.2f} kg"


def lifted(s: Situation) -> str | None:
    """The vehicle rests where the load is to be carried."""
    reference = s.state.reference
    up = reference is not None and norm(reference.velocity) == 0.0 and s.elapsed > _SETTLE_S
    return "lifted" if up and reference is not None and at(s, reference.position, _LIFTED_M) else None


def set_down(s: Situation) -> str | None:
    """The load is off; where the thrust is not known, the vehicle rests as low as where it took the object."""
    load = s.state.load
    # jaws that open let the rest of a push go upwards, away from the object; a wrapped arm would take it along
    settled = s.gripping or norm(s.state.lean) < _NO_LEAN
    if load.light_s >= _SET_DOWN_S and settled and (low(s) or not s.external):
        return "set down: the load is off"
    if math.isnan(load.now) and s.external and s.elapsed > _STILL_S and lowest(s):
        return "set down at the height of the pick-up; the thrust is not known"
    return None


def risen(s: Situation) -> bool:
    """Whether the vehicle has made most of the test lift."""
    return above(s) >= _RISEN_SHARE * s.config.grasp.verify_lift_m


def above(s: Situation) -> float:
    """Height of the vehicle over where it took the object, m."""
    return s.probe[2] - s.state.position[2]


def low(s: Situation) -> bool:
    """Whether the vehicle is about as low as where it took the object."""
    return above(s) < _AT_GROUND_M


def lies_down(s: Situation) -> bool:
    """Whether the vehicle is so low that an end which hangs low may have met its place, and lies down as it goes on."""
    return above(s) < _EARLY_M


def lowest(s: Situation) -> bool:
    """Whether the reference rests at its lowest, and the vehicle with it."""
    reference = s.state.reference
    if reference is None or not arrived(reference, s.setting_down):
        return False
    return at(s, reference.position, _LOWEST_M)


# --- orders ---


def cannot_grasp(s: Situation) -> str | None:
    """Why a grasp cannot begin now."""
    if s.config.gripper_by and s.mount.rotation[2, 2] < _DOWN:
        return "the arm does not point down: a gripper takes what is below"
    if (reason := cannot_set_out(s, s.object, "object", wraps=not s.config.gripper_by)) is not None:
        return reason
    if s.config.gripper_by and not s.state.feedforward:
        return "FEEDFORWARD is off: on a taut arm that is slow to take its load the vehicle sways; switch it on"
    if math.isnan(s.facts.vehicle.thrust):
        return "the autopilot does not tell its thrust (ATTITUDE_TARGET), so a load cannot be weighed"
    return None if s.state.load.calibrated else "the thrust of a hover is not known yet: hover for some seconds"


ORDERS: tuple[Ask, ...] = (
    Ask(Order.GRASP, frozenset({Phase.READY}), Phase.APPROACH, frozenset({Phase.CARRY}), cannot_grasp),
    Ask(Order.RELEASE, frozenset({Phase.LIFT, Phase.CARRY}), Phase.PLACE, frozenset({Phase.STOWED})),
    # nobody but a person lets go of a load: it is held where it is
    Ask(Order.ABORT, CARRYING, Phase.CARRY, frozenset({Phase.CARRY})),
    # set-points go out again after a pilot had the vehicle
    Ask(Order.READY, frozenset({Phase.CARRY}), Phase.CARRY, frozenset({Phase.CARRY})),
)

ABORTS: tuple[Row, ...] = (
    Row(
        frozenset({Phase.STARTUP}), gripper.holds_at_start, Phase.HOLDING, "gripper holds something", ArmFault.RESTARTED
    ),
    Row(
        frozenset({Phase.APPROACH, Phase.REACH}),
        gripper.does_not_open,
        Phase.DEPART,
        "gripper does not open",
        ArmFault.GRIP_TEST_FAILED,
    ),
    Row(frozenset({Phase.LIFT}), pilot_takes_over, Phase.CARRY, "pilot takes over", ArmFault.PILOT_TOOK_OVER),
    Row(
        frozenset({Phase.PLACE}),
        taken_over_while_setting_down,
        Phase.CARRY,
        "pilot takes over",
        ArmFault.PILOT_TOOK_OVER,
    ),
    Row(_SINKING, failsafe, Phase.CARRY, "autopilot failsafe", ArmFault.AUTOPILOT_FAILSAFE),
    Row(_SINKING, vehicle_lost, Phase.CARRY, "vehicle lost", ArmFault.VEHICLE_LOST),
    Row(CARRYING, disarmed, Phase.HOLDING, "disarmed", ArmFault.DISARMED),
    Row(_SINKING, estimator_jumped, Phase.CARRY, "estimator jump", ArmFault.ESTIMATOR_JUMP),
    Row(_SINKING, astray, Phase.CARRY, "set-points not followed", ArmFault.SETPOINT_REJECTED),
    Row(CARRYING, dropped, Phase.HOLDING, "load lost", ArmFault.CONTACT_LOST),
)

PROGRESS: tuple[Row, ...] = (
    Row(frozenset({Phase.REACH}), gripper.at_object, Phase.CONTACT, "object between the jaws"),
    *or_fail(Phase.CLOSE, held_aside, Phase.UNLOAD, "held aside", ArmFault.GRIP_TEST_FAILED),
    Row(frozenset({Phase.CLOSE}), closed, Phase.VERIFY, "closed"),
    *or_fail(Phase.CLOSE, not_closed, Phase.UNLOAD, "not closed", ArmFault.GRIP_TEST_FAILED),
    Row(frozenset({Phase.VERIFY}), lift_failed, Phase.UNLOAD, "test lift failed", ArmFault.GRIP_TEST_FAILED),
    Row(frozenset({Phase.VERIFY}), lift_passed, Phase.LIFT, "test lift passed"),
    Row(frozenset({Phase.LIFT}), lifted, Phase.CARRY, "lifted"),
    Row(frozenset({Phase.PLACE}), set_down, Phase.RELEASE, "load is off"),
    Row(frozenset({Phase.PLACE}), met_early, Phase.LIFT, "met something early", ArmFault.GRIP_TEST_FAILED),
    Row(frozenset({Phase.PLACE}), nothing_below, Phase.CARRY, "nothing below", ArmFault.NO_CONTACT),
)

TIME_LIMITS: tuple[Row, ...] = (Row(_SINKING, takes_too_long, Phase.CARRY, "time limit", ArmFault.TIMEOUT),)
