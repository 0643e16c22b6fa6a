"""Every cell of docs/failure_policy.md: the cause is made to happen in each phase, and what follows is watched.

The page is made from the tables; these tests make facts, and know nothing of the guards.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arm_companion.arm.model import ArmSolution, Hold
from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ModelError
from arm_companion.mission.facts import (
    ArmFault,
    Bar,
    Control,
    Facts,
    Order,
    Workshop,
    WrenchReport,
    WrenchSource,
)
from arm_companion.mission.failure_policy import CAUSES, SITUATIONS, Cause, document, reaction
from arm_companion.mission.gripper_facts import Grip, GripperAction, GripperOrder
from arm_companion.mission.motion import Reference
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import Load, ThrustCurve
from arm_companion.mission.sharing import SUSPENDED
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CALIBRATES, CARRYING, Phase, Prediction, State, Vigil
from arm_companion.mission.tendon_watch import TendonWatch
from arm_companion.procedures.tendon_zeros import Zero
from tests.unit.conftest import tendons
from tests.unit.mission_rig import (
    BENT,
    COURSE,
    HELD,
    HUNG,
    PLACE,
    T0,
    Change,
    Run,
    ask,
    gripping,
    jaws,
    memory,
    moved,
    tendon,
    vehicle,
)

Hovering = Callable[..., Facts]


DEEP = 0.06
"""How far below the pick-up a load is looked to be set down, m."""


class Blind(RodModel):
    """Mechanics that never find a solution."""

    def free(self, *_: Any, **__: Any) -> ArmSolution:
        raise ModelError("none")

    def held(self, *_: Any, **__: Any) -> ArmSolution:
        raise ModelError("none")

    def anchor(self, *_: Any, **__: Any) -> Hold:
        raise ModelError("none")


@dataclasses.dataclass(frozen=True)
class Provocation:
    """How a cause comes about.

    Attributes:
        words: what every notice about it says.
        facts: how they change from the quiet hover.
        recall: how memory differs from a quiet phase.
        seconds: for how long the facts hold.
        quiet_s: of quiet hover before.
        blind: the mechanics have no solution.
        stall_s: length of the last cycle.
        gripper: the arm has one, on a servo.
        above: the arm is above the vehicle.
    """

    words: str
    facts: Change = lambda facts: facts
    recall: Callable[[State], State] = lambda state: state
    seconds: float = 0.01
    quiet_s: float = 0.0
    blind: bool = False
    stall_s: float = 0.01
    gripper: bool = False
    above: bool = False


def _remember(**fields: object) -> Callable[[State], State]:
    return lambda state: dataclasses.replace(state, **fields)  # type: ignore[arg-type]


def _slip(state: State) -> State:
    return dataclasses.replace(state, since=T0 - 3.5)


def _loose_wrap(state: State) -> State:
    return dataclasses.replace(state, since=T0 - 20.0, bend=(5.5, 0.0), bend_goal=(5.5, 0.0))


def weighed(state: State, kilograms: float) -> State:
    """Memory of a load that was weighed, and whose rotors hover without one at the facts' thrust."""
    load = Load(ThrustCurve.prior(0.5), None, 5.0, 0.0, mass=kilograms, weighed_s=5.0 if kilograms else 0.0)
    return dataclasses.replace(state, load=load)


def _lost_contact(state: State) -> State:
    if state.phase in CARRYING:
        x, y, z = PLACE
        return weighed(dataclasses.replace(state, position=(x, y, z - 0.3), reference=Reference((x, y, z - 0.3))), 0.2)
    if state.phase in SUSPENDED:
        x, y, z = PLACE
        hung = dataclasses.replace(state.sharing, place=(x, y, z - 0.6), first=z - 0.6)  # it has sunk since
        return dataclasses.replace(state, sharing=hung)
    return _loose_wrap(state) if state.phase in (Phase.WRAP, Phase.CLOSE) else _slip(state)


def _pulled_off(state: State) -> State:
    """The same, and in a pull test the vehicle has been off its place for as long as positions are smoothed."""
    state = _lost_contact(state)
    x, y, z = PLACE
    return dataclasses.replace(state, position=(x - 0.04, y, z)) if state.phase is Phase.VERIFY else state


def _at_the_bottom(state: State) -> State:
    x, y, z = PLACE
    reference = Reference((x, y, z + DEEP))
    state = weighed(dataclasses.replace(state, since=T0 - 3.0, reference=reference), 0.2)
    lighter = ThrustCurve.prior(0.46)  # at the thrust of the facts these rotors lift a load
    return dataclasses.replace(state, load=dataclasses.replace(state.load, curve=lighter, flow=None))


