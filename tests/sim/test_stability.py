"""What is fed forward stays stable with an arm that is stiffer or softer than believed, and over a slow line."""

import dataclasses
import math
import statistics

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.sim.runner import fly_simulated
from arm_companion.sim.verdict import judge

DELAY_S = 0.1


@pytest.mark.scenario
@pytest.mark.parametrize("stiffness", [0.8, 1.2])
def test_a_pull_neither_swings_nor_runs_away(stiffness: float) -> None:
    """The whole flight, with pulls along x and down; what is judged is the vehicle's motion once a move is made."""
    config = load("sim.toml")
    backbone = config.arm.backbone
    softer = dataclasses.replace(backbone, youngs_modulus_pa=stiffness * backbone.youngs_modulus_pa)
    world = dataclasses.replace(config, arm=dataclasses.replace(config.arm, backbone=softer))
    result = run_simulated(fly_simulated(config, lambda _: None, world=world, latency_s=DELAY_S))
    verdict = judge(result.flight, result.failure)
    assert verdict.success, verdict.reason
    marks = {mark.name: mark for mark in result.flight.marks}
    assert {"hold", "pull x", "pull z", "pull x, not compensated"} <= marks.keys()
    for name, mark in marks.items():
        samples = result.flight.within(mark.start, mark.end)
        for axis in range(3):
            spread = statistics.pstdev(s.state.position_w[axis] for s in samples)
            assert spread < 0.004, (name, axis, spread)
            half = len(samples) // 2
            early, late = (
                statistics.pstdev(s.state.position_w[axis] for s in part) for part in (samples[:half], samples[half:])
            )
            assert late < max(1.5 * early, 0.002), (name, axis, early, late)
    pulls = {move.name: move for move in verdict.moves}
    assert pulls["pull x"].error_m < 0.5 * pulls["pull x, not compensated"].error_m
    assert math.isfinite(verdict.hover_error_m)
