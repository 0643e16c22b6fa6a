"""What is remembered of a bar does not outlive the flight, and never sends the vehicle to it from elsewhere."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.mission.facts import ArmFault, Bar, Facts, Order, Result, Severity
from arm_companion.mission.motion import Reference
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, State, Vigil
from arm_companion.mission.vigil import keep_vigil
from arm_companion.record_codec import dumps, loads
from tests.unit.mission_rig import ANCHOR, BENT, DT, MET, PLACE, T0, Run, ask, memory, moved, tendon, vehicle

Hovering = Callable[..., Facts]
FAR = (2.0, 40.0, -2.2)
OLD = {"contact_w": FAR, "anchor": dataclasses.replace(ANCHOR, position_w=FAR), "rest": FAR}


def forgotten(state: State) -> bool:
    return state.contact_w is None and state.anchor is None and state.rest is None


@pytest.mark.parametrize(
    ("phase", "order", "after"),
    [
        (Phase.STOWED, Order.READY, Phase.READYING),
        (Phase.READY, Order.STOW, Phase.STOWING),
        (Phase.STARTUP, None, Phase.STOWED),
    ],
)
def test_a_free_arm_remembers_no_bar(
    phase: Phase, order: Order | None, after: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(memory(phase, **OLD), parameters)
    run.cycle(hovering() if order is None else ask(hovering(), order))
    assert run.state.phase is after
    assert forgotten(run.state)


def test_an_arm_that_held_nothing_is_let_go_where_the_vehicle_is(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.STOWED, **OLD), parameters)
    run.cycles(ask(hovering(), Order.READY), 1.5)
    stuck = tendon(0, torque=False, error_bits=0x20, ready=False)(hovering())
    while run.state.phase is not Phase.HOLDING:
        run.cycles(stuck, 1.0)
    run.cycle(ask(stuck, Order.RELEASE))
    assert run.state.phase is Phase.RELEASE
    run.cycles(stuck, 0.5)
    setpoint = run.said[-1].setpoint
    assert setpoint is not None
    assert setpoint.position_w == PLACE


@pytest.mark.parametrize("phase", [Phase.HOLDING, Phase.RELEASE])
def test_no_set_point_steps_to_a_bar_that_is_elsewhere(
    phase: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(memory(phase, **OLD), parameters)
    run.cycles(ask(hovering(BENT), Order.RELEASE if phase is Phase.HOLDING else Order.FEEDFORWARD, 1.0), 1.0)
    assert run.state.phase is Phase.RELEASE
    for said in run.said:
        assert said.setpoint is not None
        assert math.dist(said.setpoint.position_w, PLACE) < 1e-9


def test_a_place_that_nobody_knows_does_not_become_known_by_a_jump(parameters: Parameters, hovering: Hovering) -> None:
    state = memory(Phase.HOLDING, contact_w=None, vigil=Vigil(position_w=PLACE))
    jumped = moved((0.4, 0.0, 0.0))(hovering(BENT))
    after = keep_vigil(Situation(state, jumped, T0 + DT, parameters))
    assert after.vigil.leap_m > 0.0
    assert after.contact_w is None


def test_a_place_that_nobody_knows_is_recorded_as_such() -> None:
    for place in (None, PLACE):
        state = State(contact_w=place, reference=Reference(PLACE))
        assert loads(State, dumps(state)).contact_w == place


NEW = Bar((9.0, 0.0, -2.0), (0.0, 1.0, 0.0), 0.035)


def test_a_bar_that_is_told_anew_does_not_redirect_a_departure(parameters: Parameters, hovering: Hovering) -> None:
    facts = dataclasses.replace(hovering(), bar=NEW, bar_age_s=0.1)
    run = Run(memory(Phase.DEPART, reference=Reference(MET), position=MET), parameters)
    for _ in range(500):
        reference = run.state.reference
        assert reference is not None
        run.cycle(vehicle(position_w=reference.position)(facts))
    x, y, z = MET
    assert run.phases == [Phase.DEPART, Phase.STOWING, Phase.STOWED]
    assert run.state.reference is not None
    assert run.state.reference.position == pytest.approx((x - parameters.config.perch.standoff_m, y, z), abs=1e-6)


@pytest.mark.parametrize("phase", [Phase.APPROACH, Phase.REACH])
@pytest.mark.parametrize(("off", "ends"), [(0.4, False), (0.6, True)])
def test_a_bar_that_is_told_elsewhere_ends_the_way_there(
    off: float, ends: bool, phase: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    bar = dataclasses.replace(NEW, point_w=(3.0 + off, 0.0, -2.0))
    run = Run(memory(phase), parameters)
    run.cycles(dataclasses.replace(hovering(), bar=bar, bar_age_s=0.1), 0.1)
    assert run.phases == ([phase, Phase.DEPART] if ends else [phase])


@pytest.mark.parametrize("order", [Order.PERCH, Order.GRASP])
def test_nobody_sets_out_before_set_points_go_out_again(
    order: Order, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(memory(Phase.READY, streaming=False, reference=None), parameters)
    answer = run.cycle(ask(hovering(), order)).answers[0]
    assert (answer.result, answer.reason) == (
        Result.TEMPORARILY_REJECTED,
        "the pilot had the vehicle: order READY first",
    )


def test_a_start_that_waits_for_a_servo_says_for_which(parameters: Parameters, hovering: Hovering) -> None:
    dead = tendon(2, silent=True, age_s=math.inf)(hovering(BENT))
    run = Run(State(t=T0 - DT), parameters)
    run.cycles(dead, 4.0)
    assert not run.texts
    run.cycles(dead, 10.0)
    (notice,) = [notice for said in run.said for notice in said.notices]
    assert notice.severity is Severity.CRITICAL
    assert notice.text.startswith("tendon 3: servo does not answer; the arm is left as it is")
    assert run.said[-1].status.error_bits & ArmFault.SERVO_SILENT
