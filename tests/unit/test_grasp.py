"""The grasp as a person sees it: what is refused, what a load does to the way on, and who may let go of it."""

import dataclasses
import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.beside import touching
from arm_companion.mission.estimate import ForceObserver
from arm_companion.mission.facts import (
    ArmFault,
    Commands,
    Control,
    Facts,
    GraspTarget,
    Order,
    Result,
    Vec3,
    WrenchSource,
)
from arm_companion.mission.motion import Reference, norm
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import Flow, Load, ThrustCurve
from arm_companion.mission.perch import TABLE
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CARRYING, Phase, State
from tests.unit.mission_rig import BENT, PLACE, T0, Run, ask, memory, moved, tendon, vehicle

Hovering = Callable[..., Facts]


@pytest.fixture(scope="module", name="parameters")
def rare(parameters: Parameters) -> Parameters:
    """The mechanics are asked less often: nothing here looks at them closely."""
    rates = dataclasses.replace(parameters.config.rates, wrench_hz=1.0)
    return Parameters(dataclasses.replace(parameters.config, rates=rates), parameters.model)


HOVER = 0.5
MASS = 0.2
HEIGHT = 0.4


def thrust_of(kilograms: float) -> float:
    """Share of thrust at which the vehicle of `sim.toml` hovers with a load, by the curve that nothing has taught."""
    return HOVER * (1.0 + kilograms / 1.8 / 1.25)


def loaded(facts: Facts, kilograms: float = MASS) -> Facts:
    return vehicle(thrust=thrust_of(kilograms))(facts)


def carrying(phase: Phase, *, up: float = HEIGHT, now: float = MASS, **fields: object) -> State:
    """Memory of a load that was weighed, `up` m over where it was taken; `now` kg hang on the arm."""
    x, y, z = PLACE
    here = (x, y, z - up)
    load = Load(_known(), _flow(thrust_of(now)), 5.0, now, mass=MASS, spread=0.03, weighed_s=5.0)
    return memory(phase, **{"position": here, "reference": Reference(here), "load": load, **fields})


def _known() -> ThrustCurve:
    small = ((1e-3, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0, 0.0), (0.0, 0.0, 1e-3, 0.0), (0.0, 0.0, 0.0, 1e-8))
    return dataclasses.replace(ThrustCurve.prior(HOVER), covariance=small)


def _flow(share: float) -> Flow:
    from arm_companion.mission.payload import Flow

    return Flow(1.0, share, 0.0)


def aloft(hovering: Hovering, kilograms: float = MASS, up: float = HEIGHT) -> Facts:
    return loaded(moved((0.0, 0.0, -up))(hovering(BENT)), kilograms)


def hovered(phase: Phase, **fields: object) -> State:
    """Memory of a vehicle whose hover is known."""
    return memory(phase, load=Load(_known(), _flow(HOVER), 5.0, 0.0), **fields)


@pytest.mark.parametrize(("autopilot", "curved"), [("px4", True), ("ardupilot", False)])
def test_the_push_that_holds_a_load_up_counts_the_rotors_curve_where_the_autopilot_does_not(
    autopilot: str, *, curved: bool, parameters: Parameters, hovering: Hovering
) -> None:
    """PX4 takes thrust for proportional; ArduPilot follows the acceleration that it measures."""
    config = parameters.config
    flown = dataclasses.replace(config, vehicle=dataclasses.replace(config.vehicle, autopilot=autopilot))
    run = Run(carrying(Phase.CARRY), dataclasses.replace(parameters, config=flown))
    run.cycles(aloft(hovering), 3.0)
    straight = -MASS * GRAVITY / config.vehicle.mass_kg
    curve = run.state.load.curve
    assert curve is not None
    assert curve.gain > 1.1
    assert run.state.lean[2] == pytest.approx(straight / curve.gain if curved else straight, rel=1e-6)


