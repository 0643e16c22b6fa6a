"""Calibration of the tendons' zeros, ordered from the ground station: rows of the table, and what they do.

Nobody stands by, so it is given up for less than anything else: nothing depends on the arm, and the old zeros stay in
force. Every way out of CALIBRATING but success leads through EASING, which takes the tendons back to where they were.
"""

import math

from arm_companion.arm.parameters import ArmParameters
from arm_companion.config.schema import Config
from arm_companion.mission import course
from arm_companion.mission.facts import (
    Answer,
    ArmAction,
    ArmFault,
    Notice,
    Order,
    Result,
    Severity,
    Workshop,
)
from arm_companion.mission.hazards import hot, low_voltage, overstressed, servo_fault
from arm_companion.mission.machine import OrderRow, Transition
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, State
from arm_companion.procedures.tendon_zeros import Options, Setup, Zero, least_slack
from arm_companion.values import replace

Row = Transition[Phase, Situation]
Ask = OrderRow[Phase, Situation]

_CALIBRATING = frozenset({Phase.CALIBRATING})
_EASING = frozenset({Phase.EASING})
_TIME_LIMIT_S = 900.0
_STORING_S = 30.0
_EASING_S = 20.0
_BACK_M_PER_S = 0.02


# --- guards: what ends it early ---


def vehicle_arms(s: Situation) -> str | None:
    """The vehicle is about to fly, or flies."""
    if s.facts.vehicle.armed:
        return "the vehicle is armed"
    return None if s.facts.vehicle.landed else "the vehicle is not on the ground"


def vehicle_silent(s: Situation) -> str | None:
    """Nobody knows whether the vehicle is armed; where it is does not matter."""
    if s.vehicle_heard:
        return None
    age = s.facts.vehicle.heartbeat_age_s
    if math.isinf(age):
        return "the autopilot has not been heard"
    return f"the autopilot is silent, heartbeat {age:.1f} s old"


def finds_no_zeros(s: Situation) -> str | None:
    """The procedure cannot go on."""
    if s.state.course is None:
        return "no calibration is under way"
    return s.state.course.refusal or None


def not_stored(s: Situation) -> str | None:
    """The zeros were found, and cannot be kept."""
    if s.state.course is None or not s.state.course.zeros:
        return None
    if s.facts.workshop is not None and s.facts.workshop.kept:
        return f"the result is not stored: {s.facts.workshop.kept}"
    return f"the result is not stored within {_STORING_S:g} s" if s.state.course.waited_s > _STORING_S else None


def takes_too_long(s: Situation) -> str | None:
    """It should be over by now."""
    return f"calibrating took more than {_TIME_LIMIT_S:g} s" if s.elapsed > _TIME_LIMIT_S else None


# --- guards: what goes well ---


def stored(s: Situation) -> str | None:
    """The zeros are kept, and what the tendons do is counted from them."""
    found = s.state.course is not None and s.state.course.zeros
    kept = s.facts.workshop is not None and s.facts.workshop.kept == ""
    return "calibrated, the zeros are in use" if found and kept else None


def eased(s: Situation) -> str | None:
    """The tendons are where they were before the calibration."""
    return "tendons are back" if s.state.course is None else None


def easing_late(s: Situation) -> str | None:
    """The way back takes too long; there is nothing better to do."""
    return f"easing took more than {_EASING_S:g} s" if s.elapsed > _EASING_S else None


# --- the order ---


def cannot_calibrate(s: Situation) -> str | None:
    """Why a calibration cannot begin now."""
    if s.state.running is not None:
        return f"{s.state.running.order.name} is under way"
    if (reason := vehicle_silent(s) or vehicle_arms(s)) is not None:
        return reason
    if s.facts.workshop is None:
        return "nowhere to keep the result: calibration.directory is empty"
    if s.config.servos.coupling:
        return "coupled tendons cannot be taken up one at a time"
    if (fault := s.servo_fault or s.tendon_fault) is not None:
        return f"{fault}; mend it, then CLEAR_ERRORS"
    return hot(s) or low_voltage(s) or _too_tight(s)


def _too_tight(s: Situation) -> str | None:
    """Limits that are too narrow for the procedure."""
    options, arm = options_of(s.config), s.parameters.model.parameters
    needed = least_slack(arm, options.threshold)
    return f"limits.pull_max_m is under {2.0 * needed:.3f}" if options.slack < needed else None


def options_of(config: Config) -> Options:
    """How the tendons are taken up, within the limits."""
    usual, limits = Options(), config.limits
    return Options(
        min(usual.threshold, 0.5 * limits.tension_max_n),
        min(usual.slack, 0.5 * limits.pull_max_m),
        min(config.calibration.take_up_m_per_s, 0.5 * limits.pull_speed_m_per_s),
        min(usual.travel, limits.pull_max_m),
    )


