"""The keep-out cone: distances against a search over its surface, and what the mission does at it."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.arm import arc
from arm_companion.arm.keep_out import KeepOut
from arm_companion.arm.reaction import mount
from arm_companion.config.flight_options import KeepOutConfig
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError
from arm_companion.geometry.arrays import Array
from arm_companion.mission.facts import Facts, Order, Request, Result
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase
from tests.unit.mission_rig import T0, gripping, memory, run

LENGTH, RADIUS = 0.25, 0.02
BELOW = mount((0.0, 0.0, 0.12), (0.0, 0.0, 0.0))


def cone(apex: tuple[float, float, float] = (0.0, 0.0, 0.05), degrees: float = 60.0) -> KeepOut:
    return KeepOut.of(np.array(apex), math.radians(degrees), BELOW, LENGTH, RADIUS)


def searched(keep_out: KeepOut, point: Array) -> float:
    """Distance of a point from the cone's surface by looking all over it; negative inside."""
    along = np.linspace(0.0, 1.0, 20_001)
    offset = point - keep_out.apex
    height = float(offset @ keep_out.axis)
    aside = float(np.linalg.norm(offset - height * keep_out.axis))
    distance = np.hypot(aside - along * math.sin(keep_out.half_angle), height - along * math.cos(keep_out.half_angle))
    inside = height > 0.0 and math.atan2(aside, height) < keep_out.half_angle
    return float(distance.min()) * (-1.0 if inside else 1.0)


@given(
    st.floats(0.0, 6.3), st.floats(-math.pi, math.pi), st.floats(-0.1, 0.1), st.floats(0.02, 0.1), st.floats(20.0, 85.0)
)
def test_the_clearance_is_the_least_distance_of_the_arm_from_the_cone(
    theta: float, delta: float, x: float, z: float, degrees: float
) -> None:
    keep_out = cone((x, 0.0, z), degrees)
    bend = theta * np.array((math.cos(delta), math.sin(delta)))
    points = [arc.tip_position(share * bend, share * LENGTH) for share in np.linspace(0.0, 1.0, 33)[1:]]
    least = min(searched(keep_out, point) for point in points) - RADIUS
    assert keep_out.clearance(bend) == pytest.approx(least, abs=5e-5)


def test_the_cone_opens_towards_the_vehicle_wherever_the_arm_sits() -> None:
    straight = np.zeros(2)
    above = KeepOut.of(
        np.array((0.0, 0.0, -0.05)), math.radians(60.0), mount((0.0, 0.0, -0.12), (180.0, 0.0, 0.0)), LENGTH, RADIUS
    )
    curled = np.array((5.0, 0.0))
    assert above.clearance(straight) == pytest.approx(cone().clearance(straight))
    assert above.clearance(curled) == pytest.approx(cone().clearance(curled))


def test_an_arm_inside_may_only_come_out() -> None:
    keep_out = cone((0.0, 0.0, 0.1), 60.0)
    inside, deeper = np.array((4.5, 0.0)), np.array((4.6, 0.0))
    assert keep_out.clearance(deeper) < keep_out.clearance(inside) < 0.0
    assert keep_out.admits(deeper, inside)
    assert not keep_out.admits(inside, deeper)
    assert keep_out.admits(inside, inside)
    assert keep_out.admits(np.zeros(2), np.array((0.1, 0.0)))


def test_a_way_is_as_clear_as_its_worst_place() -> None:
    keep_out = cone((0.06, 0.0, 0.1), 60.0)
    goal = np.array((6.2, 0.0))
    way = [keep_out.clearance(share * goal) for share in np.linspace(0.0, 1.0, 500)]
    assert keep_out.least_on_way(np.zeros(2), goal) == pytest.approx(min(way), abs=1e-3)
    assert min(way) < keep_out.clearance(goal)


def test_a_cone_at_the_centre_of_mass_is_refused() -> None:
    with pytest.raises(ValueError, match="centre of mass"):
        cone((0.0, 0.0, 0.0))
    limits = dataclasses.replace(Config().limits, keep_out=KeepOutConfig((0.0, 0.0, 0.001), 60.0))
    with pytest.raises(ConfigError, match=r"limits\.keep_out\.apex_m"):
        Config(limits=limits)


@pytest.fixture
def fenced(parameters: Parameters) -> Parameters:
    """Parameters whose cone leaves room for bends up to about 4 rad."""
    keep_out = KeepOutConfig((0.0, 0.0, 0.1), 60.0)
    config = parameters.config
    return Parameters(
        dataclasses.replace(config, limits=dataclasses.replace(config.limits, keep_out=keep_out)), parameters.model
    )


def order(facts: Facts, request: Request) -> Facts:
    return dataclasses.replace(facts, requests=(request,))


def test_jogs_into_the_cone_are_refused_and_others_are_not(
    fenced: Parameters, parameters: Parameters, hovering: Callable[..., Facts]
) -> None:
    jog = Request(3, Order.JOG, (1.0, 4.6, 0.0, 0.0))
    small = Request(3, Order.JOG, (1.0, 2.0, 0.0, 0.0))
    for cones, request, result in (
        (fenced, jog, Result.TEMPORARILY_REJECTED),
        (parameters, jog, Result.ACCEPTED),
        (fenced, small, Result.ACCEPTED),
    ):
        state, said = step(memory(Phase.READY), order(hovering(), request), T0 + 0.01, cones)
        assert [answer.result for answer in said.answers] == [result]
        assert (state.bend_goal == (0.0, 0.0)) is (result is not Result.ACCEPTED)
        assert ("inside the keep-out cone" in said.answers[0].reason) is (result is not Result.ACCEPTED)


def test_a_perch_whose_wrap_would_enter_the_cone_is_refused(fenced: Parameters, hovering: Callable[..., Facts]) -> None:
    state, said = step(memory(Phase.READY), order(hovering(), Request(3, Order.PERCH)), T0 + 0.01, fenced)
    assert state.phase is Phase.READY
    assert "keep-out cone" in said.answers[0].reason


def test_whatever_was_asked_for_no_command_enters_the_cone(fenced: Parameters, hovering: Callable[..., Facts]) -> None:
    state, _ = run(memory(Phase.READY, bend=(3.5, 0.0), bend_goal=(5.0, 0.0)), hovering((3.5, 0.0)), fenced, 2.0)
    keep_out = fenced.keep_out
    assert keep_out is not None
    assert 3.5 < state.bend[0] < 5.0
    assert 0.0 <= keep_out.clearance(np.asarray(state.bend)) < 0.01


@pytest.mark.parametrize(("what", "refused"), [(Order.PERCH, True), (Order.GRASP, True), ("gripper", False)])
def test_what_wraps_into_the_cone_is_refused_and_a_gripper_wraps_nothing(
    what: Order | str, refused: bool, fenced: Parameters, hovering: Callable[..., Facts]
) -> None:
    flown = gripping(fenced) if what == "gripper" else fenced
    request = Request(3, Order.GRASP if what == "gripper" else what)  # type: ignore[arg-type]
    _, said = step(memory(Phase.READY), order(hovering(), request), T0 + 0.01, flown)
    assert ("inside the keep-out cone" in said.answers[0].reason) is refused
