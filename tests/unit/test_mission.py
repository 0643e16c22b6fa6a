"""The mission's step, one situation at a time, with plain facts and no device."""

import dataclasses
import math
from collections.abc import Callable
from itertools import pairwise

import pytest

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import (
    Answer,
    ArmAction,
    ArmFault,
    ArmFlag,
    Commands,
    Control,
    Facts,
    Order,
    Request,
    Result,
    WrenchReport,
    WrenchSource,
)
from arm_companion.mission.mission import step
from arm_companion.mission.motion import ZERO, Reference, norm
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import NO_LOAD, Flow, Load, ThrustCurve
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, Prediction, Running, State
from arm_companion.mission.wrench import grip
from arm_companion.record_codec import dumps, loads
from tests.unit.mission_rig import ANCHOR, DT, run

Hovering = Callable[..., Facts]


def answers(said: list[Commands]) -> list[Answer]:
    return [answer for commands in said for answer in commands.answers]


def ask(facts: Facts, order: Order, *values: float) -> Facts:
    return dataclasses.replace(facts, requests=(Request(7, order, values),))


def at(phase: Phase, **memory: object) -> State:
    fields = {"t": 100.0, "since": 99.0, "control": Control.EXTERNAL, "streaming": True, **memory}
    return State(phase=phase, reference=Reference((2.0, 0.0, -2.2)), **fields)  # type: ignore[arg-type]


def test_an_arm_found_straight_is_stowed_and_moves_nothing(parameters: Parameters, hovering: Hovering) -> None:
    state, said = run(State(), hovering(), parameters)
    assert state.phase is Phase.STOWED
    assert {commands.arm for commands in said} == {ArmAction.HOLD}
    assert all(commands.setpoint is None for commands in said)


def test_an_arm_found_bent_under_torque_is_left_as_it_is(parameters: Parameters, hovering: Hovering) -> None:
    state, said = run(State(), hovering((1.2, 0.0)), parameters, 1.0)
    assert state.phase is Phase.HOLDING
    assert {commands.arm for commands in said} == {ArmAction.HOLD}
    assert all(commands.pulls is None and commands.setpoint is None for commands in said)


def test_ready_straightens_the_arm_checks_it_and_then_answers(parameters: Parameters, hovering: Hovering) -> None:
    state, said = run(at(Phase.STOWED), ask(hovering(), Order.READY), parameters, 3.0)
    assert state.phase is Phase.READY
    assert [a.result for a in answers(said)] == [Result.IN_PROGRESS, Result.ACCEPTED]


def test_torque_that_comes_on_never_jerks_the_arm(parameters: Parameters, hovering: Hovering) -> None:
    bent = hovering((0.2, 0.1))
    limp = dataclasses.replace(bent, tendons=tuple(dataclasses.replace(t, torque=False) for t in bent.tendons))
    _, said = run(at(Phase.STOWED), ask(limp, Order.READY), parameters)
    first = said[0].pulls
    assert first is not None
    assert first == pytest.approx([t.pull for t in bent.tendons], abs=5e-4)


@pytest.mark.parametrize(
    ("vehicle", "words"),
    [
        ({"armed": False}, "not flying"),
        ({"landed": True}, "not flying"),
        ({"control": Control.PILOT, "mode": "POSCTL"}, "POSCTL"),
        ({"position_age_s": 1.0}, "old"),
        ({"heartbeat_age_s": 9.0}, "heartbeat"),
        ({"position_w": (400.0, 0.0, -2.0)}, "away"),
    ],
)
def test_perch_is_refused_with_the_reason(
    parameters: Parameters, hovering: Hovering, vehicle: dict[str, object], words: str
) -> None:
    facts = ask(hovering(**vehicle), Order.PERCH)
    state, said = run(at(Phase.READY, control=facts.vehicle.control), facts, parameters)
    assert state.phase is Phase.READY
    (answer,) = answers(said)
    assert answer.result is Result.TEMPORARILY_REJECTED
    assert words in answer.reason


@pytest.mark.parametrize("phase", [Phase.APPROACH, Phase.DEPART, Phase.REACH, Phase.CONTACT])
def test_on_a_way_set_points_have_the_acceleration_of_their_path(
    parameters: Parameters, hovering: Hovering, phase: Phase
) -> None:
    """Whoever is not told that the way ends brakes by himself, behind its end."""
    state, said = run(at(phase, contact_w=(2.942, 0.0, -2.18)), hovering(), parameters, 0.2)
    sent = [commands.setpoint for commands in said if commands.setpoint is not None]
    assert len(sent) > 10
    assert norm(sent[-1].velocity_w) > 0.02, "it has begun to fly"
    assert max(norm(setpoint.acceleration_w) for setpoint in sent) > 0.15
    assert all(setpoint.acceleration_w == setpoint.path_w for setpoint in sent), "none of it is a force"
    state, said = run(state, hovering(position_age_s=0.4), parameters)
    (frozen,) = [commands.setpoint for commands in said]
    assert frozen is not None
    assert (frozen.velocity_w, frozen.acceleration_w, frozen.path_w) == (ZERO, ZERO, ZERO), "an old state moves nothing"