def _slack(facts: Facts) -> Facts:
    """All tendons at the fifth of a newton that the statics expect of so little displacement."""
    model = RodModel(_slack.parameters)  # type: ignore[attr-defined]
    pulls = model.pull_for_bend(np.zeros(2), 0.2)
    free = model.free(pulls, np.array([0.0, 0.0, 9.81]))
    found = tendons(tuple(map(float, pulls)), tuple(map(float, free.tension)))
    return dataclasses.replace(facts, tendons=tuple(dataclasses.replace(t, tension_sigma=0.05) for t in found))


def _propped(state: State) -> State:
    """Half of the load is carried by something 30 cm above where it was taken."""
    x, y, z = PLACE
    here = (x, y, z - 0.3)
    half = weighed(dataclasses.replace(state, position=here, reference=Reference(here)), 0.4)
    lighter = ThrustCurve.prior(0.45)  # at the thrust of the facts these rotors lift a load
    return dataclasses.replace(half, load=dataclasses.replace(half.load, curve=lighter, flow=None))


_WRENCH = WrenchReport((13.0, 0, 0), (0, 0, 0), (1, 1, 1), (1, 1, 1), WrenchSource.ANCHORED, True, 1.0, 0.0)
_SUSPECT = TendonWatch()

PROVOCATIONS: dict[str, Provocation] = {
    "vehicle heartbeat lost": Provocation("heartbeat 9.0 s", vehicle(heartbeat_age_s=9.0)),
    "vehicle state stale": Provocation("vehicle state is 1.00 s old", vehicle(position_age_s=1.0)),
    "pilot takes the mode": Provocation("pilot has the vehicle", vehicle(control=Control.PILOT, mode="POSCTL")),
    "autopilot failsafe": Provocation("autopilot failsafe", vehicle(control=Control.FAILSAFE, mode="RTL")),
    "pilot takes the mode, an arm above still wrapped": Provocation(
        "still wrapped", vehicle(control=Control.PILOT, mode="STABILIZED"), above=True
    ),
    "autopilot failsafe, an arm above still wrapped": Provocation(
        "still wrapped", vehicle(control=Control.FAILSAFE, mode="LAND"), above=True
    ),
    "motors drop while an arm above lets go": Provocation(
        "no longer carry", vehicle(throttle=0.2), _remember(sharing=HUNG), seconds=0.25, above=True
    ),
    "disarm": Provocation("disarmed", vehicle(armed=False)),
    "ground station lost": Provocation("ground station silent", lambda f: dataclasses.replace(f, ground_age_s=6.0)),
    "operator aborts": Provocation("order ABORT", lambda f: ask(f, Order.ABORT)),
    "servo silent": Provocation("does not answer", tendon(2, silent=True)),
    "servo hardware error": Provocation("hardware error 0x04", tendon(1, error_bits=0x04)),
    "servo without torque": Provocation("servo has no torque", tendon(1, torque=False)),
    "servo overheats (warning)": Provocation("servo at 70 degC", tendon(0, temperature=70.0), seconds=1.2),
    "servo overloaded": Provocation("hardware error 0x20", tendon(1, error_bits=0x20)),
    "low voltage": Provocation("servo supply 9.7 V", tendon(3, voltage=9.7), seconds=1.2),
    "tendon slack": Provocation("slack", _slack, seconds=1.2),
    "tendon over-tension": Provocation("tendon tension 60.0 N", tendon(0, tension=60.0)),
    "tendon broken": Provocation(
        "tendon 1 broken",
        recall=_remember(watch=(TendonWatch(broken="tendon 1 broken"), _SUSPECT, _SUSPECT, _SUSPECT)),
    ),
    "tension and pose disagree": Provocation(
        "tendon 1 jumped",
        recall=_remember(watch=(TendonWatch(jumped="tendon 1 jumped"), _SUSPECT, _SUSPECT, _SUSPECT)),
    ),
    "contact lost": Provocation(
        "no grip|closed around nothing|pull test failed|grip lost|load lost|slip",
        moved((-0.2, 0.0, -0.3)),
        _lost_contact,
        seconds=0.15,
    ),
    "nothing below to set a load down on": Provocation("nothing found", moved((0.0, 0.0, DEEP)), _at_the_bottom),
    "load meets something high above its place": Provocation(
        "met something", moved((0.0, 0.0, -0.3)), _propped, seconds=0.3
    ),
    "load swings the vehicle aside as it comes off": Provocation(
        "hang askew", moved((0.0, 0.06, 0.0)), _remember(since=T0 - 0.5)
    ),
    "arm closes beside the middle of its object": Provocation(
        "beside the middle",
        lambda facts: moved((0.0, 0.02, 0.0))(tendon(0, tension=30.0)(facts)),
        _remember(tension=(30.0, 4.0, 1.0, 4.0)),
    ),
    "slip": Provocation("grip lost|slip", moved((-0.2, 0.0, 0.2))),
    "no contact in time": Provocation("without contact", recall=_remember(since=T0 - 45.0)),
    "bar or object told elsewhere": Provocation(
        "is told", lambda f: dataclasses.replace(f, bar=Bar((9.0, 0.0, -2.0), (0.0, 1.0, 0.0), 0.035), bar_age_s=0.0)
    ),
    "gripper does not open": Provocation(
        "gripper did not open",
        jaws(closed=0.6),
        _remember(task=Order.GRASP, grip=Grip(GripperOrder(GripperAction.OPEN, T0 - 9.0))),
        gripper=True,
    ),
    "stiffness test failed": Provocation(
        "no grip|closed around nothing|pull test failed", moved((-0.04, 0.0, 0.0)), _pulled_off
    ),
    "vehicle rocks about what it holds": Provocation(
        "rocks about", recall=_remember(vigil=Vigil(rocking=0.25), since=T0 - 2.5)
    ),
    "wrench over its limit": Provocation(
        "on the airframe",
        recall=_remember(prediction=Prediction(T0, _WRENCH, (0, 0, 0.25), (0, 0), (0, 0, 0))),
    ),
    "model has no solution": Provocation("no solution", seconds=0.7, blind=True),
    "throttle not told": Provocation("throttle is not known", vehicle(throttle_age_s=9.0)),
    "set-points not followed": Provocation("does not follow", moved((-2.0, 0.0, 0.0)), seconds=1.2),
    "estimator jumps": Provocation("position jumped", moved((0.0, 1.0, 0.0)), quiet_s=0.05),
    "cycle overrun": Provocation("cycle is late", stall_s=0.4),
    "vehicle arms in a calibration": Provocation("vehicle is armed", vehicle(armed=True)),
    "calibration finds no zeros": Provocation(
        "does not pull", recall=_remember(course=dataclasses.replace(COURSE, refusal="tendon 3 does not pull"))
    ),
    "calibration cannot be stored": Provocation(
        "not stored",
        lambda f: dataclasses.replace(f, workshop=Workshop((), 1.0, "no space left")),
        _remember(course=dataclasses.replace(COURSE, zeros=(Zero(12, 0.001, 5.0, 30.0),))),
    ),
    "daemon restarted in flight": Provocation("arm found", recall=_remember(control=Control.UNKNOWN)),
}

