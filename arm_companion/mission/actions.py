"""What each phase does while it lasts: arm bend, vehicle reference and set-point."""

import dataclasses

import numpy as np

from arm_companion.mission.facts import ArmAction, Setpoint, Vec3
from arm_companion.mission.motion import (
    ZERO,
    Reference,
    add,
    clip_norm,
    follow,
    norm,
    ramp,
    scale,
    sub,
    yaw_of,
)
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, State
from arm_companion.mission.wrench import grip

_PASSIVE = frozenset({Phase.STARTUP, Phase.STOWED, Phase.HOLDING})
_REFERENCE_RESTS = frozenset({Phase.READYING, Phase.READY, Phase.STOWING, Phase.STOWED, Phase.HOLDING, Phase.RELEASE})
_ORDER_OF_PERCH = (
    Phase.APPROACH,
    Phase.REACH,
    Phase.CONTACT,
    Phase.WRAP,
    Phase.VERIFY,
    Phase.PERCHED,
)
_ORDER_OF_RELEASE = (Phase.UNLOAD, Phase.RELEASE, Phase.DEPART, Phase.STOWING, Phase.STOWED)
_FOLLOW_S = 1.0
_NUDGE_M_PER_S = 0.01
_ACCELERATION = 0.6
_YAW_RATE = 0.6
_LEAN_RATE = 1.0  # m/s^3


def prepare(s: Situation) -> State:
    """Memory at the entry of the present phase."""
    state = s.state
    match state.phase:
        case Phase.READYING | Phase.STOWING | Phase.RELEASE:
            # from where the arm really is, so that torque coming on never jerks it
            bend = s.bend if _at_rest(s) else state.bend
            return dataclasses.replace(state, bend=bend, bend_goal=(0.0, 0.0))
        case Phase.HOLDING | Phase.STOWED:
            return dataclasses.replace(state, bend=s.bend, bend_goal=s.bend)
        case Phase.APPROACH:
            return dataclasses.replace(
                state,
                heading=s.heading_to_bar(),
                anchor=None,
                offset=ZERO,
                reference=state.reference or _here(s),
            )
        case Phase.REACH:
            return dataclasses.replace(state, force=dataclasses.replace(state.force, tared_s=0.0, above_s=0.0))
        case Phase.CONTACT:
            return dataclasses.replace(state, reference=_here(s, state.heading))
        case Phase.WRAP:
            x, y = s.towards_bar_a
            theta = s.config.perch.wrap_bend_rad
            return dataclasses.replace(state, bend_goal=(theta * x, theta * y))
        case Phase.VERIFY:
            return dataclasses.replace(
                state,
                anchor=grip(s),
                offset=ZERO,
                bend_goal=state.bend,
            )
        case Phase.UNLOAD:
            return dataclasses.replace(state, offset=ZERO, bend_goal=state.bend)
    return state


def act(s: Situation) -> tuple[State, ArmAction, tuple[float, ...] | None]:
    """One cycle of the present phase: the bend and the reference move on.

    Returns:
        Memory, what the servos do, and their goals (m of tendon taken in) when they are driven.
    """
    state = dataclasses.replace(s.state, reference=_reference(s), lean=_lean(s))
    if state.phase in _PASSIVE:
        return state, ArmAction.HOLD, None
    speed = s.config.perch.bend_speed_rad_per_s
    bend = _bend_towards(state.bend, state.bend_goal, speed * s.dt)
    pulls = s.parameters.model.pull_for_bend(np.asarray(bend))
    return dataclasses.replace(state, bend=bend), ArmAction.DRIVE, tuple(float(p) for p in pulls)


def setpoint(s: Situation) -> Setpoint | None:
    """The set-point that leaves now; None when the vehicle is not ours.

    Before the switch to external control the stream already runs at the vehicle's own position, because PX4
    accepts the switch only then.
    """
    reference = s.state.reference
    if not s.state.streaming or reference is None or not s.facts.vehicle.armed:
        return None
    return Setpoint(reference.position, reference.velocity, s.state.lean, reference.yaw)


def progress(s: Situation) -> int:
    """Per cent of the running order, from the phases passed."""
    for order in (_ORDER_OF_PERCH, _ORDER_OF_RELEASE):
        if s.state.phase in order:
            return round(100 * order.index(s.state.phase) / (len(order) - 1))
    return 100 if s.state.phase is Phase.READY else 0


def _at_rest(s: Situation) -> bool:
    return s.state.bend == s.state.bend_goal or not all(tendon.torque for tendon in s.facts.tendons)


def _here(s: Situation, yaw: float | None = None) -> Reference:
    vehicle = s.facts.vehicle
    return Reference(vehicle.position_w, ZERO, yaw_of(vehicle.attitude_wb) if yaw is None else yaw)


def _reference(s: Situation) -> Reference | None:
    """The vehicle's reference after this cycle."""
    state = s.state
    if not state.streaming or not s.vehicle_fresh:
        return state.reference  # frozen: acting on old state is worse than waiting
    if not s.external:
        return _here(s)
    reference = state.reference or _here(s)
    if state.phase in _REFERENCE_RESTS:
        return dataclasses.replace(reference, velocity=ZERO)
    if state.phase in (Phase.CONTACT, Phase.WRAP):
        # the arm is stiffer than the autopilot's position loop: asking for another place only winds it up
        share = min(s.dt / _FOLLOW_S, 1.0)
        way = scale(sub(s.facts.vehicle.position_w, reference.position), share)
        return Reference(add(reference.position, way), ZERO, state.heading)
    goal, speed = _goal(s)
    return follow(
        reference,
        goal,
        state.heading,
        speed=speed,
        acceleration=_ACCELERATION,
        yaw_rate=_YAW_RATE,
        dt=s.dt,
    )


def _goal(s: Situation) -> tuple[Vec3, float]:
    """Where the reference goes in a phase that moves the vehicle, and how fast."""
    perch = s.config.perch
    anchor = s.state.anchor.position_w if s.state.anchor else s.facts.vehicle.position_w
    match s.state.phase:
        case Phase.APPROACH:
            return s.place(perch.standoff_m), perch.approach_speed_m_per_s
        case Phase.DEPART:
            return s.place(perch.standoff_m), min(perch.approach_speed_m_per_s, s.config.limits.vehicle_speed_m_per_s)
        case Phase.REACH:
            return s.place(-perch.overreach_m), perch.reach_speed_m_per_s
        case Phase.VERIFY:
            return add(anchor, scale(s.ahead, -perch.verify_pull_m)), perch.verify_pull_m
        case _:
            return add(anchor, s.state.offset), _NUDGE_M_PER_S


def _lean(s: Situation) -> Vec3:
    """The acceleration fed forward, moved towards what the prediction asks for; zero where it asks for nothing."""
    prediction = s.state.prediction
    wanted = ZERO
    if s.state.phase is Phase.PERCHED and prediction is not None:
        wanted = clip_norm(prediction.lean, s.config.limits.feedforward_m_per_s2)
    return add(s.state.lean, clip_norm(sub(wanted, s.state.lean), _LEAN_RATE * s.dt))


def _bend_towards(bend: tuple[float, float], goal: tuple[float, float], most: float) -> tuple[float, float]:
    way = (goal[0] - bend[0], goal[1] - bend[1], 0.0)
    distance = norm(way)
    if distance <= most:
        return goal
    share = ramp(0.0, 1.0, most / distance, 1.0)
    return (bend[0] + share * way[0], bend[1] + share * way[1])
