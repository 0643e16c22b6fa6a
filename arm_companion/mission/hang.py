"""The hang perch as rows of the table: from a tested grip of an arm above to motors that idle, and back.

An arm that may carry a vehicle opens for nobody before the motors carry it: every way out of these phases goes
through TAKE_BACK, which ends by the throttle, and what cannot be taken back is held in HANG_HOLD. With one
exception: by servos that hold nothing no vehicle hangs, and CLEAR_ERRORS leads out of HANG_HOLD (`refusals`).
"""

import math

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission import sharing
from arm_companion.mission.facts import ArmFault, Control, Order
from arm_companion.mission.hazards import (
    disarmed,
    estimator_jumped,
    failsafe,
    hot,
    low_voltage,
    overstressed,
    pilot_takes_over,
    servo_fault,
    servo_limp,
    tendon_broken,
    tendon_jumped,
    vehicle_lost,
    wrench_over_limit,
)
from arm_companion.mission.machine import OrderRow, Transition
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase

Row = Transition[Phase, Situation]
Ask = OrderRow[Phase, Situation]

HUNG = frozenset({Phase.LOAD_TRANSFER, Phase.HANGING})
"""Phases in which the arm carries more and more of the vehicle, or all that it shall."""

_STOWED_ONLY = frozenset({Phase.STOWED})
_UNLOAD = frozenset({Phase.UNLOAD})
_IDLE_MARGIN = 0.2  # of hover thrust, by which the motors may idle higher than asked


# --- guards ---


def carries(s: Situation) -> str | None:
    """An arm above that holds something may carry the vehicle."""
    return "an arm above may carry the vehicle" if s.arm_above else None


def slips(s: Situation) -> str | None:
    """The vehicle sinks, or slides along the bar, as it would not if the arm held."""
    hang, sinking = s.config.hang, s.facts.vehicle.velocity_w[2]
    if sinking > hang.fall_m_per_s:
        return f"slip: sinks with {sinking:.2f} m/s"
    if (slid := sharing.slid(s)) > hang.slip_m:
        return f"slip: moved {slid:.2f} m"
    if s.state.phase is Phase.LOAD_TRANSFER and (sunk := sharing.sunk(s)) > hang.give_m:
        return f"slip: sank {sunk:.2f} m under its load"
    return None


def throttle_lost(s: Situation) -> str | None:
    """The autopilot does not tell what its motors do: nobody knows how the load is shared."""
    return None if sharing.motor_share(s) is not None else "the motors' throttle is not known"


def hangs(s: Situation) -> str | None:
    """The last step down has been made, the motors idle, and the vehicle rests."""
    hang, share = s.config.hang, sharing.motor_share(s)
    now = s.state.sharing
    if share is None or now.share > hang.idle_share or now.rested_s < hang.rest_s:
        return None
    return f"hangs, motors at {share:.0%} of hover" if share <= hang.idle_share + _IDLE_MARGIN else None


def motors_carry(s: Situation) -> str | None:
    """The motors carry the vehicle again, so that the arm may let go."""
    if not sharing.carried(s):
        return None
    share = sharing.motor_share(s)
    return "the vehicle rose off the arm" if share is None else f"motors carry {share:.0%} of the hover's thrust"


def load_late(s: Situation) -> str | None:
    """The load does not move in the time allowed."""
    limit = s.config.hang.state_timeout_s
    return f"{s.state.phase.name.lower()} took more than {limit:g} s" if s.elapsed > limit else None


def taken_from_us(s: Situation) -> str | None:
    """The autopilot left our mode while we took the load back; a pilot who had it before may go on lifting."""
    return pilot_takes_over(s) if s.state.control is Control.EXTERNAL else None


def taken_before_it_opens(s: Situation) -> str | None:
    """The same, with the load taken back and the arm still whole: nobody knows what the stick asks of the motors.

    A pilot who has lifted it himself had the vehicle before, and is left to it.
    """
    return _still_wrapped(s, taken_from_us(s))


def failsafe_before_it_opens(s: Situation) -> str | None:
    """An autopilot that begins an emergency with the arm still whole may land the vehicle on it."""
    return _still_wrapped(s, failsafe(s))


def _still_wrapped(s: Situation, reason: str | None) -> str | None:
    return f"{reason}, the arm is still wrapped" if s.arm_above and reason is not None else None


def motors_drop(s: Situation) -> str | None:
    """The motors no longer carry the vehicle, and the arm is still so far around the bar that it can."""
    half_open = s.state.phase is Phase.RELEASE and math.hypot(*s.state.bend) < 0.5 * s.config.perch.wrap_bend_rad
    if not s.arm_above or not sharing.dropped(s) or half_open:
        return None
    return f"the motors no longer carry the vehicle: throttle {s.facts.vehicle.throttle:.0%}"


# --- orders ---


def cannot_hang(s: Situation) -> str | None:
    """Why a hang perch cannot begin now, beyond what any perch needs."""
    if not s.arm_above:
        return "the arm is not above the vehicle: it cannot hang by it"
    weight, limit = s.config.vehicle.mass_kg * GRAVITY, s.config.limits.wrench_force_n
    if weight > limit:
        return f"the vehicle's weight, {weight:.1f} N, is over limits.wrench_force_n = {limit:g}"
    if not sharing.throttle_known(s):
        return "the autopilot does not tell its throttle (VFR_HUD)"
    return None


