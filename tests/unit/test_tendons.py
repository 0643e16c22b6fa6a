"""Tendons: conversions that invert, a tension whose sigma is honest, and goals that no request can push too far."""

import dataclasses
import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.config.schema import LimitsConfig, ServosConfig
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.tendons import Tendons
from arm_companion.errors import ConfigError
from arm_companion.protocol.control_table import TICK_RAD

SERVOS = ServosConfig(directions=(1, -1, 1, -1), zero_ticks=(2048, -3000, 0, 90_000))
LIMITS = LimitsConfig()
RADIUS = 0.01
STATE = ServoState(
    id=1,
    position=0,
    speed=0.0,
    load=0.0,
    voltage=12.0,
    temperature=30.0,
    error_bits=0,
    torque=True,
    tripped=False,
    turns_lost=False,
    ready=True,
    silent=False,
    age_s=0.001,
)


def servos(pulls: tuple[float, ...] = (0.0,) * 4, loads: tuple[float, ...] = (0.1,) * 4) -> list[ServoState]:
    """States of servos whose tendons have these displacements (m) and pulling loads."""
    out = []
    for i, (pull, load) in enumerate(zip(pulls, loads, strict=True)):
        d = SERVOS.directions[i]
        position = SERVOS.zero_ticks[i] + round(d * pull / RADIUS / TICK_RAD)
        out.append(dataclasses.replace(STATE, id=i + 1, position=position, load=d * load))
    return out


def tendons(**limits: float) -> Tendons:
    return Tendons(SERVOS, dataclasses.replace(LIMITS, **limits), RADIUS)


indices = st.integers(0, 3)


@given(indices, st.floats(-0.12, 0.12))
def test_ticks_and_pull_invert_each_other(i: int, pull: float) -> None:
    t = tendons()
    assert t.wound(i, t.ticks(i, pull)) == pytest.approx(pull, abs=0.51 * TICK_RAD * RADIUS)


def test_one_turn_takes_in_one_circumference_in_the_servos_direction() -> None:
    t = tendons()
    assert t.wound(0, 2048 + 4096) == pytest.approx(2 * math.pi * RADIUS)
    assert t.wound(1, -3000 + 4096) == pytest.approx(-2 * math.pi * RADIUS)


def test_states_speak_of_tendons_not_of_servos() -> None:
    moving = [dataclasses.replace(s, speed=1000.0) for s in servos((0.01,) * 4, (0.2,) * 4)]
    states = tendons().states(moving)
    for state, direction in zip(states, SERVOS.directions, strict=True):
        assert state.pull == pytest.approx(0.01, abs=1e-5)
        assert state.load == pytest.approx(0.2)
        assert state.speed == pytest.approx(direction * 1000.0 * TICK_RAD * RADIUS)


def test_a_servo_never_heard_says_nothing_of_its_tendon() -> None:
    states = tendons().states([dataclasses.replace(s, age_s=math.inf, silent=True) for s in servos()])
    assert all(s.silent and s.pull == 0.0 and s.tension == 0.0 and s.tension_sigma == math.inf for s in states)


def test_tension_is_torque_over_radius_when_standing() -> None:
    standing = tendons().force(0, 0.3, 0.0, SERVOS.load_voltage_v)
    torque = 0.3 * SERVOS.load_torque_nm
    assert standing.value == pytest.approx(torque / RADIUS)
    friction, noise = SERVOS.friction_torque_nm / math.sqrt(3), SERVOS.load_sigma * SERVOS.load_torque_nm
    bias = math.hypot(friction, SERVOS.load_torque_sigma * torque)
    assert standing.bias == pytest.approx(bias / RADIUS)
    assert standing.sigma == pytest.approx(math.hypot(bias, noise) / RADIUS)


