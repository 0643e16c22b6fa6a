"""Weighing a load with the rotors: a vehicle whose curve, drag, supply and noise the estimator does not know."""

import dataclasses
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import VehicleState
from arm_companion.mission.payload import NO_LOAD, Flow, Load, ThrustCurve, watch_load, weigh

DT = 0.01
MASS = 1.8
HOVER = Flow(1.0, 0.45, 0.0)


@dataclasses.dataclass
class Rotors:
    """A vehicle that goes up and down as its thrust asks: one axis, no controller but a proportional one.

    `curve` is c of the thrust (1 - c) x + c x^2, `sag` the share of thrust lost a second.
    """

    hover: float = 0.45
    curve: float = 0.3
    drag: float = 0.25
    sag: float = 1e-4
    noise: float = 0.01  # m/s, of the velocity estimate, one sigma, over 0.3 s
    mass: float = MASS
    tilt: float = 0.0
    lag: float = 0.025  # s
    seed: int = 1

    def __post_init__(self) -> None:
        self.t = self.v = self.error = 0.0
        self.thrust = 1.0  # share of hover's
        self.integral = 0.0
        self.rng = random.Random(self.seed)

    def step(self, wanted: float, load: float) -> VehicleState:
        """Fly `wanted` (m/s, down) for one cycle with `load` kg more."""
        self.t += DT
        keep = math.exp(-DT / 0.3)
        self.error = keep * self.error + self.noise * math.sqrt(1.0 - keep * keep) * self.rng.gauss(0.0, 1.0)
        off = wanted - (self.v + self.error)
        self.integral += 2.0 * off * DT
        x = max((1.0 - (4.0 * off + self.integral) / GRAVITY) / math.cos(self.tilt), 0.1)
        self.thrust += (1.0 - math.exp(-DT / self.lag)) * (x - self.thrust)
        c = self.curve
        push = MASS * GRAVITY * ((1.0 - c) * self.thrust + c * self.thrust**2) * (1.0 - self.sag * self.t)
        total = self.mass + load
        self.v += (GRAVITY - (push * math.cos(self.tilt) + self.drag * self.v) / total) * DT
        half = self.tilt / 2.0
        return VehicleState(
            velocity_w=(0.0, 0.0, self.v + self.error),
            attitude_wb=(math.cos(half), 0.0, math.sin(half), 0.0),
            armed=True,
            landed=False,
            thrust=self.hover * x,
        )


def climb_and_hover(rotors: Rotors, load: Load = NO_LOAD, seconds: float = 15.0) -> Load:
    """A take-off and a hover, the arm free."""
    for i in range(round(seconds / DT)):
        wanted = -1.0 if 150 < i < 300 else 0.4 if 600 < i < 700 else 0.0
        load = watch_load(load, rotors.step(wanted, 0.0), MASS, DT, lifted=0.0, lag_s=rotors.lag)
    return load


def carry(rotors: Rotors, load: Load, kilograms: float, seconds: float = 5.0) -> Load:
    """The load comes on, the vehicle settles, then it is weighed."""
    for i in range(round((3.0 + seconds) / DT)):
        load = watch_load(
            load, rotors.step(-0.1 if i < 300 else 0.0, kilograms), MASS, DT, lifted=None, lag_s=rotors.lag
        )
        if i >= 300:
            load = weigh(load, DT)
    return load


def test_before_a_hover_was_seen_nothing_is_weighed() -> None:
    assert not NO_LOAD.calibrated
    assert not NO_LOAD.known
    assert NO_LOAD.sigma(MASS) == math.inf
    still = VehicleState(armed=False, thrust=0.0)
    load = watch_load(NO_LOAD, still, MASS, DT, lifted=0.0)
    assert load.curve is None
    assert math.isnan(load.now)
    assert weigh(load, DT) == load


def test_a_load_is_weighed_within_a_few_per_cent_on_a_curve_that_nobody_told() -> None:
    rotors = Rotors()
    load = carry(rotors, climb_and_hover(rotors), 0.2)
    assert load.known
    assert load.mass == pytest.approx(0.2, rel=0.06)
    assert 0.005 < load.sigma(MASS) < 0.03


def test_rotors_that_spin_up_on_the_ground_say_nothing_though_the_autopilot_says_that_it_flies() -> None:
    """PX4: not landed from a fifth of the thrust on, and two seconds later it lifts off (seen on SITL)."""
    standing = VehicleState(armed=True, landed=True, thrust=0.1)
    load = watch_load(NO_LOAD, standing, MASS, DT, lifted=0.0)
    for i in range(200):
        load = watch_load(load, VehicleState(armed=True, landed=False, thrust=0.2 + 0.0018 * i), MASS, DT, lifted=0.0)
    assert load.curve is None
    rotors = Rotors()
    load = climb_and_hover(rotors, load)
    assert load.calibrated
    load = carry(rotors, load, 0.2)
    assert load.mass == pytest.approx(0.2, rel=0.07)


