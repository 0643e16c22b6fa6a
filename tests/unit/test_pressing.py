"""Before the arm lets go of a bar, the force with which the vehicle presses down on it is eased."""

import dataclasses
import math
from collections.abc import Callable, Iterator

import pytest

from arm_companion.arm.reaction import GRAVITY
from arm_companion.config import Config
from arm_companion.mission.facts import Control, Facts, Order
from arm_companion.mission.motion import Reference
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import NO_LOAD, Flow, Load, ThrustCurve
from arm_companion.mission.pressing import EASED_S
from arm_companion.mission.state import PerchKind, Phase, State
from tests.unit.mission_rig import BENT, DT, PLACE, Run, memory

Hovering = Callable[..., Facts]
HOVER = 0.5  # share of thrust
SLOPE = 1.25  # of the curve of the rotors
SMALL = ((1e-3, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0, 0.0), (0.0, 0.0, 1e-3, 0.0), (0.0, 0.0, 0.0, 1e-8))


def lifting(newtons: float, config: Config) -> float:
    """Share of thrust with which the rotors lift so much more than the vehicle, N."""
    return HOVER * (1.0 + newtons / (config.vehicle.mass_kg * GRAVITY) / SLOPE)


def known(newtons: float, config: Config) -> Load:
    """What the rotors have told of that for a while."""
    curve = dataclasses.replace(ThrustCurve.prior(HOVER), covariance=SMALL)
    return Load(curve, Flow(1.0, lifting(newtons, config), 0.0), 5.0, newtons / GRAVITY)


class Autopilot:
    """Its integrator: presses, and lets up while it is asked to be higher than the vehicle is."""

    def __init__(self, down: float, config: Config, *, lets_up: float = 20.0) -> None:
        self.down, self._config, self._lets_up = down, config, lets_up

    def facts(self, hovering: Facts, reference: Reference | None) -> Facts:
        if reference is not None:
            self.down += self._lets_up * (reference.position[2] - PLACE[2]) * DT
        vehicle = dataclasses.replace(hovering.vehicle, thrust=lifting(-self.down, self._config))
        return dataclasses.replace(hovering, vehicle=vehicle)


def unloading(load: Load, **fields: object) -> State:
    return memory(Phase.UNLOAD, load=load, bend=BENT, bend_goal=BENT, **fields)


def flown(run: Run, autopilot: Autopilot, hovering: Facts, seconds: float) -> Iterator[State]:
    for _ in range(round(seconds / DT)):
        run.cycle(autopilot.facts(hovering, run.state.reference))
        yield run.state


def test_an_integrator_that_presses_is_wound_back_and_then_the_arm_lets_go(
    parameters: Parameters, hovering: Hovering
) -> None:
    """With 0.9 N still pressing, ArduPilot's mount sank onto the bar as the arm opened."""
    autopilot = Autopilot(1.2, parameters.config)
    run = Run(unloading(known(-1.2, parameters.config)), parameters)
    heights = []
    for state in flown(run, autopilot, hovering(BENT), 12.0):
        if state.phase is not Phase.UNLOAD:
            break
        assert state.reference is not None
        heights.append(PLACE[2] - state.reference.position[2])
    assert run.phases == [Phase.UNLOAD, Phase.RELEASE]
    assert 0.01 < max(heights) <= 0.03 + 1e-9
    assert abs(autopilot.down) < 0.4
    assert 1.5 < len(heights) * DT < EASED_S


def test_who_never_lets_up_is_not_waited_for_for_ever(parameters: Parameters, hovering: Hovering) -> None:
    autopilot = Autopilot(1.2, parameters.config, lets_up=0.0)
    run = Run(unloading(known(-1.2, parameters.config)), parameters)
    lasted = sum(state.phase is Phase.UNLOAD for state in flown(run, autopilot, hovering(BENT), 12.0)) * DT
    assert lasted == pytest.approx(EASED_S, abs=0.2)


@pytest.mark.parametrize("newtons", [-0.1, 0.8, math.nan])
def test_nothing_is_moved_for_a_little_for_an_upward_pull_or_for_rotors_that_tell_nothing(
    newtons: float, parameters: Parameters, hovering: Hovering
) -> None:
    load = NO_LOAD if math.isnan(newtons) else known(newtons, parameters.config)
    autopilot = Autopilot(0.0 if math.isnan(newtons) else -newtons, parameters.config, lets_up=0.0)
    facts = hovering(BENT, thrust=math.nan) if math.isnan(newtons) else hovering(BENT)
    run = Run(unloading(load), parameters)
    for _ in range(80):
        run.cycle(facts if math.isnan(newtons) else autopilot.facts(facts, run.state.reference))
        assert run.state.reference is not None
        assert run.state.reference.position == PLACE
    run.cycles(facts if math.isnan(newtons) else autopilot.facts(facts, None), 0.3)
    assert run.state.phase is Phase.RELEASE