def test_an_arm_is_wrapped_only_once_the_vehicle_rests_beside_the_bar(
    parameters: Parameters, hovering: Hovering
) -> None:
    """The blow of the bar throws it back and forth: 2 cm off and slow is also where it passes by, or turns round."""
    clear = parameters.config.perch.wrap_clearance_m
    state = dataclasses.replace(at(Phase.CONTACT, contact_w=(2.0 + clear, 0.0, -2.2)), since=100.0)
    there = hovering()
    state, _ = run(state, there, parameters, 2.4)
    assert state.phase is Phase.CONTACT
    for _ in range(3):
        state, _ = run(state, hovering(position_w=(2.025, 0.0, -2.2)), parameters, 0.4)
        assert state.phase is Phase.CONTACT, "not near enough"
        state, _ = run(state, hovering(velocity_w=(0.025, 0.0, 0.0)), parameters, 0.4)
        assert state.phase is Phase.CONTACT, "not slow enough"
        state, _ = run(state, there, parameters, 0.4)
        assert state.phase is Phase.CONTACT, "not for long enough"
    state, _ = run(state, there, parameters, 0.15)
    assert state.phase is Phase.WRAP


@pytest.mark.parametrize("off", [(-0.025, 0.0), (0.008, 0.02)], ids=["farther from the bar", "aside"])
def test_a_vehicle_that_never_quite_rests_wraps_all_the_same(
    parameters: Parameters, hovering: Hovering, off: tuple[float, float]
) -> None:
    clear = parameters.config.perch.wrap_clearance_m
    state = dataclasses.replace(at(Phase.CONTACT, contact_w=(2.0 + clear, 0.0, -2.2)), since=100.0)
    restless = hovering(position_w=(2.0 + off[0], off[1], -2.2))
    state, _ = run(state, restless, parameters, 7.8)
    assert state.phase is Phase.CONTACT
    state, _ = run(state, restless, parameters, 0.4)
    assert state.phase is Phase.WRAP


def test_nearer_to_the_bar_than_it_should_be_it_waits_on(parameters: Parameters, hovering: Hovering) -> None:
    """The curl would meet the bar before it closes, throw the vehicle back, and have it rock about the grip."""
    clear = parameters.config.perch.wrap_clearance_m
    state = dataclasses.replace(at(Phase.CONTACT, contact_w=(2.0 + clear, 0.0, -2.2)), since=100.0)
    state, _ = run(state, hovering(position_w=(2.022, 0.0, -2.2)), parameters, 12.0)
    assert state.phase is Phase.CONTACT
    state, _ = run(state, hovering(position_w=(2.008, 0.0, -2.2)), parameters, 0.6)
    assert state.phase is Phase.WRAP


def test_an_object_is_not_closed_around_beside_its_middle(parameters: Parameters, hovering: Hovering) -> None:
    clear = parameters.config.perch.wrap_clearance_m
    state = at(Phase.CONTACT, contact_w=(2.0 + clear, 0.0, -2.2), task=Order.GRASP)
    state = dataclasses.replace(state, since=100.0)
    state, _ = run(state, hovering(position_w=(2.0, 0.015, -2.2)), parameters, 12.0)
    assert state.phase is Phase.CONTACT
    state, _ = run(state, hovering(position_w=(1.98, 0.008, -2.18)), parameters, 0.6)
    assert state.phase is Phase.CLOSE, "height and the way towards it matter less"


@pytest.mark.parametrize(("amplitude", "lets_go"), [(0.25, False), (0.6, True)])
def test_a_vehicle_that_rocks_about_its_grip_lets_go_and_another_that_comes_to_rest_does_not(
    parameters: Parameters, hovering: Hovering, amplitude: float, lets_go: bool
) -> None:
    state = dataclasses.replace(at(Phase.VERIFY, anchor=ANCHOR), since=100.0)
    seconds = 0.0
    while state.phase is Phase.VERIFY and seconds < 2.5:
        rate = amplitude * math.sin(2.8 * seconds)
        rocking = hovering(position_w=(2.0, 0.0, -2.2), rate_b=(0.0, rate, 0.0))
        state, _ = run(state, rocking, parameters, DT)
        seconds += DT
    assert (state.phase is Phase.UNLOAD) is lets_go
    assert not lets_go or 1.9 < seconds < 2.2, "a blow of the closing arm is waited out"


