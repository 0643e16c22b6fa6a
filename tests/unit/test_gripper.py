"""The gripper as the mission sees it: when it opens and closes, what tells that it did, and what never lets go."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.config import load
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError
from arm_companion.mission import gripper
from arm_companion.mission.facts import ArmFault, ArmFlag, Control, Facts, Order, Result
from arm_companion.mission.gripper_facts import (
    Grip,
    GripperAction,
    GripperAnswer,
    GripperFate,
    GripperOrder,
    GripperState,
)
from arm_companion.mission.motion import Reference
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import Load
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CARRYING, Phase, State
from arm_companion.record_codec import dumps, loads
from tests.unit.mission_rig import PLACE, T0, Change, Run, ask, gripping, jaws, memory, moved, tendon, vehicle
from tests.unit.test_grasp import HEIGHT, MASS, _known, carrying, hovered, loaded

Hovering = Callable[..., Facts]
STRAIGHT = (0.0, 0.0)
LONG_AGO = T0 - 60.0


@pytest.fixture(scope="module", name="parameters")
def with_gripper(parameters: Parameters) -> Parameters:
    """A gripper on a servo; the mechanics are asked less often, as nothing here looks at them closely."""
    rates = dataclasses.replace(parameters.config.rates, wrench_hz=1.0)
    return gripping(Parameters(dataclasses.replace(parameters.config, rates=rates), parameters.model))


@pytest.fixture(scope="module")
def outputs(parameters: Parameters) -> Parameters:
    """A gripper on the autopilot's output."""
    return gripping(parameters, by="autopilot")


def grip(action: GripperAction, at: float = LONG_AGO, **fields: object) -> Grip:
    return Grip(GripperOrder(action, at), **fields)  # type: ignore[arg-type]


CLOSED, OPENED = grip(GripperAction.CLOSE), grip(GripperAction.OPEN)
HOLDS = {"closed": 0.7, "load": 0.34}


def answer(fate: GripperFate, since_s: float = 9.0, reason: str = "", at: float = LONG_AGO) -> Change:
    """Facts in which the autopilot says this of the order given at `at`."""
    gripper = GripperState(answer=GripperAnswer(at, fate, since_s, reason))
    return lambda facts: dataclasses.replace(facts, gripper=gripper)


def at_object(phase: Phase, parameters: Parameters, hovering: Hovering, **fields: object) -> tuple[State, Facts]:
    """Memory and facts of a vehicle that has the object between its open jaws."""
    facts = jaws()(hovering())
    state = memory(phase, **{"task": Order.GRASP, "bend": STRAIGHT, "bend_goal": STRAIGHT, **fields})
    place = Situation(state, facts, T0, parameters).place(0.0)
    where = {"position": place, "reference": Reference(place), "contact_w": place}
    facts = vehicle(position_w=place)(facts)
    return dataclasses.replace(state, **where), facts  # type: ignore[arg-type]


# --- the way to the object ---


def test_the_object_is_taken_from_above_with_the_tip_at_its_height(parameters: Parameters, hovering: Hovering) -> None:
    facts = jaws()(hovering())
    run = Run(hovered(Phase.READY, bend=STRAIGHT, bend_goal=STRAIGHT), parameters)
    run.cycle(ask(facts, Order.GRASP))
    assert run.state.phase is Phase.APPROACH
    assert run.said[-1].gripper == GripperOrder(GripperAction.OPEN, run.state.since)
    s = Situation(run.state, facts, run.state.t, parameters)
    config = parameters.config
    x, y, z = config.grasp.object_position_m
    arm = config.mount.position_m[2] + config.arm.length_m + config.gripper.depth_m
    assert s.place(0.0) == pytest.approx((x, y, z - arm))
    assert s.standoff == pytest.approx((x, y, z - arm - config.perch.standoff_m))


def test_closed_jaws_wait_above_the_object_and_go_back_when_they_do_not_open(
    parameters: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.REACH, parameters, hovering)
    high = Situation(state, facts, T0, parameters).standoff
    facts = vehicle(position_w=high)(facts)
    state = dataclasses.replace(
        state, position=high, reference=Reference(high), grip=grip(GripperAction.OPEN, T0), since=T0
    )
    run = Run(state, parameters)
    run.cycles(jaws(closed=0.9)(facts), 3.0)
    assert run.phases == [Phase.REACH]
    assert run.said[-1].setpoint is not None
    assert run.said[-1].setpoint.position_w == pytest.approx(high)
    run.cycles(jaws(closed=0.9)(facts), 2.5)
    assert run.phases[:2] == [Phase.REACH, Phase.DEPART]
    assert any("did not open within 5 s" in text for text in run.texts)
    assert run.state.errors & ArmFault.GRIP_TEST_FAILED
    opening = Run(state, parameters)
    opening.cycles(jaws()(facts), 1.0)
    assert opening.said[-1].setpoint is not None
    assert opening.said[-1].setpoint.position_w[2] > high[2], "down onto the object"


