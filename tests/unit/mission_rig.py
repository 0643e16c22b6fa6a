"""The mission in simulated time without devices: memory in any phase, facts that change, and laws that always hold."""

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from arm_companion.arm.reaction import GRAVITY
from arm_companion.arm.tension import LoadCurve
from arm_companion.config import Config
from arm_companion.mission import calibrating
from arm_companion.mission.course import Course
from arm_companion.mission.facts import ArmAction, Commands, Control, Facts, Order, Request, Workshop
from arm_companion.mission.glide import Glide
from arm_companion.mission.gripper_facts import GripperAction, GripperState, JawState
from arm_companion.mission.mission import step
from arm_companion.mission.motion import Reference, norm, sub
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.sharing import SUSPENDED
from arm_companion.mission.state import CALIBRATES, CARRYING, MOVES_VEHICLE, TIP, Anchor, Phase, Reach, Sharing, State
from arm_companion.values import replace

DT = 0.01
T0 = 100.0
PLACE = (2.0, 0.0, -2.2)
MET = (2.942, 0.0, -2.18)
"""Where the arm touches the configured bar."""
ANCHOR = Anchor(PLACE, (1.0, 0.0, 0.0, 0.0), (8.0, 4.0, 1.0, 4.0))
BENT = (3.0, 0.0)
HUNG = Sharing(hover=0.5, share=0.25, step=0.25, place=PLACE, first=PLACE[2])
REACH = Reach((2.0, 0.0, -1.78), PLACE, (0.0, 0.0), False, 1.0, Glide.rest(PLACE), Glide.rest((0.0, 0.0, 0.0)), PLACE)
"""A tip that is on its way: 5 cm from its point, though vehicle and arm have done what they were asked to."""
HELD = CARRYING | SUSPENDED | {Phase.VERIFY, Phase.PERCHED, Phase.UNLOAD, Phase.RELEASE, Phase.HOLDING}
"""Phases in which the arm is around the bar, or around the object."""

SETUP = calibrating.setup_of(Config(), Workshop((LoadCurve(150.0, 12.0, 0.1, 0.0, 5.0, 1.5, 0.02),) * 4, 1.5e-5))
COURSE = Course((0.0,) * 4, held=True, goal=(0.0,) * 4, setup=SETUP)
"""A calibration that has just been begun."""

Change = Callable[[Facts], Facts]


def memory(phase: Phase, **fields: object) -> State:
    """Memory of a mission that has just come into `phase`, the vehicle at PLACE under set-points."""
    held = phase in HELD
    bend = BENT if held else (0.0, 0.0)
    known: dict[str, object] = {
        "t": T0,
        "since": T0 - 0.1,
        "control": Control.EXTERNAL,
        "armed": phase not in CALIBRATES,
        "streaming": phase is not Phase.STARTUP,
        "reference": Reference(PLACE),
        "position": PLACE,
        "contact_w": MET if phase in {Phase.APPROACH, Phase.REACH, Phase.DEPART} else PLACE,
        "anchor": ANCHOR if held else None,
        "sharing": HUNG if phase in SUSPENDED else Sharing(),
        "reach": REACH if phase in TIP else None,
        "tension": (8.0, 4.0, 1.0, 4.0),
        "task": Order.GRASP if phase in CARRYING | {Phase.CLOSE} else Order.PERCH,
        "course": {Phase.CALIBRATING: COURSE, Phase.EASING: replace(COURSE, goal=(-0.1,) * 4)}.get(phase),
        "bend": bend,
        "bend_goal": (0.0, 0.0) if phase is Phase.RELEASE else bend,
    }
    return State(phase=phase, **{**known, **fields})  # type: ignore[arg-type]


def run(state: State, facts: Facts, parameters: Parameters, seconds: float = DT) -> tuple[State, list[Commands]]:
    """Let `seconds` pass with the same facts; requests count once."""
    said = []
    t = state.t or T0
    for _ in range(max(round(seconds / DT), 1)):
        t += DT
        state, commands = step(state, facts, t, parameters)
        said.append(commands)
        facts = dataclasses.replace(facts, requests=())
    return state, said


