"""The way out of HOLDING when a servo has failed: a person on the ground, and an arm that holds nothing any more."""

import dataclasses
from collections.abc import Callable

import pytest

from arm_companion.mission.facts import Answer, Facts, Order, Result
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase
from tests.unit.mission_rig import BENT, Change, Run, ask, changed, gripping, jaws, memory, tendon

Hovering = Callable[..., Facts]

LANDED = {"armed": False, "landed": True}
SHUT_DOWN = tendon(0, error_bits=0x20, torque=False, ready=False)
"""The inner tendon's servo: it has let go, and stands where it was."""
NO_TORQUE: tuple[Change, ...] = tuple(tendon(i, torque=False, homed=False, ready=False) for i in range(4))


def failed(hovering: Hovering, bend: tuple[float, float] = (0.0, 0.0), **vehicle: object) -> Facts:
    """Facts after RELEASE has opened the arm as far as the other servos can: the failed one stands as it was."""
    stood = hovering(BENT).tendons[0].pull
    return changed(hovering(bend, **{**LANDED, **vehicle}), (SHUT_DOWN, tendon(0, pull=stood)))


def cleared(facts: Facts, parameters: Parameters, **fields: object) -> tuple[Run, Answer]:
    """CLEAR_ERRORS in HOLDING, and the first answer to it."""
    run = Run(memory(Phase.HOLDING, armed=facts.vehicle.armed, **fields), parameters)
    run.cycles(facts, 0.1)
    commands = run.cycle(ask(facts, Order.CLEAR_ERRORS))
    return run, commands.answers[0]


def test_on_the_ground_an_arm_that_has_let_go_is_cleared_and_nothing_moves(
    parameters: Parameters, hovering: Hovering
) -> None:
    run, answer = cleared(failed(hovering), parameters)
    assert answer.result is Result.IN_PROGRESS
    assert run.state.phase is Phase.STOWED
    assert run.said[-1].recover
    well = hovering(**LANDED)
    run.cycles(well, 0.1)
    assert [a.result for a in run.said[-10].answers] == [Result.ACCEPTED]
    assert all(said.pulls is None for said in run.said)
    run.cycles(ask(well, Order.READY), 0.1)
    assert run.state.phase is Phase.READYING


def test_a_servo_that_does_not_come_back_is_told_and_may_be_cleared_again(
    parameters: Parameters, hovering: Hovering
) -> None:
    dead = tendon(0, silent=True, torque=False)(failed(hovering))
    run, _ = cleared(dead, parameters)
    run.cycles(dead, 7.0)
    last = [answer for said in run.said for answer in said.answers][-1]
    assert (last.result, last.reason) == (Result.FAILED, "tendon 1: servo hardware error 0x20")
    assert run.state.phase is Phase.STOWED
    assert run.cycle(ask(dead, Order.CLEAR_ERRORS)).recover


def test_servos_whose_power_was_taken_away_hold_nothing(parameters: Parameters, hovering: Hovering) -> None:
    run, answer = cleared(changed(hovering(BENT, **LANDED), NO_TORQUE), parameters)
    assert answer.result is Result.IN_PROGRESS
    assert run.said[-1].recover


@pytest.mark.parametrize(
    ("vehicle", "words"),
    [
        ({"armed": True, "landed": False}, "armed"),
        ({"armed": True}, "armed"),
        ({"landed": False}, "not on the ground"),
        ({"heartbeat_age_s": 9.0}, "silent"),
        ({"heartbeat_age_s": float("inf")}, "not been heard"),
    ],
)
def test_a_vehicle_that_may_fly_stays_as_it_is(
    vehicle: dict[str, object], words: str, parameters: Parameters, hovering: Hovering
) -> None:
    run, answer = cleared(failed(hovering, **vehicle), parameters)
    assert answer.result is Result.TEMPORARILY_REJECTED
    assert words in answer.reason
    assert run.phases == [Phase.HOLDING]
    assert not any(said.recover for said in run.said)


@pytest.mark.parametrize(
    "changes",
    [
        (),
        tuple(tendon(i, error_bits=0x01, ready=False) for i in range(4)),  # a low supply: they report it, and hold
        tuple(tendon(i, silent=True) for i in range(4)),
        tuple(tendon(i, homed=False, pull=0.0, ready=False) for i in range(4)),
    ],
    ids=["well", "low supply", "silent", "turns lost under torque"],
)
def test_what_holds_or_may_hold_is_not_let_go(
    changes: tuple[Change, ...], parameters: Parameters, hovering: Hovering
) -> None:
    """A vehicle whose motors were stopped at the bar may hang by an arm below, disarmed and at rest."""
    run, answer = cleared(changed(failed(hovering, BENT), changes), parameters)
    assert answer.result is Result.TEMPORARILY_REJECTED
    assert "holds" in answer.reason
    assert "RELEASE" in answer.reason
    assert run.phases == [Phase.HOLDING]
    assert not any(said.recover for said in run.said)


@pytest.mark.parametrize(("bend", "result"), [(BENT, Result.TEMPORARILY_REJECTED), ((0.0, 0.0), Result.IN_PROGRESS)])
def test_a_daemon_that_starts_beside_an_arm_that_holds_reboots_none_of_its_servos(
    bend: tuple[float, float], result: Result, parameters: Parameters, hovering: Hovering
) -> None:
    """A restart under the bar, with a low supply and one servo silent: those that report it still hold the vehicle."""
    low = tuple(tendon(i, error_bits=0x01, ready=False) for i in range(3))
    facts = changed(hovering(bend), (*low, tendon(3, silent=True, torque=False, pull=0.0)))
    run = Run(memory(Phase.STARTUP), parameters)
    run.cycles(facts, 0.1)
    commands = run.cycle(ask(facts, Order.CLEAR_ERRORS))
    assert commands.answers[0].result is result
    assert commands.recover is (result is Result.IN_PROGRESS)
    assert run.phases == [Phase.STARTUP]


@pytest.mark.parametrize(("torque", "result"), [(True, Result.TEMPORARILY_REJECTED), (False, Result.IN_PROGRESS)])
def test_jaws_that_hold_are_released_first(
    torque: bool, result: Result, parameters: Parameters, hovering: Hovering
) -> None:
    holding = jaws(closed=0.6, load=0.4, torque=torque, error_bits=0x20 if not torque else 0, ready=torque)
    run, answer = cleared(holding(failed(hovering)), gripping(parameters))
    assert answer.result is result
    assert run.said[-1].gripper is None


def test_of_an_arm_above_nobody_knows_whether_the_vehicle_hangs_by_it(
    parameters: Parameters, hovering: Hovering
) -> None:
    mount = dataclasses.replace(parameters.config.mount, rpy_deg=(180.0, 0.0, 0.0))
    above = Parameters(dataclasses.replace(parameters.config, mount=mount), parameters.model)
    run = Run(memory(Phase.HOLDING, armed=False), above)
    commands = run.cycle(ask(failed(hovering), Order.CLEAR_ERRORS))
    assert commands.answers[0].result is Result.TEMPORARILY_REJECTED
    assert not commands.recover
    assert run.phases == [Phase.HOLDING, Phase.HANG_HOLD]
