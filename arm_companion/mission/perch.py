"""The anchor perch as a table: an arm below wraps a bar and holds, while the vehicle goes on flying.

The rows of the grasp, which shares the way to its object and back, come from `grasp`.

Abort rows stand first and therefore win. A row's guard returns its reason in words.
"""

from arm_companion.mission import beside, calibrating, grasp, gripper, hang, jog, pressing, reach_table, tries
from arm_companion.mission.estimate import strength
from arm_companion.mission.facts import ArmFault, Order
from arm_companion.mission.hazards import (
    astray,
    disarmed,
    estimator_jumped,
    failsafe,
    grip_lost,
    hot,
    low_voltage,
    motors_stopped,
    overstressed,
    pilot_takes_over,
    rocks,
    servo_fault,
    servo_limp,
    tendon_broken,
    tendon_jumped,
    vehicle_lost,
    wrench_over_limit,
)
from arm_companion.mission.machine import OrderRow, Table, Transition
from arm_companion.mission.motion import ZERO, arrived, norm, sub
from arm_companion.mission.pull_test import pull_test_failed, pull_test_passed, tested_to_hang
from arm_companion.mission.refusals import cannot_clear, cannot_set_out, may_hold, mend_first
from arm_companion.mission.situation import Situation, at
from arm_companion.mission.state import CARRYING, PerchKind, Phase

Row = Transition[Phase, Situation]

FREE_FLIGHT = frozenset({Phase.APPROACH, Phase.REACH})
GRASPING = frozenset({Phase.CONTACT, Phase.WRAP, Phase.CLOSE})
GRIPPED = frozenset({Phase.VERIFY, Phase.PERCHED})
LEAVING = frozenset({Phase.UNLOAD, Phase.RELEASE, Phase.DEPART})

TENSE = GRASPING | GRIPPED | CARRYING | frozenset({Phase.UNLOAD, Phase.HOLDING})
"""Phases in which the arm may be carrying a load."""

_AT_STANDOFF_M = 0.06
_CONTACT_PERSISTS_S = 0.15
_SETTLE_S = 1.0
_BACK_M = 0.002
_AT_LIMIT_RAD = 1e-6
_POSE_CHECKED_RAD = 0.15
_ADOPT_BEND_RAD = 0.3
_CLEAR_BEND_RAD = 0.25
_SAME_M = 0.5  # a bar that is told anew, and better, is as near
_READYING_S = 10.0


# --- guards: what did not come in time ---


def _too_long(limit_s: float, what: str, s: Situation) -> str | None:
    return f"{what} took more than {limit_s:g} s" if s.elapsed > limit_s else None


def state_timeout(s: Situation) -> str | None:
    """A moving phase lasts longer than allowed."""
    return _too_long(s.config.perch.state_timeout_s, s.state.phase.name.lower(), s)


def approach_late(s: Situation) -> str | None:
    """The stand-off is not reached in the time that the way to it takes, and as much again as any moving phase has."""
    perch = s.config.perch
    return _too_long(perch.state_timeout_s + s.state.way_m / perch.approach_speed_m_per_s, "approach", s)


def depart_late(s: Situation) -> str | None:
    """The same of the way back."""
    perch = s.config.perch
    return _too_long(perch.state_timeout_s + perch.standoff_m / s.speed_back, "depart", s)


def no_contact(s: Situation) -> str | None:
    """The reach ended, or took too long, without the bar."""
    perch = s.config.perch
    if (late := _too_long(perch.contact_timeout_s, "reach without contact", s)) is not None:
        return late
    reference = s.state.reference
    end = s.place(-perch.overreach_m)
    if reference is not None and arrived(reference, end) and at(s, end, 0.05):
        return f"no contact {perch.overreach_m * 100:.0f} cm past where the bar should be"
    return None


def told_elsewhere(s: Situation) -> str | None:
    """The bar or object is told to be far from where it was when the vehicle set out: nobody has checked this one."""
    before = s.state.contact_w
    if before is None or (away := norm(sub(s.place(0.0), before))) <= _SAME_M:
        return None
    return f"the {'object' if s.grasping else 'bar'} is told {away:.1f} m from where it was"