@pytest.mark.parametrize(
    ("phase", "above_s", "seconds", "learns"),
    [
        (Phase.REACH, 0.0, 0.3, True),
        (Phase.REACH, 0.05, 0.01, False),  # one cycle: then it has met something
        (Phase.CONTACT, 0.0, 1.0, False),
        (Phase.CONTACT, 0.0, 3.0, True),
    ],
)
def test_the_rotors_are_not_learnt_from_while_the_arm_may_lie_against_what_it_met(
    phase: Phase, above_s: float, seconds: float, *, learns: bool, parameters: Parameters, hovering: Hovering
) -> None:
    """It carries a tenth of a newton or two, which the battery's fall would be taken for."""
    force = ForceObserver(tared_s=2.0, force=(-9.0, 0.0), velocity=(0.0, 0.0), above_s=above_s)
    state = hovered(phase, since=T0 - 0.01, force=force if above_s else ForceObserver())
    run = Run(state, parameters)
    run.cycles(vehicle(thrust=HOVER - 0.01)(hovering()), seconds)
    assert state.load.curve is not None
    assert run.state.load.curve is not None
    learnt = run.state.load.curve.theta[0] - state.load.curve.theta[0]
    assert (learnt > 0.0) == learns, "less thrust hovers: stronger rotors, or something else carries"


# --- setting out ---


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (vehicle(armed=False), "not flying"),
        (vehicle(landed=True), "not flying"),
        (vehicle(control=Control.PILOT, mode="POSCTL"), "POSCTL"),
        (vehicle(heartbeat_age_s=9.0), "heartbeat"),
        (vehicle(position_w=(99.0, 0.0, -2.0)), "object is 96 m away"),
        (vehicle(thrust=math.nan), "ATTITUDE_TARGET"),
    ],
)
def test_a_grasp_is_refused_with_the_reason(
    change: Callable[[Facts], Facts], words: str, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(hovered(Phase.READY, control=change(hovering()).vehicle.control), parameters)
    run.cycle(ask(change(hovering()), Order.GRASP))
    (answer,) = run.said[-1].answers
    assert (run.state.phase, answer.result) == (Phase.READY, Result.TEMPORARILY_REJECTED)
    assert words in answer.reason


def test_a_grasp_waits_for_a_hover_to_weigh_by(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.READY), parameters)
    run.cycle(ask(hovering(), Order.GRASP))
    assert "hover for some seconds" in run.said[-1].answers[0].reason
    run.cycles(hovering(), 4.0)
    run.cycle(ask(hovering(), Order.GRASP, request=8))
    assert run.state.phase is Phase.APPROACH


def test_an_object_that_stands_upright_is_not_reached_for(parameters: Parameters, hovering: Hovering) -> None:
    upright = GraspTarget((3.0, 0.0, -1.5), (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0), 0.03)
    facts = dataclasses.replace(hovering(), grasp_target=upright, grasp_target_age_s=0.1)
    run = Run(hovered(Phase.READY), parameters)
    run.cycle(ask(facts, Order.GRASP))
    assert run.said[-1].answers[0].reason == "the object is not level"


def test_the_object_is_the_one_told_last_and_else_the_configured_one(
    parameters: Parameters, hovering: Hovering
) -> None:
    state = memory(Phase.REACH, task=Order.GRASP)
    grasp = parameters.config.grasp
    assert Situation(state, hovering(), T0, parameters).bar.point_w == grasp.object_position_m
    turned = GraspTarget((4.0, 1.0, -1.0), (math.cos(0.25), 0.0, 0.0, math.sin(0.25)), 0.02)
    told = dataclasses.replace(hovering(), grasp_target=turned, grasp_target_age_s=0.1)
    bar = Situation(state, told, T0, parameters).bar
    assert (bar.point_w, bar.radius) == ((4.0, 1.0, -1.0), 0.02)
    assert bar.axis_w == pytest.approx((math.cos(0.5), math.sin(0.5), 0.0))
    assert Situation(memory(Phase.REACH), told, T0, parameters).bar.point_w == parameters.config.perch.bar_position_m


