"""Figures of the verdict, from flights made up of a few samples."""

import math
from dataclasses import replace

import pytest

from arm_companion.sim.flight import Flight, WrenchSeen
from arm_companion.sim.ports import PlantTruth, RigidState
from arm_companion.sim.verdict import excursion, wrench_errors
from arm_companion.sim.world import Sample

ZERO = (0.0, 0.0, 0.0)
TRUTH = PlantTruth(ZERO, ZERO, 0.0, ZERO, 0.0, (4.0,) * 4, ZERO, body_contact=False)
STILL = RigidState(ZERO, ZERO, (1.0, 0.0, 0.0, 0.0), ZERO, ZERO)


def flight(away: dict[float, float]) -> Flight:
    """Ten seconds at 25 Hz asked to climb by 0.1 m/s; `away`: how far north of that it is, from when on."""
    made = Flight(end=10.0, states=[(0.0, "PERCHED"), (4.0, "RELEASE"), (8.0, "DEPART")])
    for i in range(250):
        t = 0.04 * i
        north = max(((since, x) for since, x in away.items() if since <= t), default=(0.0, 0.0))[1]
        made.asked.append((t, (0.0, 0.0, -0.1 * t)))
        made.samples.append(Sample(t, replace(STILL, position_w=(north, 0.0, -0.1 * t)), TRUTH))
    return made


def test_the_band_covers_what_lies_within_two_sigma_of_the_truth() -> None:
    seen = flight({})
    truth = replace(TRUTH, force_b=(1.0, 0.0, -2.0))
    seen.samples = [replace(sample, truth=truth) for sample in seen.samples]
    sigma = (0.1, 0.2, 0.3)
    for t, told in ((1.0, (1.1, 0.3, -1.5)), (2.0, (1.3, 0.5, -2.0)), (3.0, (9.0, 9.0, 9.0))):
        seen.wrenches.append(WrenchSeen(t, told, ZERO, sigma, t < 3.0, 2))
    (error,) = wrench_errors(seen, {"perched": ("PERCHED",), "free": ("READY",)})
    assert error.predictions == 2, "what is not valid does not count"
    assert error.covered == pytest.approx(4 / 6)


def test_the_excursion_is_counted_from_the_place_asked_while_the_arm_lets_go() -> None:
    assert excursion(flight({5.0: 0.03, 6.0: 0.12, 7.0: 0.0})) == pytest.approx(0.12)
    assert excursion(flight({1.0: 0.5, 3.9: 0.02, 8.1: 0.4})) == pytest.approx(0.02), "neither before nor on the way"


def test_there_is_no_excursion_of_an_arm_that_never_let_go_or_of_a_vehicle_that_was_asked_nothing() -> None:
    never = flight({})
    never.states = [(0.0, "PERCHED")]
    assert math.isnan(excursion(never))
    free = flight({5.0: 0.3})
    free.asked = [(t, place) for t, place in free.asked if t < 3.0]
    assert math.isnan(excursion(free))
    assert free.asked_at(1.0) == pytest.approx((0.0, 0.0, -0.1), abs=1e-9)
    assert free.asked_at(0.0) is not None
    assert free.asked_at(-1.0) is None
    assert free.asked_at(3.5) is None