def test_the_jaws_close_once_the_vehicle_rests_with_the_object_between_them(
    parameters: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.REACH, parameters, hovering, grip=OPENED)
    run = Run(state, parameters)
    run.cycles(facts, 4.0)
    assert run.phases == [Phase.REACH, Phase.CONTACT, Phase.CLOSE]
    assert run.said[-1].gripper == GripperOrder(GripperAction.CLOSE, run.state.since)
    assert all(said.pulls is not None for said in run.said)
    assert max(math.hypot(*run.state.bend), math.hypot(*run.state.bend_goal)) < 0.01, "the arm stays straight"


def test_a_vehicle_that_arrived_stays_where_it_was_asked_to_be_though_it_sways(
    parameters: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.REACH, parameters, hovering, grip=OPENED)
    assert state.reference is not None
    x, y, z = state.reference.position
    run = Run(dataclasses.replace(state, position=(x + 0.02, y, z)), parameters)
    run.cycles(vehicle(position_w=(x + 0.02, y, z))(facts), 0.1)
    assert run.phases == [Phase.REACH, Phase.CONTACT]
    assert run.state.contact_w == pytest.approx((x, y, z))


def test_a_tip_that_stands_on_something_stops_there(parameters: Parameters, hovering: Hovering) -> None:
    state, facts = at_object(Phase.REACH, parameters, hovering, grip=OPENED)
    x, y, z = state.position
    higher = (x, y, z - 0.08)
    load_ = Load(_known(), None, 5.0, -0.08)
    state = dataclasses.replace(state, position=higher, reference=Reference(higher), load=load_)
    on_it = loaded(vehicle(position_w=higher)(facts), -0.08)
    run = Run(state, parameters)
    for _ in range(300):
        run.cycle(on_it)
        if run.state.phase is not Phase.REACH:
            break
    assert run.phases == [Phase.REACH, Phase.CONTACT]
    assert any("from below" in text for text in run.texts)
    assert run.state.contact_w == pytest.approx(higher)


def test_an_arm_above_has_nothing_to_grip(parameters: Parameters, hovering: Hovering) -> None:
    config = parameters.config
    above = dataclasses.replace(config, mount=dataclasses.replace(config.mount, rpy_deg=(180.0, 0.0, 0.0)))
    run = Run(hovered(Phase.READY), Parameters(above, parameters.model))
    run.cycle(ask(jaws()(hovering()), Order.GRASP))
    assert "does not point down" in run.said[-1].answers[0].reason


def test_without_the_feed_forward_nothing_is_gripped(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(hovered(Phase.READY, feedforward=False), parameters)
    run.cycle(ask(jaws()(hovering()), Order.GRASP))
    assert "FEEDFORWARD is off" in run.said[-1].answers[0].reason


def test_a_dead_gripper_keeps_the_arm_from_getting_ready(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.STOWED), parameters)
    run.cycle(ask(jaws(silent=True)(hovering()), Order.READY))
    (said,) = run.said[-1].answers
    assert (said.result, said.reason) == (
        Result.TEMPORARILY_REJECTED,
        "gripper: servo does not answer; mend it, then CLEAR_ERRORS",
    )


# --- closing, by a servo ---


@pytest.mark.parametrize(
    ("fields", "after", "words"),
    [
        ({"closed": 0.7, "load": 0.34}, Phase.VERIFY, "closed by 70% with 34% load"),
        ({"closed": 0.99, "load": 0.1}, Phase.UNLOAD, "the gripper closed on nothing"),
        ({"closed": 0.5, "load": 0.05}, Phase.UNLOAD, "did not close within 5 s: 50% closed with 5% load"),
        ({"closed": 0.5, "load": 0.34, "speed": 0.5}, Phase.UNLOAD, "did not close within 5 s"),
        ({"closed": 0.5, "silent": True}, Phase.UNLOAD, "gripper: servo does not answer"),
        ({"closed": 0.5, "error_bits": 0x20}, Phase.UNLOAD, "gripper: servo hardware error 0x20"),
    ],
)
def test_what_stops_short_and_pulls_has_closed_on_something(
    fields: dict[str, object], after: Phase, words: str, parameters: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.CLOSE, parameters, hovering, grip=CLOSED, since=T0)
    run = Run(state, parameters)
    facts = jaws(**fields)(facts)
    for _ in range(600):
        run.cycle(facts)
        if run.state.phase is not Phase.CLOSE:
            break
    assert run.phases == [Phase.CLOSE, after]
    assert any(words in text for text in run.texts), run.texts
    assert bool(run.said[-1].status.flags & ArmFlag.GRIPPER_CLOSED) is (after is Phase.VERIFY)


