"""Laws of mechanics that the plant must keep, and what an arm can and cannot hold."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from arm_companion.config.schema import Config
from arm_companion.errors import ModelError
from arm_companion.sim import mjcf, plant
from arm_companion.sim.plant import Array, Plant
from arm_companion.sim.ports import PlantTruth, RigidState, RotorCommand, Vec3

IDLE = RotorCommand(0.0, (0.0, 0.0, 0.0))
Pulls = tuple[float, ...]
Wrapped = tuple[Plant, float, Pulls]
STRAIGHT: Pulls = (0.0,) * 4
WEIGHT = 1.8 * 9.81
HOVER = RotorCommand(WEIGHT, (0.0, 0.0, 0.0))
ARM_WEIGHT = 0.3604  # N: 9 disks of 3 g, an end disk of 6 g, 3.24 g of backbone, 0.5 g of tendons
BENDING_STIFFNESS = 0.0193019  # E I of the 1.6 mm backbone, N m^2


def change(**sections: dict[str, Any]) -> Config:
    """The default configuration with keys of some sections replaced."""
    config = Config()
    for name, values in sections.items():
        config = dataclasses.replace(config, **{name: dataclasses.replace(getattr(config, name), **values)})
    return config


def pulls_for_bend(theta: float, delta: float = 0.0) -> Pulls:
    """Tendon goals of a bend, stretch included: r theta cos + theta EI / (2 r L k) cos."""
    r, length, stiffness = 0.02, 0.25, 3231.35
    c = np.cos(np.radians((0.0, -90.0, -180.0, -270.0)) - delta)
    return tuple(float(p) for p in (r * theta + theta * BENDING_STIFFNESS / (2 * r * length * stiffness)) * c)


def run(world: Plant, seconds: float, rotors: RotorCommand = IDLE, pulls: Pulls = STRAIGHT) -> None:
    for _ in range(round(seconds / 0.001)):
        world.step(rotors, pulls)


def scaled(pulls: Pulls, share: float) -> Pulls:
    return tuple(share * pull for pull in pulls)


def beside(world: Plant, offset: Vec3) -> Vec3:
    x, y, z = world.state().position_w
    return (x + offset[0], y + offset[1], z + offset[2])


def held(config: Config) -> Plant:
    """A plant without gravity whose airframe is held as in a vice, damped so that the arm soon rests."""
    world = Plant(config)
    world._model.dof_armature[:6] = 1e7
    world._model.dof_damping[6:] *= 10.0
    world._model.opt.gravity[2] = 0.0
    return world


# --- at rest ---


def test_it_stands_at_the_origin_and_weighs_what_it_should() -> None:
    world = Plant(Config())
    run(world, 1.5)
    state, truth = world.state(), world.truth()
    assert np.allclose(state.position_w, 0.0, atol=5e-4)
    assert np.allclose(state.specific_force_b, (0.0, 0.0, -9.81), atol=1e-6)
    assert np.allclose(truth.force_b, (0.0, 0.0, ARM_WEIGHT), atol=1e-4)
    assert np.allclose(truth.torque_b, 0.0, atol=1e-6)
    assert truth.body_contact
    assert truth.contact_force_n == 0.0
    assert np.allclose(truth.tip_position_w, (0.0, 0.0, 0.12 + 0.25), atol=5e-4)
    assert mjcf.moving_mass(Config().arm) * 9.81 == pytest.approx(ARM_WEIGHT, abs=1e-4)
    assert world.time == pytest.approx(1.5)


def test_a_mount_turned_by_ninety_degrees_points_the_arm_forward() -> None:
    forward = Plant(change(mount={"position_m": (0.1, 0.0, 0.0), "rpy_deg": (0.0, 90.0, 0.0)}))
    assert np.allclose(forward.truth().tip_position_w, (0.35, 0.0, 0.0), atol=1e-9)
    above = Plant(change(mount={"position_m": (0.0, 0.0, -0.1), "rpy_deg": (180.0, 0.0, 0.0)}))
    assert np.allclose(above.truth().tip_position_w, (0.0, 0.0, -0.35), atol=1e-9)
    assert np.allclose(above.truth().force_b, (0.0, 0.0, ARM_WEIGHT), atol=1e-4)


# --- axes and signs ---


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_push_moves_the_vehicle_its_way_in_ned(axis: int) -> None:
    world = Plant(Config())
    force = [0.0, 0.0, -1.0]  # off the ground first
    force[axis] += 1.0 if axis < 2 else -1.0
    world.push(force)
    run(world, 0.3, HOVER)
    velocity = world.state().velocity_w
    assert velocity[axis] * force[axis] > 0.0
    assert abs(velocity[axis]) == pytest.approx(abs(force[axis]) * 0.3 / 1.8, rel=0.1)


def test_thrust_lifts_and_torques_turn_about_body_axes() -> None:
    world = Plant(Config())
    run(world, 0.2, RotorCommand(1.2 * WEIGHT, (0.0, 0.0, 0.0)))
    assert world.state().position_w[2] < 0.0
    for axis in range(3):
        world = Plant(Config())
        torque = [0.0, 0.0, 0.0]
        torque[axis] = 0.02
        run(world, 0.2, RotorCommand(1.1 * WEIGHT, (torque[0], torque[1], torque[2])))
        state = world.state()
        assert state.rate_b[axis] > 0.01
        assert state.attitude_wb[1 + axis] > 0.001
        assert np.linalg.norm(state.attitude_wb) == pytest.approx(1.0)


def test_wind_carries_the_vehicle_along() -> None:
    world = Plant(change(sim={"wind_m_per_s": (2.0, -1.0, 0.0)}))
    run(world, 0.5, RotorCommand(1.05 * WEIGHT, (0.0, 0.0, 0.0)))
    north, east, _ = world.state().velocity_w
    assert north > 0.05
    assert east == pytest.approx(-north / 2, rel=0.1)


# --- Newton and Euler ---


def test_the_wrench_is_what_the_airframe_feels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Force and torque of the arm are what rotors, weight and contact leave unexplained of the airframe's motion."""
    monkeypatch.setattr(plant, "_DRAG_N_PER_M_S", 0.0)
    monkeypatch.setattr(plant, "_ROTARY_DRAG_NM_PER_RAD_S", 0.0)
    world = Plant(Config())
    mass = 1.8 - mjcf.moving_mass(Config().arm)
    inertia = mass * np.square((0.105, 0.105, 0.14))
    run(world, 0.3, RotorCommand(1.5 * WEIGHT, (0.0, 0.0, 0.0)))
    world.move_bar(beside(world, (0.06, 0.0, 0.25)))  # the arm will hit it
    hit = 0.0
    for i in range(400):
        rotors = RotorCommand(WEIGHT * (1 + 0.2 * math.sin(i / 20)), (0.3 * math.sin(i / 15), 0.05, -0.1))
        before = world.state()
        world.step(rotors, (min(i * 2e-4, 0.03), 0.0, -min(i * 2e-4, 0.03), 0.01))
        after, truth = world.state(), world.truth()
        # specific force is the step's mean in the new axes, the wrench is in the old: turn by the step's rotation
        turn = np.eye(3) + 0.001 * cross_matrix(after.rate_b)
        force = mass * turn @ after.specific_force_b - np.array((0.0, 0.0, -rotors.thrust_n))
        assert np.allclose(force, truth.force_b, atol=2e-3 + 1e-3 * np.linalg.norm(truth.force_b))
        rate = np.array(before.rate_b)
        torque = inertia * (np.subtract(after.rate_b, rate) / 0.001) + np.cross(rate, inertia * rate)
        assert np.allclose(torque - rotors.torque_b, truth.torque_b, atol=1e-9)
        hit = max(hit, truth.contact_force_n)
    assert hit > 1.0
    assert not world.truth().body_contact