ORDERS: tuple[Ask, ...] = (
    Ask(Order.CALIBRATE, frozenset({Phase.STOWED}), Phase.CALIBRATING, frozenset({Phase.STOWED}), cannot_calibrate),
    Ask(Order.ABORT, _CALIBRATING, Phase.EASING, _EASING),
    Ask(Order.ABORT, _EASING, Phase.EASING, _EASING),  # it is being given up already
    Ask(Order.STOW, _CALIBRATING, Phase.EASING, frozenset({Phase.STOWED})),
    Ask(Order.STOW, _EASING, Phase.EASING, frozenset({Phase.STOWED})),
)

ABORTS: tuple[Row, ...] = tuple(
    Row(_CALIBRATING, guard, Phase.EASING, name, error)
    for guard, name, error in (
        (vehicle_arms, "vehicle arms", ArmFault.CALIBRATION_FAILED),
        (vehicle_silent, "autopilot silent", ArmFault.VEHICLE_LOST),
        (servo_fault, "servo fault", ArmFault.SERVO_FAULT),
        (overstressed, "over-tension", ArmFault.TENDON_OVER_TENSION),
        (hot, "servo hot", ArmFault.OVERHEAT),
        (low_voltage, "low voltage", ArmFault.LOW_VOLTAGE),
        (finds_no_zeros, "no zeros found", ArmFault.CALIBRATION_FAILED),
        (not_stored, "not stored", ArmFault.CALIBRATION_FAILED),
    )
)

PROGRESS: tuple[Row, ...] = (
    Row(_CALIBRATING, stored, Phase.STOWED, "zeros stored"),
    Row(_EASING, eased, Phase.STOWED, "tendons back"),
)

LIMITS: tuple[Row, ...] = (
    Row(_CALIBRATING, takes_too_long, Phase.EASING, "time limit", ArmFault.TIMEOUT),
    Row(_EASING, easing_late, Phase.STOWED, "time limit", ArmFault.TIMEOUT),
)


# --- what it does ---


def prepare(s: Situation) -> State:
    """Memory at the entry of CALIBRATING, or of EASING."""
    under_way = s.state.course
    if s.state.phase is Phase.EASING:
        return replace(s.state, course=None if under_way is None else course.back(under_way), pulls=())
    workshop = s.facts.workshop
    if workshop is None or not s.facts.tendons:
        return replace(s.state, course=None)
    return replace(s.state, course=course.begin(setup_of(s.config, workshop), s.facts.tendons), pulls=())


def setup_of(config: Config, workshop: Workshop) -> Setup:
    """What the procedure needs to know of the arm."""
    servos = config.servos
    return Setup(
        ArmParameters.of(config.arm),
        workshop.curves,
        servos.directions,
        servos.ids,
        workshop.m_per_tick,
        config.limits.tension_max_n,
        options_of(config),
    )


def act(s: Situation) -> tuple[State, ArmAction, tuple[float, ...] | None]:
    """One cycle of CALIBRATING or EASING: memory, what the servos do, and their goals."""
    now, tendons = s.state.course, s.facts.tendons
    if now is None or len(tendons) != len(now.origin):
        return replace(s.state, course=None), ArmAction.HOLD, None
    if s.state.phase is Phase.EASING:
        now, done = course.go_back(now, tendons, _speed_back(s), s.dt)
        if done:
            return replace(s.state, course=None), ArmAction.HOLD, None
    elif not now.ended:
        now = course.carry_on(now, tendons, s.dt)
    else:
        now = replace(now, said="", waited_s=now.waited_s + s.dt)
    state = replace(s.state, course=now)
    return (state, ArmAction.LIMP, None) if now.limp else (state, ArmAction.WIND, now.pulls)


def _speed_back(s: Situation) -> float:
    return min(_BACK_M_PER_S, 0.5 * s.config.limits.pull_speed_m_per_s)


def tell(before: State, s: Situation, answers: list[Answer], notices: list[Notice]) -> tuple[Zero, ...]:
    """Tell people, and whoever ordered it, what came of this cycle.

    Args:
        before: memory before `act`.
        s: the cycle, with memory after it.
        answers: to be added to.
        notices: to be added to.

    Returns:
        The zeros, in the cycle in which they are found.
    """
    old, now, running = before.course, s.state.course, s.state.running
    if s.state.phase is not Phase.CALIBRATING or now is None or old is None:
        return ()
    if now.said:
        notices.append(Notice(Severity.INFO, now.said))
    if running is not None and now.progress != old.progress:
        answers.append(Answer(running.request, Result.IN_PROGRESS, progress=now.progress))
    if old.zeros:
        return ()
    for i, zero in enumerate(now.zeros):
        text = f"tendon {i + 1}: zero {zero.ticks:+d} ticks from before, +-{1e3 * zero.sigma:.2f} mm"
        notices.append(Notice(Severity.INFO, text))
    return now.zeros
