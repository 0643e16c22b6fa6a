"""The mission's step: a pure function from memory and facts to memory and commands."""

from arm_companion.arm.tension import fuse
from arm_companion.errors import CommandRejected
from arm_companion.mission import actions, calibrating, carry, gripper, reaching
from arm_companion.mission.estimate import (
    delayed,
    observe_force,
    smooth_position,
    smooth_tensions,
    tare,
    time_above,
)
from arm_companion.mission.facts import (
    Answer,
    ArmAction,
    ArmFault,
    Commands,
    Facts,
    Notice,
    Order,
    Request,
    Result,
    Severity,
    TensionEstimate,
)
from arm_companion.mission.jog import follow_stream, jog
from arm_companion.mission.motion import ZERO
from arm_companion.mission.notices import TOLD_IN
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.perch import TABLE
from arm_companion.mission.refusals import mend_first, not_in
from arm_companion.mission.report import status_report
from arm_companion.mission.sharing import keep_sharing
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CALIBRATES, MOVES_VEHICLE, PerchKind, Phase, Prediction, Running, State
from arm_companion.mission.tendon_watch import watch
from arm_companion.mission.tries import given_up
from arm_companion.mission.vigil import keep_vigil
from arm_companion.mission.wrench import predict
from arm_companion.values import replace

_CLEAR_TIMEOUT_S = 6.0
_MOVES = {Order.JOG: jog, Order.REACH: reaching.plan}
_BESIDE = frozenset({Order.JOG, Order.FEEDFORWARD})  # orders that leave the running one alone

SAFE_ACTION: dict[Phase, ArmAction] = dict.fromkeys(Phase, ArmAction.HOLD) | dict.fromkeys(CALIBRATES, ArmAction.LIMP)
"""What the servos do in each phase when the cycle itself fails or the daemon is told to stop.

An anchored arm must not let go by itself, a free one must not move by itself: each keeps its goals. Torque is
cut only in a calibration, where one tendon may be pulling against nothing and the arm is to hang again; elsewhere a
phase in which a limp arm is safe (stowed, on the ground) is also safe with torque on.
"""


def step(state: State, facts: Facts, t: float, parameters: Parameters) -> tuple[State, Commands]:
    """One cycle: orders, then transitions, then the phase's action.

    Args:
        state: memory after the previous step.
        facts: the world as known now.
        t: loop time, s.
        parameters: configuration and arm model.

    Returns:
        Memory after this step and everything that it asks for.
    """
    answers: list[Answer] = []
    notices: list[Notice] = []
    situation = Situation(state, facts, t, parameters)
    situation = situation.remembering(_estimate(situation))
    situation = _yield_to_pilot(situation, notices)
    for request in facts.requests:
        situation = _obey(situation, request, answers, notices)
    situation = situation.remembering(follow_stream(situation, notices))
    situation = _move_on(situation, answers, notices)
    situation = situation.remembering(gripper.settled(state, situation))
    recover = _begins_clearing(situation)
    situation = _finish_clearing(situation, answers)
    state, arm, pulls = actions.act(situation)
    before, situation = situation.state, situation.remembering(state)
    zeros = calibrating.tell(before, situation, answers, notices)
    prediction = predict(situation)
    state = replace(
        _warn(situation, notices),
        t=t,
        prediction=prediction,
        control=facts.vehicle.control,
        armed=facts.vehicle.armed,
        moved_at=_moved_at(situation),
    )
    commands = Commands(
        arm,
        pulls,
        actions.setpoint(situation),
        tuple(answers),
        tuple(notices),
        status_report(situation, prediction),
        prediction.wrench,
        recover=recover,
        tensions=_tensions(facts, state, prediction),
        stiffness=prediction.stiffness,
        payload=carry.report(situation),
        zeros=zeros,
        gripper=state.grip.order,
    )
    return state, commands