@pytest.mark.parametrize("rate", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, 3.0)], ids=str)
def test_rates_that_are_no_numbers_and_turns_about_the_vertical_are_no_rocking(
    parameters: Parameters, hovering: Hovering, rate: tuple[float, float, float]
) -> None:
    state = dataclasses.replace(at(Phase.VERIFY, anchor=ANCHOR), since=100.0)
    state, _ = run(state, hovering(position_w=(2.0, 0.0, -2.2), rate_b=rate), parameters, 2.5)
    assert state.phase is Phase.VERIFY
    assert state.vigil.rocking == 0.0


@pytest.mark.parametrize("phase", [Phase.STOWED, Phase.APPROACH, Phase.PERCHED, Phase.HOLDING])
def test_an_order_that_is_illegal_in_a_phase_changes_nothing(
    parameters: Parameters, hovering: Hovering, phase: Phase
) -> None:
    before = at(phase, anchor=ANCHOR)
    state, said = run(before, ask(hovering(), Order.PERCH), parameters)
    assert state.phase is phase
    assert phase.name in answers(said)[0].reason


@pytest.mark.parametrize(
    ("phase", "after"),
    [
        (Phase.APPROACH, Phase.STOWING),
        (Phase.REACH, Phase.STOWING),
        (Phase.CONTACT, Phase.RELEASE),
        (Phase.WRAP, Phase.RELEASE),
        (Phase.VERIFY, Phase.HOLDING),
        (Phase.PERCHED, Phase.HOLDING),
        (Phase.DEPART, Phase.STOWING),
    ],
)
def test_the_pilot_wins_in_the_same_cycle(
    parameters: Parameters, hovering: Hovering, phase: Phase, after: Phase
) -> None:
    facts = hovering(control=Control.PILOT, mode="POSCTL")
    running = Running(7, Order.PERCH, frozenset({Phase.PERCHED}))
    state, (commands,) = run(at(phase, anchor=ANCHOR, running=running), facts, parameters)
    assert commands.setpoint is None
    assert state.phase is after
    assert state.errors & ArmFault.PILOT_TOOK_OVER
    assert [a.result for a in commands.answers] == [Result.FAILED]
    later, said = run(state, facts, parameters, 5.0)
    assert all(c.setpoint is None for c in said)
    assert not later.streaming


def test_set_points_do_not_come_back_by_themselves_when_the_pilot_gives_control_back(
    parameters: Parameters, hovering: Hovering
) -> None:
    state, _ = run(at(Phase.PERCHED, anchor=ANCHOR), hovering(control=Control.PILOT), parameters)
    state, said = run(state, hovering(), parameters, 2.0)
    assert state.phase is Phase.HOLDING
    assert all(c.setpoint is None for c in said)


def test_a_vehicle_given_back_without_ready_is_left_alone_when_the_arm_has_let_go(
    parameters: Parameters, hovering: Hovering
) -> None:
    held = at(Phase.HOLDING, anchor=ANCHOR, contact_w=(2.0, 0.0, -2.2), bend=(3.0, 0.0), bend_goal=(3.0, 0.0))
    held = dataclasses.replace(held, streaming=False, reference=None)
    state, first = run(held, ask(hovering((3.0, 0.0)), Order.RELEASE), parameters)
    state, later = run(state, hovering(), parameters, 8.0)
    assert state.phase is Phase.STOWED
    assert [a.result for a in answers(first + later)][-1] is Result.ACCEPTED


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_set_points_that_moved_the_vehicle_are_followed_by_some_that_rest(
    parameters: Parameters, hovering: Hovering, autopilot: str
) -> None:
    """ArduPilot flies on for three seconds with the last velocity and acceleration that it was told."""
    flown = dataclasses.replace(parameters.config.vehicle, autopilot=autopilot)
    parameters = Parameters(dataclasses.replace(parameters.config, vehicle=flown), parameters.model)
    moving = Reference((2.0, 0.0, -2.2), (0.5, 0.0, 0.0))
    before = dataclasses.replace(at(Phase.APPROACH, contact_w=(2.942, 0.0, -2.18)), reference=moving)
    state, said = run(before, hovering(), parameters)
    assert said[-1].setpoint is not None
    assert said[-1].setpoint.velocity_w[0] > 0.4
    jumped = hovering(position_w=(2.0, 1.0, -2.2))
    state, said = run(state, jumped, parameters, 0.9)
    assert state.phase is Phase.STOWING
    assert {None if c.setpoint is None else c.setpoint.velocity_w for c in said} == {(0.0, 0.0, 0.0)}
    _, said = run(state, jumped, parameters, 4.0)
    assert (said[-1].setpoint is None) is (autopilot == "ardupilot")
    _, said = run(state, hovering(control=Control.PILOT, mode="LOITER"), parameters, 1.0)
    assert all(c.setpoint is None for c in said), "the pilot wins meanwhile too"


