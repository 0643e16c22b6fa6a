"""What happens when things go wrong, cause by cause: asked of the perch's tables, never said a second time.

`python -m arm_companion.mission.failure_policy > docs/failure_policy.md` writes the page; a test fails when the two
differ. A cause names the guards that stand for it. Where no row answers it in a phase, its `otherwise` says why.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

from arm_companion.mission import calibrating, grasp, gripper, hang, hazards, perch, pull_test, reach_table
from arm_companion.mission.facts import ArmFault, Order
from arm_companion.mission.notices import WARNINGS
from arm_companion.mission.perch import TABLE
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase

Guard = Callable[[Situation], str | None]

SITUATIONS: dict[str, tuple[Phase, ...]] = {
    "at rest": (Phase.STARTUP, Phase.STOWED, Phase.READYING, Phase.READY, Phase.STOWING),
    "free flight": (Phase.APPROACH, Phase.REACH, Phase.DEPART, Phase.TIP_MOVE, Phase.TIP_HOLD),
    "in contact": (Phase.CONTACT, Phase.WRAP, Phase.CLOSE, Phase.RELEASE),
    "anchored": (Phase.VERIFY, Phase.PERCHED, Phase.UNLOAD),
    "hanging": (Phase.LOAD_TRANSFER, Phase.HANGING, Phase.TAKE_BACK, Phase.HANG_HOLD),
    "carrying": (Phase.LIFT, Phase.CARRY, Phase.PLACE),
    "holding": (Phase.HOLDING,),
    "calibrating": (Phase.CALIBRATING, Phase.EASING),
}
"""Phases by what lies between arm, bar and vehicle. On the ground or in the air, an arm at rest does the same."""


@dataclass(frozen=True)
class Cause:
    """One thing that goes wrong.

    Attributes:
        name: for people.
        bit: of ARM_STATUS.errors; NONE: it has none.
        guards: of the tables' rows that stand for it.
        otherwise: what happens in phases that have no row, and why that is right.
        order: order that stands for it.
    """

    name: str
    bit: ArmFault
    guards: tuple[Guard, ...]
    otherwise: str
    order: Order | None = None


CAUSES: tuple[Cause, ...] = (
    Cause(
        "vehicle heartbeat lost",
        ArmFault.VEHICLE_LOST,
        (hazards.vehicle_lost, calibrating.vehicle_silent),
        "goes on: what it does needs no vehicle; no perch is begun",
    ),
    Cause(
        "vehicle state stale",
        ArmFault.VEHICLE_STATE_STALE,
        (hazards.vehicle_lost,),
        "goes on, the reference frozen; no perch is begun",
    ),
    Cause(
        "pilot takes the mode",
        ArmFault.PILOT_TOOK_OVER,
        (hazards.pilot_takes_over, hang.taken_from_us, grasp.taken_over_while_setting_down, reach_table.taken_over),
        "no set-points; goes on with the arm alone",
    ),
    Cause(
        "autopilot failsafe",
        ArmFault.AUTOPILOT_FAILSAFE,
        (hazards.failsafe,),
        "no set-points; goes on with the arm alone",
    ),
    Cause(
        "pilot takes the mode, an arm above still wrapped",
        ArmFault.PILOT_TOOK_OVER,
        (hang.taken_before_it_opens,),
        "as with any arm; one whose load the pilot has taken back himself goes on letting go",
    ),
    Cause(
        "autopilot failsafe, an arm above still wrapped",
        ArmFault.AUTOPILOT_FAILSAFE,
        (hang.failsafe_before_it_opens,),
        "as with any arm",
    ),
    Cause(
        "motors drop while an arm above lets go",
        ArmFault.SETPOINT_REJECTED,
        (hang.motors_drop,),
        "not judged: the arm does not let go; in RELEASE nothing once it is half open, as it can hold nothing then",
    ),
    Cause(
        "disarm",
        ArmFault.DISARMED,
        (hazards.disarmed, hazards.motors_stopped),
        "no set-points; goes on with the arm alone",
    ),
    Cause(
        "ground station lost",
        ArmFault.GROUND_LOST,
        (hazards.ground_lost,),
        "nothing: nobody needs it",
    ),
    Cause(
        "operator aborts",
        ArmFault.OPERATOR_ABORT,
        (),
        "accepted; nothing is under way, or it is being given up already",
        Order.ABORT,
    ),
    Cause("servo silent", ArmFault.SERVO_SILENT, (hazards.servo_fault,), "goes on with the others; READY is refused"),
    Cause(
        "servo hardware error",
        ArmFault.SERVO_FAULT,
        (hazards.servo_fault,),
        "goes on with the others; READY is refused",
    ),
    Cause(
        "servo without torque",
        ArmFault.SERVO_FAULT,
        (hazards.servo_limp,),
        "not judged: the torque comes on with what is done next, or need not be on",
    ),
    Cause("servo overheats (warning)", ArmFault.OVERHEAT, (hazards.hot,), "nothing"),
    Cause(
        "servo overloaded",
        ArmFault.OVERLOAD,
        (hazards.servo_fault,),
        "goes on with the others; READY is refused",
    ),
    Cause("low voltage", ArmFault.LOW_VOLTAGE, (hazards.low_voltage,), "nothing"),
    Cause("tendon slack", ArmFault.TENDON_SLACK, (hazards.slack,), "nothing; no goal lets a slack tendon out"),
    Cause(
        "tendon over-tension",
        ArmFault.TENDON_OVER_TENSION,
        (hazards.overstressed,),
        "goes on; the drivers let the tendon out, never in",
    ),
    Cause(
        "tendon broken",
        ArmFault.TENDON_BROKEN,
        (hazards.tendon_broken,),
        "goes on; READY is refused until CLEAR_ERRORS",
    ),
    Cause(
        "tension and pose disagree",
        ArmFault.TENSION_DISAGREES,
        (hazards.tendon_jumped,),
        "goes on; READY is refused until CLEAR_ERRORS",
    ),
    Cause(
        "contact lost",
        ArmFault.CONTACT_LOST,
        (perch.no_grip, grasp.not_closed, pull_test.pull_test_failed, hazards.grip_lost, hang.slips, grasp.dropped),
        "cannot be told from letting go; a free arm has none",
    ),
    Cause(
        "slip",
        ArmFault.SLIP,
        (hazards.grip_lost, hang.slips),
        "not judged: the vehicle is not asked to stay, or not held yet",
    ),
    Cause("no contact in time", ArmFault.NO_CONTACT, (perch.no_contact,), "does not apply"),
    Cause(
        "bar or object told elsewhere",
        ArmFault.NO_CONTACT,
        (perch.told_elsewhere,),
        "nothing: the way back is from the one that was met",
    ),
    Cause("nothing below to set a load down on", ArmFault.NO_CONTACT, (grasp.nothing_below,), "does not apply"),
    Cause(
        "load meets something high above its place",
        ArmFault.GRIP_TEST_FAILED,
        (grasp.met_early,),
        "does not apply; whoever sets down by hand knows where",
    ),
    Cause(
        "load swings the vehicle aside as it comes off",
        ArmFault.NONE,
        (grasp.hangs_askew,),
        "not judged: only what is lifted shows by its first swing that it hangs askew",
    ),
    Cause(
        "arm closes beside the middle of its object",
        ArmFault.GRIP_TEST_FAILED,
        (grasp.held_aside,),
        "not judged: an object is judged as it is closed around, a bar has no middle",
    ),
    Cause(
        "gripper does not open",
        ArmFault.GRIP_TEST_FAILED,
        (gripper.does_not_open,),
        "goes on; a RELEASE whose gripper stays closed ends by its time limit, and holds",
    ),
    Cause(
        "stiffness test failed",
        ArmFault.GRIP_TEST_FAILED,
        (pull_test.pull_test_failed, perch.no_grip, grasp.lift_failed, grasp.not_closed),
        "does not apply",
    ),
    Cause(
        "vehicle rocks about what it holds",
        ArmFault.GRIP_TEST_FAILED,
        (hazards.rocks,),
        "nothing: it is judged where a grip is tested",
    ),
    Cause(
        "wrench over its limit",
        ArmFault.WRENCH_LIMIT,
        (hazards.wrench_over_limit,),
        "goes on: the arm is free, or it is letting go, or its load is being taken back, or its wrench is not known",
    ),
    Cause("model has no solution", ArmFault.MODEL, (hazards.model_blind,), "nothing: ARM_REACTION_WRENCH is not valid"),
    Cause(
        "throttle not told",
        ArmFault.VEHICLE_STATE_STALE,
        (hang.throttle_lost,),
        "nothing: nobody needs it; a hang perch is not begun; a load counts as taken back when the vehicle rises",
    ),
    Cause(
        "set-points not followed",
        ArmFault.SETPOINT_REJECTED,
        (hazards.astray,),
        "not judged: at the bar a held vehicle cannot follow, and elsewhere it is asked for nothing",
    ),
    Cause(
        "estimator jumps",
        ArmFault.ESTIMATOR_JUMP,
        (hazards.estimator_jumped,),
        "goes on: all that is remembered moves with the estimate",
    ),
    Cause(
        "cycle overrun",
        ArmFault.CYCLE_OVERRUN,
        (hazards.overrun,),
        "nothing: a late step bends the arm by two cycles, and moves nothing farther than a tenth of a second allows",
    ),
    Cause(
        "vehicle arms in a calibration",
        ArmFault.CALIBRATION_FAILED,
        (calibrating.vehicle_arms,),
        "does not apply; no calibration is begun, and one that was given up goes on easing",
    ),
    Cause(
        "calibration finds no zeros",
        ArmFault.CALIBRATION_FAILED,
        (calibrating.finds_no_zeros,),
        "does not apply",
    ),
    Cause(
        "calibration cannot be stored",
        ArmFault.CALIBRATION_FAILED,
        (calibrating.not_stored,),
        "does not apply",
    ),
    Cause(
        "daemon restarted in flight",
        ArmFault.RESTARTED,
        (perch.straight_at_start, perch.bent_at_start, gripper.holds_at_start),
        "does not apply: every start begins in STARTUP, and nothing moves until told",
    ),
    Cause("recorder's disk full", ArmFault.NONE, (), "nothing: counted, the record has a gap"),
    Cause(
        "MQTT broker gone",
        ArmFault.NONE,
        (),
        "nothing: it serves people alone, and connects again by itself",
    ),
    Cause(
        "configuration changed in flight",
        ArmFault.NONE,
        (),
        "refused unless STARTUP or STOWED; the file is read at the start alone",
    ),
)


@dataclass(frozen=True)
class Reaction:
    """What one phase does about one cause.

    Attributes:
        targets: phases that follow; empty: it stays.
        told: what is told when it stays.
    """

    targets: tuple[Phase, ...]
    told: tuple[str, ...] = ()


def reaction(cause: Cause, phase: Phase) -> Reaction:
    """What the tables say."""
    targets = [row.target for row in TABLE.transitions if phase in row.sources and row.guard in cause.guards]
    if cause.order is not None and (ask := TABLE.order(cause.order, phase)) is not None and ask.target is not phase:
        targets.append(ask.target)
    told = [
        warned.consequence or "goes on"
        for warned in WARNINGS
        if phase in warned.phases and warned.guard in cause.guards and not targets
    ]
    return Reaction(tuple(dict.fromkeys(targets)), tuple(dict.fromkeys(told)))


def cell(cause: Cause, situation: str) -> str:
    """One cell of the page: phases that do the same stand together."""
    groups: dict[str, list[str]] = {}
    for phase in SITUATIONS[situation]:
        does = reaction(cause, phase)
        if does.targets:
            text = "→ " + " or ".join(target.name for target in does.targets)
        elif does.told:
            text = f"told: {'; '.join(does.told)}"
        else:
            text = "(a)"
        groups.setdefault(text, []).append(phase.name)
    if set(groups) == {"(a)"}:
        return "(a)"
    return "<br>".join(f"{', '.join(names)} {text}" for text, names in groups.items())


_HEADER = """# What happens when things go wrong