ELSEWHERE = {"recorder's disk full", "MQTT broker gone", "configuration changed in flight"}
"""Causes that the mission never sees: test_failure_policy_daemon.py."""

NO_BIT = {"contact lost"}
"""What people see of it is the bit of the test that found it."""

CELLS = [(cause, situation) for cause in CAUSES for situation in SITUATIONS if cause.name not in ELSEWHERE]


def turned_up(parameters: Parameters) -> Parameters:
    """The same arm above the vehicle."""
    config = parameters.config
    mount = dataclasses.replace(config.mount, rpy_deg=(180.0, 0.0, 0.0))
    limits = dataclasses.replace(config.limits, keep_out=dataclasses.replace(config.limits.keep_out, half_angle_deg=0))
    return Parameters(dataclasses.replace(config, mount=mount, limits=limits), parameters.model)


def provoke(cause: Cause, phase: Phase, parameters: Parameters, facts: Facts) -> Run:
    """The cause in a phase, until its facts have held for as long as they say."""
    how = PROVOCATIONS[cause.name]
    _slack.parameters = parameters.model.parameters  # type: ignore[attr-defined]
    if how.blind:
        parameters = Parameters(parameters.config, Blind(parameters.model.parameters))
    if how.gripper:
        parameters = gripping(parameters)
    if how.above:
        parameters = turned_up(parameters)
    run = Run(how.recall(memory(phase)), parameters)
    if how.quiet_s:
        run.cycles(facts, how.quiet_s)
    if how.stall_s > 0.01:
        run.cycle(facts, how.stall_s)
    else:
        run.cycles(how.facts(facts), how.seconds)
    return run