@pytest.mark.parametrize("silent", [True, False])
def test_an_arm_that_lets_go_waits_for_a_late_servo_and_not_for_a_dead_one(
    parameters: Parameters, hovering: Hovering, silent: bool
) -> None:
    """The others open the arm as far as they can; a vehicle was left on its bar by one servo without power."""
    bent = (4.7, 0.0)
    state = at(Phase.RELEASE, contact_w=(2.0, 0.0, -2.2), bend=bent, bend_goal=(0.0, 0.0))
    facts = hovering(bent)
    dead = tuple(dataclasses.replace(t, silent=silent and i == 0) for i, t in enumerate(facts.tendons))
    state, _ = run(state, dataclasses.replace(facts, tendons=dead), parameters, 6.0)
    assert state.phase is Phase.RELEASE
    assert state.bend == ((0.0, 0.0) if silent else pytest.approx((bent[0] - 0.3, 0.0), abs=0.1))


@pytest.mark.parametrize(("left_m", "stays"), [(8.0, True), (0.3, False)])
def test_an_approach_that_is_given_up_far_away_brings_the_vehicle_no_nearer(
    parameters: Parameters, hovering: Hovering, left_m: float, stays: bool
) -> None:
    bar, standoff = (2.942, 0.0, -2.18), parameters.config.perch.standoff_m
    begin = Reference((bar[0] - standoff - left_m, 0.0, -2.18), (0.4, 0.0, 0.0))
    state = dataclasses.replace(at(Phase.APPROACH, contact_w=bar), reference=begin)
    order: tuple[Request, ...] = (Request(7, Order.ABORT),)
    for _ in range(1000):
        reference = state.reference
        assert reference is not None
        facts = hovering(position_w=reference.position, velocity_w=reference.velocity)
        state, _ = run(state, dataclasses.replace(facts, requests=order), parameters)
        order = ()
    assert state.phase is Phase.STOWED
    assert state.reference is not None
    way = state.reference.position[0] - begin.position[0]
    assert way == pytest.approx(0.2 if stays else left_m, abs=0.06)


@pytest.mark.parametrize(("follows", "ends"), [(True, Phase.REACH), (False, Phase.STOWED)])
def test_a_bar_at_the_end_of_a_long_way_is_come_to(
    parameters: Parameters, hovering: Hovering, follows: bool, ends: Phase
) -> None:
    """PERCH takes bars up to 50 m away; half a minute is enough for 15 m."""
    start = (-22.0, 0.0, -2.18)
    state = dataclasses.replace(at(Phase.READY, position=start), reference=Reference(start))
    order: tuple[Request, ...] = (Request(7, Order.PERCH),)
    for _ in range(1200):
        reference = state.reference
        assert reference is not None
        off = (0.0, 0.0 if follows else 0.3, 0.0)  # beside its way, but not astray
        x, y, z = (a + b for a, b in zip(reference.position, off, strict=True))
        facts = hovering(position_w=(x, y, z), velocity_w=reference.velocity)
        state, _ = step(state, dataclasses.replace(facts, requests=order), state.t + 0.1, parameters)
        order = ()
        if state.phase is ends:
            break
    assert state.phase is ends


@pytest.mark.parametrize(("past", "ends"), [(-0.01, False), (0.0, True)])
def test_the_bar_is_looked_for_up_to_the_overreach(
    past: float, ends: bool, parameters: Parameters, hovering: Hovering
) -> None:
    """A bar may be farther than it is told to be, but an arm that meets none goes back."""
    reaching, perch = at(Phase.REACH), parameters.config.perch
    place = Situation(reaching, hovering(), 100.0, parameters).place(-perch.overreach_m - past)
    state = dataclasses.replace(reaching, position=place, reference=Reference(place))
    state, said = run(state, hovering(position_w=place), parameters)
    assert state.phase is (Phase.DEPART if ends else Phase.REACH)
    assert any("no contact 6 cm past where the bar should be" in n.text for c in said for n in c.notices) is ends


def test_a_slow_way_back_to_a_far_standoff_gets_the_time_that_it_takes(
    parameters: Parameters, hovering: Hovering
) -> None:
    config = parameters.config
    config = dataclasses.replace(
        config,
        perch=dataclasses.replace(config.perch, standoff_m=4.0),
        limits=dataclasses.replace(config.limits, vehicle_speed_m_per_s=0.1),
    )
    slow, start = dataclasses.replace(parameters, config=config), (3.0, 0.0, -2.18)
    state = dataclasses.replace(at(Phase.DEPART, position=start, contact_w=start), reference=Reference(start))
    for _ in range(450):
        assert state.phase is Phase.DEPART
        assert state.reference is not None
        facts = hovering(position_w=state.reference.position, velocity_w=state.reference.velocity)
        state, _ = step(state, facts, state.t + 0.1, slow)
        if state.phase is not Phase.DEPART:
            break
    assert state.reference is not None
    assert state.reference.position == pytest.approx((-1.0, 0.0, -2.18), abs=0.01), "and not where 30 s ended"
    assert not state.errors & ArmFault.TIMEOUT


