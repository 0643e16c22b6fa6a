"""What has to last before it counts, cycle by cycle; and everything known moves with a jump of the estimator."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.mission.facts import Bar, Control, Facts, GraspTarget, WrenchReport, WrenchSource
from arm_companion.mission.motion import Reference, add
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, Prediction, Sharing, State, Vigil
from arm_companion.mission.vigil import HEAT_MARGIN_K, VOLTAGE_MARGIN_V, keep_vigil
from tests.unit.mission_rig import (
    ANCHOR,
    BENT,
    DT,
    PLACE,
    T0,
    Change,
    Run,
    gripping,
    jaws,
    memory,
    moved,
    tendon,
    vehicle,
)

Hovering = Callable[..., Facts]
LEAP = (0.0, 1.0, 0.5)
LASTED = Vigil(position_w=PLACE, astray_s=0.4, hot_s=0.4, low_s=0.4, slack_s=0.4, tight_s=0.4, blind_s=0.4)


def kept(state: State, facts: Facts, parameters: Parameters) -> State:
    """Memory after one cycle of the vigil."""
    return keep_vigil(Situation(state, facts, T0 + DT, parameters))


# --- how long it has lasted ---


@pytest.mark.parametrize(
    ("timer", "change"),
    [
        ("hot_s", tendon(2, temperature=80.0)),
        ("low_s", tendon(2, voltage=1.0)),
        ("slack_s", tendon(2, tension=-9.0)),
        ("tight_s", tendon(1, tension=45.1)),
        ("astray_s", moved((0.0, 0.51, 0.0))),
    ],
)
def test_a_timer_runs_while_its_fact_holds_and_starts_anew_once_it_does_not(
    timer: str, change: Change, parameters: Parameters, hovering: Hovering
) -> None:
    # the vehicle was there in the cycle before, so that it has not jumped
    bad = change(hovering())
    state = memory(Phase.APPROACH, vigil=dataclasses.replace(LASTED, position_w=bad.vehicle.position_w))
    timers = {"astray_s", "hot_s", "low_s", "slack_s", "tight_s", "blind_s"}
    after = kept(state, bad, parameters).vigil
    assert getattr(after, timer) == pytest.approx(0.4 + DT)
    assert all(getattr(after, other) == 0.0 for other in timers - {timer})
    assert getattr(kept(memory(Phase.APPROACH, vigil=LASTED), hovering(), parameters).vigil, timer) == 0.0


def test_the_margins_divide_hot_from_warm_and_low_from_enough(parameters: Parameters, hovering: Hovering) -> None:
    servos = parameters.config.servos
    heat, least = servos.temperature_limit_c - HEAT_MARGIN_K, servos.voltage_min_v + VOLTAGE_MARGIN_V
    state = memory(Phase.READY, vigil=LASTED)
    for off, counts in ((-0.1, False), (0.1, True)):
        assert (kept(state, tendon(1, temperature=heat + off)(hovering()), parameters).vigil.hot_s > 0.0) is counts
        assert (kept(state, tendon(1, voltage=least - off)(hovering()), parameters).vigil.low_s > 0.0) is counts


def test_slack_is_what_two_sigma_and_a_servo_that_pulls_leave_no_doubt_about(
    parameters: Parameters, hovering: Hovering
) -> None:
    least = parameters.config.limits.tension_min_n
    state = memory(Phase.READY, vigil=LASTED)
    for off, counts in ((-0.1, True), (0.1, False)):
        facts = tendon(1, tension=least - 2.0 + off, tension_sigma=1.0)(hovering())
        assert (kept(state, facts, parameters).vigil.slack_s > 0.0) is counts
    limp = tendon(1, tension=-9.0, torque=False)(hovering())
    assert kept(state, limp, parameters).vigil.slack_s == 0.0


@pytest.mark.parametrize("fields", [{"silent": True}, {"tension_sigma": math.inf}])
def test_a_servo_that_says_nothing_is_neither_hot_nor_low_nor_slack(
    fields: dict[str, object], parameters: Parameters, hovering: Hovering
) -> None:
    facts = tendon(1, temperature=99.0, voltage=1.0, tension=-9.0, **fields)(hovering())
    after = kept(memory(Phase.READY, vigil=LASTED), facts, parameters).vigil
    assert (after.hot_s, after.low_s, after.slack_s) == (0.0, 0.0, 0.0)


def test_the_grippers_servo_counts_while_it_answers(parameters: Parameters, hovering: Hovering) -> None:
    state = memory(Phase.READY, vigil=LASTED)
    for silent in (False, True):
        facts = jaws(temperature=99.0, voltage=1.0, silent=silent)(hovering())
        after = kept(state, facts, gripping(parameters)).vigil
        assert (after.hot_s > 0.0, after.low_s > 0.0) == (not silent, not silent)


def test_blind_is_a_prediction_without_a_solution_for_a_vehicle_that_is_known(
    parameters: Parameters, hovering: Hovering
) -> None:
    solved = WrenchReport((1.0, 0, 0), (0, 0, 0), (1, 1, 1), (1, 1, 1), WrenchSource.ANCHORED, True, 1.0, 0.0)
    for residual, fields, counts in (
        (math.nan, {}, True),
        (0.0, {}, False),
        (math.nan, {"position_age_s": 9.0}, False),
    ):
        wrench = dataclasses.replace(solved, residual=residual)
        prediction = Prediction(T0, wrench, (0, 0, 0.25), (0, 0), (0, 0, 0))
        state = memory(Phase.PERCHED, vigil=LASTED, prediction=prediction)
        assert (kept(state, vehicle(**fields)(hovering()), parameters).vigil.blind_s > 0.0) is counts


@pytest.mark.parametrize(
    ("phase", "fields"),
    [
        (Phase.PERCHED, {}),
        (Phase.APPROACH, {"control": Control.PILOT}),
        (Phase.APPROACH, {"position_age_s": 9.0}),
    ],
)
def test_a_vehicle_that_need_not_follow_or_is_not_known_is_not_astray(
    phase: Phase, fields: dict[str, object], parameters: Parameters, hovering: Hovering
) -> None:
    far = vehicle(**fields)(moved((0.0, 2.0, 0.0))(hovering()))
    state = memory(phase, vigil=dataclasses.replace(LASTED, position_w=far.vehicle.position_w))
    assert kept(state, far, parameters).vigil.astray_s == 0.0


# --- jumps ---


def test_everything_in_world_axes_moves_with_a_jump(parameters: Parameters, hovering: Hovering) -> None:
    state = memory(
        Phase.PERCHED,
        vigil=Vigil(position_w=PLACE),
        reference=Reference((1.0, 2.0, -3.0)),
        contact_w=(1.0, 2.0, -4.0),
        position=(1.0, 2.0, -5.0),
        rest=(1.0, 2.0, -6.0),
        sharing=Sharing(place=(1.0, 2.0, -7.0), first=-8.0),
    )
    after = kept(state, moved(LEAP)(hovering()), parameters)
    assert after.reference is not None
    assert after.anchor is not None
    assert after.reference.position == pytest.approx(add((1.0, 2.0, -3.0), LEAP))
    assert after.contact_w == pytest.approx(add((1.0, 2.0, -4.0), LEAP))
    assert after.position == pytest.approx(add((1.0, 2.0, -5.0), LEAP))
    assert after.rest == pytest.approx(add((1.0, 2.0, -6.0), LEAP))
    assert after.sharing.place == pytest.approx(add((1.0, 2.0, -7.0), LEAP))
    assert after.sharing.first == pytest.approx(-8.0 + LEAP[2])
    assert after.anchor.position_w == pytest.approx(add(ANCHOR.position_w, LEAP))
    ((at, leap),) = after.vigil.jumps
    assert at == T0 + DT
    assert leap == pytest.approx(LEAP)
    assert after.vigil.leap_m == pytest.approx(math.hypot(*LEAP))
    assert after.vigil.jumped_at == T0 + DT


def test_a_target_moves_with_the_jumps_since_it_was_told(parameters: Parameters, hovering: Hovering) -> None:
    first = (5.0, 0.0, 0.0)
    state = memory(Phase.READY, vigil=Vigil(position_w=PLACE, jumps=((T0 - 10.0, first),), jumped_at=T0 - 10.0))
    jumped = moved(LEAP)(hovering())
    after = kept(state, jumped, parameters)
    told = GraspTarget((1.0, 0.0, -1.0), None, 0.03)
    for age, leaps in ((60.0, (first, LEAP)), (5.0, (LEAP,)), (0.0, ())):
        facts = dataclasses.replace(
            jumped, bar=Bar((1.0, 0.0, -1.0), (0.0, 1.0, 0.0), 0.03), bar_age_s=age, grasp_target=told
        )
        facts = dataclasses.replace(facts, grasp_target_age_s=age)
        there: tuple[float, float, float] = (1.0, 0.0, -1.0)
        for leap in leaps:
            there = add(there, leap)
        seen = Situation(after, facts, T0 + 2.0 * DT, parameters)
        assert seen.perch_bar.point_w == pytest.approx(there)
        assert seen.object.point_w == pytest.approx(there)


def test_jumps_are_few_in_memory_and_none_is_lost(parameters: Parameters, hovering: Hovering) -> None:
    many = tuple((T0 - 20.0 + i, (1.0, 0.0, 0.0)) for i in range(8))
    state = memory(Phase.READY, vigil=Vigil(position_w=PLACE, jumps=many))
    jumps = kept(state, moved(LEAP)(hovering()), parameters).vigil.jumps
    assert len(jumps) == 8
    assert jumps[0] == (T0 - 19.0, (2.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("fields", "left"),
    [
        ({"armed": False, "position_age_s": 5.0}, 0),
        ({"armed": False, "heartbeat_age_s": 5.0}, 0),
        ({"armed": True, "heartbeat_age_s": 5.0}, 1),
        ({"armed": False}, 1),
    ],
)
def test_an_autopilot_that_was_away_on_the_ground_has_a_new_frame(
    fields: dict[str, object], left: int, parameters: Parameters, hovering: Hovering
) -> None:
    state = memory(Phase.STOWED, vigil=Vigil(jumps=((T0 - 10.0, LEAP),)))
    assert len(kept(state, vehicle(**fields)(hovering()), parameters).vigil.jumps) == left


def test_what_the_vehicle_can_have_flown_is_no_jump(parameters: Parameters, hovering: Hovering) -> None:
    farthest = 0.25 + 2.0 * (DT + parameters.config.vehicle.state_timeout_s)
    slow, fast = (0.0, 0.0, 0.0), (0.0, 2.0, 0.0)
    for before, now in ((slow, fast), (fast, slow)):
        state = memory(Phase.READY, vigil=Vigil(position_w=PLACE, velocity_w=before))
        for off, jumps in ((-0.01, False), (0.01, True)):
            facts = vehicle(velocity_w=now)(moved((0.0, farthest + off, 0.0))(hovering()))
            after = kept(state, facts, parameters)
            assert (after.vigil.leap_m > 0.0) is jumps
            if jumps:
                flown = now[1] * DT
                assert after.contact_w == pytest.approx(add(PLACE, (0.0, farthest + off - flown, 0.0)))


def test_a_place_that_is_not_fresh_neither_jumps_nor_is_compared_with(
    parameters: Parameters, hovering: Hovering
) -> None:
    stale = vehicle(position_age_s=9.0)(moved(LEAP)(hovering()))
    after = kept(memory(Phase.READY, vigil=Vigil(position_w=PLACE)), stale, parameters)
    assert after.vigil.leap_m == 0.0
    assert after.vigil.position_w is None
    assert kept(after, moved(LEAP)(hovering()), parameters).vigil.leap_m == 0.0


@pytest.mark.parametrize(("gap_s", "off", "jumps"), [(0.4, 0.45, True), (0.4, 0.3, False), (1.5, 3.0, False)])
def test_a_jump_behind_a_short_gap_is_one_of_what_could_not_be_flown_meanwhile(
    gap_s: float, off: float, jumps: bool, parameters: Parameters, hovering: Hovering
) -> None:
    """An estimator that is set anew says nothing for a moment; after a long one the vehicle may be anywhere."""
    run = Run(memory(Phase.RELEASE, bend=BENT), parameters)
    run.cycles(hovering(BENT), 0.1)
    for i in range(round(gap_s / DT)):
        run.cycle(vehicle(position_age_s=0.2 + DT * i)(hovering(BENT)))
    elsewhere = moved((off, 0.0, 0.0))(hovering(BENT))
    said = run.cycle(elsewhere)
    assert (run.state.vigil.jumped_at == run.state.t) is jumps
    if jumps:  # a vehicle that is still half wrapped is not dragged along
        assert said.setpoint is not None
        assert said.setpoint.position_w == pytest.approx(elsewhere.vehicle.position_w, abs=0.1)