@pytest.mark.parametrize(
    ("cause", "situation"), CELLS, ids=[f"{cause.name} - {situation}" for cause, situation in CELLS]
)
def test_what_the_page_says_is_what_happens(
    cause: Cause, situation: str, parameters: Parameters, hovering: Hovering
) -> None:
    words = re.compile(PROVOCATIONS[cause.name].words)
    for phase in SITUATIONS[situation]:
        run = provoke(cause, phase, parameters, quiet(hovering, phase))
        told = [text for text in run.texts if words.search(text)]
        says = reaction(cause, phase)
        changes = [text for text in told if "->" in text]
        if says.targets:
            assert changes, f"{phase.name}: {run.texts}"
            source, _, target = changes[0].split(":")[0].partition(" -> ")
            assert (source, Phase[target] in says.targets) == (phase.name, True)
            if cause.name not in NO_BIT and Phase[target] is not Phase.STOWED:
                assert any(cause.bit in commands.status.error_bits for commands in run.said)
        elif says.told:
            assert not changes
            assert len(told) == 1, f"{phase.name}: {run.texts}"
        else:
            assert not told, f"{phase.name}: {told}"


@pytest.mark.parametrize("phase", list(Phase), ids=lambda phase: phase.name)
def test_the_pilot_wins_in_the_same_cycle_in_every_phase(
    phase: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    for control in (Control.PILOT, Control.FAILSAFE, Control.UNKNOWN):
        run = Run(memory(phase), parameters)
        run.cycles(hovering(), 0.02)
        commands = run.cycle(hovering(control=control, mode="POSCTL"))
        assert commands.setpoint is None
        run.cycles(hovering(control=control, mode="POSCTL"), 0.5)
        run.cycles(hovering(), 0.5)  # given back: nobody has asked for anything
        assert all(said.setpoint is None for said in run.said[2:])


def quiet(hovering: Hovering, phase: Phase) -> Facts:
    """Facts of a phase in which nothing goes wrong."""
    if phase in CALIBRATES:
        return hovering(armed=False, landed=True)
    return hovering(BENT if phase in HELD else (0.0, 0.0))


GRIP = (Phase.VERIFY, Phase.PERCHED, Phase.UNLOAD, Phase.HOLDING)


@pytest.mark.parametrize("phase", GRIP, ids=lambda phase: phase.name)
def test_a_grip_is_never_opened_while_the_motors_stand_or_nobody_is_heard(
    phase: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    for facts in (hovering(BENT, armed=False), hovering(BENT, heartbeat_age_s=9.0)):
        run = Run(memory(phase), parameters)
        run.cycles(facts, 2.0)
        assert run.state.phase is Phase.HOLDING
        assert all(said.pulls is None for said in run.said[1:])


def test_motors_that_stop_while_the_arm_lets_go_stop_that_too(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.RELEASE), parameters)
    run.cycles(hovering(BENT), 0.5)
    run.cycles(hovering(BENT, armed=False), 1.0)
    assert run.phases == [Phase.RELEASE, Phase.HOLDING]


@pytest.mark.parametrize("vehicle", [{"armed": False}, {"armed": False, "heartbeat_age_s": math.inf}])
def test_a_person_may_let_go_of_a_bar_while_the_vehicle_stands_or_has_not_been_heard_yet(
    vehicle: dict[str, object], parameters: Parameters, hovering: Hovering
) -> None:
    facts = hovering(BENT, **vehicle)
    run = Run(memory(Phase.HOLDING, armed=False, control=facts.vehicle.control), parameters)
    run.cycles(facts, 0.2)
    run.cycles(ask(facts, Order.RELEASE), 1.0)
    assert run.phases == [Phase.HOLDING, Phase.RELEASE]


@pytest.mark.parametrize("fault", ["servo silent", "low voltage", "servo overheats (warning)", "tendon broken"])
def test_a_perched_arm_with_a_failing_part_holds_until_a_person_lets_it_go(
    fault: str, parameters: Parameters, hovering: Hovering
) -> None:
    cause = next(cause for cause in CAUSES if cause.name == fault)
    run = provoke(cause, Phase.PERCHED, parameters, hovering(BENT))
    broken = PROVOCATIONS[fault].facts(hovering(BENT))
    run.cycles(broken, 3.0)
    assert run.phases == [Phase.PERCHED]
    run.cycles(ask(broken, Order.RELEASE), 1.5)
    assert Phase.RELEASE in run.phases


def test_after_a_jump_of_the_estimator_the_vehicle_is_asked_to_stay_and_a_grip_does_not_count_as_slipped(
    parameters: Parameters, hovering: Hovering
) -> None:
    jumped = moved((0.0, 1.0, 0.0))(hovering())
    jumped_bent = moved((0.0, 1.0, 0.0))(hovering(BENT))
    free, held = Run(memory(Phase.REACH), parameters), Run(memory(Phase.PERCHED), parameters)
    for run, before, after in ((free, hovering(), jumped), (held, hovering(BENT), jumped_bent)):
        run.cycles(before, 0.05)
        run.cycles(after, 1.5)
        setpoint = run.said[-1].setpoint
        assert setpoint is not None
        assert math.dist(setpoint.position_w, jumped.vehicle.position_w) < 0.1
        assert run.state.errors & ArmFault.ESTIMATOR_JUMP
    assert held.phases == [Phase.PERCHED]
    assert free.phases[:2] == [Phase.REACH, Phase.STOWING]


def test_a_bar_that_is_told_after_a_jump_is_where_it_is_told_to_be(parameters: Parameters, hovering: Hovering) -> None:

    run = Run(memory(Phase.PERCHED), parameters)
    run.cycles(hovering(), 0.05)
    jumped = moved((0.0, 1.0, 0.0))(hovering())
    run.cycles(jumped, 0.05)
    old = Situation(run.state, jumped, run.state.t, parameters).bar
    assert old.point_w == pytest.approx((3.0, 1.0, -2.0))
    told = dataclasses.replace(jumped, bar=Bar((3.0, 0.9, -2.0), (0.0, 1.0, 0.0), 0.035), bar_age_s=0.0)
    assert Situation(run.state, told, run.state.t, parameters).bar.point_w == (3.0, 0.9, -2.0)


def test_fast_flight_is_no_jump(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.APPROACH), parameters)
    for i in range(50):
        facts = hovering(position_w=(2.0 - 0.3 * (i // 5), 0.0, -2.2), velocity_w=(-6.0, 0.0, 0.0))
        run.cycle(facts)
    assert not any("jumped" in text for text in run.texts)


def test_a_vehicle_that_begins_to_follow_again_stays_where_it_is(parameters: Parameters, hovering: Hovering) -> None:
    stuck = moved((-2.0, 0.0, 0.0))(hovering())
    run = Run(memory(Phase.APPROACH), parameters)
    run.cycles(stuck, 1.3)
    assert run.state.phase is Phase.STOWING
    setpoint = run.said[-1].setpoint
    assert setpoint is not None
    assert setpoint.position_w == stuck.vehicle.position_w


@pytest.mark.parametrize(
    ("bend", "after"), [((0.0, 0.0), Phase.STOWED), ((1.2, 0.0), Phase.HOLDING)], ids=["free", "holding"]
)
def test_a_daemon_restarted_in_flight_takes_over_what_it_finds_and_moves_nothing_until_told(
    bend: tuple[float, float], after: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(State(t=T0), parameters)
    run.cycles(hovering(bend), 5.0)
    assert run.state.phase is after
    assert all(said.pulls is None and said.setpoint is None for said in run.said)
    run.cycles(ask(hovering(bend), Order.RELEASE if after is Phase.HOLDING else Order.READY), 0.1)
    assert run.said[-1].pulls is not None


def test_no_perch_is_begun_with_a_hot_servo_or_a_low_supply(parameters: Parameters, hovering: Hovering) -> None:
    for change, words in ((tendon(0, temperature=70.0), "degC"), (tendon(0, voltage=9.7), "supply")):
        run = Run(memory(Phase.READY), parameters)
        run.cycles(change(hovering()), 1.2)
        run.cycles(ask(change(hovering()), Order.PERCH), 0.02)
        assert run.state.phase is Phase.READY
        assert any(words in answer.reason for said in run.said for answer in said.answers)


def test_every_cause_has_its_provocation() -> None:
    assert set(PROVOCATIONS) | ELSEWHERE == {cause.name for cause in CAUSES}


def test_every_phase_is_in_one_situation() -> None:
    assert sorted(phase.value for phases in SITUATIONS.values() for phase in phases) == [p.value for p in Phase]


def test_the_committed_page_is_the_tables() -> None:
    page = Path(__file__).parents[2] / "docs" / "failure_policy.md"
    assert page.read_text(encoding="utf-8") == document(), (
        "python -m arm_companion.mission.failure_policy > docs/failure_policy.md"
    )