def test_a_set_point_is_always_complete_and_finite(parameters: Parameters, hovering: Hovering) -> None:
    for phase in Phase:
        _, said = run(at(phase, anchor=ANCHOR), hovering(), parameters, 0.1)
        for commands in said:
            if (sp := commands.setpoint) is not None:
                assert all(map(math.isfinite, (*sp.position_w, *sp.velocity_w, *sp.acceleration_w, sp.yaw)))


def test_stale_vehicle_state_freezes_the_reference(parameters: Parameters, hovering: Hovering) -> None:
    before = at(Phase.RELEASE, anchor=ANCHOR, bend=(2.0, 0.0), bend_goal=(0.0, 0.0))
    state, said = run(before, hovering(position_age_s=2.0, position_w=(9.0, 9.0, 9.0)), parameters, 0.5)
    assert state.reference == before.reference
    assert said[-1].setpoint is not None


def test_a_frozen_reference_asks_for_no_speed(parameters: Parameters, hovering: Hovering) -> None:
    for phase in (Phase.APPROACH, Phase.RELEASE):
        before = dataclasses.replace(at(phase, anchor=ANCHOR), reference=Reference((2.0, 0.0, -2.2), (0.5, 0.0, 0.0)))
        _, said = run(before, hovering(position_age_s=2.0), parameters, 0.1)
        assert all(c.setpoint is not None and c.setpoint.velocity_w == (0.0, 0.0, 0.0) for c in said)


def test_a_silent_servo_ends_the_approach_and_is_told(parameters: Parameters, hovering: Hovering) -> None:
    facts = hovering()
    dead = dataclasses.replace(facts.tendons[2], silent=True)
    facts = dataclasses.replace(facts, tendons=(*facts.tendons[:2], dead, facts.tendons[3]))
    running = Running(7, Order.PERCH, frozenset({Phase.PERCHED}))
    state, said = run(at(Phase.APPROACH, running=running), facts, parameters)
    assert state.phase is Phase.DEPART
    assert "tendon 3" in answers(said)[0].reason


def test_a_silent_servo_never_lets_a_perched_arm_go(parameters: Parameters, hovering: Hovering) -> None:
    facts = hovering((3.0, 0.0))
    dead = dataclasses.replace(facts.tendons[0], silent=True, error_bits=0x20)
    facts = dataclasses.replace(facts, tendons=(dead, *facts.tendons[1:]))
    held = at(Phase.PERCHED, anchor=ANCHOR, bend=(3.0, 0.0), bend_goal=(3.0, 0.0))
    state, said = run(held, facts, parameters, 5.0)
    assert state.phase is Phase.PERCHED
    assert state.bend == (3.0, 0.0)
    warnings = [n.text for c in said for n in c.notices]
    assert sum("hardware error" in text for text in warnings) == 1


def test_a_perched_vehicle_is_moved_only_within_the_limit(parameters: Parameters, hovering: Hovering) -> None:
    held = at(Phase.PERCHED, anchor=ANCHOR)
    state, said = run(held, ask(hovering(), Order.JOG, 3.0, 0.2, 0.0, 0.0), parameters)
    assert answers(said)[0].result is Result.TEMPORARILY_REJECTED
    assert state.offset == (0.0, 0.0, 0.0)
    state, said = run(held, ask(hovering(), Order.JOG, 3.0, 0.01, 0.0, 0.0), parameters, 1.0)
    assert answers(said)[0].result is Result.ACCEPTED
    assert state.reference is not None
    speed = parameters.config.perch.jog_speed_m_per_s
    assert 0.9 * speed < state.reference.position[0] - 2.0 < 1.1 * speed, "slowly, or it overshoots"
    state, _ = run(state, hovering(), parameters, 3.0)
    assert state.reference is not None
    assert state.reference.position == pytest.approx((2.01, 0.0, -2.2))


