"""Facts of a vehicle and arm in a quiet hover, to be changed one thing at a time."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import Config, load
from arm_companion.mission.facts import Control, Facts, TendonState, VehicleState
from arm_companion.mission.parameters import Parameters

HOVER = VehicleState(
    position_w=(2.0, 0.0, -2.2),
    armed=True,
    landed=False,
    control=Control.EXTERNAL,
    mode="OFFBOARD",
    heartbeat_age_s=0.3,
    position_age_s=0.01,
    attitude_age_s=0.01,
    throttle=0.5,
    throttle_age_s=0.05,
    thrust=0.5,
)


@pytest.fixture(scope="session")
def config() -> Config:
    return load("sim.toml")


@pytest.fixture(scope="session")
def parameters(config: Config) -> Parameters:
    return Parameters(config, RodModel(ArmParameters.of(config.arm)))


def tendons(pulls: tuple[float, ...], tensions: tuple[float, ...]) -> tuple[TendonState, ...]:
    return tuple(
        TendonState(pull, 0.0, tension, 0.5, 0.1, 30.0, 12.0, 0, silent=False, age_s=0.002, torque=True)
        for pull, tension in zip(pulls, tensions, strict=True)
    )


@pytest.fixture
def hovering(parameters: Parameters) -> Callable[..., Facts]:
    """A maker of facts: the arm at a bend, free, and a vehicle with some fields changed."""

    def make(bend: tuple[float, float] = (0.0, 0.0), **vehicle: Any) -> Facts:
        pulls = parameters.model.pull_for_bend(np.asarray(bend))
        free = parameters.model.free(pulls, np.array([0.0, 0.0, 9.81]))
        return Facts(
            dataclasses.replace(HOVER, **vehicle),
            tendons(tuple(map(float, pulls)), tuple(map(float, free.tension))),
        )

    return make