def test_a_moments_load_is_none(parameters: Parameters, hovering: Hovering) -> None:
    state, facts = at_object(Phase.CLOSE, parameters, hovering, grip=CLOSED, since=T0)
    run = Run(state, parameters)
    for i in range(100):
        run.cycle(jaws(closed=0.5, load=0.34 if i % 20 < 15 else 0.0)(facts))
    assert run.phases == [Phase.CLOSE]


# --- closing, by the autopilot ---


@pytest.mark.parametrize(
    ("fate", "after", "words"),
    [
        (answer(GripperFate.TAKEN, 2.5), Phase.VERIFY, "has had 2 s to close"),
        (answer(GripperFate.REFUSED, 0.0, "the autopilot answers DO_GRIPPER: denied"), Phase.UNLOAD, "denied"),
        (answer(GripperFate.PENDING), Phase.UNLOAD, "did not close within 5 s"),
        (answer(GripperFate.TAKEN, 9.0, at=LONG_AGO - 1.0), Phase.UNLOAD, "did not close within 5 s"),
    ],
    ids=["taken", "denied", "no answer", "an answer to another order"],
)
def test_an_autopilots_gripper_has_closed_when_it_took_the_order_and_had_its_time(
    fate: Change, after: Phase, words: str, outputs: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.CLOSE, outputs, hovering, grip=CLOSED, since=T0)
    run = Run(state, outputs)
    for _ in range(600):
        run.cycle(fate(facts))
        if run.state.phase is not Phase.CLOSE:
            break
    assert run.phases == [Phase.CLOSE, after]
    assert any(words in text for text in run.texts), run.texts


def test_an_answer_that_is_too_young_is_waited_for(outputs: Parameters, hovering: Hovering) -> None:
    state, facts = at_object(Phase.CLOSE, outputs, hovering, grip=CLOSED, since=T0)
    run = Run(state, outputs)
    run.cycles(answer(GripperFate.TAKEN, 1.9)(facts), 1.0)
    assert run.phases == [Phase.CLOSE]


def test_jaws_that_stand_open_count_only_when_open_was_the_last_thing_they_were_told(
    parameters: Parameters, hovering: Hovering
) -> None:
    for known, counts in ((Grip(), False), (CLOSED, False), (OPENED, True)):
        s = Situation(memory(Phase.REACH, grip=known), jaws(closed=0.0)(hovering()), T0, parameters)
        assert gripper.is_open(s) is counts


def test_an_autopilots_gripper_that_does_not_close_has_no_figures_to_tell(
    outputs: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.CLOSE, outputs, hovering, grip=CLOSED, since=T0 - 5.1)
    facts = dataclasses.replace(facts, gripper=GripperState())
    assert gripper.not_closed(Situation(state, facts, T0, outputs)) == "the gripper did not close within 5 s"


# --- the test lift ---


def test_the_test_lift_begins_at_once_and_pushes_more_and_more_until_the_vehicle_rises(
    parameters: Parameters, hovering: Hovering
) -> None:
    state, facts = at_object(Phase.CLOSE, parameters, hovering, grip=CLOSED, since=T0, load=Load(_known(), None, 5.0))
    run = Run(state, parameters)
    facts = jaws(**HOLDS)(loaded(facts, 0.0))
    run.cycles(facts, 0.4)
    assert run.phases == [Phase.CLOSE, Phase.VERIFY]
    run.cycles(facts, 0.2)
    early = run.said[-1].setpoint
    run.cycles(facts, 1.0)
    late = run.said[-1].setpoint
    assert early is not None
    assert late is not None
    grasp, mass = parameters.config.grasp, parameters.config.vehicle.mass_kg
    assert late.position_w[2] < early.position_w[2] < state.position[2]
    assert late.position_w[:2] == pytest.approx(state.position[:2])
    most = grasp.mass_max_kg * 9.80665 / mass / 1.25
    assert -early.acceleration_w[2] == pytest.approx(0.3 * most, rel=0.2)
    assert -late.acceleration_w[2] == pytest.approx(most, rel=0.05)
    x, y, z = facts.vehicle.position_w
    run.cycles(vehicle(position_w=(x, y, z - 0.05))(facts), 2.0)
    assert run.said[-1].setpoint is not None
    assert -run.said[-1].setpoint.acceleration_w[2] < 0.1 * most, "it rose with nothing on it"