Made from the tables in `arm_companion/mission/`: `perch.py`, `hang.py`, `grasp.py`, `reach_table.py`,
`calibrating.py` and `notices.py`. A test fails when the two differ.

- `→` names the state that follows, in the same cycle. Every change is told as STATUSTEXT with its reason, and a
  command that is running is answered with FAILED.
- "told" is one STATUSTEXT in a state, and changes nothing.
- (a) is the column "anywhere else".
- A try that finds no contact or no grip is followed by another, up to `perch.attempts`; what stands here for it is what
  the last one does.
- The pilot always wins: set-points stop in the cycle in which another mode is seen, in every state.
- A grip that is tested is given up only by a person, by a limit that breaks (tension, wrench), or when it slips: a
  vehicle that hangs on an arm with a dead servo is better off than one that falls.
- An arm that may carry a vehicle whose motors idle or stand never opens. What goes wrong with it brings the motors up
  (TAKE_BACK), if the vehicle is ours; if it is not, the arm holds (HANG_HOLD) until a person has the motors carry it.
  It holds again when the vehicle is taken from us, or its motors drop, before the arm has opened.
- An arm above that is found or left HOLDING goes on to HANG_HOLD at once.
- A calibration is on the ground, and nothing depends on the arm: it is given up for anything. The tendons go back to
  where they were, the torque becomes what it was, and the zeros that were in force stay.
- What is carried is never let go by itself: the arm holds, and a person decides. Only a load that is gone already
  ends the carrying, in HOLDING.

"""


def document() -> str:
    """The whole page."""
    lines = [
        f"| cause | ARM_ERROR | {' | '.join(SITUATIONS)} | anywhere else (a) |",
        "| --- | --- |" + " --- |" * (len(SITUATIONS) + 1),
    ]
    for cause in CAUSES:
        bit = cause.bit.name if cause.bit else "-"
        cells = " | ".join(cell(cause, situation) for situation in SITUATIONS)
        lines.append(f"| {cause.name} | {bit} | {cells} | {cause.otherwise} |")
    return _HEADER + "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(document())