@pytest.mark.parametrize(("task", "beside_m"), [(Order.GRASP, 0.0), (Order.PERCH, 0.03)])
def test_an_object_is_taken_by_its_middle_and_a_bar_where_it_was_met(
    parameters: Parameters, hovering: Hovering, task: Order, beside_m: float
) -> None:
    """In wind it is met beside its middle; held there, its weight leans the vehicle as it comes off."""
    ahead, aside = np.array((math.cos(0.3), math.sin(0.3), 0.0)), np.array((-math.sin(0.3), math.cos(0.3), 0.0))
    state = memory(Phase.CONTACT, task=task, heading=0.3)
    planned = np.array(Situation(state, hovering(), T0, parameters).place(0.0))
    for past in (0.0, 0.01):
        here = vehicle(position_w=tuple((planned + past * ahead + 0.03 * aside).tolist()))(hovering())
        met = np.array(touching(Situation(state, here, T0, parameters))) - planned
        assert met @ aside == pytest.approx(beside_m)
        assert -0.02 < met @ ahead - past < 0.0, "less what the observer was late by"
        assert met[2] == pytest.approx(0.0)


# --- taking ---


HELD_BEFORE = 0.03
"""What the flight stack lifts of an object by itself as the arm has closed around it, kg."""


def kilograms(push: Vec3) -> float:
    """What an acceleration upwards lifts, as the vehicle's curve of thrust has it."""
    return -push[2] * 1.8 * 1.25 / GRAVITY


def asked(run: Run) -> tuple[Vec3, Vec3]:
    """Place and acceleration of the newest set-point."""
    said = run.said[-1].setpoint
    assert said is not None
    return said.position_w, said.acceleration_w


def beside_middle(metres: float, parameters: Parameters, facts: Facts) -> Facts:
    """Facts in which the vehicle hovers `metres` aside of where it takes the object by its middle, facing +x."""
    x, y, z = Situation(memory(Phase.CLOSE), facts, T0, parameters).place(0.0)
    return vehicle(position_w=(x, y + metres, z))(facts)


def test_a_curl_waits_for_a_vehicle_that_was_carried_off_just_before_it_would_hold_it_there(
    parameters: Parameters, hovering: Hovering
) -> None:
    wrap = parameters.config.perch.wrap_bend_rad

    def bent_by(share: float, aside: float) -> float:
        begun = share * wrap
        reference = Reference(beside_middle(aside, parameters, hovering()).vehicle.position_w)
        state = memory(Phase.CLOSE, bend=(begun, 0.0), bend_goal=(wrap, 0.0), reference=reference)
        run = Run(state, parameters)
        run.cycles(beside_middle(aside, parameters, hovering((begun, 0.0))), 0.1)
        return run.state.bend[0] - begun

    assert bent_by(0.2, 0.03) > 0.0, "far from the object there is time"
    assert bent_by(0.37, 0.03) == 0.0
    assert bent_by(0.37, -0.03) == 0.0
    assert bent_by(0.37, 0.005) > 0.0
    assert bent_by(0.6, 0.03) > 0.0, "around the object the arm holds the vehicle where it is"