def test_the_mean_wrench_has_every_step_in_it_once() -> None:
    """A blow of milliseconds between two samples is felt by the airframe, and one in a sample is no lasting force."""
    world = Plant(Config())
    run(world, 0.3, RotorCommand(1.5 * WEIGHT, (0.0, 0.0, 0.0)))
    world.move_bar(beside(world, (0.06, 0.0, 0.25)))
    world.mean_wrench()
    forces, torques = [], []
    for i in range(200):
        world.step(RotorCommand(WEIGHT, (0.0, 0.0, 0.0)), (min(i * 2e-4, 0.03), 0.0, -min(i * 2e-4, 0.03), 0.01))
        forces.append(world.truth().force_b)
        torques.append(world.truth().torque_b)
    assert np.ptp(forces, axis=0).max() > 1.0, "there was a blow"
    force, torque = world.mean_wrench()
    assert force == pytest.approx(np.mean(forces, axis=0), abs=1e-9)
    assert torque == pytest.approx(np.mean(torques, axis=0), abs=1e-9)
    assert world.mean_wrench()[0] == forces[-1], "with no step since, the last one's"


def cross_matrix(v: Vec3) -> Array:
    return np.array(((0.0, -v[2], v[1]), (v[2], 0.0, -v[0]), (-v[1], v[0], 0.0)))