@dataclass
class Run:
    """A mission that steps, and everything that it said."""

    state: State
    parameters: Parameters
    said: list[Commands] = dataclasses.field(default_factory=list)
    phases: list[Phase] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        self.silent = False  # the pilot took over, and nobody has ordered READY since
        self.phases.append(self.state.phase)

    def cycle(self, facts: Facts, dt: float = DT) -> Commands:
        """One step, after which all laws hold."""
        before = self.state
        self.state, commands = step(before, facts, before.t + dt, self.parameters)
        self.said.append(commands)
        if self.state.phase is not self.phases[-1]:
            self.phases.append(self.state.phase)
        self._check(before, facts, commands)
        check_load(before, self.state, facts, commands)
        check_gripper(before, self.state, commands)
        return commands

    def cycles(self, facts: Facts, seconds: float) -> None:
        """The same facts for a while; requests come once."""
        for _ in range(max(round(seconds / DT), 1)):
            self.cycle(facts)
            facts = dataclasses.replace(facts, requests=())

    @property
    def texts(self) -> list[str]:
        """Every notice so far."""
        return [notice.text for commands in self.said for notice in commands.notices]

    def _check(self, before: State, facts: Facts, commands: Commands) -> None:
        """No command is illegal, and limits hold on what leaves."""
        config, state = self.parameters.config, self.state
        limits, perch = config.limits, config.perch
        if before.control is Control.EXTERNAL and facts.vehicle.control is not Control.EXTERNAL and before.streaming:
            self.silent = True
        if any(request.order is Order.READY for request in facts.requests) and state.streaming:
            self.silent = False
        setpoint = commands.setpoint
        if self.silent or not facts.vehicle.armed:
            assert setpoint is None, "the pilot has the vehicle"
        if setpoint is not None:
            values = (*setpoint.position_w, *setpoint.velocity_w, *setpoint.acceleration_w, setpoint.yaw)
            assert all(map(math.isfinite, values))
            most = GRAVITY if state.phase in SUSPENDED else limits.feedforward_m_per_s2
            assert norm(setpoint.acceleration_w) <= most + 1e-9
            fastest = max(perch.approach_speed_m_per_s, 3.0 * perch.reach_speed_m_per_s, limits.vehicle_speed_m_per_s)
            assert norm(setpoint.velocity_w) <= fastest + 1e-9
            if state.phase not in MOVES_VEHICLE and facts.vehicle.control is Control.EXTERNAL:
                assert setpoint.velocity_w == (0.0, 0.0, 0.0), "nobody asked the vehicle to move"
        check_calibration(state, facts, commands)
        assert (commands.pulls is not None) == (commands.arm in (ArmAction.DRIVE, ArmAction.WIND))
        if state.phase in {Phase.STARTUP, Phase.STOWED, Phase.HOLDING}:
            assert commands.arm is ArmAction.HOLD, "nothing moves until told"
        if commands.pulls is not None:
            assert all(math.isfinite(pull) and abs(pull) <= limits.pull_max_m for pull in commands.pulls)
            assert math.hypot(*state.bend) <= limits.bend_max_rad + 1e-9 or math.hypot(*before.bend) >= math.hypot(
                *state.bend
            )
        if (state.phase, state.since) == (before.phase, before.since) and state.pulls and before.pulls:
            turned = math.hypot(state.bend[0] - before.bend[0], state.bend[1] - before.bend[1])
            assert turned <= perch.bend_speed_rad_per_s * 0.1 + 1e-9
        assert not commands.recover or state.phase in {Phase.STARTUP, Phase.STOWED}
        answered = [answer.request for answer in commands.answers]
        assert {request.id for request in facts.requests} <= set(answered), "every order is answered in its cycle"


def check_calibration(state: State, facts: Facts, commands: Commands) -> None:
    """Tendons are wound only in a calibration, and none goes on under a vehicle that may fly."""
    if state.phase in CALIBRATES:
        assert commands.arm is not ArmAction.DRIVE, "where straight is, nobody knows"
    else:
        assert commands.arm is not ArmAction.LIMP, "a limp arm drops what it holds"
        assert commands.arm is not ArmAction.WIND, "slack is for calibrations"
    if state.phase is Phase.CALIBRATING:
        assert facts.vehicle.landed
        assert not facts.vehicle.armed


