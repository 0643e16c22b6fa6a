"""A perch that does not hold is tried again, as often as the configuration says, and never against a person."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from arm_companion.mission.facts import ArmFault, Control, Facts, Order, Result
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase, Running
from tests.unit.conftest import tendons
from tests.unit.mission_rig import DT, PLACE, T0, Change, Run, ask, memory, tendon, vehicle

Hovering = Callable[..., Facts]
REQUEST = 7
SET_OUT = Running(REQUEST, Order.PERCH, frozenset({Phase.PERCHED, Phase.HANGING}), T0)


class Flight:
    """A vehicle that is where it is asked to be, an arm that is bent as it is told, and a bar that holds neither."""

    def __init__(self, parameters: Parameters, hovering: Hovering, attempts: int, **fields: object) -> None:
        config = parameters.config
        perch = dataclasses.replace(config.perch, attempts=attempts)
        self.parameters = dataclasses.replace(parameters, config=dataclasses.replace(config, perch=perch))
        known: dict[str, object] = {"running": SET_OUT, "tries": 1, **fields}
        self.run = Run(memory(Phase.VERIFY, **known), self.parameters)
        self.facts = hovering((3.0, 0.0))
        self.control = Control.EXTERNAL
        self.change: Change = lambda facts: facts

    def until(self, *phases: Phase, seconds: float = 60.0) -> None:
        """Fly until one of these phases begins."""
        begun = len(self.run.phases)
        for _ in range(round(seconds / DT)):
            self.cycle()
            if self.run.phases[begun:] and self.run.state.phase in phases:
                return
        raise AssertionError(f"{[p.name for p in self.run.phases]} has no {[p.name for p in phases]}")

    def cycle(self, order: Order | None = None) -> None:
        """One step."""
        state = self.run.state
        place = state.reference.position if state.reference else PLACE
        facts = vehicle(position_w=place, control=self.control)(self.facts)
        pulls = self.parameters.model.pull_for_bend(np.asarray(state.bend))
        facts = dataclasses.replace(facts, tendons=tendons(tuple(map(float, pulls)), (8.0, 4.0, 1.0, 4.0)))
        facts = self.change(facts)
        self.run.cycle(facts if order is None else ask(facts, order, request=8))

    @property
    def answers(self) -> list[tuple[int, Result]]:
        """Every answer that ends an order."""
        every = [answer for commands in self.run.said for answer in commands.answers]
        return [(answer.request, answer.result) for answer in every if answer.result is not Result.IN_PROGRESS]


def test_a_grip_that_does_not_hold_is_let_go_and_tried_again(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=2)
    flight.until(Phase.APPROACH)
    assert flight.run.phases == [Phase.VERIFY, Phase.UNLOAD, Phase.RELEASE, Phase.DEPART, Phase.APPROACH]
    assert any("another try follows, 2 of 2" in text for text in flight.run.texts)
    assert flight.answers == []
    assert flight.run.state.errors is ArmFault.NONE
    assert flight.run.state.tries == 2
    assert flight.run.state.anchor is None
    flight.until(Phase.REACH)


def test_the_last_try_fails_the_order(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=2, tries=2)
    flight.until(Phase.STOWING)
    assert flight.answers == [(REQUEST, Result.FAILED)]
    assert flight.run.state.errors & ArmFault.GRIP_TEST_FAILED


def test_one_attempt_is_one(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=1)
    flight.until(Phase.STOWING)
    assert flight.answers == [(REQUEST, Result.FAILED)]
    assert Phase.APPROACH not in flight.run.phases


def test_a_grip_that_nobody_waits_for_is_not_tried_again(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=3, running=None)
    flight.until(Phase.STOWING)
    assert Phase.APPROACH not in flight.run.phases
    assert flight.run.state.errors & ArmFault.GRIP_TEST_FAILED
    assert not any("another try" in text for text in flight.run.texts)


@pytest.mark.parametrize("order", [Order.ABORT, Order.STOW])
def test_a_person_ends_it_on_the_way_back(parameters: Parameters, hovering: Hovering, order: Order) -> None:
    flight = Flight(parameters, hovering, attempts=3)
    flight.until(Phase.DEPART)
    flight.cycle(order)
    assert (REQUEST, Result.CANCELLED) in flight.answers
    flight.until(Phase.STOWED)
    assert Phase.APPROACH not in flight.run.phases


def test_the_pilot_ends_it(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=3)
    flight.until(Phase.DEPART)
    flight.control = Control.PILOT
    flight.cycle()
    assert flight.run.state.phase is Phase.STOWING
    assert flight.answers == [(REQUEST, Result.FAILED)]


def test_a_vehicle_that_is_taken_while_the_arm_lets_go_ends_it(parameters: Parameters, hovering: Hovering) -> None:
    """Without a fault, so nothing but the end itself can answer who waits."""
    flight = Flight(parameters, hovering, attempts=3)
    flight.until(Phase.RELEASE)
    flight.control = Control.PILOT
    flight.until(Phase.STOWING)
    assert flight.answers == [(REQUEST, Result.FAILED)]
    assert flight.run.state.running is None


def test_what_would_refuse_a_perch_refuses_another_try(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=3)
    flight.until(Phase.DEPART)
    flight.change = tendon(1, temperature=90.0)
    flight.until(Phase.STOWING)
    assert Phase.APPROACH not in flight.run.phases
    assert flight.answers == [(REQUEST, Result.FAILED)]


def test_the_next_order_counts_from_one(parameters: Parameters, hovering: Hovering) -> None:
    flight = Flight(parameters, hovering, attempts=2, tries=2)
    flight.until(Phase.STOWED)
    flight.cycle(Order.READY)
    flight.until(Phase.READY)
    flight.cycle(Order.PERCH)
    assert flight.run.state.phase is Phase.APPROACH
    assert flight.run.state.tries == 1
