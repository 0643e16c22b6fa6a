"""Laws of the perch's transition table, read from the table itself."""

from pathlib import Path

import pytest

from arm_companion.mission.diagram import document
from arm_companion.mission.facts import ArmFault, ArmFlag, Order
from arm_companion.mission.machine import mermaid
from arm_companion.mission.mission import SAFE_ACTION
from arm_companion.mission.perch import GRASPING, GRIPPED, TABLE
from arm_companion.mission.sharing import SUSPENDED
from arm_companion.mission.state import MOVES_VEHICLE, Phase
from arm_companion.protocol.dialect import mav


def edges() -> set[tuple[Phase, Phase]]:
    steps = {(source, row.target) for row in TABLE.transitions for source in row.sources}
    return steps | {(source, row.target) for row in TABLE.orders for source in row.sources}


def reachable(start: Phase) -> set[Phase]:
    seen, todo = {start}, [start]
    while todo:
        here = todo.pop()
        for source, target in edges():
            if source is here and target not in seen:
                seen.add(target)
                todo.append(target)
    return seen


def test_every_phase_is_reachable_from_the_start() -> None:
    assert reachable(Phase.STARTUP) == set(Phase)


@pytest.mark.parametrize("phase", list(Phase))
def test_every_phase_leads_back_to_stowed(phase: Phase) -> None:
    assert Phase.STOWED in reachable(phase)


@pytest.mark.parametrize("phase", list(Phase))
def test_an_abort_is_legal_in_every_phase(phase: Phase) -> None:
    assert TABLE.order(Order.ABORT, phase) is not None


@pytest.mark.parametrize("phase", sorted(MOVES_VEHICLE, key=lambda p: p.value))
def test_every_phase_that_flies_ends_by_itself_in_time(phase: Phase) -> None:
    limited = {source for row in TABLE.transitions if "time limit" in row.label for source in row.sources}
    limited |= {Phase.REACH}  # its time limit is the search for contact
    if phase not in {Phase.PERCHED, Phase.HANGING, Phase.CARRY, Phase.TIP_HOLD}:  # held until told
        assert phase in limited


@pytest.mark.parametrize("phase", sorted(GRASPING | GRIPPED, key=lambda p: p.value))
def test_a_gripping_arm_never_stows_or_departs_without_letting_go_first(phase: Phase) -> None:
    assert not {target for source, target in edges() if source is phase} & {
        Phase.STOWING,
        Phase.STOWED,
        Phase.DEPART,
    }


@pytest.mark.parametrize("phase", sorted(SUSPENDED, key=lambda p: p.value))
def test_an_arm_that_may_carry_the_vehicle_leaves_through_the_motors_alone(phase: Phase) -> None:
    after = {target for source, target in edges() if source is phase} - SUSPENDED
    # CLEAR_ERRORS leads to STOWED, of an arm alone that holds nothing: the law in `check_cleared`
    assert after == {Phase.TAKE_BACK: {Phase.UNLOAD}, Phase.HANG_HOLD: {Phase.STOWED}}.get(phase, set())
    assert not any(row.fails for row in TABLE.transitions if phase in row.sources and row.target not in SUSPENDED), (
        "it is opened by what the motors do, never by a failure"
    )


def test_abort_rows_come_before_progress() -> None:
    first_progress = next(i for i, row in enumerate(TABLE.transitions) if not row.fails)
    late = [
        row
        for row in TABLE.transitions[first_progress:]
        if row.error in (ArmFault.PILOT_TOOK_OVER, ArmFault.SERVO_FAULT)
    ]
    assert late == []


def test_every_phase_has_a_safe_action() -> None:
    assert set(SAFE_ACTION) == set(Phase)


def test_the_diagram_shows_every_edge_of_the_table() -> None:
    lines = mermaid(TABLE, Phase).splitlines()
    assert lines[0] == "stateDiagram-v2"
    shown = {tuple(line.split(":")[0].split(" --> ")) for line in (raw.strip() for raw in lines[1:])}
    assert shown == {(a.name, b.name) for a, b in edges() if a is not b}


@pytest.mark.parametrize(("ours", "prefix"), [(ArmFlag, "ARM_FLAG_"), (ArmFault, "ARM_ERROR_")])
def test_bits_are_those_of_the_dialect(ours: type[ArmFlag] | type[ArmFault], prefix: str) -> None:
    for member in ours:
        assert getattr(mav, prefix + member.name) == member.value


def test_phase_numbers_are_those_of_the_dialect() -> None:
    for phase in Phase:
        assert getattr(mav, f"ARM_STATE_{phase.name}") == phase.value


def test_the_committed_diagram_is_the_table() -> None:
    page = Path(__file__).parents[2] / "docs" / "perch_states.md"
    assert page.read_text(encoding="utf-8") == document(), (
        "python -m arm_companion.mission.diagram > docs/perch_states.md"
    )
