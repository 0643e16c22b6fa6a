"""The jaws of the plant: they meet on nothing, stop at what is between them, and turn the horn of their servo back."""

import dataclasses

import pytest

from arm_companion.config import load
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError
from arm_companion.sim.jaws import Jaws, OutputDrive, ServoDrive
from arm_companion.sim.plant import Plant
from arm_companion.sim.ports import RotorCommand

CONFIG = load("sim_gripper.toml")
OFF = RotorCommand(0.0, (0.0, 0.0, 0.0))
STILL = (0.0,) * 4
TIP = 0.12 + 0.25 + CONFIG.gripper.depth_m  # m below the centre of mass of the standing vehicle


def standing(*, held: bool) -> tuple[Plant, Jaws]:
    """A vehicle on the ground, with the object between its open jaws or far away."""
    place = (0.0, 0.0, TIP) if held else (5.0, 0.0, TIP)
    thing = dataclasses.replace(CONFIG.sim.object, position_m=place)
    plant = Plant(dataclasses.replace(CONFIG, sim=dataclasses.replace(CONFIG.sim, object=thing)))
    assert plant.jaws is not None
    return plant, plant.jaws


def close(plant: Plant, jaws: Jaws, share: float) -> None:
    for i in range(500):
        jaws.drive(share * min(i / 300.0, 1.0))
        plant.step(OFF, STILL)


def test_jaws_meet_where_nothing_is_and_nothing_strains() -> None:
    plant, jaws = standing(held=False)
    close(plant, jaws, 1.0)
    assert jaws.force == pytest.approx(0.0, abs=0.5)
    assert plant.truth().contact_force_n == 0.0


def test_jaws_stop_at_an_object_and_hold_it_with_what_their_springs_have() -> None:
    plant, jaws = standing(held=True)
    assert plant.truth().contact_force_n == 0.0, "there is room between open jaws"
    radius, half = CONFIG.sim.object.radius_m, 0.5 * CONFIG.sim.gripper.opening_m
    close(plant, jaws, 0.7)
    beyond = 0.7 * half - (half - radius)
    assert jaws.force == pytest.approx(2.0 * 3000.0 * beyond, rel=0.15)
    assert plant.truth().contact_force_n == pytest.approx(jaws.force, rel=0.1)


@pytest.mark.parametrize(("open_ticks", "closed_ticks"), [(1024, 3072), (3072, 1024)])
def test_the_force_of_the_jaws_turns_the_horn_back_towards_open(open_ticks: int, closed_ticks: int) -> None:
    drive = ServoDrive(dataclasses.replace(CONFIG.gripper, open_ticks=open_ticks, closed_ticks=closed_ticks), 0.1)
    assert drive.closed(open_ticks) == 0.0
    assert drive.closed(closed_ticks) == 1.0
    against = drive.torque(30.0)  # of the emulator: positive towards shrinking positions
    assert (against > 0.0) is (closed_ticks > open_ticks)
    work = 30.0 * 0.05 / 3.141592653589793  # over half a turn of the horn, each jaw 5 cm
    assert abs(against) == pytest.approx(work)


def test_an_output_of_the_autopilot_takes_its_time_and_stalls_at_its_force() -> None:
    output = OutputDrive()
    assert output.advance(closing=True, force=0.0, dt=0.75) == pytest.approx(0.5)
    assert output.advance(closing=True, force=40.0, dt=0.75) == pytest.approx(0.5)
    assert output.advance(closing=False, force=40.0, dt=0.75) == 0.0


def test_jaws_are_a_part_of_the_end_disk() -> None:
    light = dataclasses.replace(
        CONFIG, arm=dataclasses.replace(CONFIG.arm, mass=dataclasses.replace(CONFIG.arm.mass, end_disk_kg=0.02))
    )
    with pytest.raises(ConfigError, match="does not hold both jaws"):
        Plant(light)
    heavy, _ = standing(held=False)
    assert heavy._model.body_subtreemass[heavy._airframe] == pytest.approx(CONFIG.vehicle.mass_kg, rel=1e-6)


def test_an_arm_without_a_gripper_has_no_jaws() -> None:
    assert Plant(load("sim.toml")).jaws is None
    assert Config().grasp.kind == "wrap"