def test_friction_is_taken_off_when_winding_in_and_added_when_letting_out() -> None:
    t = tendons()
    inwards, standing, outwards = (t.force(0, 0.3, speed, 12.0).value for speed in (0.02, 0.0, -0.02))
    friction_n = SERVOS.friction_torque_nm / RADIUS
    assert inwards == pytest.approx(standing - friction_n)
    assert outwards == pytest.approx(standing + friction_n)
    assert t.force(0, 0.1, 0.02, 12.0).sigma < t.force(0, 0.1, 0.0, 12.0).sigma


@given(st.floats(-1.0, 1.0), st.floats(-0.1, 0.1))
def test_a_tendon_never_pushes(load: float, speed: float) -> None:
    force = tendons().force(0, load, speed, 12.0)
    assert force.value >= 0.0
    assert force.sigma >= force.bias > 0.0


# Goals.


def test_the_first_goals_are_where_the_tendons_are() -> None:
    t = tendons()
    t.states(servos((0.01, -0.02, 0.0, 0.005)))
    goals = t.goals((0.1, 0.1, 0.1, 0.1), 100.0)
    assert [t.wound(i, g) for i, g in enumerate(goals)] == pytest.approx([0.01, -0.02, 0.0, 0.005], abs=1e-5)
    assert all(t.limited)


def test_goals_approach_what_is_wanted_at_the_speed_limit_and_reach_it() -> None:
    t = tendons()
    t.states(servos())
    wanted = (0.03, -0.03, 0.001, 0.0)
    now, path = 10.0, []
    for _ in range(200):
        path.append([t.wound(i, g) for i, g in enumerate(t.goals(wanted, now))])
        now += 0.01
    step = LIMITS.pull_speed_m_per_s * 0.01
    for a, b in itertools.pairwise(path):
        assert all(abs(y - x) <= step + 2e-5 for x, y in zip(a, b, strict=True))
    assert path[-1] == pytest.approx(list(wanted), abs=1e-5)
    assert path[30][0] == pytest.approx(30 * step, abs=2e-5)
    assert not any(t.limited)


def test_a_pause_is_no_licence_to_jump() -> None:
    t = tendons()
    t.states(servos())
    t.goals((0.0,) * 4, 0.0)
    goals = t.goals((0.1,) * 4, 60.0)
    assert t.wound(0, goals[0]) <= LIMITS.pull_speed_m_per_s * 0.1 + 1e-5


def test_after_a_rest_goals_start_from_where_the_tendons_have_gone() -> None:
    t = tendons()
    t.states(servos())
    t.goals((0.0,) * 4, 0.0)
    t.rest()
    t.states(servos((0.02,) * 4))
    goals = t.goals((0.0,) * 4, 5.0)
    assert t.wound(0, goals[0]) == pytest.approx(0.02, abs=1e-5)


def test_an_over_tight_tendon_is_let_out_whatever_is_wanted() -> None:
    t = tendons(tension_max_n=20.0)
    t.states(servos())
    t.goals((0.0,) * 4, 0.0)
    tight = 1.2 * 20.0 * RADIUS / SERVOS.load_torque_nm
    t.states(servos(loads=(tight, 0.1, 0.1, 0.1)))
    goals = t.goals((0.05, 0.05, 0.0, 0.0), 0.01)
    assert t.wound(0, goals[0]) < -1e-5
    assert t.wound(1, goals[1]) > 1e-4


def test_a_tendon_that_stays_tight_is_let_out_no_farther_than_any_goal_may_go() -> None:
    t = tendons(tension_max_n=20.0)
    jammed = servos(loads=(0.5, 0.1, 0.1, 0.1))
    for cycle in range(1000):
        t.states(jammed)
        goals = t.goals((0.0,) * 4, 0.01 * cycle)
    assert t.wound(0, goals[0]) == pytest.approx(-LIMITS.pull_max_m, abs=1e-5)