def cannot_open(s: Situation) -> str | None:
    """Why an arm that holds something must not open now, though a person asks."""
    return "an arm above may carry the vehicle; ask again" if s.arm_above else None


def cannot_take_back(s: Situation) -> str | None:
    """Why the motors cannot take the load back now."""
    if (reason := disarmed(s)) is not None:
        away = "on the ground take the servos' power away, then CLEAR_ERRORS"
        return f"{reason} and may hang by the arm: arm it first; {away}"
    return vehicle_lost(s) or failsafe(s)


ORDERS: tuple[Ask, ...] = (
    Ask(Order.RELEASE, HUNG, Phase.TAKE_BACK, _STOWED_ONLY),
    Ask(Order.RELEASE, frozenset({Phase.HANG_HOLD}), Phase.TAKE_BACK, _STOWED_ONLY, cannot_take_back),
    Ask(Order.ABORT, HUNG, Phase.TAKE_BACK, frozenset({Phase.TAKE_BACK})),
    *(
        Ask(Order.ABORT, frozenset({phase}), phase, frozenset({phase}))  # it is on its way, or nobody can
        for phase in (Phase.TAKE_BACK, Phase.HANG_HOLD)
    ),
    # the vehicle is given back to us: set-points stream again, for an autopilot that wants them before the switch
    Ask(Order.READY, frozenset({Phase.HANG_HOLD}), Phase.HANG_HOLD, frozenset({Phase.HANG_HOLD})),
)

ABORTS: tuple[Row, ...] = (
    *(
        Row(phases, guard, Phase.HANG_HOLD, name, error)
        for phases, guard, name, error in (
            (HUNG, pilot_takes_over, "pilot takes over", ArmFault.PILOT_TOOK_OVER),
            (frozenset({Phase.TAKE_BACK}), taken_from_us, "pilot takes over", ArmFault.PILOT_TOOK_OVER),
            (sharing.SHARING, failsafe, "autopilot failsafe", ArmFault.AUTOPILOT_FAILSAFE),
            (sharing.SHARING, vehicle_lost, "vehicle lost", ArmFault.VEHICLE_LOST),
            (sharing.SHARING, disarmed, "disarmed", ArmFault.DISARMED),
        )
    ),
    *(
        Row(phases, guard, Phase.TAKE_BACK, name, error)
        for phases, guard, name, error in (
            (frozenset({Phase.LOAD_TRANSFER}), estimator_jumped, "estimator jump", ArmFault.ESTIMATOR_JUMP),
            (HUNG, slips, "slip", ArmFault.SLIP),
            (HUNG, servo_fault, "servo fault", ArmFault.SERVO_FAULT),
            (HUNG, servo_limp, "no torque", ArmFault.SERVO_FAULT),
            (HUNG, tendon_broken, "tendon broken", ArmFault.TENDON_BROKEN),
            (HUNG, tendon_jumped, "tendon jumped", ArmFault.TENSION_DISAGREES),
            (HUNG, hot, "servo hot", ArmFault.OVERHEAT),
            (HUNG, low_voltage, "low voltage", ArmFault.LOW_VOLTAGE),
            (HUNG, overstressed, "over-tension", ArmFault.TENDON_OVER_TENSION),
            (HUNG, wrench_over_limit, "wrench limit", ArmFault.WRENCH_LIMIT),
            (frozenset({Phase.LOAD_TRANSFER}), throttle_lost, "throttle not known", ArmFault.VEHICLE_STATE_STALE),
        )
    ),
    # the load is taken back, and the vehicle may still come down onto an arm that opens: it is held again
    *(
        Row(phases, guard, Phase.HOLDING, name, error)
        for phases, guard, name, error in (
            (_UNLOAD, taken_before_it_opens, "pilot takes over, arm above", ArmFault.PILOT_TOOK_OVER),
            (_UNLOAD, failsafe_before_it_opens, "autopilot failsafe, arm above", ArmFault.AUTOPILOT_FAILSAFE),
            (_UNLOAD | {Phase.RELEASE}, motors_drop, "motors drop, arm above", ArmFault.SETPOINT_REJECTED),
        )
    ),
)

PROGRESS: tuple[Row, ...] = (
    Row(frozenset({Phase.HOLDING}), carries, Phase.HANG_HOLD, "arm above"),
    Row(frozenset({Phase.LOAD_TRANSFER}), hangs, Phase.HANGING, "load transferred"),
    Row(frozenset({Phase.TAKE_BACK}), motors_carry, Phase.UNLOAD, "motors carry"),
)

LIMITS: tuple[Row, ...] = (
    Row(frozenset({Phase.LOAD_TRANSFER}), load_late, Phase.TAKE_BACK, "time limit", ArmFault.TIMEOUT),
    Row(frozenset({Phase.TAKE_BACK}), load_late, Phase.HANG_HOLD, "time limit", ArmFault.TIMEOUT),
)
