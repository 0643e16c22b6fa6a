"""The object of the simulated world: it lies across its cradles, and falls where they are not."""

import math

import pytest

from arm_companion.config import load
from arm_companion.sim.plant import Plant
from arm_companion.sim.ports import RotorCommand

CONFIG = load("sim_grasp.toml")
OFF = RotorCommand(0.0, (0.0, 0.0, 0.0))
STILL = (0.0, 0.0, 0.0, 0.0)


def run(plant: Plant, seconds: float) -> None:
    for _ in range(round(seconds / CONFIG.sim.step_s)):
        plant.step(OFF, STILL)


def test_the_object_lies_still_on_its_cradles_and_touches_nothing_else() -> None:
    plant = Plant(CONFIG)
    run(plant, 1.0)
    truth = plant.truth()
    assert truth.object_position_w is not None
    assert math.dist(truth.object_position_w, CONFIG.sim.object.position_m) < 0.002
    assert truth.object_supported
    assert truth.contact_force_n == 0.0
    assert truth.wrap_angle == 0.0


def test_the_object_weighs_what_is_configured_and_a_shifted_one_rolls_back() -> None:
    plant = Plant(CONFIG)
    body = plant._object
    assert plant._model.body_mass[body] == pytest.approx(CONFIG.sim.object.mass_kg, rel=1e-6)
    plant._data.qpos[-7:-4] += (0.015, 0.0, 0.03)
    run(plant, 2.0)
    place = plant.truth().object_position_w
    assert place is not None
    assert math.dist(place, CONFIG.sim.object.position_m) < 0.005


def test_without_its_cradles_it_falls() -> None:
    plant = Plant(CONFIG)
    plant._data.qpos[-7:-4] += (0.3, 0.0, 0.0)
    run(plant, 0.3)
    place = plant.truth().object_position_w
    assert place is not None
    assert place[2] - CONFIG.sim.object.position_m[2] == pytest.approx(0.5 * 9.81 * 0.09, rel=0.05)
    assert not plant.truth().object_supported


def test_an_arm_that_lost_the_object_does_not_meet_it_any_more_but_the_ground_does() -> None:
    plant = Plant(CONFIG)
    before = _pairs(plant)
    plant.lose_object()
    assert before == {"arm", "cradles", "ground", "airframe"}
    assert _pairs(plant) == {"cradles", "ground", "airframe"}


def test_a_world_of_no_object_has_none() -> None:
    plant = Plant(load("sim.toml"))
    run(plant, 0.01)
    assert plant.truth().object_position_w is None
    assert not plant.truth().object_supported


def _pairs(plant: Plant) -> set[str]:
    """What the object's geom may touch, by MuJoCo's own rule."""
    model = plant._model
    thing = model.geom("object").id
    found = set()
    for other in range(model.ngeom):
        if other == thing or not (
            model.geom_contype[thing] & model.geom_conaffinity[other]
            or model.geom_contype[other] & model.geom_conaffinity[thing]
        ):
            continue
        body = model.geom_bodyid[other]
        name = model.body(body).name
        if plant._link_of_geom[other] >= 0:
            found.add("arm")
        elif name in {"cradles", "airframe"}:
            found.add(name)
        elif model.geom_type[other] == 0:
            found.add("ground")
    return found
