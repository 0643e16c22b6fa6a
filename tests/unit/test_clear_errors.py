"""The way out of HOLDING when a servo has failed: a person on the ground, and an arm that holds nothing any more."""

import dataclasses
import math
from collections.abc import Callable

import pytest

from arm_companion.errors import ModelError
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
    assert last.result is Result.FAILED
    assert last.reason == "tendon 1: servo hardware error 0x20; mend it, then CLEAR_ERRORS"
    assert run.state.phase is Phase.STOWED
    assert run.cycle(ask(dead, Order.CLEAR_ERRORS)).recover


def test_servos_whose_power_was_taken_away_hold_nothing(parameters: Parameters, hovering: Hovering) -> None:
    run, answer = cleared(changed(hovering(BENT, **LANDED), NO_TORQUE), parameters)
    assert answer.result is Result.IN_PROGRESS
    assert run.said[-1].recover


@pytest.mark.parametrize(
    ("vehicle", "words"),
    [
        (
            {"armed": True, "landed": False},
            "armed: RELEASE; if it comes back to HOLDING, land, disarm, then CLEAR_ERRORS",
        ),
        ({"armed": True}, "armed: RELEASE"),
        ({"landed": False}, "not on the ground: RELEASE"),
        ({"heartbeat_age_s": 9.0}, "silent, heartbeat 9.0 s old: nobody knows"),
        ({"heartbeat_age_s": float("inf")}, "not been heard: nobody knows"),
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
        (*(tendon(i, silent=True) for i in range(3)), tendon(3, pull=0.02)),  # the last one answers
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


def above(parameters: Parameters) -> Parameters:
    mount = dataclasses.replace(parameters.config.mount, rpy_deg=(180.0, 0.0, 0.0))
    return Parameters(dataclasses.replace(parameters.config, mount=mount), parameters.model)


@pytest.mark.parametrize("changes", [(), NO_TORQUE], ids=["let go", "no torque"])
@pytest.mark.parametrize("phase", [Phase.HOLDING, Phase.HANG_HOLD])
def test_no_vehicle_hangs_by_an_arm_above_that_holds_nothing(
    phase: Phase, changes: tuple[Change, ...], parameters: Parameters, hovering: Hovering
) -> None:
    """The vehicle came down on its arm, or never hung: what keeps a hanging one up is tendons under torque."""
    run = Run(memory(phase, armed=False), above(parameters))
    commands = run.cycle(ask(changed(failed(hovering), changes), Order.CLEAR_ERRORS))
    assert commands.answers[0].result is Result.IN_PROGRESS
    assert commands.recover
    assert run.phases == [phase, Phase.STOWED]
    well = hovering(**LANDED)
    run.cycles(well, 0.1)
    assert all(said.pulls is None for said in run.said)
    run.cycles(ask(well, Order.READY), 0.1)
    assert run.state.phase is Phase.READYING


@pytest.mark.parametrize(
    ("vehicle", "changes", "words"),
    [
        ({}, (), "holds, or may hold: on the ground take the servos' power away for a moment"),
        ({}, (tendon(0, torque=False),), "holds, or may hold"),
        ({}, tuple(tendon(i, silent=True) for i in range(4)), "does not answer: see to the power and the cable"),
        ({}, tuple(tendon(i, homed=False, pull=0.0, ready=False) for i in range(4)), "holds, or may hold"),
        ({"armed": True}, NO_TORQUE, "armed: READY, external control, RELEASE"),
        ({"landed": False}, NO_TORQUE, "not on the ground"),
        ({"heartbeat_age_s": 9.0}, NO_TORQUE, "silent"),
    ],
    ids=["wrapped", "one limp", "silent", "turns lost under torque", "armed", "in the air", "autopilot silent"],
)
def test_an_arm_above_by_which_the_vehicle_may_hang_is_left_as_it_is(
    vehicle: dict[str, object], changes: tuple[Change, ...], words: str, parameters: Parameters, hovering: Hovering
) -> None:
    """An autopilot says of a disarmed vehicle that hangs that it stands on the ground."""
    run = Run(memory(Phase.HANG_HOLD, armed=bool(vehicle.get("armed"))), above(parameters))
    commands = run.cycle(ask(changed(hovering(BENT, **{**LANDED, **vehicle}), changes), Order.CLEAR_ERRORS))
    assert commands.answers[0].result is Result.TEMPORARILY_REJECTED
    assert words in commands.answers[0].reason
    assert not any(said.recover for said in run.said)
    assert run.phases == [Phase.HANG_HOLD]


def test_a_servo_that_stays_dead_is_named_with_what_to_do(parameters: Parameters, hovering: Hovering) -> None:
    """The others have opened the arm: RELEASE would not help, and their power neither."""
    run, answer = cleared(changed(failed(hovering), (tendon(0, silent=True, torque=True),)), parameters)
    assert answer.result is Result.TEMPORARILY_REJECTED
    assert answer.reason == (
        "tendon 1 holds, or may hold, and does not answer: see to the power and the cable, then CLEAR_ERRORS"
    )
    assert run.phases == [Phase.HOLDING]


@pytest.mark.parametrize(
    ("phase", "order"),
    [
        *((Phase.HOLDING, order) for order in (Order.READY, Order.PERCH, Order.STOW, Order.CALIBRATE)),
        *((Phase.HANG_HOLD, order) for order in (Order.PERCH, Order.STOW, Order.CALIBRATE)),
    ],
)
def test_an_arm_that_holds_names_the_way_out_with_every_other_order(
    phase: Phase, order: Order, parameters: Parameters, hovering: Hovering
) -> None:
    rig = above(parameters) if phase is Phase.HANG_HOLD else parameters
    commands = Run(memory(phase, armed=False), rig).cycle(ask(failed(hovering), order))
    assert commands.answers[0].result is Result.TEMPORARILY_REJECTED
    assert commands.answers[0].reason.startswith(f"{order.name} is not possible in state {phase.name}: ")
    assert "CLEAR_ERRORS" in commands.answers[0].reason


@pytest.mark.parametrize(
    "change", [tendon(1, silent=True, torque=False), tendon(1, error_bits=0x20, torque=False), tendon(1, homed=False)]
)
def test_ready_after_a_fault_asks_for_clear_errors(change: Change, parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.STOWED, armed=False), parameters)
    commands = run.cycle(ask(changed(hovering(**LANDED), (change,)), Order.READY))
    assert commands.answers[0].result is Result.TEMPORARILY_REJECTED
    assert commands.answers[0].reason.count("CLEAR_ERRORS") == 1


def test_displacements_that_no_arm_can_have_fail_no_cycle(parameters: Parameters, hovering: Hovering) -> None:
    """A dead servo's last word is that its tendon is taken in; the opposite one, power-cycled, tells any turn."""
    most = parameters.config.limits.pull_max_m
    odd = changed(
        hovering(**LANDED),
        (
            tendon(0, pull=most, silent=True),
            *(tendon(i, pull=0.5 * most, torque=False, homed=False, ready=False) for i in (1, 2, 3)),
        ),
    )
    with pytest.raises(ModelError):
        parameters.model.bend_for_pull([each.pull for each in odd.tendons])
    run, answer = cleared(odd, parameters)
    assert "does not answer" in answer.reason
    run, answer = cleared(changed(odd, (tendon(0, silent=False, torque=False, homed=False),)), parameters)
    assert answer.result is Result.IN_PROGRESS
    assert run.state.phase is Phase.STOWED
    assert math.hypot(*run.state.bend) <= parameters.config.limits.bend_max_rad


def test_clear_errors_in_the_middle_of_something_asks_for_its_end(parameters: Parameters, hovering: Hovering) -> None:
    commands = Run(memory(Phase.READY), parameters).cycle(ask(hovering(), Order.CLEAR_ERRORS))
    assert commands.answers[0].reason == "CLEAR_ERRORS is not possible in state READY: STOW or RELEASE first"