def _estimate(s: Situation) -> State:
    """The observers after this cycle."""
    s = s.remembering(keep_vigil(s))
    state, perch = s.state, s.config.perch
    expected = state.prediction.tensions if state.prediction is not None else ()
    force = (
        observe_force(state.force, s.facts.vehicle, s.config.vehicle.mass_kg, s.dt) if s.vehicle_fresh else state.force
    )
    if state.phase is Phase.REACH and not s.gripping:
        force = force if s.near_bar and force.tared else tare(force, s.dt)
        # the bar pushes the arm, and with it the vehicle, back
        force = time_above(force, (-s.ahead[0], -s.ahead[1]), perch.contact_force_n, s.dt)
    return replace(
        state,
        force=force,
        felt=delayed(state.felt, state.lean, s.dt),
        tension=smooth_tensions(state.tension, s.facts.tendons, s.dt),
        watch=watch(state.watch, s.facts.tendons, expected, s.dt, s.config.limits),
        load=carry.track_load(s),
        grip=gripper.watch(s),
        position=smooth_position(state.position, s.facts.vehicle, s.dt),
        sharing=keep_sharing(s),
    )


def _moved_at(s: Situation) -> float | None:
    """When our set-points last asked the vehicle to move, or pushed; None: it is not ours."""
    state = s.state
    if not (s.external and state.streaming and s.facts.vehicle.armed):
        return None
    pushes = state.moved_at is not None and state.lean != ZERO
    return s.t if state.phase in MOVES_VEHICLE or pushes else state.moved_at


def _yield_to_pilot(s: Situation, notices: list[Notice]) -> Situation:
    """Stop the set-points in the very cycle in which the autopilot leaves our mode."""
    if not (s.pilot_took_over and s.state.streaming):
        return s
    notices.append(Notice(Severity.NOTICE, f"set-points stopped: mode {s.facts.vehicle.mode}"))
    return s.remembering(replace(s.state, streaming=False, reference=None))


def _obey(s: Situation, request: Request, answers: list[Answer], notices: list[Notice]) -> Situation:
    """Carry out one order, or reject it and change nothing."""
    name, phase, asked = request.order.name, s.state.phase, s
    try:
        if request.order is Order.PERCH:
            asked = s.remembering(replace(s.state, kind=_kind(request)))
        row = TABLE.order(request.order, phase)
        if row is None:
            raise CommandRejected(not_in(request.order, phase))
        if (reason := row.refusal(asked)) is not None:
            raise CommandRejected(reason)
        moved = _MOVES[request.order](s, request) if request.order in _MOVES else s.state
    except CommandRejected as rejected:
        again_later = TABLE.known(request.order)
        result = Result.TEMPORARILY_REJECTED if again_later else Result.DENIED
        answers.append(Answer(request.id, result, rejected.reason))
        return s
    s = s.remembering(moved)
    if s.state.running is not None and request.order not in _BESIDE:
        answers.append(Answer(s.state.running.request, Result.CANCELLED, f"{name} ordered"))
        s = s.remembering(replace(s.state, running=None))
    s = s.remembering(_settle(s.state, request))
    if row.target is not phase:
        aborted = ArmFault.OPERATOR_ABORT if request.order is Order.ABORT else ArmFault.NONE
        s = _enter(s, row.target, f"order {name}", notices, aborted)
    if s.state.phase in row.done:
        answers.append(Answer(request.id, Result.ACCEPTED, progress=100))
        return s
    answers.append(Answer(request.id, Result.IN_PROGRESS, progress=0))
    return s.remembering(replace(s.state, running=Running(request.id, request.order, row.done, s.t)))


def _settle(state: State, request: Request) -> State:
    """What an order changes in memory besides the phase."""
    match request.order:
        case Order.READY:
            return replace(state, streaming=True, errors=ArmFault.NONE)
        case Order.CALIBRATE:
            return replace(state, errors=ArmFault.NONE)
        case Order.PERCH:
            return replace(state, errors=ArmFault.NONE, task=request.order, kind=_kind(request), tries=0)
        case Order.REACH:
            return replace(state, errors=ArmFault.NONE)
        case Order.GRASP:
            return replace(state, errors=ArmFault.NONE, task=request.order, kind=PerchKind.ANCHOR, tries=0)
        case Order.CLEAR_ERRORS:  # a person has looked at the tendons
            return replace(state, errors=ArmFault.NONE, watch=())
        case Order.FEEDFORWARD:
            return replace(state, feedforward=bool(request.parameters[0]))
    return state