def no_grip(s: Situation) -> str | None:
    """The arm is wrapped as far as allowed, yet no tendon carries a grip's tension."""
    if not s.at_bend_goal or s.elapsed < s.config.perch.wrap_bend_rad / s.config.perch.bend_speed_rad_per_s + _SETTLE_S:
        return None
    if gripped(s) is not None or not wrapped_to_the_limit(s):
        return None
    return f"no grip: {max(s.state.tension):.1f} N at full wrap, {s.grip_needed:.1f} N are needed"


# --- guards: what goes well ---


def straight_at_start(s: Situation) -> str | None:
    """The daemon finds the arm straight or slack: nothing depends on it."""
    if not s.heard:
        return None
    limp = not any(tendon.torque for tendon in s.facts.tendons)
    small = norm((*s.bend, 0.0)) < _ADOPT_BEND_RAD
    return "arm found at rest" if limp or small else None


def bent_at_start(s: Situation) -> str | None:
    """The daemon finds the arm bent under torque: someone depends on it, so it is left as it is."""
    if not s.heard:
        return None
    return "arm found bent and holding; it is left as it is"


def pose_checked(s: Situation) -> str | None:
    """The arm stands where it was told to, with torque on."""
    ok = (
        s.elapsed > _SETTLE_S
        and all(tendon.torque for tendon in s.facts.tendons)
        and s.at_bend_goal
        and s.bend_error < _POSE_CHECKED_RAD
    )
    return "pose checked" if ok else None


def pose_check_failed(s: Situation) -> str | None:
    """The arm does not reach its ready pose."""
    if s.elapsed < _READYING_S:
        return None
    if not all(tendon.torque for tendon in s.facts.tendons):
        return "servo torque does not come on"
    return f"arm is {s.bend_error:.2f} rad away from its ready pose"


def at_standoff(s: Situation) -> str | None:
    """The vehicle rests at the stand-off, facing the bar; in DEPART also where an approach was ended far before it."""
    goal = s.standoff
    reference = s.state.reference
    ok = reference is not None and arrived(reference, goal) and at(s, goal, _AT_STANDOFF_M)
    if not ok:
        return None
    return "at rest, far from the bar" if s.state.contact_w is None else "at the stand-off"


def ready_to_try_again(s: Situation) -> str | None:
    """Back at the stand-off after a try that came to nothing, the order still open, and nothing against another."""
    if not tries.setting_out(s) or at_standoff(s) is None:
        return None
    against = grasp.cannot_grasp(s) if s.grasping else cannot_perch(s)
    return "at the stand-off for another try" if against is None else None


def contact_found(s: Situation) -> str | None:
    """Something pushes the vehicle back, and goes on doing so, that the free arm does not explain."""
    if s.state.force.above_s < _CONTACT_PERSISTS_S:
        return None
    return f"contact: {strength(s.state.force.residual):.1f} N beyond what the free arm explains"


def wrapped_to_the_limit(s: Situation) -> bool:
    """Whether the wrap must not bend any farther; in WRAP it goes on up to there while the grip is loose."""
    return norm((*s.state.bend, 0.0)) >= s.config.limits.bend_max_rad - _AT_LIMIT_RAD


def gripped(s: Situation) -> str | None:
    """Some tendon carries the grip tension with the wrap complete."""
    most = max(s.state.tension)
    return f"gripped with {most:.1f} N" if s.at_bend_goal and most >= s.grip_needed else None


def unloaded(s: Situation) -> str | None:
    """The reference is back where the vehicle rests and nothing presses or is fed forward: letting go does not kick."""
    reference, ours = s.state.reference, s.external and s.state.anchor is not None
    back = reference is None or not ours or norm(sub(reference.position, pressing.eased(s))) < _BACK_M
    calm = back and s.state.lean == ZERO and pressing.is_eased(s)
    return "unloaded" if calm and s.elapsed > _SETTLE_S else None


