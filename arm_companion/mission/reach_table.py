"""The rows that REACH adds to the table: the tip goes to a point and stays there until something else is asked for."""

from arm_companion.mission.facts import ArmFault, Order
from arm_companion.mission.hazards import (
    astray,
    estimator_jumped,
    failsafe,
    hot,
    low_voltage,
    motors_stopped,
    overstressed,
    pilot_takes_over,
    servo_fault,
    servo_limp,
    tendon_broken,
    tendon_jumped,
    vehicle_lost,
)
from arm_companion.mission.machine import OrderRow, Transition
from arm_companion.mission.reaching import WITHIN_S, tip_error
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import TIP, Phase

Row = Transition[Phase, Situation]
Ask = OrderRow[Phase, Situation]

_JUDGED_S = 1.0
_LEFT = 2.0


def taken_over(s: Situation) -> str | None:
    """The autopilot left our mode in this cycle; who flies by hand from the start is left to it."""
    return pilot_takes_over(s) if s.pilot_took_over else None


def at_point(s: Situation) -> str | None:
    """The tip has been at its point for a while."""
    reach = s.state.reach
    return tip_error(s) if reach is not None and reach.within_s >= WITHIN_S else None


def not_in_time(s: Situation) -> str | None:
    """The tip is not at its point in time."""
    limit = s.config.reach.state_timeout_s
    return f"after {limit:g} s the {tip_error(s)}" if s.elapsed > limit else None


def left_point(s: Situation) -> str | None:
    """A tip that was at its point is no longer there."""
    reach = s.state.reach
    if reach is None or s.elapsed < _JUDGED_S or reach.error_m <= _LEFT * s.config.reach.tolerance_m:
        return None
    return tip_error(s)


def cannot_reach(s: Situation) -> str | None:
    """Why no point can be reached now."""
    if (lost := vehicle_lost(s)) is not None:
        return lost
    return hot(s) or low_voltage(s)


ORDERS: tuple[Ask, ...] = (
    Ask(Order.REACH, frozenset({Phase.READY}) | TIP, Phase.TIP_MOVE, frozenset({Phase.TIP_HOLD}), cannot_reach),
    Ask(Order.READY, TIP, Phase.READYING, frozenset({Phase.READY})),
    Ask(Order.STOW, TIP, Phase.STOWING, frozenset({Phase.STOWED})),
    Ask(Order.ABORT, TIP, Phase.STOWING, frozenset({Phase.STOWING})),
)

ABORTS: tuple[Row, ...] = tuple(
    Row(TIP, guard, Phase.STOWING, label, error)
    for guard, label, error in (
        (taken_over, "pilot takes over", ArmFault.PILOT_TOOK_OVER),
        (failsafe, "autopilot failsafe", ArmFault.AUTOPILOT_FAILSAFE),
        (vehicle_lost, "vehicle lost", ArmFault.VEHICLE_LOST),
        (motors_stopped, "motors stop", ArmFault.DISARMED),
        (estimator_jumped, "estimator jump", ArmFault.ESTIMATOR_JUMP),
        (astray, "set-points not followed", ArmFault.SETPOINT_REJECTED),
        (servo_fault, "servo fault", ArmFault.SERVO_FAULT),
        (servo_limp, "no torque", ArmFault.SERVO_FAULT),
        (tendon_broken, "tendon broken", ArmFault.TENDON_BROKEN),
        (tendon_jumped, "tendon jumped", ArmFault.TENSION_DISAGREES),
        (hot, "servo hot", ArmFault.OVERHEAT),
        (low_voltage, "low voltage", ArmFault.LOW_VOLTAGE),
        (overstressed, "over-tension", ArmFault.TENDON_OVER_TENSION),
    )
)

PROGRESS: tuple[Row, ...] = (
    Row(frozenset({Phase.TIP_MOVE}), at_point, Phase.TIP_HOLD, "tip at its point"),
    Row(frozenset({Phase.TIP_MOVE}), not_in_time, Phase.TIP_HOLD, "time limit", ArmFault.TIMEOUT),
)