# --- carrying ---


def held(phase: Phase, **fields: object) -> State:
    """Memory of a load that was weighed in closed jaws."""
    return carrying(phase, **{"bend": STRAIGHT, "bend_goal": STRAIGHT, "grip": CLOSED, "task": Order.GRASP, **fields})


def aloft(hovering: Hovering, kilograms: float = MASS) -> Facts:
    return jaws(**HOLDS)(loaded(moved((0.0, 0.0, -HEIGHT))(hovering()), kilograms))


@pytest.mark.parametrize("phase", sorted(CARRYING, key=lambda p: p.value), ids=lambda p: p.name)
@pytest.mark.parametrize(
    "change",
    [
        vehicle(control=Control.PILOT, mode="POSCTL"),
        vehicle(control=Control.FAILSAFE, mode="RTL"),
        vehicle(heartbeat_age_s=9.0),
        vehicle(armed=False),
        tendon(1, silent=True),
        jaws(**{**HOLDS, "silent": True}),
        jaws(**{**HOLDS, "error_bits": 0x20, "torque": False}),
        jaws(**{**HOLDS, "homed": False, "ready": False, "torque": False}),
        jaws(**{**HOLDS, "temperature": 71.0}),
        jaws(**{**HOLDS, "voltage": 9.6}),
        jaws(closed=0.99),
        moved((0.0, 1.0, 0.0)),
        lambda facts: ask(facts, Order.ABORT),
        lambda facts: ask(facts, Order.STOW),
    ],
)
def test_nothing_but_a_person_or_the_ground_opens_the_jaws_on_a_load(
    phase: Phase, change: Change, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(held(phase), parameters)
    run.cycles(aloft(hovering), 0.1)
    run.cycles(change(aloft(hovering)), 1.2)
    assert set(run.phases) <= CARRYING | {Phase.HOLDING}
    assert all(said.gripper == CLOSED.order for said in run.said)


def test_a_silent_gripper_is_told_while_it_carries(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(held(Phase.CARRY), parameters)
    run.cycles(jaws(**{**HOLDS, "silent": True})(aloft(hovering)), 0.5)
    assert run.phases == [Phase.CARRY]
    assert "gripper: servo does not answer; the arm holds" in run.texts
    assert run.said[-1].status.error_bits & ArmFault.SERVO_SILENT


@pytest.mark.parametrize("change", [jaws(**{**HOLDS, "temperature": 71.0}), jaws(**{**HOLDS, "voltage": 9.6})])
def test_a_hot_gripper_or_one_short_of_voltage_is_told(
    change: Change, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(held(Phase.CARRY), parameters)
    run.cycles(change(aloft(hovering)), 1.3)
    assert any("gripper: servo at 71" in text or "servo supply 9.6 V" in text for text in run.texts)


def test_jaws_that_meet_make_a_smaller_loss_of_weight_a_drop(parameters: Parameters, hovering: Hovering) -> None:
    for shut, after in ((False, Phase.CARRY), (True, Phase.HOLDING)):
        run = Run(held(Phase.CARRY, now=0.65 * MASS), parameters)
        facts = aloft(hovering, 0.65 * MASS)
        run.cycles(jaws(closed=0.99)(facts) if shut else facts, 1.0)
        assert run.state.phase is after
        assert all(said.gripper == CLOSED.order for said in run.said)


def test_the_load_hangs_between_the_jaws(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(held(Phase.CARRY), parameters)
    run.cycles(aloft(hovering), 1.0)
    payload = run.said[-1].payload
    assert payload is not None
    depth = 0.12 + parameters.config.arm.length_m + parameters.config.gripper.depth_m
    assert payload.centre_of_mass_b == pytest.approx((0.0, 0.0, depth))


# --- letting go ---


def test_the_jaws_open_once_the_load_is_off_and_only_then_does_the_vehicle_leave(
    parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(held(Phase.PLACE, up=0.0), parameters)
    on_ground = jaws(**HOLDS)(loaded(hovering(), 0.0))
    run.cycles(on_ground, 3.0)
    assert run.phases == [Phase.PLACE, Phase.RELEASE]
    assert run.said[-1].gripper == GripperOrder(GripperAction.OPEN, run.state.since)
    assert run.said[-1].setpoint is not None
    assert run.said[-1].setpoint.position_w == pytest.approx(PLACE, abs=0.01), "it waits for the jaws"
    run.cycles(jaws()(on_ground), 1.0)
    assert run.phases == [Phase.PLACE, Phase.RELEASE, Phase.DEPART]
    assert run.said[-1].setpoint.position_w[2] < PLACE[2], "straight up"


def test_a_release_in_the_cycle_in_which_the_motors_stop_opens_nothing(
    parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(memory(Phase.HOLDING, armed=True, grip=CLOSED), parameters)
    stopped = vehicle(armed=False)(jaws(**HOLDS)(hovering()))
    commands = run.cycle(ask(stopped, Order.RELEASE))
    assert run.phases == [Phase.HOLDING]
    assert any("RELEASE -> HOLDING" in text for text in run.texts), "it had begun"
    assert commands.gripper == CLOSED.order
    commands = run.cycle(ask(stopped, Order.RELEASE, request=8))
    assert run.state.phase is Phase.RELEASE
    assert commands.gripper is not None
    assert commands.gripper.action is GripperAction.OPEN, "said again of motors that stand, it counts"


def test_jaws_that_do_not_open_end_in_holding(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(held(Phase.RELEASE, grip=OPENED, since=T0 - 29.0), parameters)
    run.cycles(jaws(closed=0.7)(hovering()), 2.0)
    assert run.phases == [Phase.RELEASE, Phase.HOLDING]


# --- a restart ---


@pytest.mark.parametrize(
    ("fields", "after"),
    [
        (HOLDS, Phase.HOLDING),
        ({"closed": 0.0, "load": 0.02}, Phase.STOWED),
        ({"closed": 0.99, "load": 0.3}, Phase.STOWED),
        ({**HOLDS, "torque": False}, Phase.STOWED),
        ({"silent": True}, Phase.STARTUP),
    ],
    ids=["holds", "open", "closed on nothing", "without torque", "silent"],
)
def test_a_daemon_that_starts_takes_a_gripper_over_as_it_is(
    fields: dict[str, object], after: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(State(t=T0), parameters)
    facts = jaws(**fields)(hovering())
    run.cycles(facts, 2.0)
    assert run.state.phase is after
    assert all(said.gripper is None for said in run.said), "nothing moves until told"
    if after is Phase.HOLDING:
        run.cycles(ask(facts, Order.RELEASE), 0.1)
        assert run.said[-1].gripper is not None
        assert run.said[-1].gripper.action is GripperAction.OPEN


@pytest.mark.parametrize(
    ("change", "after"),
    [
        (vehicle(), Phase.HOLDING),
        (vehicle(armed=False), Phase.STOWED),
        (vehicle(armed=False, heartbeat_age_s=math.inf), Phase.STARTUP),
    ],
    ids=["in flight", "on the ground", "nobody heard"],
)
def test_what_an_autopilots_gripper_holds_in_flight_nobody_knows_after_a_restart(
    change: Change, after: Phase, outputs: Parameters, hovering: Hovering
) -> None:
    run = Run(State(t=T0), outputs)
    run.cycles(dataclasses.replace(change(hovering()), gripper=GripperState()), 1.0)
    assert run.state.phase is after


# --- what is recorded, and what is configured ---


def test_everything_about_a_gripper_is_recorded(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(held(Phase.CARRY), parameters)
    facts = aloft(hovering)
    commands = run.cycle(facts)
    assert loads(Facts, dumps(facts)).gripper == facts.gripper
    assert loads(type(commands), dumps(commands)).gripper == commands.gripper
    assert loads(State, dumps(run.state)).grip == run.state.grip
    told = answer(GripperFate.REFUSED, 0.5, "denied")(facts)
    assert loads(Facts, dumps(told)) == told


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("gripper.servo_id=3",), "gripper.servo_id = 3 is one of servos.ids"),
        (("gripper.closed_ticks=1050",), "at least 100 ticks"),
        (("gripper.load_min=0.4",), "never reached"),
        (("gripper.by=autopilot", "vehicle.component_id=1"), "means ourselves"),
        (("gripper.by=autopilot", "gripper.moving_s=6"), "gripper.timeout_s"),
    ],
)
def test_a_gripper_that_cannot_be_meant_is_refused(settings: tuple[str, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load("sim_gripper.toml", settings)


def test_without_a_gripper_the_bus_has_the_tendons_servos_alone() -> None:
    config = Config()
    assert config.bus_servos is config.servos
    assert load("sim_gripper.toml").bus_servos.ids == (1, 2, 3, 4, 5)
    assert load("sim_gripper.toml", ("gripper.by=autopilot",)).bus_servos.ids == (1, 2, 3, 4)