def unwrapped(s: Situation) -> str | None:
    """The arm is straight enough to leave, and its gripper open."""
    ok = s.at_bend_goal and norm((*s.bend, 0.0)) < _CLEAR_BEND_RAD and gripper.is_open(s)
    return "arm clear of the bar" if ok else None


def cannot_depart(s: Situation) -> str | None:
    """The arm is clear but the vehicle is not ours to move, or nobody knows any more where the bar was met."""
    if not unwrapped(s):
        return None
    if not (s.external and s.state.streaming):  # given back, it is ours to move once READY has said so
        return "arm clear; the vehicle is not ours to move"
    return "arm clear; where the bar was met is not known" if s.state.contact_w is None else None


# --- orders: what a person may ask, and when ---


def cannot_ready(s: Situation) -> str | None:
    """Why the arm cannot be made ready now."""
    if s.facts.calibration.refusal:  # of a servo that was turned it knows more than the servo's own fault
        return s.facts.calibration.refusal
    fault = s.tendon_fault or s.servo_fault
    return None if fault is None else mend_first(fault)


def cannot_perch(s: Situation) -> str | None:
    """Why a perch cannot begin now."""
    if (reason := cannot_set_out(s, s.perch_bar, "bar")) is not None:
        return reason
    return hang.cannot_hang(s) if s.state.kind is PerchKind.HANG else None


Ask = OrderRow[Phase, Situation]
STOWED_ONLY = frozenset({Phase.STOWED})

ORDERS: tuple[Ask, ...] = (
    *grasp.ORDERS,
    Ask(
        Order.READY,
        frozenset({Phase.STOWED, Phase.STOWING}),
        Phase.READYING,
        frozenset({Phase.READY}),
        cannot_ready,
    ),
    Ask(Order.READY, frozenset({Phase.READY}), Phase.READY, frozenset({Phase.READY}), cannot_ready),
    Ask(Order.PERCH, frozenset({Phase.READY}), Phase.APPROACH, frozenset({Phase.PERCHED, Phase.HANGING}), cannot_perch),
    *jog.ORDERS,
    *reach_table.ORDERS,
    Ask(Order.RELEASE, GRASPING | GRIPPED, Phase.UNLOAD, STOWED_ONLY),
    Ask(Order.RELEASE, frozenset({Phase.HOLDING}), Phase.RELEASE, STOWED_ONLY, hang.cannot_open),
    Ask(Order.STOW, FREE_FLIGHT | {Phase.DEPART}, Phase.DEPART, STOWED_ONLY),
    Ask(Order.STOW, frozenset({Phase.READYING, Phase.READY, Phase.STOWING}), Phase.STOWING, STOWED_ONLY),
    Ask(Order.STOW, STOWED_ONLY, Phase.STOWED, STOWED_ONLY),
    Ask(Order.ABORT, FREE_FLIGHT, Phase.DEPART, frozenset({Phase.DEPART})),
    Ask(Order.ABORT, GRASPING | GRIPPED, Phase.UNLOAD, frozenset({Phase.UNLOAD})),
    Ask(Order.ABORT, frozenset({Phase.READYING, Phase.READY}), Phase.STOWING, frozenset({Phase.STOWING})),
    # servos may be rebooted and homed only where nothing hangs on them; `done` is when they are well
    Ask(Order.CLEAR_ERRORS, frozenset({Phase.STARTUP}), Phase.STARTUP, frozenset(), may_hold),
    Ask(Order.CLEAR_ERRORS, STOWED_ONLY, Phase.STOWED, frozenset()),
    Ask(Order.CLEAR_ERRORS, frozenset({Phase.HOLDING, Phase.HANG_HOLD}), Phase.STOWED, frozenset(), cannot_clear),
    *(Ask(Order.FEEDFORWARD, frozenset({phase}), phase, frozenset({phase})) for phase in Phase),
    *(
        # nothing is under way that could be given up, or it is being given up already
        Ask(Order.ABORT, frozenset({phase}), phase, frozenset({phase}))
        for phase in (
            *sorted(LEAVING, key=lambda p: p.value),
            Phase.STOWING,
            Phase.HOLDING,
            Phase.STOWED,
            Phase.STARTUP,
        )
    ),
    *hang.ORDERS,
    *calibrating.ORDERS,
)