def test_the_feedforward_leans_the_way_that_the_arm_pulls_back(parameters: Parameters, hovering: Hovering) -> None:
    bend = (4.9, 0.0)
    facts = hovering(bend)
    held = at(Phase.PERCHED, bend=bend, bend_goal=bend, position=(2.0, 0.0, -2.2), tension=(25.0, 9.0, 0.5, 9.0))
    anchor = grip(Situation(held, facts, 100.0, parameters))
    assert anchor.beyond, "the model finds the grip"
    _, said = run(dataclasses.replace(held, anchor=anchor), ask(facts, Order.JOG, 3.0, 0.01, 0.0, 0.0), parameters, 3.0)
    setpoint = said[-1].setpoint
    assert setpoint is not None
    north, east, down = setpoint.acceleration_w
    assert 0.2 < north < parameters.config.limits.feedforward_m_per_s2
    assert abs(east) < 0.1 * north
    assert down == 0.0


def test_down_a_perched_vehicle_feels_what_its_rotors_lift_beyond_its_weight(
    parameters: Parameters, hovering: Hovering
) -> None:
    bend, mass, share = (4.9, 0.0), parameters.config.vehicle.mass_kg, 0.5
    known = ((1e-4, 0.0, 0.0, 0.0), (0.0, 1e-2, 0.0, 0.0), (0.0, 0.0, 1e-4, 0.0), (0.0, 0.0, 0.0, 1e-8))
    curve = ThrustCurve(share, (GRAVITY, GRAVITY / share, 0.1, 0.0), known)
    weighed = Load(curve=curve, flow=Flow(1.0, share, 0.0), seen_s=5.0)
    held = at(Phase.PERCHED, bend=bend, bend_goal=bend, position=(2.0, 0.0, -2.2), tension=(25.0, 9.0, 0.5, 9.0))
    anchor = grip(Situation(held, hovering(bend), 100.0, parameters))

    def wrench(load: Load, extra: float) -> WrenchReport:
        facts = hovering(bend, thrust=share * (1.0 + extra / (mass * GRAVITY)))
        _, said = run(dataclasses.replace(held, anchor=anchor, load=load), facts, parameters, 3.0)
        assert said[-1].wrench.valid
        return said[-1].wrench

    unweighed, level, pulled = wrench(NO_LOAD, 2.0), wrench(weighed, 0.0), wrench(weighed, 2.0)
    assert pulled.force_b[2] - level.force_b[2] == pytest.approx(2.0, rel=0.03)
    assert unweighed.force_b[2] == pytest.approx(level.force_b[2], abs=0.1)
    # rotors that lift the vehicle alone carry its arm, and that the wrap is around a bar changes nothing
    assert level.force_b[2] == pytest.approx(parameters.model.parameters.mass * GRAVITY, abs=0.02)
    assert 0.05 < pulled.force_sigma[2] < 0.3
    assert unweighed.force_sigma[2] > 1.0


def test_a_vertical_move_pushes_harder_until_the_limit_and_lets_go_when_the_move_ends(
    parameters: Parameters, hovering: Hovering
) -> None:
    facts = hovering()
    held = at(Phase.PERCHED, anchor=ANCHOR, position=ANCHOR.position_w)
    state, said = run(held, ask(facts, Order.JOG, 3.0, 0.0, 0.0, 0.01), parameters, 20.0)
    pushes = [c.setpoint.acceleration_w[2] for c in said if c.setpoint is not None]
    limit = parameters.config.perch.slide_force_n / parameters.config.vehicle.mass_kg
    assert all(after >= before for before, after in pairwise(pushes))
    assert pushes[-1] == pytest.approx(limit)
    state, said = run(state, ask(facts, Order.JOG, 3.0, 0.0, 0.0, 0.0), parameters, 5.0)
    assert state.lean == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("kilograms", [-0.26, 0.26])
def test_a_vertical_move_counts_what_the_autopilot_pushes_by_itself(
    kilograms: float, parameters: Parameters, hovering: Hovering
) -> None:
    """ArduPilot's own loop added 1.1 N to our 1.5 on SITL, and the ring around the bar tipped over onto its edge."""
    down = 0.01 if kilograms < 0.0 else -0.01
    share = 0.5 * (1.0 + kilograms / 1.8 / 1.25)  # of thrust, with which the rotors lift less, or more
    small = ((1e-3, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0, 0.0), (0.0, 0.0, 1e-3, 0.0), (0.0, 0.0, 0.0, 1e-8))
    curve = dataclasses.replace(ThrustCurve.prior(0.5), covariance=small)
    load = Load(curve, Flow(1.0, share, 0.0), 5.0, kilograms)
    mass, most = parameters.config.vehicle.mass_kg, parameters.config.perch.slide_force_n
    held = at(
        Phase.PERCHED,
        anchor=ANCHOR,
        position=ANCHOR.position_w,
        offset=(0.0, 0.0, down),
        lean=(0.0, 0.0, math.copysign(most / mass, down)),
        load=load,
    )
    state, _ = run(held, hovering(thrust=share), parameters, 1.0)
    assert abs(state.lean[2]) * mass < 0.5 * most, "it gives way"
    unknown, _ = run(dataclasses.replace(held, load=NO_LOAD), hovering(), parameters, 1.0)
    assert abs(unknown.lean[2]) * mass == pytest.approx(most), "of a thrust that nobody tells nothing is known"