def test_a_daemon_that_starts_in_flight_does_not_wait_for_a_take_off() -> None:
    load = NO_LOAD
    rotors = Rotors()
    for _ in range(300):
        load = watch_load(load, rotors.step(0.0, 0.0), MASS, DT, lifted=0.0)
    assert load.curve is not None


def test_an_autopilot_that_smooths_the_thrust_that_it_tells_weighs_as_well() -> None:
    """ArduPilot, 80 ms (seen on SITL: 220 g of 200 g where only the rotors' own lag was counted)."""
    found = climb_and_hover(Rotors(lag=0.1, noise=0.003, sag=0.0)).curve
    assert found is not None
    assert found.gain == pytest.approx(1.3, rel=0.03)


def test_a_long_hover_makes_no_curve_flatter() -> None:
    """The autopilot answers the noise of its own estimate, and nothing comes of those answers."""
    rotors = Rotors(noise=0.01, sag=0.0)
    found = climb_and_hover(rotors, seconds=120.0).curve
    assert found is not None
    assert found.gain == pytest.approx(1.3, rel=0.06)


def test_nothing_weighs_nothing() -> None:
    rotors = Rotors()
    load = carry(rotors, climb_and_hover(rotors), 0.0)
    assert load.mass == pytest.approx(0.0, abs=3.0 * load.sigma(MASS))


def test_a_tilt_is_not_taken_for_a_load() -> None:
    rotors = Rotors(noise=0.0)
    level = climb_and_hover(rotors)
    rotors.tilt = 0.3
    assert carry(rotors, level, 0.0).mass == pytest.approx(0.0, abs=0.01)


def test_a_load_that_goes_is_seen_within_a_fifth_of_a_second() -> None:
    rotors = Rotors()
    load = carry(rotors, climb_and_hover(rotors), 0.2)
    seen = []
    for _ in range(20):
        load = watch_load(load, rotors.step(0.0, 0.0), MASS, DT, lifted=None)
        seen.append(load.now)
    assert seen[0] > 0.7 * load.mass
    assert min(seen) < 0.5 * load.mass


def test_an_emptying_battery_is_not_taken_for_a_load_however_long_it_is_carried() -> None:
    rotors = Rotors(sag=3e-4)
    load = carry(rotors, climb_and_hover(rotors), 0.2, 9.0)
    weight = load.mass
    assert load.settled
    for _ in range(6000):
        load = weigh(watch_load(load, rotors.step(0.0, 0.2), MASS, DT, lifted=load.mass), DT)
    assert load.mass == weight
    assert load.now == pytest.approx(0.2, abs=0.03)
    for _ in range(20):
        load = watch_load(load, rotors.step(0.0, 0.0), MASS, DT, lifted=None)
    assert load.now < 0.5 * load.mass


@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("sag", [0.0, 2e-4, 4e-4])
def test_the_battery_goes_on_emptying_while_something_is_held_and_nothing_can_be_learnt(sag: float, seed: int) -> None:
    rotors = Rotors(sag=sag, seed=seed)
    load = climb_and_hover(rotors, seconds=35.0)
    for _ in range(4000):
        load = watch_load(load, rotors.step(0.0, 0.0), MASS, DT, lifted=None)
    seen = []
    for _ in range(500):
        load = watch_load(load, rotors.step(0.0, 0.0), MASS, DT, lifted=None)
        seen.append(load.now)
    emptied = MASS * sag * 40.0  # which before stood for as much load
    assert np.mean(seen) == pytest.approx(0.0, abs=max(0.01, 0.4 * emptied))
    assert abs(np.mean(seen)) < 2.0 * load.sigma_now(MASS)


@pytest.mark.parametrize("seed", range(1, 4))
@pytest.mark.parametrize("sag", [0.0, 1e-4, 3e-4])
def test_rotors_that_idle_empty_the_battery_slowly_however_long_they_do(sag: float, seed: int) -> None:
    """A vehicle that hangs for half an hour: momentum theory has power go with thrust to the power of 1.5."""
    load = climb_and_hover(Rotors(sag=sag, seed=seed), seconds=60.0)
    assert load.curve is not None
    before, share = load.curve, 0.25
    idle = VehicleState(armed=True, landed=False, thrust=0.45 * share)
    for _ in range(18_000):
        load = watch_load(load, idle, MASS, 0.1, lifted=None)
    after, emptied = load.curve, GRAVITY * sag * 1800.0 * share**1.5
    assert after is not None
    assert before.theta[0] - after.theta[0] == pytest.approx(emptied, abs=2.0 * math.sqrt(after.covariance[0][0]))
    assert math.sqrt(after.covariance[0][0]) < 1.0, "it is still better known than before the flight"
    assert after.gain_sigma > abs(after.gain - before.gain - emptied / GRAVITY)