@pytest.mark.parametrize(
    "fields", [{"task": Order.GRASP}, {"kind": PerchKind.HANG}, {"anchor": None}], ids=["object", "hang", "unknown"]
)
def test_only_a_vehicle_that_stands_on_a_bar_by_its_own_anchor_is_lifted(
    fields: dict[str, object], parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(unloading(known(-1.2, parameters.config), **fields), parameters)
    autopilot = Autopilot(1.2, parameters.config, lets_up=0.0)
    for state in flown(run, autopilot, hovering(BENT), 0.8):
        assert state.reference is not None
        assert state.reference.position == PLACE


def test_the_way_out_of_a_wrap_begins_no_lower_than_easing_ended(parameters: Parameters, hovering: Hovering) -> None:
    """A step down of 3 cm would press again, with what has just been wound back."""
    raised = Reference((PLACE[0], PLACE[1], PLACE[2] - 0.02), (0.0, 0.0, 0.0), 0.0)
    wrapped = (parameters.config.perch.wrap_bend_rad, 0.0)
    run = Run(memory(Phase.RELEASE, reference=raised, bend=wrapped, contact_w=(2.0, 0.0, -2.26)), parameters)
    before = raised.position[2]
    for _ in range(200):
        run.cycle(hovering(run.state.bend))
        assert run.state.reference is not None
        assert run.state.reference.position[2] <= before
        before = run.state.reference.position[2]
    far = Reference((PLACE[0], PLACE[1], PLACE[2] - 0.3), (0.0, 0.0, 0.0), 0.0)
    run = Run(dataclasses.replace(run.state, reference=far, bend=BENT), parameters)
    run.cycle(hovering(BENT))
    assert run.state.reference is not None
    assert run.state.reference.position[2] > far.position[2] + 0.1, "not for what it has drifted"


@pytest.mark.parametrize(
    ("fields", "told"), [({}, True), ({"task": Order.GRASP}, False), ({"kind": PerchKind.HANG}, False)]
)
def test_a_vehicle_that_leaves_its_bar_is_told_how_fast_it_rises_and_from_where_it_rests(
    fields: dict[str, object], told: bool, parameters: Parameters, hovering: Hovering
) -> None:
    """The bar carried some of the arm, and without it the vehicle sinks, and its mount onto the bar."""
    here = (PLACE[0] - 0.01, PLACE[1], PLACE[2])  # the estimate has drifted by a centimetre since the grip
    wrapped = (parameters.config.perch.wrap_bend_rad, 0.0)
    state = memory(Phase.RELEASE, reference=Reference(here), rest=here, bend=wrapped, contact_w=(1.96, 0.0, -2.26))
    run = Run(dataclasses.replace(state, **fields), parameters)  # type: ignore[arg-type]
    before = run.state.reference
    for _ in range(100):
        run.cycle(hovering(run.state.bend))
        after = run.state.reference
        assert before is not None
        assert after is not None
        rise = (after.position[2] - before.position[2]) / 0.01 if told else 0.0
        assert after.velocity == pytest.approx((0.0, 0.0, rise), abs=1e-9)
        if told:
            assert abs(after.position[0] - before.position[0]) < 1e-3, "no jump back to where it gripped"
        before = after
    assert not told or rise < -0.005


def test_a_pilot_who_took_over_meanwhile_does_not_wait_for_a_place(parameters: Parameters, hovering: Hovering) -> None:
    load = known(-1.2, parameters.config)
    run = Run(unloading(load, control=Control.PILOT, reference=None), parameters)
    facts = hovering(BENT, control=Control.PILOT, position_w=(2.1, 0.0, -2.2), thrust=lifting(-1.2, parameters.config))
    run.cycles(facts, 1.2)
    assert run.state.phase is Phase.RELEASE
    places = {commands.setpoint.position_w for commands in run.said if commands.setpoint is not None}
    assert places <= {facts.vehicle.position_w}, "the stream that PX4 needs asks for nothing"