def test_moves_start_where_the_anchored_vehicle_came_to_rest(parameters: Parameters, hovering: Hovering) -> None:
    facts = hovering(position_w=(2.0, 0.0, -2.195))
    held = at(Phase.PERCHED, anchor=ANCHOR, position=ANCHOR.position_w)
    state, _ = run(held, facts, parameters, 30.0)
    assert state.rest == pytest.approx((2.0, 0.0, -2.195), abs=2e-4)
    state, _ = run(state, ask(facts, Order.JOG, 3.0, 0.0, 0.0, 0.01), parameters, 3.0)
    assert state.reference is not None
    assert state.reference.position == pytest.approx((2.0, 0.0, -2.185), abs=2e-4)


def test_without_a_model_of_the_grip_nothing_is_fed_forward_and_nothing_is_called_valid(
    parameters: Parameters, hovering: Hovering
) -> None:
    _, said = run(at(Phase.PERCHED, anchor=ANCHOR), ask(hovering(), Order.JOG, 3.0, 0.01, 0.0, 0.0), parameters, 2.0)
    assert all(c.setpoint is not None and c.setpoint.acceleration_w == (0.0, 0.0, 0.0) for c in said)
    assert not any(c.wrench.valid for c in said)


def test_a_second_order_cancels_the_first_and_both_are_answered(parameters: Parameters, hovering: Hovering) -> None:
    state, _ = run(at(Phase.STOWED), ask(hovering(), Order.READY), parameters)
    facts = dataclasses.replace(hovering(), requests=(Request(8, Order.STOW),))
    state, said = run(state, facts, parameters, 3.0)
    assert state.phase is Phase.STOWED
    assert [(a.request, a.result) for a in answers(said)] == [
        (7, Result.CANCELLED),
        (8, Result.IN_PROGRESS),
        (8, Result.ACCEPTED),
    ]


def test_memory_facts_and_commands_survive_their_text_form_bit_for_bit(
    parameters: Parameters, hovering: Hovering
) -> None:
    facts = ask(hovering((0.3, -0.2), position_age_s=math.inf), Order.JOG, 1.0, 0.1, 0.2)
    state, (commands,) = run(
        at(Phase.PERCHED, anchor=ANCHOR, errors=ArmFault.SLIP | ArmFault.TIMEOUT), facts, parameters
    )
    assert dumps(loads(State, dumps(state))) == dumps(state)
    assert loads(Facts, dumps(facts)) == facts
    assert loads(State, dumps(state)).errors == state.errors == ArmFault.SLIP | ArmFault.TIMEOUT | ArmFault.VEHICLE_LOST
    assert dumps(loads(Commands, dumps(commands))) == dumps(commands)


def test_a_disarmed_vehicle_ends_the_approach_and_never_opens_a_grip(
    parameters: Parameters, hovering: Hovering
) -> None:
    for phase, after in ((Phase.APPROACH, Phase.STOWING), (Phase.WRAP, Phase.HOLDING), (Phase.PERCHED, Phase.HOLDING)):
        state, _ = run(at(phase, anchor=ANCHOR), hovering(armed=False), parameters)
        assert state.phase is after
        assert state.errors & ArmFault.DISARMED


def test_a_wrench_over_its_limit_unloads_the_grip(parameters: Parameters, hovering: Hovering) -> None:
    wrench = WrenchReport((13.0, 0, 0), (0, 0, 0), (1, 1, 1), (1, 1, 1), WrenchSource.ANCHORED, True, 1.0, 0.0)
    prediction = Prediction(100.0, wrench, (0, 0, 0.25), (0, 0), (0, 0, 0))
    state, said = run(at(Phase.PERCHED, anchor=ANCHOR, prediction=prediction), hovering(), parameters)
    assert state.phase is Phase.UNLOAD
    assert any("13.0 N" in notice.text for c in said for notice in c.notices)


# CLEAR_ERRORS.


def lost_turns(facts: Facts) -> Facts:
    return dataclasses.replace(
        facts, tendons=tuple(dataclasses.replace(t, homed=False, ready=False, torque=False) for t in facts.tendons)
    )


