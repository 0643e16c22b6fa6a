"""Random facts and orders for hundreds of cycles: no exception, no illegal command, limits on all that leaves.

The laws themselves are in `mission_rig.Run`, which checks them after every step.
"""

import dataclasses
import math
from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from arm_companion.mission.facts import (
    ArmSetpoint,
    Bar,
    Control,
    Facts,
    Order,
    Request,
    Result,
    SetpointKind,
    VehicleState,
    Workshop,
)
from arm_companion.mission.gripper_facts import GripperAnswer, GripperFate, GripperState, JawState
from arm_companion.mission.hazards import vehicle_lost
from arm_companion.mission.notices import WARNINGS
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.perch import TABLE
from arm_companion.mission.state import MOVES_VEHICLE, Phase
from arm_companion.record_codec import dumps, loads
from tests.unit.mission_rig import DT, SETUP, Run, gripping, memory
from tests.unit.test_perch_table import reachable

Hovering = Callable[..., Facts]

AGES = st.sampled_from((0.01, 0.2, 0.3, 3.0, math.inf))
METRES = st.floats(-5.0, 5.0)
PLACES = st.tuples(METRES, METRES, METRES)
TURNS = st.floats(-math.pi, math.pi).map(lambda yaw: (math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)))
VEHICLES = st.builds(
    VehicleState,
    position_w=st.one_of(st.just((2.0, 0.0, -2.2)), PLACES),
    velocity_w=st.one_of(st.just((0.0, 0.0, 0.0)), PLACES),
    attitude_wb=TURNS,
    armed=st.sampled_from((True, True, True, False)),
    landed=st.booleans(),
    control=st.sampled_from((Control.EXTERNAL, Control.EXTERNAL, *Control)),
    mode=st.just("ANY"),
    heartbeat_age_s=AGES,
    position_age_s=AGES,
    attitude_age_s=AGES,
    throttle=st.floats(0.0, 1.0),
    throttle_age_s=AGES,
    thrust=st.sampled_from((0.5, 0.5, 0.3, 0.6, 1.0, 0.0, math.nan)),
)
TENDON = st.fixed_dictionaries(
    {
        "tension": st.floats(-5.0, 100.0),
        "tension_sigma": st.sampled_from((0.05, 1.0, math.inf)),
        "temperature": st.floats(-20.0, 100.0),
        "voltage": st.floats(0.0, 16.0),
        "error_bits": st.sampled_from((0, 0, 0, 1, 0x20, 0xFF)),
        "silent": st.sampled_from((False, False, False, True)),
        "torque": st.sampled_from((True, True, False)),
        "ready": st.sampled_from((True, True, False)),
        "homed": st.sampled_from((True, True, False)),
    }
)
PARAMETERS = {
    Order.JOG: st.tuples(st.sampled_from((1.0, 2.0, 3.0, 0.0, 9.0)), *[st.floats(-7.0, 7.0)] * 3),
    Order.FEEDFORWARD: st.sampled_from(((0.0,), (1.0,))),
    Order.PERCH: st.sampled_from(((0.0,), (1.0,))),
    Order.REACH: st.one_of(
        st.tuples(st.sampled_from((0.0, 1.0)), METRES, METRES, METRES),
        st.tuples(st.sampled_from((0.0, 1.0)), st.floats(1.5, 2.5), st.floats(-0.5, 0.5), st.floats(-2.2, -1.6)),
    ),
}
ORDERS = st.sampled_from(Order).flatmap(lambda order: st.tuples(st.just(order), PARAMETERS.get(order, st.just(()))))
BARS = st.builds(
    lambda point, yaw, radius: Bar(point, (math.cos(yaw), math.sin(yaw), 0.0), radius),
    PLACES,
    st.floats(-math.pi, math.pi),
    st.floats(0.005, 0.1),
)
STREAMS = st.builds(
    ArmSetpoint,
    kind=st.sampled_from(SetpointKind),
    theta=st.floats(-9.0, 9.0),
    delta=st.floats(-4.0, 4.0),
    tip_a=PLACES,
    age_s=st.just(0.0),
    timeout_s=st.just(1.0),
)


JAWS = st.builds(
    JawState,
    closed=st.sampled_from((0.0, 0.5, 0.98, -3.0)),
    speed=st.sampled_from((0.0, 0.0, 1.0)),
    load=st.sampled_from((0.0, 0.34, -0.5)),
    temperature=st.sampled_from((30.0, 75.0)),
    voltage=st.sampled_from((12.0, 5.0)),
    error_bits=st.sampled_from((0, 0, 0x20)),
    silent=st.booleans(),
    torque=st.booleans(),
    ready=st.booleans(),
    homed=st.booleans(),
)
ANSWERS = st.builds(
    GripperAnswer, at=st.floats(0.0, 200.0), fate=st.sampled_from(GripperFate), since_s=st.floats(0.0, 9.0)
)
GRIPPERS = st.one_of(st.none(), st.builds(GripperState, jaws=st.one_of(JAWS, st.none()), answer=ANSWERS))