def test_a_moving_arm_does_not_move_the_common_centre_of_mass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant, "_DRAG_N_PER_M_S", 0.0)
    world = Plant(Config())
    run(world, 0.3, RotorCommand(1.5 * WEIGHT, (0.0, 0.0, 0.0)))
    data = world._data
    start, t = data.subtree_com[world._airframe].copy(), world.time
    speed = data.qvel[2]
    for i in range(300):  # free fall while the arm whips to and fro
        pull = 0.03 * math.sin(i / 20)
        world.step(IDLE, (pull, 0.5 * pull, -pull, -0.5 * pull))
    fallen = world.time - t
    expected = np.add(start, (0.0, 0.0, speed * fallen - 0.5 * 9.81 * fallen**2))
    assert np.allclose(data.subtree_com[world._airframe], expected, atol=0.01)
    assert abs(world.truth().tip_position_w[0] - world.state().position_w[0]) > 0.01


# --- tendons ---


@pytest.mark.parametrize("servo", [1e9, 5000.0])
def test_tension_follows_the_law_of_an_elastic_pull_only_tendon(servo: float) -> None:
    config = Config()
    config = change(arm={"tendons": dataclasses.replace(config.arm.tendons, servo_stiffness_n_per_m=servo)})
    k = 1 / (0.35 / (4e9 * math.pi * 0.0006**2 / 4) + 1 / servo)
    world = Plant(config)
    assert world.tensions() == pytest.approx((4.0,) * 4)
    for pull in (0.002, -0.0005, -0.01):  # the straight arm stays straight: the path's length does not change
        run(world, 0.3, IDLE, (pull,) * 4)
        assert world.tensions() == pytest.approx((max(0.0, 4.0 + k * pull),) * 4, abs=1e-3)
    assert world.truth().tension == world.tensions()


def test_bending_takes_tension_from_the_outer_tendon_to_the_inner() -> None:
    world = held(Config())
    theta = math.radians(30.0)
    run(world, 2.0, IDLE, pulls_for_bend(theta))
    inner, side, outer, other = world.tensions()
    # between real disks the tendons press the backbone towards its chord: EI - l^2 sum(tau) / 12
    bending = BENDING_STIFFNESS - 0.025**2 * sum((inner, side, outer, other)) / 12
    assert inner - outer == pytest.approx(theta * bending / (0.02 * 0.25), rel=0.005)
    assert side == pytest.approx(other)
    # an arc between two disks is shorter than its backbone: L (theta / n)^2 / 24 off every tendon
    assert side == pytest.approx(4.0 - 3231.35 * 0.25 * (theta / 10) ** 2 / 24, abs=0.01)
    tip = np.subtract(world.truth().tip_position_w, (0.0, 0.0, 0.12))
    assert np.allclose(tip, (0.25 / theta * (1 - math.cos(theta)), 0.0, 0.25 / theta * math.sin(theta)), atol=3e-4)


def test_directions_are_equal() -> None:
    """The same bend in another direction is the same bend, turned: hinges leave no preferred plane."""
    tips, tensions = [], []
    for delta in (0.0, math.pi / 4, math.pi / 2, math.pi):
        world = held(Config())
        run(world, 2.0, IDLE, pulls_for_bend(1.5, delta))
        x, y, z = np.subtract(world.truth().tip_position_w, (0.0, 0.0, 0.12))
        c, s = math.cos(delta), math.sin(delta)
        tips.append((c * x + s * y, c * y - s * x, z))
        tensions.append(world.tensions())
    assert np.allclose(tips, tips[0], atol=5e-4)
    assert np.allclose(tensions[2], np.roll(tensions[0], -1), atol=1e-6)
    assert np.allclose(tensions[3], np.roll(tensions[0], 2), atol=1e-6)


# Tip deflection in mm under a following load of 0.981 N across the tip, from an independent chain with ten guides.
REFERENCE_MM = [(4.0, 0.0, 70.956), (4.0, 45.0, 71.313), (1.0, 60.0, 69.170)]


@pytest.mark.parametrize(("pretension", "theta_deg", "deflection_mm"), REFERENCE_MM)
def test_stiffness_agrees_with_an_independent_chain(pretension: float, theta_deg: float, deflection_mm: float) -> None:
    config = Config()
    config = change(arm={"tendons": dataclasses.replace(config.arm.tendons, pretension_n=pretension)})
    world = held(config)
    pulls = pulls_for_bend(math.radians(theta_deg))
    run(world, 3.0, IDLE, pulls)
    free = world.truth().tip_position_w
    data, tip, link = world._data, world._tip, world._model.body(mjcf.link(10)).id
    for _ in range(4000):
        force = data.site_xmat[tip].reshape(3, 3)[:, 0] * 0.981
        data.xfrc_applied[link, :3] = force
        data.xfrc_applied[link, 3:] = np.cross(data.site_xpos[tip] - data.xipos[link], force)
        world.step(IDLE, pulls)
    moved = np.linalg.norm(np.subtract(world.truth().tip_position_w, free)) * 1e3
    assert moved == pytest.approx(deflection_mm, rel=0.012)


# --- contact ---