def _kind(request: Request) -> PerchKind:
    """Which perch a PERCH asks for."""
    return PerchKind(int(request.parameters[0])) if request.parameters else PerchKind.ANCHOR


def _begins_clearing(s: Situation) -> bool:
    """Whether CLEAR_ERRORS came in this cycle and there is something to bring back."""
    running = s.state.running
    began = running is not None and running.order is Order.CLEAR_ERRORS and running.since == s.t
    return began and s.servo_fault is not None


def _finish_clearing(s: Situation, answers: list[Answer]) -> Situation:
    """Answer CLEAR_ERRORS once the servos are well, or after as long as bringing them back may take."""
    running = s.state.running
    if running is None or running.order is not Order.CLEAR_ERRORS:
        return s
    if (fault := s.servo_fault) is None:
        answers.append(Answer(running.request, Result.ACCEPTED, progress=100))
    elif s.t - running.since > _CLEAR_TIMEOUT_S:
        answers.append(Answer(running.request, Result.FAILED, mend_first(fault)))
    else:
        return s
    return s.remembering(replace(s.state, running=None))


def _move_on(s: Situation, answers: list[Answer], notices: list[Notice]) -> Situation:
    """Apply the first row that fires, and tell whoever waits for the outcome."""
    fired = TABLE.next(s.state.phase, s)
    if fired is None:
        return s
    row, reason = fired
    s = _enter(s, row.target, reason, notices, row.error)
    running = s.state.running
    if running is None:
        return s
    if row.fails or given_up(running, s.state.phase):
        answers.append(Answer(running.request, Result.FAILED, reason))
    elif s.state.phase in running.done:
        answers.append(Answer(running.request, Result.ACCEPTED, progress=100))
    else:
        answers.append(Answer(running.request, Result.IN_PROGRESS, reason, actions.progress(s)))
        return s
    return s.remembering(replace(s.state, running=None))


def _enter(s: Situation, phase: Phase, reason: str, notices: list[Notice], error: ArmFault) -> Situation:
    """Change the phase: one notice with its cause, and the phase's own preparations."""
    severity = Severity.WARNING if error else Severity.INFO
    notices.append(Notice(severity, f"{s.state.phase.name} -> {phase.name}: {reason}"))
    state = replace(
        s.state,
        phase=phase,
        since=s.t,
        errors=s.state.errors | error,
        warned=frozenset(),
    )
    return s.remembering(actions.prepare(s.remembering(state)))


def _warn(s: Situation, notices: list[Notice]) -> State:
    """Say once per phase what a person must know and no transition tells; what the reason counts may go on changing."""
    state = s.state
    for told in TOLD_IN[state.phase]:
        name = told.guard.__name__
        if name in state.warned or (reason := told.guard(s)) is None:
            continue
        notices.append(Notice(told.severity, f"{reason}; {told.consequence}" if told.consequence else reason))
        state = replace(state, warned=state.warned | {name}, errors=state.errors | told.error)
    return state


def _tensions(facts: Facts, state: State, prediction: Prediction) -> tuple[TensionEstimate, ...]:
    """Tensions by load and statics together, where the statics know them and nothing contradicts them."""
    if len(prediction.tensions) != len(facts.tendons) or len(state.watch) != len(facts.tendons):
        return tuple(TensionEstimate(t.tension, t.tension_sigma) for t in facts.tendons)
    return tuple(
        TensionEstimate(*fuse((t.tension, t.tension_sigma), (says.tension, says.sigma)))
        if says.exact and t.torque and t.homed and not (t.silent or suspect.fault)
        else TensionEstimate(t.tension, t.tension_sigma)
        for t, says, suspect in zip(facts.tendons, prediction.tensions, state.watch, strict=True)
    )