@pytest.mark.parametrize(("aside", "follows"), [(0.005, Phase.VERIFY), (0.02, Phase.UNLOAD), (-0.02, Phase.UNLOAD)])
def test_what_is_held_beside_its_middle_is_let_go_before_it_is_lifted(
    aside: float, follows: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    wrap = parameters.config.perch.wrap_bend_rad
    held = memory(Phase.CLOSE, bend=(wrap, 0.0), bend_goal=(wrap, 0.0), tension=(30.0, 4.0, 1.0, 4.0))
    run = Run(held, parameters)
    run.cycle(tendon(0, tension=30.0)(beside_middle(aside, parameters, hovering((wrap, 0.0)))))
    assert run.phases == [Phase.CLOSE, follows]
    assert any("closed 2.0 cm beside the middle" in text for text in run.texts) == (follows is Phase.UNLOAD)


def test_an_arm_that_closes_around_nothing_goes_back(parameters: Parameters, hovering: Hovering) -> None:
    wrap = parameters.config.perch.wrap_bend_rad
    run = Run(memory(Phase.CLOSE, since=T0 - 10.0, bend=(wrap, 0.0), bend_goal=(wrap, 0.0)), parameters)
    run.cycle(hovering((wrap, 0.0)))
    assert run.phases == [Phase.CLOSE, Phase.UNLOAD]
    assert run.state.errors & ArmFault.GRIP_TEST_FAILED


def test_the_test_lift_waits_until_the_vehicle_is_steady_then_goes_up(
    parameters: Parameters, hovering: Hovering
) -> None:
    closed = {"tension": (30.0, 5.0, 1.0, 5.0), "bend": BENT, "bend_goal": BENT, "feedforward": False}
    run = Run(hovered(Phase.CLOSE, **closed), parameters)
    run.cycle(hovering(BENT))
    assert run.state.phase is Phase.VERIFY
    run.cycles(hovering(BENT), 2.0)
    assert asked(run)[0] == PLACE
    run.cycles(hovering(BENT), 2.0)
    assert asked(run)[0][2] < PLACE[2] - 0.01


@pytest.mark.parametrize("rises", [True, False])
def test_an_object_that_lies_is_taken_by_the_push_before_the_vehicle_is_asked_up(
    parameters: Parameters, hovering: Hovering, rises: bool
) -> None:
    """It holds the vehicle down: asked up meanwhile, it would be centimetres away from where it is asked to be."""
    lift = {"task": Order.GRASP, "since": T0 - 2.4, "offset": (0.0, 0.0, -0.05)}
    run = Run(carrying(Phase.VERIFY, up=0.0, now=HELD_BEFORE, **lift), parameters)
    pushes = []
    for tenth in range(20):
        run.cycles(aloft(hovering, HELD_BEFORE + 0.01 * tenth, 0.0), 0.1)
        place, push = asked(run)
        assert place[2] == pytest.approx(PLACE[2]), "not asked up"
        pushes.append(kilograms(push))
    assert pushes[-1] == pytest.approx(0.24 - HELD_BEFORE, abs=0.02), "an eighth a second, less what the loops hold"
    assert all(0.0 <= more - less < 0.02 for less, more in itertools.pairwise(pushes)), "without a jump"
    if rises:
        run.cycles(aloft(hovering, MASS, 0.025), 1.0)
        place, push = asked(run)
        assert -0.06 < place[2] - PLACE[2] < -0.026, "asked up from when it rose, and not left behind"
        assert kilograms(push) == pytest.approx(MASS - HELD_BEFORE, rel=0.1), "what is felt, and no more"
        run.cycle(vehicle(control=Control.PILOT, mode="POSCTL")(aloft(hovering, MASS, 0.025)))
        assert run.state.load.before == 0.0, "whoever flies it next begins anew"
    else:
        run.cycles(aloft(hovering, MASS, 0.005), 0.5)
        assert asked(run)[0][2] == pytest.approx(PLACE[2] - 0.005, abs=1e-3), "where the load stretches it to"
        run.cycles(aloft(hovering, MASS, 0.0), 3.0)
        assert asked(run)[0][2] < PLACE[2] - 0.01, "a push that is as great as it may be has to be helped"


@pytest.mark.parametrize(
    ("begun", "age", "seconds", "follows"), [(0.0, 0.0, 2.0, 1.0), (2.4, 0.0, 0.4, 0.3), (0.0, 0.4, 0.2, 0.0)]
)
def test_until_the_push_could_lift_something_the_place_of_the_pick_up_is_where_the_vehicle_rests(
    parameters: Parameters, hovering: Hovering, begun: float, age: float, seconds: float, follows: float
) -> None:
    """And not where the closing arm had it; of an old state nobody knows that it rests there."""
    run = Run(carrying(Phase.VERIFY, up=0.0, now=0.0, task=Order.GRASP, since=T0 - begun), parameters)
    run.cycles(vehicle(position_age_s=age)(aloft(hovering, 0.0, -0.01)), seconds)
    assert run.state.anchor is not None
    assert run.state.anchor.position_w[2] == pytest.approx(PLACE[2] + 0.01 * follows, abs=5e-4)


@pytest.mark.parametrize(
    ("kilograms", "up", "after", "words"),
    [
        (MASS, 0.05, Phase.LIFT, "test lift passed: 0.2"),
        (0.0, 0.05, Phase.UNLOAD, "0.00 kg on the arm"),
        (0.9, 0.0, Phase.UNLOAD, "at most 0.5 kg"),
        (math.nan, 0.05, Phase.UNLOAD, "thrust is not known"),
    ],
)
def test_the_test_lift_tells_an_object_from_nothing_and_from_what_is_too_much(
    kilograms: float, up: float, after: Phase, words: str, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.VERIFY, up=up, now=kilograms, task=Order.GRASP, since=T0 - 8.0), parameters)
    run.cycles(aloft(hovering, kilograms, up), 3.5)
    assert run.phases[1] is after
    assert any(words in text for text in run.texts)