@dataclasses.dataclass(frozen=True)
class Happening:
    """Some cycles with the same facts."""

    vehicle: VehicleState | None
    tendons: tuple[dict[str, object], ...] | None
    bend: tuple[float, float]
    orders: tuple[tuple[Order, tuple[float, ...]], ...]
    bar: Bar | None
    stream: ArmSetpoint | None
    ground_age_s: float
    gripper: GripperState | None
    cycles: int
    dt: float

    def facts(self, hovering: Hovering, first: int) -> Facts:
        """As one step sees them."""
        facts = hovering(self.bend)
        tendons = facts.tendons
        if self.tendons is not None:
            tendons = tuple(
                dataclasses.replace(t, **change)  # type: ignore[arg-type]
                for t, change in zip(tendons, self.tendons, strict=True)
            )
        return dataclasses.replace(
            facts,
            vehicle=facts.vehicle if self.vehicle is None else self.vehicle,
            tendons=tendons,
            requests=tuple(Request(first + i, order, values) for i, (order, values) in enumerate(self.orders)),
            bar=self.bar,
            bar_age_s=0.1 if self.bar else math.inf,
            arm_setpoint=self.stream,
            ground_age_s=self.ground_age_s,
            workshop=Workshop(SETUP.curves, SETUP.m_per_tick),
            gripper=self.gripper,
        )


HAPPENINGS = st.builds(
    Happening,
    vehicle=st.one_of(st.none(), VEHICLES),
    tendons=st.one_of(st.none(), st.none(), st.tuples(TENDON, TENDON, TENDON, TENDON)),
    bend=st.sampled_from(((0.0, 0.0), (0.1, 0.0), (1.0, 0.5), (3.0, 0.0), (4.9, 0.0))),
    orders=st.lists(ORDERS, max_size=3).map(tuple),
    bar=st.one_of(st.none(), st.none(), BARS),
    stream=st.one_of(st.none(), st.none(), STREAMS),
    ground_age_s=st.sampled_from((0.5, 9.0, math.inf)),
    gripper=GRIPPERS,
    cycles=st.integers(1, 40),
    dt=st.sampled_from((DT, DT, DT, 0.0, 0.05, 2.0)),
)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    start=st.sampled_from(Phase),
    happenings=st.lists(HAPPENINGS, min_size=8, max_size=16),
    gripper=st.sampled_from(("", "servo", "autopilot")),
)
def test_nothing_that_can_be_seen_or_ordered_makes_an_exception_or_an_illegal_command(
    parameters: Parameters, hovering: Hovering, start: Phase, happenings: list[Happening], gripper: str
) -> None:
    rates = dataclasses.replace(parameters.config.rates, wrench_hz=5.0)
    rare = Parameters(dataclasses.replace(parameters.config, rates=rates), parameters.model)
    run = Run(memory(start), gripping(rare, by=gripper) if gripper else rare)
    ended: dict[int, Result] = {}
    for i, happening in enumerate(happenings):
        facts = happening.facts(hovering, 10 * i)
        for _ in range(happening.cycles):
            commands = run.cycle(facts, happening.dt)
            facts = dataclasses.replace(facts, requests=())
            for answer in commands.answers:
                assert answer.request not in ended, "an order ends once"
                if answer.result is not Result.IN_PROGRESS:
                    ended[answer.request] = answer.result
    dumps(run.state)
    loads(type(run.state), dumps(run.state))


# What the tables themselves promise.


FLYING = [phase for phase in Phase if phase in MOVES_VEHICLE]


@pytest.mark.parametrize("phase", FLYING, ids=lambda phase: phase.name)
def test_every_live_phase_can_abort_and_the_abort_ends_at_rest_or_holding(phase: Phase) -> None:
    row = TABLE.order(Order.ABORT, phase)
    assert row is not None
    assert {Phase.STOWED, Phase.HOLDING} & reachable(row.target)
    if row.target is phase:  # being given up already: it ends by itself
        assert any(phase in row.sources and row.target is not phase for row in TABLE.transitions)


@pytest.mark.parametrize("phase", FLYING, ids=lambda phase: phase.name)
def test_every_phase_that_moves_the_vehicle_has_an_answer_to_its_loss(phase: Phase) -> None:
    labels = {row.label for row in TABLE.transitions if phase in row.sources}
    if phase is Phase.RELEASE:
        assert "vehicle not ours" in labels, "half a grip is no grip: it goes on opening, and leaves the vehicle alone"
    elif phase is Phase.CARRY:
        assert any(phase in told.phases and told.guard is vehicle_lost for told in WARNINGS), "it holds, and says so"
    else:
        assert "vehicle lost" in labels
    assert labels & {"disarmed", "motors stop"}
