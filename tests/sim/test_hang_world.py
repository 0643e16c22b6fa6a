"""What the simulated world must know of hanging: idle rotors, autopilots that believe in a landing, and the judge."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.config import load
from arm_companion.sim.autopilot_flavours import FLAVOURS
from arm_companion.sim.autopilot_modes import FlightModes
from arm_companion.sim.flight import Flight
from arm_companion.sim.flight_control import ZERO, Airframe, Estimate, FlightController, MotionSetpoint
from arm_companion.sim.hang_verdict import judge_hang
from arm_companion.sim.mjcf import GRAVITY
from arm_companion.sim.plant import Plant
from arm_companion.sim.ports import PlantTruth, RigidState, RotorCommand
from arm_companion.sim.world import Sample

DT = 0.01
AIRFRAME = Airframe(1.4)
WEIGHT_N = 1.4 * GRAVITY


def down(acceleration: float) -> MotionSetpoint:
    return MotionSetpoint((0.0, 0.0, -2.0), ZERO, (0.0, 0.0, acceleration), 0.0)


@pytest.mark.parametrize(("acceleration", "share"), [(0.0, 1.0), (0.5 * GRAVITY, 0.5), (GRAVITY, AIRFRAME.thrust_min)])
def test_rotors_turn_a_tilted_vehicle_with_no_more_than_their_thrust(acceleration: float, share: float) -> None:
    controller = FlightController(AIRFRAME)
    tilted = Estimate((0.0, 0.0, -2.0), attitude_wb=(math.cos(0.4), math.sin(0.4), 0.0, 0.0))
    for _ in range(100):
        rotors = controller.update(tilted, down(acceleration), DT)
    assert rotors.thrust_n == pytest.approx(share * WEIGHT_N, rel=0.01)
    assert abs(rotors.torque_b[0]) <= min(rotors.thrust_n * AIRFRAME.arm, AIRFRAME.torque_max[0]) + 1e-9
    assert abs(rotors.torque_b[0]) > 0.5 * min(rotors.thrust_n * AIRFRAME.arm, AIRFRAME.torque_max[0])


def airborne(name: str) -> FlightModes:
    """Modes of an autopilot that hovers under external set-points."""
    modes = FlightModes(FLAVOURS[name], dict(FLAVOURS[name].parameters), lambda *_: None)
    modes.ready = True
    at = Estimate((0.0, 0.0, -2.5))
    modes.request_mode(FLAVOURS[name].names["GUIDED" if name == "ardupilot" else "LOITER"], 0.0)
    modes.arm(0.0)
    modes.takeoff(2.5)
    for _ in range(400):
        modes.thrust_share = 1.0
        modes.demand(at, DT)
    for i in range(200):
        modes.set_external(down(0.0), 4.0 + i * DT)
    modes.request_mode(FLAVOURS[name].names["GUIDED" if name == "ardupilot" else "OFFBOARD"], 6.0)
    assert not modes.landed
    return modes


def hang(modes: FlightModes, share: float, seconds: float) -> float:
    """Let it hang at rest; gives for how long it flew."""
    for i in range(round(seconds / DT)):
        now = 6.0 + i * DT
        modes.set_external(down((1.0 - share) * GRAVITY), now)
        modes.tick(now)
        modes.thrust_share = share
        modes.demand(Estimate((0.0, 0.0, -2.5)), DT)
        if modes.landed:
            return i * DT
    return math.inf


def test_ardupilot_takes_motors_at_their_lower_limit_for_a_landing_ignores_set_points_and_disarms() -> None:
    modes = airborne("ardupilot")
    assert hang(modes, 0.05, 5.0) == pytest.approx(1.0, abs=0.1)
    assert modes.armed
    hang(modes, 0.05, 0.05)
    for _ in range(1100):
        modes.demand(Estimate((0.0, 0.0, -2.5)), DT)
    assert not modes.armed


@pytest.mark.parametrize(("name", "share"), [("ardupilot", 0.25), ("px4", 0.25), ("px4", 0.05)])
def test_a_quarter_of_the_hovers_thrust_is_no_landing_and_px4_wants_a_commanded_descent(
    name: str, share: float
) -> None:
    assert hang(airborne(name), share, 30.0) == math.inf


def test_the_default_idle_share_is_above_what_ardupilot_takes_for_a_landing() -> None:
    assert hang(airborne("ardupilot"), load("sim_hang.toml").hang.idle_share, 5.0) == math.inf


def test_the_plant_tells_when_something_reaches_into_a_propeller() -> None:
    config = load("sim_hang.toml")
    plant = Plant(config)
    still = RotorCommand(WEIGHT_N, ZERO)
    plant.step(still, (0.0,) * 4)
    assert not plant.truth().rotor_contact
    plant.move_bar((0.25, 0.0, -0.05))
    plant.step(still, (0.0,) * 4)
    assert plant.truth().rotor_contact


def sample(t: float, carried: float, z: float = -2.7, **truth: object) -> Sample:
    """Truth at one instant in which the bar carries a share of the weight."""
    state = RigidState((3.0, 0.0, z), ZERO, (1.0, 0.0, 0.0, 0.0), ZERO, ZERO)
    plain = PlantTruth(
        ZERO,
        ZERO,
        20.0 if carried else 0.0,
        (0.0, 0.0, -carried * WEIGHT_N),
        4.0,
        (30.0,) * 4,
        ZERO,
        body_contact=False,
    )
    return Sample(t, state, dataclasses.replace(plain, **truth))  # type: ignore[arg-type]


def flight(hung_s: float = 15.0, change: Callable[[list[Sample]], None] = lambda _: None) -> Flight:
    samples = [sample(0.04 * i, 0.75 if 10.0 <= 0.04 * i < 10.0 + hung_s else 0.0) for i in range(1000)]
    samples += [sample(40.0 + 0.04 * i, 0.0, z=0.0) for i in range(50)]
    change(samples)
    return Flight(samples=samples, states=[(0.0, "READY"), (10.0, "HANGING"), (25.0, "STOWED")], end=42.0)


def test_the_judge_sees_who_carried_the_weight() -> None:
    verdict = judge_hang(flight(), "", WEIGHT_N)
    assert (verdict.success, verdict.verdict) == (True, "hung")
    short = judge_hang(flight(hung_s=6.0), "", WEIGHT_N)
    assert not short.success
    assert "for 6.0 s only" in short.reason
    light = judge_hang(flight(), "", 2.0 * WEIGHT_N)
    assert "only" in light.reason, "a bar that carries a third of the weight does not carry it"


def test_a_moment_without_load_does_not_end_the_hanging_and_a_second_does() -> None:
    def gap(seconds: float) -> Callable[[list[Sample]], None]:
        def cut(samples: list[Sample]) -> None:
            for i in range(400, 400 + round(seconds / 0.04)):
                samples[i] = sample(samples[i].t, 0.0)

        return cut

    assert judge_hang(flight(change=gap(0.12)), "", WEIGHT_N).success
    assert not judge_hang(flight(change=gap(1.0)), "", WEIGHT_N).success


@pytest.mark.parametrize(
    ("i", "truth", "z", "words"),
    [
        (300, {"rotor_contact": True}, -2.7, "propeller"),
        (300, {"body_contact": True}, -2.7, "airframe touched"),
        (400, {}, -2.4, "sank by 0.30 m"),
        (-1, {}, -1.0, "did not land"),
        (-1, {"contact_force_n": 1.0}, 0.0, "did not let go"),
    ],
)
def test_the_judge_forgives_no_harm(i: int, truth: dict[str, object], z: float, words: str) -> None:
    def harm(samples: list[Sample]) -> None:
        samples[i] = sample(samples[i].t, 0.75 if i > 0 else 0.0, z, **truth)

    verdict = judge_hang(flight(change=harm), "", WEIGHT_N)
    assert not verdict.success
    assert words in verdict.reason