@pytest.mark.parametrize(("first", "then"), [(0.03, 0.16), (0.55, 0.16), (math.nan, 0.16), (0.16, 0.0)])
def test_what_the_test_lift_finds_has_to_last(
    first: float, then: float, parameters: Parameters, hovering: Hovering
) -> None:
    """As an object breaks free of its cradle the vehicle jumps, and weighs nothing or too much for a moment."""
    now = 0.0 if math.isnan(first) else first
    run = Run(carrying(Phase.VERIFY, up=0.05, now=now, task=Order.GRASP, since=T0 - 8.0), parameters)
    run.cycles(aloft(hovering, first, 0.05), 0.2)
    assert run.phases == [Phase.VERIFY]
    run.cycles(aloft(hovering, then, 0.05), 3.0)
    assert run.phases[1] is (Phase.LIFT if then else Phase.UNLOAD)


def test_a_load_is_weighed_reported_predicted_and_held_up(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(carrying(Phase.LIFT), parameters)
    run.state = dataclasses.replace(run.state, load=dataclasses.replace(run.state.load, mass=0.0, weighed_s=0.0))
    run.cycles(aloft(hovering), 3.0)
    said = run.said[-1]
    assert said.payload is not None
    assert said.payload.valid
    assert said.payload.mass == pytest.approx(MASS, rel=0.03)
    assert 0.0 < said.payload.mass_sigma < 0.05
    middle = np.array(said.payload.centre_of_mass_b)
    assert middle == pytest.approx((0.25 / parameters.config.perch.wrap_bend_rad, 0.0, 0.12), abs=1e-6)
    assert said.wrench.source is WrenchSource.PAYLOAD
    assert said.wrench.valid
    arm = parameters.model.free(np.array(run.said[-1].pulls), np.array((0.0, 0.0, 9.80665))).base_wrench[2]
    assert said.wrench.force_b[2] - arm == pytest.approx(MASS * 9.80665, rel=0.03)
    assert said.setpoint is not None
    assert said.setpoint.acceleration_w == pytest.approx((0.0, 0.0, -MASS * 9.80665 / 1.8 / 1.25), rel=0.03)


def test_switched_off_nothing_is_held_up(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(carrying(Phase.CARRY, feedforward=False), parameters)
    run.cycles(aloft(hovering), 1.0)
    assert all(said.setpoint is not None and norm(said.setpoint.acceleration_w) == 0.0 for said in run.said)


# --- carrying ---


def opened(commands: list[Commands]) -> bool:
    """Whether the arm was let out."""
    driven = [said.pulls for said in commands if said.pulls is not None]
    return any(abs(max(after) - max(before)) > 1e-6 for before, after in itertools.pairwise(driven))


@pytest.mark.parametrize("phase", sorted(CARRYING, key=lambda p: p.value), ids=lambda p: p.name)
@pytest.mark.parametrize(
    "change",
    [
        vehicle(control=Control.PILOT, mode="POSCTL"),
        vehicle(control=Control.FAILSAFE, mode="RTL"),
        vehicle(heartbeat_age_s=9.0),
        vehicle(position_age_s=2.0),
        vehicle(armed=False),
        vehicle(thrust=math.nan),
        tendon(1, silent=True),
        tendon(0, error_bits=0x20),
        tendon(0, temperature=79.0),
        tendon(2, voltage=9.6),
        moved((0.0, 1.0, 0.0)),
        lambda facts: ask(facts, Order.ABORT),
        lambda facts: ask(facts, Order.STOW),
        lambda facts: dataclasses.replace(facts, ground_age_s=9.0),
    ],
)
def test_nothing_but_a_person_or_the_ground_lets_go_of_a_load(
    phase: Phase, change: Callable[[Facts], Facts], parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(phase), parameters)
    run.cycles(aloft(hovering), 0.1)
    run.cycles(change(aloft(hovering)), 1.2)
    assert set(run.phases) <= CARRYING | {Phase.HOLDING}
    assert not opened(run.said)


def test_an_abort_while_setting_down_holds_where_it_is(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(carrying(Phase.PLACE), parameters)
    run.cycles(ask(aloft(hovering), Order.ABORT), 1.0)
    assert run.phases == [Phase.PLACE, Phase.CARRY]
    assert run.said[-1].setpoint is not None
    assert run.said[-1].setpoint.velocity_w == (0.0, 0.0, 0.0)


def test_after_the_pilot_had_it_the_load_stays_on_until_set_points_are_asked_for_again(
    parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.CARRY), parameters)
    run.cycles(aloft(hovering), 0.1)
    flown = vehicle(control=Control.PILOT, mode="POSCTL")(moved((3.0, 0.0, 0.0))(aloft(hovering)))
    run.cycles(flown, 1.0)
    back = vehicle(control=Control.EXTERNAL)(flown)
    run.cycles(back, 0.5)
    assert run.said[-1].setpoint is None
    run.cycles(ask(back, Order.READY), 0.5)
    setpoint = run.said[-1].setpoint
    assert setpoint is not None
    assert setpoint.position_w == pytest.approx(flown.vehicle.position_w)
    assert run.phases == [Phase.CARRY]
    run.cycles(ask(back, Order.RELEASE, request=9), 1.0)
    setpoint = run.said[-1].setpoint
    assert run.state.phase is Phase.PLACE
    assert setpoint is not None
    assert setpoint.position_w[0] == pytest.approx(flown.vehicle.position_w[0]), "set down here, not brought back"
    assert setpoint.position_w[2] > flown.vehicle.position_w[2]


def test_a_pilot_who_sets_the_load_down_by_hand_is_followed_by_the_arm(
    parameters: Parameters, hovering: Hovering
) -> None:
    pilot = vehicle(control=Control.PILOT, mode="POSCTL")
    run = Run(carrying(Phase.CARRY, control=Control.PILOT, streaming=False), parameters)
    run.cycles(ask(pilot(aloft(hovering)), Order.RELEASE), 2.0)
    assert run.state.phase is Phase.PLACE
    run.cycles(pilot(aloft(hovering, 0.0, 0.2)), 2.0)
    assert run.phases == [Phase.CARRY, Phase.PLACE, Phase.RELEASE]
    assert all(said.setpoint is None for said in run.said)


@pytest.mark.parametrize("phase", [Phase.CARRY, Phase.PLACE])
def test_a_load_that_is_lost_is_told_within_three_tenths_of_a_second_and_the_arm_stays_as_it_is(
    phase: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(phase), parameters)
    run.cycles(aloft(hovering), 1.0)
    up = MASS * 9.80665 / 1.8  # the thrust stays, the weight is gone
    for i in range(30):
        falling = vehicle(velocity_w=(0.0, 0.0, -up * 0.01 * (i + 1)))(aloft(hovering))
        run.cycle(falling)
        if run.state.phase is Phase.HOLDING:
            break
    assert run.phases == [phase, Phase.HOLDING]
    assert run.state.errors & ArmFault.CONTACT_LOST
    assert any("load lost: 0.20 kg" in text for text in run.texts)
    assert norm(run.state.lean) == 0.0


def test_a_load_that_is_lost_before_it_was_weighed_is_lost_too(parameters: Parameters, hovering: Hovering) -> None:
    state = carrying(Phase.LIFT)
    run = Run(dataclasses.replace(state, load=dataclasses.replace(state.load, mass=0.0, weighed_s=0.0)), parameters)
    run.cycles(aloft(hovering), 0.3)
    assert run.phases == [Phase.LIFT]
    run.cycles(aloft(hovering, 0.0), 1.0)
    assert run.phases == [Phase.LIFT, Phase.HOLDING]


def test_a_gust_is_not_taken_for_a_lost_load(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(carrying(Phase.CARRY), parameters)
    for i in range(200):
        gust = 0.02 * math.sin(2.0 * math.pi * 0.8 * i * 0.01)  # 0.1 m/s^2 up and down
        run.cycle(vehicle(velocity_w=(0.0, 0.0, gust))(aloft(hovering)))
    assert run.phases == [Phase.CARRY]


# --- setting down ---


def test_the_arm_opens_when_the_load_is_off_at_the_ground(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(carrying(Phase.PLACE, up=0.0), parameters)
    run.cycles(aloft(hovering, MASS, 0.0), 1.0)
    assert run.phases == [Phase.PLACE]
    run.cycles(aloft(hovering, 0.0, 0.0), 2.0)
    assert run.phases == [Phase.PLACE, Phase.RELEASE]
    assert any("the load is off" in text for text in run.texts)


def test_with_nothing_below_the_load_is_kept(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(carrying(Phase.PLACE, up=0.0), parameters)
    for i in range(800):
        run.cycle(aloft(hovering, MASS, -0.06 * min(i / 400.0, 1.0)))
    assert run.phases[:2] == [Phase.PLACE, Phase.CARRY]
    assert run.state.errors & ArmFault.NO_CONTACT
    assert not opened(run.said)


def test_a_load_that_swings_beside_what_it_lay_on_is_kept(parameters: Parameters, hovering: Hovering) -> None:
    """It pulls the vehicle to and fro, so that it never rests where it is as low as it may go."""
    run = Run(carrying(Phase.PLACE, up=0.0), parameters)
    for i in range(800):
        facts = moved((0.0, 0.04 * math.sin(0.04 * i), 0.0))(aloft(hovering, MASS, -0.06 * min(i / 400.0, 1.0)))
        swinging = dataclasses.replace(facts.vehicle, velocity_w=(0.0, 0.16 * math.cos(0.04 * i), 0.0))
        run.cycle(dataclasses.replace(facts, vehicle=swinging))
    assert run.phases[:2] == [Phase.PLACE, Phase.CARRY]
    assert any("nothing found to set the load down on" in text for text in run.texts)
    assert not opened(run.said)


def test_a_load_that_meets_something_high_above_its_place_is_lifted_again_and_kept(
    parameters: Parameters, hovering: Hovering
) -> None:
    """An end of what hangs askew: the arm would turn it out of its hold by going on."""
    run = Run(carrying(Phase.PLACE, up=0.15), parameters)
    run.cycles(aloft(hovering, 0.6 * MASS, 0.15), 0.5)
    assert run.phases == [Phase.PLACE, Phase.LIFT]
    assert any("met something 15 cm above where it was taken: 0.1" in text for text in run.texts)
    assert run.state.errors & ArmFault.GRIP_TEST_FAILED
    for i in range(800):
        run.cycle(aloft(hovering, MASS, 0.15 + 0.25 * min(i / 400.0, 1.0)))
    place, _ = asked(run)
    assert place == pytest.approx((PLACE[0], PLACE[1], PLACE[2] - HEIGHT))
    assert run.phases == [Phase.PLACE, Phase.LIFT, Phase.CARRY]
    assert not opened(run.said)


def test_a_load_that_stands_on_one_end_above_its_place_is_not_taken_for_lost_nor_let_go(
    parameters: Parameters, hovering: Hovering
) -> None:
    """300 g hung 31 degrees askew and jammed 5 cm above where they had lain; an arm that opened dropped them."""
    run = Run(carrying(Phase.PLACE, up=0.05), parameters)
    while run.state.phase is Phase.PLACE and len(run.said) < 100:
        run.cycle(aloft(hovering, 0.1 * MASS, 0.05))
    assert run.phases == [Phase.PLACE, Phase.LIFT]
    assert any("met something 5 cm above where it was taken: 0.0" in text for text in run.texts), run.texts
    run.cycles(aloft(hovering, MASS, 0.15), 1.0)
    assert run.phases == [Phase.PLACE, Phase.LIFT]
    assert not opened(run.said)


def test_lifted_again_elsewhere_it_stays_there_and_never_goes_down(parameters: Parameters, hovering: Hovering) -> None:
    """A table, two metres away and half a metre higher than what the object lay on."""
    x, y, z = PLACE
    here = (x + 2.0, y, z - 0.5)
    run = Run(carrying(Phase.PLACE, position=here, reference=Reference(here)), parameters)
    run.cycles(moved((2.0, 0.0, 0.0))(aloft(hovering, 0.6 * MASS, 0.5)), 0.5)
    assert run.phases == [Phase.PLACE, Phase.LIFT]
    for _ in range(400):
        run.cycle(vehicle(position_w=asked(run)[0])(aloft(hovering)))
    (there_x, there_y, there_z), _ = asked(run)
    assert (there_x, there_y) == pytest.approx((x + 2.0, y), abs=1e-3)
    assert z - 0.7 < there_z < z - 0.55


@pytest.mark.parametrize(("share", "up"), [(0.6, 0.06), (0.95, 0.15)])
def test_what_touches_near_its_place_or_only_swings_is_set_down(
    share: float, up: float, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.PLACE, up=up), parameters)
    run.cycles(aloft(hovering, share * MASS, up), 1.0)
    assert run.phases == [Phase.PLACE]


@pytest.mark.parametrize(("up", "goes_down"), [(0.2, False), (0.06, True)])
def test_what_is_aside_of_its_place_waits_in_the_air_and_lies_down_once_an_end_of_it_may_lie_there(
    up: float, goes_down: bool, parameters: Parameters, hovering: Hovering
) -> None:
    """A load 30 degrees askew met its cradle 6 cm early, and pushed the vehicle aside, which waited, and lost it."""
    run = Run(carrying(Phase.PLACE, up=up), parameters)
    run.cycles(moved((0.0, 0.045, 0.0))(aloft(hovering, 0.9 * MASS, up)), 1.5)
    (_, _, z), _ = asked(run)
    assert run.phases == [Phase.PLACE]
    assert (z > PLACE[2] - up + 0.01) is goes_down


@pytest.mark.parametrize(
    ("aside", "ahead", "late", "tells"),
    [(0.06, 0.0, False, True), (-0.06, 0.0, False, True), (0.03, 0.06, False, False), (0.06, 0.0, True, False)],
    ids=["to one side", "to the other", "back and forth", "a gust later on"],
)
def test_a_load_that_swings_the_vehicle_along_its_axis_as_it_comes_off_is_told_once(
    aside: float, ahead: float, late: bool, tells: bool, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.LIFT, up=0.1, since=T0), parameters)
    run.cycles(aloft(hovering, MASS, 0.1), 2.6 if late else 0.1)
    run.cycles(moved((ahead, aside, 0.0))(aloft(hovering, MASS, 0.1)), 0.5)
    told = [text for text in run.texts if "may hang askew: it swung the vehicle 6.0 cm aside" in text]
    assert len(told) == (1 if tells else 0), run.texts
    assert not run.state.errors
    assert run.phases == [Phase.LIFT]


@pytest.mark.parametrize("up", [0.4, 6.0])
def test_setting_down_has_the_time_that_the_way_down_takes(
    up: float, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.CARRY, up=up), parameters)
    commands = run.cycle(ask(aloft(hovering, up=up), Order.RELEASE))
    high = up
    for _ in range(round(100.0 * (up + 5.0) / parameters.config.grasp.lift_speed_m_per_s)):
        if commands.setpoint is None or run.state.phase is not Phase.PLACE:
            break
        high = PLACE[2] - commands.setpoint.position_w[2]
        commands = run.cycle(aloft(hovering, MASS if high > 0.0 else 0.0, high))
    assert run.phases == [Phase.CARRY, Phase.PLACE, Phase.RELEASE]


def test_a_vehicle_that_does_not_come_down_keeps_its_load_after_a_while(
    parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.CARRY, up=0.4), parameters)
    run.cycle(ask(aloft(hovering), Order.RELEASE))
    run.state = dataclasses.replace(run.state, since=run.state.since - 50.0)
    run.cycle(aloft(hovering))
    assert run.phases == [Phase.CARRY, Phase.PLACE, Phase.CARRY]
    assert run.state.errors & ArmFault.TIMEOUT


def test_without_a_thrust_it_is_set_down_at_the_height_of_the_pick_up(
    parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(carrying(Phase.PLACE, up=0.0), parameters)
    run.cycles(vehicle(thrust=math.nan)(aloft(hovering, MASS, 0.0)), 4.0)
    assert run.phases == [Phase.PLACE, Phase.RELEASE]


def test_the_way_out_begins_where_the_arm_is() -> None:
    for phase in CARRYING:
        row = TABLE.order(Order.RELEASE, phase)
        assert row is None or row.target is Phase.PLACE, "a carried load is never opened on the spot by RELEASE"
