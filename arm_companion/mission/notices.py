"""What people are told, once in a phase, about a cause that no row of the perch's table answers."""

from arm_companion.mission.facts import ArmFault, Severity
from arm_companion.mission.hang import throttle_lost
from arm_companion.mission.hazards import (
    disarmed,
    estimator_jumped,
    ground_lost,
    hot,
    low_voltage,
    model_blind,
    overrun,
    overstressed,
    servo_fault,
    slack,
    tendon_broken,
    tendon_jumped,
)
from arm_companion.mission.load import CARRYING
from arm_companion.mission.machine import Warned
from arm_companion.mission.perch import FREE_FLIGHT, GRASPING, GRIPPED, TENSE
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import MOVES_VEHICLE, Phase

Told = Warned[Phase, Situation]

WARNINGS: tuple[Told, ...] = (
    Told(TENSE, servo_fault, Severity.CRITICAL, "the arm holds"),
    *(
        Told(GRIPPED | {Phase.HOLDING}, guard, Severity.CRITICAL, "the arm holds")
        for guard in (tendon_broken, tendon_jumped)
    ),
    *(
        Told(
            frozenset({Phase.PERCHED, Phase.HOLDING}),
            guard,
            Severity.CRITICAL,
            "the arm holds; let go while it still can",
        )
        for guard in (hot, low_voltage)
    ),
    *(
        Told(
            frozenset(Phase) - FREE_FLIGHT - GRASPING - GRIPPED - {Phase.HOLDING} - CARRYING,
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
        for guard in (servo_fault, tendon_broken, tendon_jumped, hot, low_voltage, overstressed)
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
    Told(frozenset({Phase.HOLDING}), overstressed, Severity.CRITICAL, "the arm holds"),
    Told(frozenset(Phase), slack, Severity.WARNING),
    Told(MOVES_VEHICLE, model_blind, Severity.WARNING, "nothing is fed forward"),
    Told(frozenset(Phase) - {Phase.STARTUP, Phase.STOWED}, ground_lost, Severity.WARNING, "the autopilot decides"),
    Told(frozenset(Phase), overrun, Severity.WARNING, error=ArmFault.CYCLE_OVERRUN),
)
"""What a person must know and no transition tells."""
