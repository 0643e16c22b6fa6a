"""The path that makes ArduPilot hold against a force, against the law that it is solved from."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.drivers.path_feedforward import PathFeedforward
from arm_companion.mission.facts import Setpoint, Vec3

PLACE, STILL = (1.0, 2.0, -3.0), (0.0, 0.0, 0.0)
DT = 0.01
P, INTEGRAL, D, K = 2.0, 1.0, 0.25, 1.0  # ArduPilot's defaults, level
P_DOWN, K_DOWN, P_A, I_A = 5.0, 1.0, 0.98, 1.96


def asked(lean: Vec3) -> Setpoint:
    return Setpoint(PLACE, (0.1, 0.0, 0.0), lean, 0.4)


def test_without_a_force_the_set_point_stays_what_it_is() -> None:
    path = PathFeedforward()
    for i in range(100):
        assert path.shaped(asked(STILL), i * DT) == asked(STILL)


def test_the_acceleration_of_a_path_that_is_flown_stays_what_it_is() -> None:
    """It is what ArduPilot takes it for: only the force beside it is turned into a path."""
    together, alone = PathFeedforward(), PathFeedforward()
    flown, lean = (0.2, 0.0, -0.1), (0.3, -0.2, 0.1)
    both = (lean[0] + flown[0], lean[1] + flown[1], lean[2] + flown[2])
    for i in range(200):
        out = together.shaped(Setpoint(PLACE, STILL, both, 0.4, flown), i * DT)
        force = alone.shaped(Setpoint(PLACE, STILL, lean, 0.4), i * DT)
        assert out.position_w == pytest.approx(force.position_w, abs=1e-12)
        assert [a - b for a, b in zip(out.acceleration_w, flown, strict=True)] == pytest.approx(force.acceleration_w)
    still = PathFeedforward()
    assert still.shaped(Setpoint(PLACE, STILL, flown, 0.4, flown), 0.0).acceleration_w == flown


@given(
    st.lists(st.tuples(*(st.floats(-2.0, 2.0),) * 2), min_size=3, max_size=3),
    st.floats(0.1, 3.0),
)
def test_the_controller_makes_of_the_path_what_was_asked(waves: list[tuple[float, float]], rate: float) -> None:
    """ArduPilot's law, integrated beside it: what comes out is the acceleration that went in."""
    path = PathFeedforward()
    level, down = 0.0, 0.0  # integrals
    for i in range(400):
        t = i * DT
        x, y, z = (a * math.sin(rate * t) + b * (1.0 - math.exp(-t)) for a, b in waves)
        lean = (x, y, z)
        out = path.shaped(asked(lean), t)
        e = [out.position_w[k] - PLACE[k] for k in range(3)]
        v = [out.velocity_w[0] - 0.1, out.velocity_w[1], out.velocity_w[2]]
        a = out.acceleration_w
        level += (v[0] + K * e[0]) * DT
        made = a[0] + P * (v[0] + K * e[0]) + INTEGRAL * level + D * (a[0] + K * v[0])
        steps = [DT * (abs(a) * rate + abs(b)) for a, b in waves]  # most that each changes by from one step to the next
        assert made == pytest.approx(lean[0], abs=0.05 + steps[0])
        wanted = a[2] + P_DOWN * (v[2] + K_DOWN * e[2])
        down += wanted * DT
        assert P_A * wanted + I_A * down == pytest.approx(lean[2], abs=0.12 + steps[2])


def test_position_velocity_and_acceleration_belong_to_each_other() -> None:
    path = PathFeedforward()
    last = path.shaped(asked((1.0, -0.5, 0.3)), 0.0)
    for i in range(1, 300):
        now = path.shaped(asked((1.0, -0.5, 0.3)), i * DT)
        for k in range(3):
            assert now.position_w[k] - last.position_w[k] == pytest.approx(
                DT * (now.velocity_w[k] - (0.1 if k == 0 else 0.0)), abs=1e-9
            )
            assert now.velocity_w[k] - last.velocity_w[k] == pytest.approx(DT * now.acceleration_w[k], abs=1e-9)
        last = now


def test_a_lasting_force_is_handed_over_to_the_integrator() -> None:
    path = PathFeedforward()
    for i in range(2000):
        out = path.shaped(asked((1.5, 0.0, 1.5)), i * DT)
    assert out.position_w == pytest.approx(PLACE, abs=1e-3)
    assert out.acceleration_w == pytest.approx(STILL, abs=1e-3)


def test_a_stream_that_begins_anew_begins_from_nothing() -> None:
    path, fresh = PathFeedforward(), PathFeedforward()
    for i in range(100):
        path.shaped(asked((1.0, 1.0, 1.0)), i * DT)
    path.reset()
    for i in range(50):
        assert path.shaped(asked((0.5, 0.0, 0.0)), 1.0 + i * DT) == fresh.shaped(asked((0.5, 0.0, 0.0)), 1.0 + i * DT)


@given(st.floats(0.11, 10.0), st.tuples(*(st.floats(-5.0, 5.0),) * 3))
def test_a_force_that_was_handed_over_is_not_handed_over_again_after_a_late_set_point(gap: float, lean: Vec3) -> None:
    """The integrators hold it already: beginning anew would make twice the force of it."""
    path = PathFeedforward()
    for i in range(2500):
        path.shaped(asked(lean), i * DT)
    for i in range(100):
        out = path.shaped(asked(lean), 25.0 + gap + i * DT)
        assert out.position_w == pytest.approx(PLACE, abs=1e-3)
        assert out.acceleration_w == pytest.approx(STILL, abs=1e-3)


@given(st.floats(0.11, 0.6), st.integers(20, 200), st.floats(-2.0, 2.0))
def test_what_the_controller_made_of_a_gap_is_known(gap: float, before: int, force: float) -> None:
    """ArduPilot flies on with the last acceleration; from the next set-point on it makes what is asked for."""
    path, times = PathFeedforward(), [i * DT for i in range(before)]
    times += [times[-1] + gap + i * DT for i in range(300)]
    integral, last = 0.0, times[0]
    e = v = a = 0.0
    for t in times:
        for _ in range(round((t - last) / 1e-3)):
            e, v = e + v * 1e-3 + 0.5e-6 * a, v + a * 1e-3
            integral += (v + K * e) * 1e-3
        out = path.shaped(asked((force, 0.0, 0.0)), t)
        e, v, a, last = out.position_w[0] - PLACE[0], out.velocity_w[0] - 0.1, out.acceleration_w[0], t
        made = a + P * (v + K * e) + INTEGRAL * integral + D * (a + K * v)
        assert made == pytest.approx(force, abs=0.06 * abs(force) + 0.02)


@given(st.tuples(*(st.floats(-5.0, 5.0),) * 3))
def test_the_path_stays_near(lean: Vec3) -> None:
    path = PathFeedforward()
    for i in range(600):
        out = path.shaped(asked(lean), i * DT)
        assert math.dist(out.position_w, PLACE) < 0.5 * math.hypot(*lean) + 1e-6
