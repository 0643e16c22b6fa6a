"""A solution written down: what comes back starts the next solve from the very same bits, and tells the same."""

import json

import numpy as np
import pytest

from arm_companion.arm.arc_model import ArcModel
from arm_companion.arm.model import ArmSolution, Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.arm.rod_start import RodStart, start_of
from arm_companion.config.schema import Config
from arm_companion.geometry.se3 import Pose
from arm_companion.record_codec import build, plain

ARM = ArmParameters.of(Config().arm)
GRAVITY = (0.4, -0.3, 9.7)
WOUND = np.array((0.02, 0.004, -0.019, 0.0))
PAYLOAD = Payload(0.2, np.array((0.01, 0.0, 0.03)))


@pytest.fixture(params=["numpy", "numba"])
def model(request: pytest.FixtureRequest) -> RodModel:
    if request.param == "numba":
        pytest.importorskip("numba")
    return RodModel(ARM, fast=request.param == "numba")


def hold(model: RodModel, kind: str, step: float) -> Hold:
    """The free arm's end, held a few millimetres from where it would be."""
    free = model.free(WOUND, GRAVITY)
    place = Pose(free.tip_rotation, free.tip_position + np.array((0.002 + step, -0.001, -0.003)))
    if kind == "pinned":
        return Hold(ARM.L, place, HoldKind.PINNED, pivot=np.array((0.02, 0.0, 0.0)))
    if kind == "bar":
        return Hold(ARM.L, place, HoldKind.BAR, axis=np.array((0.0, 1.0, 0.0)))
    return Hold(ARM.L, place)


def solved(model: RodModel, kind: str) -> ArmSolution:
    """A solution found from another, as in flight."""
    start = None
    for step in (0.0, 1e-4, 2e-4):
        if kind in {"free", "loaded"}:
            payload = PAYLOAD if kind == "loaded" else None
            start = model.free(WOUND + step, GRAVITY, payload=payload, start=start)
        else:
            start = model.held(WOUND, hold(model, kind, step), GRAVITY, start=start)
    assert start is not None
    return start


@pytest.mark.parametrize("kind", ["free", "loaded", "pinned", "bar", "clamped"])
def test_what_comes_back_is_the_same_bit_for_bit(model: RodModel, kind: str) -> None:
    solution = solved(model, kind)
    text = json.dumps(plain(start_of(solution)))
    elsewhere = RodModel(ARM, fast=model.fast)
    again = elsewhere.resumed(build(RodStart, json.loads(text)))
    for name in ("pull", "bend", "tip_position", "tip_rotation", "tension", "base_wrench", "tip_wrench", "gravity"):
        assert np.array_equal(getattr(again, name), getattr(solution, name)), name
    assert np.array_equal(again.taut_margin, solution.taut_margin, equal_nan=True)
    assert np.array_equal(again.base_stiffness, solution.base_stiffness)
    assert np.array_equal(again.derivatives.pull, solution.derivatives.pull)
    assert json.dumps(plain(start_of(again))) == text
    if kind in {"free", "loaded"}:
        pull, payload = solution.pull + 3e-4, PAYLOAD if kind == "loaded" else None
        here = model.free(pull, GRAVITY, payload=payload, start=solution)
        there = elsewhere.free(pull, GRAVITY, payload=payload, start=again)
        assert here.coordinates.tolist() != model.free(pull, GRAVITY, payload=payload).coordinates.tolist(), "it shows"
    else:
        here = model.held(solution.pull, hold(model, kind, 4e-4), GRAVITY, start=solution)
        there = elsewhere.held(solution.pull, hold(model, kind, 4e-4), GRAVITY, start=again)
    assert here.coordinates.tolist() == there.coordinates.tolist()
    assert here.base_wrench.tolist() == there.base_wrench.tolist()


def test_what_no_rod_solved_has_no_start() -> None:
    assert start_of(None) is None
    assert start_of(ArcModel(ARM).free(np.zeros(ARM.n), GRAVITY)) is None
    assert (
        start_of(RodModel(ARM).free(np.zeros(ARM.n), GRAVITY, follower_wrench=(0.0, 0.1, 0.0, 0.0, 0.0, 0.0))) is None
    )