@pytest.mark.parametrize("thrust", [math.nan, 0.0])
def test_without_a_thrust_there_is_no_load_of_this_moment_and_the_weight_stays(thrust: float) -> None:
    rotors = Rotors()
    load = carry(rotors, climb_and_hover(rotors), 0.2)
    told = dataclasses.replace(rotors.step(0.0, 0.2), thrust=thrust)
    after = watch_load(load, told, MASS, DT, lifted=None)
    assert math.isnan(after.now)
    assert after.mass == load.mass
    assert after.curve is not None
    assert load.curve is not None
    assert after.curve.theta == load.curve.theta


def test_what_is_known_of_the_curve_fades_while_nothing_can_be_learnt() -> None:
    load = climb_and_hover(Rotors())
    assert load.curve is not None
    later = load.curve.forget(60.0)
    assert later.sigma(HOVER) > load.curve.sigma(HOVER)
    assert later.theta == load.curve.theta


def test_a_battery_may_be_swapped_while_the_vehicle_is_disarmed() -> None:
    load = climb_and_hover(Rotors(), seconds=120.0)
    assert load.curve is not None
    waiting = watch_load(load, VehicleState(armed=True, landed=True, thrust=0.1), MASS, DT, lifted=0.0)
    assert waiting.curve is not None
    assert waiting.curve.calibrated, "rotors that idle have the battery that they had"
    for _ in range(2):
        load = watch_load(load, VehicleState(armed=False, landed=True, thrust=0.0), MASS, DT, lifted=0.0)
    stood, prior = load.curve, ThrustCurve.prior(0.45)
    assert stood is not None
    assert not stood.calibrated
    assert stood.covariance[0][0] == prior.covariance[0][0], "as much as the prior's, however long it stands"
    assert stood.covariance[3][3] == prior.covariance[3][3]
    assert stood.covariance[1][1] < 0.5 * prior.covariance[1][1], "the rotors are the same"
    assert np.linalg.eigvalsh(np.array(stood.covariance)).min() > 0.0
    fuller = Rotors(hover=0.45 * 0.94, seed=2)  # a full battery: 6 % more thrust at the same share, 0.6 m/s^2
    load, off = climb_and_hover(fuller, load, 4.0), []
    for i in range(400):
        load = watch_load(load, fuller.step(0.0, 0.0), MASS, DT, lifted=0.0)
        if i % 50 == 0 and load.calibrated:
            off.append(abs(load.now) / load.sigma_now(MASS))
    assert off
    assert max(off) < 3.0


def test_a_time_that_stands_still_changes_nothing() -> None:
    load = climb_and_hover(Rotors())
    assert watch_load(load, Rotors().step(0.0, 0.0), MASS, 0.0, lifted=0.0) == load


def test_the_gain_is_what_an_acceleration_really_comes_to() -> None:
    for curve in (0.0, 0.3, 0.5):
        rotors = Rotors(curve=curve, noise=0.0, sag=0.0)
        found = climb_and_hover(rotors).curve
        assert found is not None
        assert found.gain == pytest.approx(1.0 + curve, rel=0.04)  # d/dx of (1 - c) x + c x^2 at 1


def test_the_prior_is_a_hover_at_its_own_share() -> None:
    curve = ThrustCurve.prior(0.4)
    assert curve.lift(Flow(1.0, 0.4, 0.0)) == pytest.approx(GRAVITY)
    assert np.linalg.eigvalsh(np.array(curve.covariance)).min() > 0.0
    assert not curve.calibrated


@settings(max_examples=20, deadline=None)
@given(
    kilograms=st.floats(0.05, 0.5),
    hover=st.floats(0.3, 0.6),
    curve=st.floats(0.0, 0.6),
    drag=st.floats(0.1, 0.4),
    sag=st.floats(0.0, 4e-4),
    off=st.floats(-0.05, 0.05),
    seed=st.integers(0, 10_000),
)
def test_the_true_mass_is_within_three_sigma(
    kilograms: float, hover: float, curve: float, drag: float, sag: float, off: float, seed: int
) -> None:
    rotors = Rotors(hover, curve, drag, sag, mass=MASS * (1.0 + off), seed=seed)
    load = carry(rotors, climb_and_hover(rotors), kilograms)
    assert abs(load.mass - kilograms) <= 3.0 * load.sigma(MASS)