def check_load(before: State, state: State, facts: Facts, commands: Commands) -> None:
    """An arm that may carry the vehicle does not move, and never opens over stopped motors."""
    if state.phase in SUSPENDED:
        assert commands.arm is ArmAction.HOLD, "an arm that may carry the vehicle does not move"
    if (before.phase, state.phase) == (Phase.HANG_HOLD, Phase.STOWED):
        check_cleared(facts)
    elif before.phase in SUSPENDED and state.phase not in SUSPENDED:
        assert before.phase is Phase.TAKE_BACK
        assert facts.vehicle.armed, "an arm that carries a vehicle with stopped motors never opens"


def check_cleared(facts: Facts) -> None:
    """Only of an arm that holds nothing is it believed that the vehicle stands, and does not hang."""
    assert any(request.order is Order.CLEAR_ERRORS for request in facts.requests), "nobody but a person knows"
    assert facts.vehicle.landed
    assert not facts.vehicle.armed
    under_torque = [tendon for tendon in facts.tendons if tendon.torque]
    assert all(tendon.homed and abs(tendon.pull) < 0.01 for tendon in under_torque), "a wrapped tendon holds"


def check_gripper(before: State, state: State, commands: Commands) -> None:
    """The gripper is told to open where nothing is held yet, and in RELEASE; nowhere else is it told anything new."""
    order, last = commands.gripper, before.grip.order
    if order == last or order is None:
        assert order == last, "an order stands"
        return
    assert state.phase in {Phase.APPROACH, Phase.CLOSE, Phase.RELEASE}
    assert (order.action is GripperAction.CLOSE) == (state.phase is Phase.CLOSE)


def ask(facts: Facts, order: Order, *values: float, request: int = 7) -> Facts:
    """The same facts with one order."""
    return dataclasses.replace(facts, requests=(Request(request, order, values),))


def vehicle(**fields: object) -> Change:
    """Facts in which the vehicle differs."""
    return lambda facts: dataclasses.replace(facts, vehicle=dataclasses.replace(facts.vehicle, **fields))  # type: ignore[arg-type]


def tendon(i: int, **fields: object) -> Change:
    """Facts in which one tendon differs."""

    def change(facts: Facts) -> Facts:
        tendons = list(facts.tendons)
        tendons[i] = dataclasses.replace(tendons[i], **fields)  # type: ignore[arg-type]
        return dataclasses.replace(facts, tendons=tuple(tendons))

    return change


JAWS = JawState(
    closed=0.0,
    speed=0.0,
    load=0.0,
    temperature=30.0,
    voltage=12.0,
    error_bits=0,
    silent=False,
    torque=True,
    ready=True,
    homed=True,
)


def jaws(**fields: object) -> Change:
    """Facts in which the arm has a gripper on a servo, quiet and open but for `fields`."""
    return lambda facts: dataclasses.replace(facts, gripper=GripperState(dataclasses.replace(JAWS, **fields)))  # type: ignore[arg-type]


def gripping(parameters: Parameters, **options: object) -> Parameters:
    """The same parameters of an arm with a gripper."""
    config = parameters.config
    config = dataclasses.replace(
        config,
        grasp=dataclasses.replace(config.grasp, kind="gripper"),
        gripper=dataclasses.replace(config.gripper, **options),  # type: ignore[arg-type]
    )
    return Parameters(config, parameters.model)


def changed(facts: Facts, changes: Iterable[Change]) -> Facts:
    """All changes, one after the other."""
    for change in changes:
        facts = change(facts)
    return facts


def moved(by: tuple[float, float, float]) -> Change:
    """Facts in which the vehicle is elsewhere."""
    return lambda facts: vehicle(position_w=sub(facts.vehicle.position_w, (-by[0], -by[1], -by[2])))(facts)