def test_clear_errors_has_the_servos_brought_back_once_and_tells_how_it_ended(
    parameters: Parameters, hovering: Hovering
) -> None:
    broken, well = lost_turns(hovering()), hovering()
    state = at(Phase.STOWED, errors=ArmFault.TIMEOUT)
    state, said = run(state, ask(broken, Order.CLEAR_ERRORS), parameters, 1.0)
    assert [commands.recover for commands in said] == [True] + [False] * 99
    assert [a.result for a in answers(said)] == [Result.IN_PROGRESS]
    assert state.errors == ArmFault.NONE
    after, said = run(state, well, parameters)
    assert [a.result for a in answers(said)] == [Result.ACCEPTED]
    assert after.running is None
    state, said = run(state, broken, parameters, 7.0)
    (answer,) = answers(said)
    assert (answer.result, state.running, state.phase) == (Result.FAILED, None, Phase.STOWED)
    assert "lost its turns" in answer.reason


@pytest.mark.parametrize("phase", [p for p in Phase if p not in {Phase.STARTUP, Phase.STOWED}])
def test_no_servo_is_rebooted_or_homed_where_something_hangs_on_it(
    parameters: Parameters, hovering: Hovering, phase: Phase
) -> None:
    _, said = run(at(phase, anchor=ANCHOR), ask(hovering(), Order.CLEAR_ERRORS), parameters)
    assert [a.result for a in answers(said)] == [Result.TEMPORARILY_REJECTED]
    assert not any(commands.recover for commands in said)


def test_a_servo_that_lost_its_turns_is_a_fault_even_without_torque(parameters: Parameters, hovering: Hovering) -> None:
    _, said = run(at(Phase.STOWED), ask(lost_turns(hovering()), Order.READY), parameters)
    (answer,) = answers(said)
    assert answer.result is Result.TEMPORARILY_REJECTED
    assert "lost its turns" in answer.reason
    assert said[-1].status.error_bits & ArmFault.SERVO_FAULT


def test_a_prediction_starts_from_the_last_and_says_what_a_first_one_would(
    hovering: Hovering, parameters: Parameters
) -> None:
    first, _ = run(at(Phase.READY), hovering((0.5, 0.0)), parameters)
    facts = hovering((0.505, 0.0))
    warm, _ = run(first, facts, parameters, 0.1)
    alone, _ = run(at(Phase.READY), facts, parameters)
    assert warm.prediction is not None
    assert alone.prediction is not None
    assert warm.prediction.free is not None
    assert alone.prediction.free is not None
    assert warm.prediction.free.iterations < alone.prediction.free.iterations
    assert warm.prediction.tip_a == pytest.approx(alone.prediction.tip_a, abs=1e-7)
    assert warm.prediction.wrench.force_b == pytest.approx(alone.prediction.wrench.force_b, abs=1e-6)


# FEEDFORWARD.


def leaning(parameters: Parameters, hovering: Hovering) -> tuple[State, Facts]:
    """A perched mission that is asked for 10 mm, three seconds ago."""
    bend = (4.9, 0.0)
    facts = hovering(bend)
    held = at(Phase.PERCHED, bend=bend, bend_goal=bend, position=(2.0, 0.0, -2.2), tension=(25.0, 9.0, 0.5, 9.0))
    anchor = grip(Situation(held, facts, 100.0, parameters))
    state, _ = run(
        dataclasses.replace(held, anchor=anchor), ask(facts, Order.JOG, 3.0, 0.01, 0.0, 0.0), parameters, 3.0
    )
    return state, facts


def test_the_feedforward_goes_off_and_on_by_command_without_a_step(parameters: Parameters, hovering: Hovering) -> None:
    state, facts = leaning(parameters, hovering)
    assert state.lean != (0.0, 0.0, 0.0)
    full = math.hypot(*state.lean)
    for wanted, end in ((0.0, 0.0), (1.0, full)):
        before = state.lean
        state, said = run(state, ask(facts, Order.FEEDFORWARD, wanted), parameters, 4.0)
        assert [a.result for a in answers(said)] == [Result.ACCEPTED]
        leans = [before, *(c.setpoint.acceleration_w for c in said if c.setpoint is not None)]
        assert all(math.dist(a, b) <= 1.0 * DT + 1e-9 for a, b in pairwise(leans))
        assert math.hypot(*state.lean) == pytest.approx(end, abs=0.05)
        assert bool(said[-1].status.flags & ArmFlag.FEEDFORWARD) == bool(wanted)
        assert state.phase is Phase.PERCHED


@pytest.mark.parametrize("phase", list(Phase))
def test_feedforward_may_be_switched_anywhere_and_ends_no_other_order(
    parameters: Parameters, hovering: Hovering, phase: Phase
) -> None:
    running = Running(3, Order.PERCH, frozenset())
    state, (commands,) = run(
        at(phase, anchor=ANCHOR, running=running), ask(hovering(), Order.FEEDFORWARD, 0.0), parameters
    )
    assert not state.feedforward
    assert (7, Result.ACCEPTED) in [(a.request, a.result) for a in commands.answers]
    assert (3, Result.CANCELLED) not in [(a.request, a.result) for a in commands.answers]