@pytest.fixture(scope="module")
def wrapped() -> Wrapped:
    """A standing vehicle whose arm curls about a bar that lies level with its base, and the pulls that hold it."""
    config = Config()
    world = Plant(config)
    run(world, 0.2)
    reach = config.sim.bar.radius_m + config.perch.disk_radius_m
    world.move_bar((reach, 0.0, 0.12))
    bend = 0.0
    while bend < config.perch.wrap_bend_rad:
        bend += 0.001
        world.step(IDLE, pulls_for_bend(bend))
    run(world, 1.0, IDLE, pulls_for_bend(bend))
    return world, reach, pulls_for_bend(bend)


def test_a_wrapped_arm_holds_the_bar(wrapped: Wrapped) -> None:
    world, reach, pulls = wrapped
    rest = world.truth()
    assert rest.wrap_angle > math.pi
    assert rest.contact_force_n > 1.0
    assert max(rest.tension) > 20.0
    # what the bar does to the arm reaches the airframe
    assert np.allclose(np.subtract(rest.force_b, rest.contact_net_w), (0.0, 0.0, ARM_WEIGHT), atol=0.02)
    for i in range(1000):  # the bar is drawn away by 10 mm
        world.move_bar((reach + 1e-5 * i, 0.0, 0.12))
        world.step(IDLE, pulls)
    run(world, 0.5, IDLE, pulls)
    drawn = world.truth()
    assert 1.0 < drawn.force_b[0] - rest.force_b[0] < 15.0
    assert drawn.wrap_angle > 2.0


def test_a_bar_out_of_reach_is_not_touched(wrapped: Wrapped) -> None:
    config = Config()
    world = Plant(config)
    world.move_bar((0.4, 0.0, 0.12))
    for i in range(2000):
        world.step(IDLE, scaled(wrapped[2], i / 2000))
    truth = world.truth()
    assert truth.contact_force_n == 0.0
    assert truth.contact_net_w == pytest.approx((0.0, 0.0, 0.0))
    assert truth.wrap_angle == 0.0
    assert max(truth.tension) < 20.0


def test_the_airframe_on_the_bar_is_body_contact() -> None:
    world = Plant(Config())
    run(world, 0.5, RotorCommand(1.3 * WEIGHT, (0.0, 0.0, 0.0)))
    assert not world.truth().body_contact
    world.move_bar(beside(world, (0.18, 0.0, -0.08)))  # into the front rotors
    run(world, 0.01, HOVER)
    assert world.truth().body_contact
    assert not world.truth().mount_only


def test_the_mount_on_the_bar_is_told_from_the_rest_of_the_airframe() -> None:
    world = Plant(Config())
    run(world, 0.5, RotorCommand(1.3 * WEIGHT, (0.0, 0.0, 0.0)))
    assert not world.truth().mount_only
    world.move_bar(beside(world, (0.05, 0.0, 0.08)))
    run(world, 0.004, HOVER)
    assert world.truth().body_contact
    assert world.truth().mount_only


# --- the simulation itself ---


def test_it_repeats_bit_for_bit_whoever_looks(wrapped: Wrapped) -> None:
    def play(*, curious: bool) -> tuple[RigidState, PlantTruth]:
        world = Plant(Config())
        world.move_bar((0.058, 0.0, 0.12))
        for i in range(600):
            world.step(RotorCommand(5.0, (0.0, 0.01, 0.0)), scaled(wrapped[2], i / 600))
            if curious and i % 7 == 0:
                world.truth()
                world.state()
        return world.state(), world.truth()

    assert play(curious=True) == play(curious=False)


def test_commands_that_are_no_numbers_are_refused_and_change_nothing() -> None:
    world = Plant(Config())
    for rotors, pulls in (
        (RotorCommand(math.nan, (0.0, 0.0, 0.0)), STRAIGHT),
        (RotorCommand(0.0, (0.0, math.inf, 0.0)), STRAIGHT),
        (IDLE, (0.0, math.nan, 0.0, 0.0)),
    ):
        with pytest.raises(ModelError):
            world.step(rotors, pulls)
    with pytest.raises(ValueError, match="2 pulls for 4 tendons"):
        world.step(IDLE, (0.0, 0.0))
    assert world.time == 0.0
    run(world, 0.01)
    assert world.time == pytest.approx(0.01)


def test_a_bump_between_two_looks_is_remembered_and_told_once() -> None:
    world = Plant(Config())
    run(world, 0.5, RotorCommand(1.3 * WEIGHT, (0.0, 0.0, 0.0)))
    world.touched()
    where = beside(world, (0.18, 0.0, -0.08))
    world.move_bar(where)
    run(world, 0.004, HOVER)
    world.move_bar((50.0, 0.0, -2.0))
    run(world, 0.036, HOVER)
    assert not world.truth().body_contact, "the bar is gone again"
    touched = world.touched()
    assert touched.body
    assert touched.rotor
    assert not touched.mount_only
    assert not world.touched().body
