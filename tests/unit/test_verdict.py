"""Figures of the verdict, from flights made up of a few samples."""

import math
from dataclasses import replace

import pytest

from arm_companion.config import load
from arm_companion.sim.flight import Flight, WrenchSeen
from arm_companion.sim.grasp_verdict import judge_grasp
from arm_companion.sim.ports import PlantTruth, RigidState
from arm_companion.sim.verdict import after, excursion, unharmed, wrench_errors
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


def landed(*, fell: float = 0.0, attitude: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)) -> Flight:
    """A flight that stands on the ground in the end, after it has sunk with `fell` m/s for a moment."""
    made = flight({})
    made.samples[200] = replace(made.samples[200], state=replace(STILL, velocity_w=(0.0, 0.0, fell)))
    made.samples[-1] = replace(made.samples[-1], state=replace(STILL, attitude_wb=attitude))
    return made


def test_a_vehicle_that_fell_to_the_ground_has_not_landed() -> None:
    assert after(landed(fell=1.5), perched=True) == []
    assert after(landed(fell=6.0), perched=True) == ["the vehicle fell with 6.0 m/s"]
    assert after(landed(attitude=(0.0, 1.0, 0.0, 0.0)), perched=True) == ["the vehicle lies on its side"]


def test_an_arm_that_reached_into_a_propeller_is_harm_in_every_scenario() -> None:
    seen = landed()
    assert unharmed(seen) == []
    seen.samples[100] = replace(seen.samples[100], truth=replace(TRUTH, rotor_contact=True))
    assert unharmed(seen, leaning=True) == ["a propeller struck something at 4.0 s"]


def test_an_object_that_fell_was_not_put_back_wherever_it_lies() -> None:
    def carried(drop: float) -> Flight:
        """Lifted by 0.4 m and let down by 0.1 m/s, but for the last `drop` m."""
        made = flight({})
        times = [sample.t for sample in made.samples]
        heights = [min(0.4, 0.1 * t, max(0.9 - 0.1 * t, 0.0)) for t in times]
        heights = [0.0 if t > 5.0 and h < drop else h for t, h in zip(times, heights, strict=True)]
        made.samples = [
            replace(s, truth=replace(TRUTH, object_position_w=(3.0, 0.0, -1.5 - h)))
            for s, h in zip(made.samples, heights, strict=True)
        ]
        return made

    config = load("sim_grasp.toml")
    assert "fell" not in judge_grasp(carried(0.0), "", config).reason
    assert "the object fell with" in judge_grasp(carried(0.1), "", config).reason


def test_an_arm_at_the_bar_is_seen_though_the_machine_stood_still_at_the_end() -> None:
    seen = landed()
    seen.samples[-1] = replace(seen.samples[-1], truth=replace(TRUTH, contact_force_n=1.0))
    seen.end += 3.0
    assert after(seen, perched=True) == ["the arm did not let go of the bar"]