@pytest.mark.parametrize("load", [0.5, 0.0])
def test_a_servo_that_fell_silent_is_not_let_out_for_what_it_said_last(load: float) -> None:
    t = tendons(tension_max_n=20.0, tension_min_n=2.0)
    heard = servos(loads=(load, 0.1, 0.1, 0.1))
    t.states(heard)
    t.goals((0.0,) * 4, 0.0)
    heard[0] = dataclasses.replace(heard[0], silent=True, age_s=0.2)
    for cycle in range(1, 200):
        silent, other, *_ = t.states(heard)
        goals = t.goals((0.0,) * 4, 0.01 * cycle)
    assert silent.tension_sigma == math.inf
    assert other.tension_sigma < math.inf
    assert t.wound(0, goals[0]) == pytest.approx(0.0, abs=1e-5)


def test_only_a_tendon_that_is_surely_slack_is_not_let_out() -> None:
    sure = dataclasses.replace(SERVOS, load_sigma=0.0005, friction_torque_nm=0.0, load_torque_sigma=0.0)
    for config, out in ((SERVOS, True), (sure, False)):
        t = Tendons(config, dataclasses.replace(LIMITS, tension_min_n=2.0), RADIUS)
        t.states(servos(loads=(0.0,) * 4))
        t.goals((0.0,) * 4, 0.0)
        goals = t.goals((-0.05,) * 4, 0.01)
        assert (t.wound(0, goals[0]) < -1e-4) is out


wild = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.lists(
        st.tuples(
            st.tuples(wild, wild, wild, wild), st.floats(0.0, 5.0), st.lists(st.floats(-1, 1), min_size=4, max_size=4)
        ),
        min_size=1,
        max_size=12,
    )
)
def test_no_request_breaks_a_limit(story: list[tuple[tuple[float, ...], float, list[float]]]) -> None:
    t = tendons()
    t.states(servos())
    now = 0.0
    before: tuple[float, ...] = (0.0,) * 4
    for wanted, pause, loads in story:
        now += pause
        t.states(servos(before, tuple(loads)))
        pulls = tuple(t.wound(i, g) for i, g in enumerate(t.goals(wanted, now)))
        step = LIMITS.pull_speed_m_per_s * min(pause, 0.1)
        for old, new in zip(before, pulls, strict=True):
            assert abs(new) <= LIMITS.pull_max_m + 1e-5
            assert abs(new - old) <= step + 2e-5
        before = pulls


# Coupling.

ROWS = ((1.0, 0.0, 0.0, 0.0), (0.5, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, -0.3), (0.0, 0.0, 0.2, 1.0))
COUPLED = dataclasses.replace(SERVOS, coupling=ROWS)


@given(st.lists(st.floats(-0.05, 0.05), min_size=4, max_size=4))
def test_goals_of_coupled_tendons_come_back_as_their_displacements(wanted: list[float]) -> None:
    t = Tendons(COUPLED, dataclasses.replace(LIMITS, pull_speed_m_per_s=1.0), RADIUS)
    t.states(servos())
    t.goals((0.0,) * 4, 0.0)
    goals = t.goals(wanted, 0.1)
    states = t.states([dataclasses.replace(STATE, id=i + 1, position=goal) for i, goal in enumerate(goals)])
    assert [state.pull for state in states] == pytest.approx(wanted, abs=3e-5)


def test_coupled_tensions_do_the_work_that_the_servos_do() -> None:
    t = Tendons(COUPLED, LIMITS, RADIUS)
    states = t.states(servos(loads=(0.3, 0.2, 0.2, 0.25)))
    pulleys = [sum(ROWS[j][i] * states[j].tension for j in range(4)) for i in range(4)]
    gain = SERVOS.load_torque_nm / RADIUS
    assert pulleys == pytest.approx([0.3 * gain, 0.2 * gain, 0.2 * gain, 0.25 * gain])
    assert all(state.tension_sigma >= state.tension_bias > 0.0 for state in states)


@pytest.mark.parametrize("rows", [((1.0, 0.0),), ((0.0,) * 4,) * 4, ((1.0, 1.0, 0.0, 0.0),) * 4])
def test_a_coupling_that_cannot_be_inverted_is_refused(rows: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(ConfigError, match="coupling"):
        dataclasses.replace(SERVOS, coupling=rows)