_ENDS_A_BEGINNING = ((FREE_FLIGHT, Phase.DEPART), (GRASPING | {Phase.VERIFY}, Phase.UNLOAD))

TABLE: Table[Phase, Situation] = Table(
    transitions=(
        # aborts: first whose vehicle it is
        *(
            Row(phases, guard, target, name, error)
            for guard, name, error in (
                (pilot_takes_over, "pilot takes over", ArmFault.PILOT_TOOK_OVER),
                (failsafe, "autopilot failsafe", ArmFault.AUTOPILOT_FAILSAFE),
                (vehicle_lost, "vehicle lost", ArmFault.VEHICLE_LOST),
            )
            for phases, target in (
                (FREE_FLIGHT | {Phase.DEPART}, Phase.STOWING),
                (GRASPING, Phase.RELEASE),
                (GRIPPED, Phase.HOLDING),
            )
        ),
        # a grip that is about to be opened, with nobody known to fly: it may be all that holds the vehicle
        Row(frozenset({Phase.UNLOAD}), vehicle_lost, Phase.HOLDING, "vehicle lost", ArmFault.VEHICLE_LOST),
        Row(FREE_FLIGHT | {Phase.DEPART}, disarmed, Phase.STOWING, "disarmed", ArmFault.DISARMED),
        Row(
            GRASPING | GRIPPED | {Phase.UNLOAD},
            disarmed,
            Phase.HOLDING,
            "disarmed",
            ArmFault.DISARMED,
        ),
        Row(frozenset({Phase.RELEASE}), motors_stopped, Phase.HOLDING, "motors stop", ArmFault.DISARMED),
        *hang.ABORTS,
        # then where it is: a jump moves all that is remembered, so a grip that is tested already stays
        Row(
            FREE_FLIGHT | {Phase.DEPART},
            estimator_jumped,
            Phase.STOWING,
            "estimator jump",
            ArmFault.ESTIMATOR_JUMP,
        ),
        Row(GRASPING | {Phase.VERIFY}, estimator_jumped, Phase.UNLOAD, "estimator jump", ArmFault.ESTIMATOR_JUMP),
        Row(FREE_FLIGHT | {Phase.DEPART}, astray, Phase.STOWING, "set-points not followed", ArmFault.SETPOINT_REJECTED),
        Row(FREE_FLIGHT, told_elsewhere, Phase.DEPART, "bar told elsewhere", ArmFault.NO_CONTACT),
        # then the arm: nothing new is begun with it, and a grip that is tested already stays until a person says
        *(
            Row(phases, guard, target, name, error)
            for guard, name, error in (
                (servo_fault, "servo fault", ArmFault.SERVO_FAULT),
                (tendon_broken, "tendon broken", ArmFault.TENDON_BROKEN),
                (tendon_jumped, "tendon jumped", ArmFault.TENSION_DISAGREES),
            )
            for phases, target in (*_ENDS_A_BEGINNING, (frozenset({Phase.READYING, Phase.READY}), Phase.STOWING))
        ),
        *(
            Row(phases, servo_limp, target, "no torque", ArmFault.SERVO_FAULT)
            for phases, target in (*_ENDS_A_BEGINNING, (frozenset({Phase.READY}), Phase.STOWING))
        ),
        *(
            Row(phases, guard, target, name, error)
            for guard, name, error in (
                (hot, "servo hot", ArmFault.OVERHEAT),
                (low_voltage, "low voltage", ArmFault.LOW_VOLTAGE),
            )
            for phases, target in _ENDS_A_BEGINNING
        ),
        Row(FREE_FLIGHT, overstressed, Phase.DEPART, "over-tension", ArmFault.TENDON_OVER_TENSION),
        Row(GRASPING | GRIPPED, overstressed, Phase.UNLOAD, "over-tension", ArmFault.TENDON_OVER_TENSION),
        Row(GRIPPED, wrench_over_limit, Phase.UNLOAD, "wrench limit", ArmFault.WRENCH_LIMIT),
        Row(frozenset({Phase.PERCHED}), grip_lost, Phase.UNLOAD, "grip lost", ArmFault.SLIP),
        Row(
            frozenset({Phase.READYING}),
            pose_check_failed,
            Phase.STOWING,
            "pose check failed",
            ArmFault.TIMEOUT,
        ),
        *grasp.ABORTS,
        *reach_table.ABORTS,
        *calibrating.ABORTS,
        # progress
        *tries.or_fail(Phase.VERIFY, rocks, Phase.UNLOAD, "vehicle rocks", ArmFault.GRIP_TEST_FAILED),
        *grasp.PROGRESS,
        *calibrating.PROGRESS,
        *hang.PROGRESS,
        *reach_table.PROGRESS,
        Row(frozenset({Phase.VERIFY}), tested_to_hang, Phase.LOAD_TRANSFER, "pull test passed, to hang"),
        Row(frozenset({Phase.STARTUP}), straight_at_start, Phase.STOWED, "arm at rest"),
        Row(frozenset({Phase.STARTUP}), bent_at_start, Phase.HOLDING, "arm holds something", ArmFault.RESTARTED),
        Row(frozenset({Phase.READYING}), pose_checked, Phase.READY, "pose checked"),
        Row(frozenset({Phase.APPROACH}), at_standoff, Phase.REACH, "at stand-off"),
        Row(frozenset({Phase.REACH}), contact_found, Phase.CONTACT, "contact found"),
        *tries.or_fail(Phase.REACH, no_contact, Phase.DEPART, "no contact", ArmFault.NO_CONTACT),
        Row(frozenset({Phase.CONTACT}), beside.settled_at_object, Phase.CLOSE, "settled at the object"),
        Row(frozenset({Phase.CONTACT}), beside.settled, Phase.WRAP, "settled"),
        Row(frozenset({Phase.WRAP}), gripped, Phase.VERIFY, "grip tension"),
        *tries.or_fail(Phase.WRAP, no_grip, Phase.UNLOAD, "no grip", ArmFault.GRIP_TEST_FAILED),
        Row(frozenset({Phase.VERIFY}), pull_test_passed, Phase.PERCHED, "pull test passed"),
        *tries.or_fail(Phase.VERIFY, pull_test_failed, Phase.UNLOAD, "pull test failed", ArmFault.GRIP_TEST_FAILED),
        Row(frozenset({Phase.UNLOAD}), unloaded, Phase.RELEASE, "unloaded"),
        Row(frozenset({Phase.RELEASE}), cannot_depart, Phase.STOWING, "vehicle not ours"),
        Row(frozenset({Phase.RELEASE}), unwrapped, Phase.DEPART, "arm clear"),
        Row(frozenset({Phase.DEPART}), ready_to_try_again, Phase.APPROACH, "another try"),
        Row(frozenset({Phase.DEPART}), at_standoff, Phase.STOWING, "at stand-off"),
        Row(frozenset({Phase.STOWING}), pose_checked, Phase.STOWED, "arm straight"),
        # time limits last: progress in the same cycle wins
        *hang.LIMITS,
        *grasp.TIME_LIMITS,
        *calibrating.LIMITS,
        Row(frozenset({Phase.APPROACH}), approach_late, Phase.DEPART, "time limit", ArmFault.TIMEOUT),
        Row(GRASPING | {Phase.VERIFY}, state_timeout, Phase.UNLOAD, "time limit", ArmFault.TIMEOUT),
        Row(frozenset({Phase.UNLOAD}), state_timeout, Phase.RELEASE, "time limit", ArmFault.TIMEOUT),
        Row(frozenset({Phase.RELEASE}), state_timeout, Phase.HOLDING, "time limit", ArmFault.TIMEOUT),
        Row(frozenset({Phase.DEPART}), depart_late, Phase.STOWING, "time limit", ArmFault.TIMEOUT),
        Row(frozenset({Phase.STOWING}), state_timeout, Phase.HOLDING, "time limit", ArmFault.TIMEOUT),
    ),
    orders=ORDERS,
)
