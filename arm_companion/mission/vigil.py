"""What has to last before it counts: how long each doubtful fact has held, and jumps of the vehicle's position."""

import math

from arm_companion.mission.facts import TendonState, Vec3
from arm_companion.mission.gripper_facts import JawState
from arm_companion.mission.motion import ZERO, add, low_pass, norm, scale, sub
from arm_companion.mission.situation import Situation, at
from arm_companion.mission.state import FOLLOWS, State
from arm_companion.values import replace

HEAT_MARGIN_K = 7.0
"""A servo is called hot by so much before it lets go."""

VOLTAGE_MARGIN_V = 0.5
"""The supply is called low by so much before a servo reports it."""

_JUMP_M = 0.25  # more than the estimator's noise, less than what hurts at a bar
_GAP_S = 1.0  # without a fresh position, after which the vehicle may be anywhere
_BURST_M_PER_S2 = 0.75  # a quarter of the acceleration with which a hover ends and another begins unseen
_JUMPS = 8  # that are remembered one by one
_AWAY_S = 3.0
_RESTS_M = 0.02
_ROCKING_S = 1.0
_ASTRAY_M = 0.5  # the reference moves at half a metre a second, and a multirotor lags it by less than a second


def keep_vigil(s: Situation) -> State:
    """Memory with the timers of this cycle; after a jump of the position, everything known moves with it."""
    if (leap := _leap(s)) is not None:
        s = s.remembering(_move_frame(s, leap))
    state, dt = s.state, s.dt
    limits, servos, tendons = s.config.limits, s.config.servos, s.facts.tendons
    heard = [tendon for tendon in tendons if not tendon.silent and math.isfinite(tendon.tension_sigma)]
    answering: list[TendonState | JawState] = [*heard]
    if s.jaws is not None and not s.jaws.silent:
        answering.append(s.jaws)

    def time(before: float, *, holds: bool) -> float:
        return before + dt if holds else 0.0

    before = state.vigil
    if _new_frame(s):
        before = replace(before, jumps=())
    if s.vehicle_fresh:
        vehicle = s.facts.vehicle
        before = replace(before, position_w=vehicle.position_w, velocity_w=vehicle.velocity_w, unseen_s=0.0)
    else:
        unseen_s = before.unseen_s + s.t - s.state.t
        known = max(unseen_s, s.facts.vehicle.position_age_s) <= _GAP_S
        before = replace(before, unseen_s=unseen_s, position_w=before.position_w if known else None)
    vigil = replace(
        before,
        astray_s=time(before.astray_s, holds=_astray(s)),
        hot_s=time(
            before.hot_s, holds=any(t.temperature > servos.temperature_limit_c - HEAT_MARGIN_K for t in answering)
        ),
        low_s=time(before.low_s, holds=any(t.voltage < servos.voltage_min_v + VOLTAGE_MARGIN_V for t in answering)),
        slack_s=time(
            before.slack_s,
            holds=any(t.torque and t.tension + 2.0 * t.tension_sigma < limits.tension_min_n for t in heard),
        ),
        tight_s=time(before.tight_s, holds=any(t.tension > limits.tension_max_n for t in heard)),
        blind_s=time(before.blind_s, holds=_blind(s)),
        unheard_s=time(before.unheard_s, holds=not s.heard),
        rested_s=time(before.rested_s, holds=_rests(s)),
        rocking=_rocking(s, before.rocking),
    )
    return replace(state, vigil=vigil)


def _new_frame(s: Situation) -> bool:
    """Whether the autopilot has been away on the ground, restarted perhaps: its new frame has not jumped yet."""
    vehicle = s.facts.vehicle
    return not vehicle.armed and max(vehicle.position_age_s, vehicle.heartbeat_age_s) > _AWAY_S


def _astray(s: Situation) -> bool:
    """Whether a vehicle that should follow the reference is far from it."""
    reference = s.state.reference
    if s.state.phase not in FOLLOWS or reference is None or not (s.external and s.vehicle_fresh):
        return False
    return norm(sub(reference.position, s.facts.vehicle.position_w)) > _ASTRAY_M


def _rests(s: Situation) -> bool:
    """Whether the vehicle is where a reference is that rests itself."""
    reference = s.state.reference
    if reference is None or reference.velocity != ZERO or not s.vehicle_fresh:
        return False
    return at(s, reference.position, _RESTS_M)


def _rocking(s: Situation, before: float) -> float:
    """Mean square of the rates of roll and pitch; what is old or no number leaves it as it was."""
    roll, pitch, _ = s.facts.vehicle.rate_b
    now = roll * roll + pitch * pitch
    return low_pass(before, now, s.dt, _ROCKING_S) if s.vehicle_fresh and math.isfinite(now) else before


def _blind(s: Situation) -> bool:
    """Whether the mechanics found no equilibrium for what the arm is doing now."""
    prediction = s.state.prediction
    return prediction is not None and s.vehicle_fresh and math.isnan(prediction.wrench.residual)


def _leap(s: Situation) -> Vec3 | None:
    """By how much the estimator moved the vehicle since it was seen last, m; None when the vehicle may have flown it.

    Between two positions lie at most the way that the greater of both speeds makes, and the estimator's noise; after
    a gap, which is how many an estimator begins anew, what may have been flown unseen besides.
    """
    last, vehicle = s.state.vigil, s.facts.vehicle
    if last.position_w is None or not s.vehicle_fresh:
        return None
    way = sub(vehicle.position_w, last.position_w)
    speed = max(norm(vehicle.velocity_w), norm(last.velocity_w))
    gap = last.unseen_s + s.t - s.state.t
    flown = speed * (gap + s.config.vehicle.state_timeout_s) + _BURST_M_PER_S2 * gap**2
    return sub(way, scale(vehicle.velocity_w, gap)) if norm(way) > _JUMP_M + flown else None


def _move_frame(s: Situation, leap: Vec3) -> State:
    """Everything that is remembered in world axes moves with the estimate: the vehicle itself has not moved.

    Without this an anchored vehicle would seem to have slipped, and a free one would be sent back by the jump.
    """
    state = s.state
    anchor, reference = state.anchor, state.reference
    jumps = (*state.vigil.jumps, (s.t, leap))
    if len(jumps) > _JUMPS:  # the two oldest are one: few targets are older than one of them and not the other
        (_, first), (at, second), *rest = jumps
        jumps = ((at, add(first, second)), *rest)
    return replace(
        state,
        reference=None if reference is None else replace(reference, position=add(reference.position, leap)),
        contact_w=None if state.contact_w is None else add(state.contact_w, leap),
        position=add(state.position, leap),
        anchor=None if anchor is None else replace(anchor, position_w=add(anchor.position_w, leap)),
        sharing=replace(state.sharing, place=add(state.sharing.place, leap), first=state.sharing.first + leap[2]),
        rest=None if state.rest is None else add(state.rest, leap),
        vigil=replace(state.vigil, jumps=jumps, jumped_at=s.t, leap_m=norm(leap)),
    )
