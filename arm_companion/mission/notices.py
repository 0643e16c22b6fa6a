"""What people are told, once in a phase, about a cause that no row of the perch's table answers."""

from arm_companion.mission.facts import ArmFault, Severity
from arm_companion.mission.grasp import hangs_askew
from arm_companion.mission.hang import throttle_lost
from arm_companion.mission.hazards import (
    astray,
    disarmed,
    estimator_jumped,
    failsafe,
    ground_lost,
    hot,
    low_voltage,
    model_blind,
    overrun,
    overstressed,
    pilot_takes_over,
    servo_fault,
    servo_limp,
    slack,
    tendon_broken,
    tendon_jumped,
    unheard_at_start,
    vehicle_lost,
    wrench_over_limit,
)
from arm_companion.mission.machine import Warned
from arm_companion.mission.perch import FREE_FLIGHT, GRASPING, GRIPPED, TENSE
from arm_companion.mission.reach_table import left_point
from arm_companion.mission.sharing import SUSPENDED
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CALIBRATES, CARRYING, MOVES_VEHICLE, TIP, Phase

Told = Warned[Phase, Situation]

WARNINGS: tuple[Told, ...] = (
    Told(
        frozenset({Phase.STARTUP}),
        unheard_at_start,
        Severity.CRITICAL,
        "the arm is left as it is, and nothing is possible before it is heard",
    ),
    Told(TENSE, servo_fault, Severity.CRITICAL, "the arm holds"),
    Told(TENSE, servo_limp, Severity.CRITICAL, "the others hold", ArmFault.SERVO_FAULT),
    *(
        Told(GRIPPED | CARRYING | {Phase.HOLDING}, guard, Severity.CRITICAL, "the arm holds")
        for guard in (tendon_broken, tendon_jumped)
    ),
    *(
        Told(
            CARRYING | {Phase.PERCHED, Phase.HOLDING},
            guard,
            Severity.CRITICAL,
            "the arm holds; let go while it still can",
        )
        for guard in (hot, low_voltage)
    ),
    *(
        Told(
            frozenset(Phase) - FREE_FLIGHT - GRASPING - GRIPPED - CARRYING - SUSPENDED - TIP - {Phase.HOLDING},
            guard,
            Severity.WARNING,
            "no perch is begun",
        )
        for guard in (hot, low_voltage)
    ),
    *(
        Told(
            frozenset({Phase.TAKE_BACK, Phase.HANG_HOLD}),
            guard,
            Severity.CRITICAL,
            "the arm holds and cannot let go: let the motors carry the vehicle while it still can",
        )
        for guard in (servo_fault, servo_limp, tendon_broken, tendon_jumped, hot, low_voltage, overstressed)
    ),
    Told(
        frozenset({Phase.HANG_HOLD}),
        disarmed,
        Severity.CRITICAL,
        "it may hang by the arm, which holds: arm it before RELEASE",
    ),
    Told(frozenset({Phase.HANGING}), throttle_lost, Severity.WARNING, "the arm holds on"),
    Told(
        frozenset({Phase.PERCHED, Phase.HANGING}),
        estimator_jumped,
        Severity.WARNING,
        "the arm holds on",
        ArmFault.ESTIMATOR_JUMP,
    ),
    Told(CARRYING | {Phase.HOLDING}, overstressed, Severity.CRITICAL, "the arm holds"),
    Told(CARRYING, wrench_over_limit, Severity.CRITICAL, "the arm holds"),
    Told(frozenset({Phase.LIFT}), hangs_askew, Severity.WARNING, "the longer it is carried, the farther it turns"),
    *(
        Told(frozenset({Phase.CARRY}), guard, Severity.WARNING, "the arm holds on, no set-points", error)
        for guard, error in (
            (pilot_takes_over, ArmFault.PILOT_TOOK_OVER),
            (failsafe, ArmFault.AUTOPILOT_FAILSAFE),
        )
    ),
    *(
        Told(frozenset({Phase.CARRY}), guard, Severity.WARNING, "the arm holds on, the set-point stays", error)
        for guard, error in (
            (vehicle_lost, ArmFault.VEHICLE_LOST),
            (estimator_jumped, ArmFault.ESTIMATOR_JUMP),
        )
    ),
    Told(
        frozenset({Phase.CARRY}),
        astray,
        Severity.WARNING,
        "the arm holds on, the set-point comes to the vehicle",
        ArmFault.SETPOINT_REJECTED,
    ),
    Told(frozenset({Phase.TIP_HOLD}), left_point, Severity.WARNING, "the arm does what it can"),
    Told(frozenset(Phase) - CALIBRATES, slack, Severity.WARNING),
    Told(MOVES_VEHICLE, model_blind, Severity.WARNING, "a held arm's last stiffness stays"),
    Told(frozenset(Phase) - {Phase.STARTUP, Phase.STOWED}, ground_lost, Severity.WARNING, "the autopilot decides"),
    Told(frozenset(Phase), overrun, Severity.WARNING, error=ArmFault.CYCLE_OVERRUN),
)
"""What a person must know and no transition tells."""

TOLD_IN = {phase: [told for told in WARNINGS if phase in told.phases] for phase in Phase}
"""The same of each phase."""
