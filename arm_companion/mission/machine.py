"""A state machine as data: rows of transitions, and one function that applies them.

No transition exists outside a table. Rows are tried from the first to the last, so abort rows, which come
first, win over progress. A row's guard returns the reason in words when it fires, and that reason is what the
log and the operator see.
"""

import enum
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

from arm_companion.mission.facts import ArmFault, Order, Severity

P = TypeVar("P", bound=enum.Enum)
S = TypeVar("S")


@dataclass(frozen=True)
class Transition(Generic[P, S]):
    """One row: from any of `sources` to `target` when `guard` gives a reason.

    Attributes:
        sources: phases in which the row is tried.
        guard: reason in words when the row fires, else None.
        target: phase that follows.
        label: what the generated diagram shows.
        error: cause of failure that the row stands for; the running command has failed by it.
    """

    sources: frozenset[P]
    guard: Callable[[S], str | None]
    target: P
    label: str
    error: ArmFault = ArmFault.NONE

    @property
    def fails(self) -> bool:
        """Whether the row is an abort."""
        return bool(self.error)


@dataclass(frozen=True)
class OrderRow(Generic[P, S]):
    """What an order from a person does: from any of `sources` to `target` unless `refusal` objects.

    Attributes:
        order: the order.
        sources: phases in which it is legal; elsewhere it is rejected and changes nothing.
        target: phase that follows at once.
        done: phases whose entry completes the order.
        refusal: reason in words to refuse now, else None.
    """

    order: Order
    sources: frozenset[P]
    target: P
    done: frozenset[P]
    refusal: Callable[[S], str | None] = lambda _: None


@dataclass(frozen=True)
class Warned(Generic[P, S]):
    """What is told once in a phase and changes nothing.

    Attributes:
        phases: in which it is told.
        guard: reason in words while it holds, else None.
        severity: of the notice.
        consequence: what follows, appended to the reason.
        error: cause that stays in ARM_STATUS when it held for a cycle only.
    """

    phases: frozenset[P]
    guard: Callable[[S], str | None]
    severity: Severity
    consequence: str = ""
    error: ArmFault = ArmFault.NONE


@dataclass(frozen=True)
class Table(Generic[P, S]):
    """All rows of one behaviour."""

    transitions: tuple[Transition[P, S], ...]
    orders: tuple[OrderRow[P, S], ...]

    @cached_property
    def _rows(self) -> dict[P, list[Transition[P, S]]]:
        """The rows of each phase, in their order; most are of others."""
        phases = frozenset[P]().union(*(row.sources for row in self.transitions))
        return {phase: [row for row in self.transitions if phase in row.sources] for phase in phases}

    def next(self, phase: P, situation: S) -> tuple[Transition[P, S], str] | None:
        """The first row that fires in `phase`, with its reason."""
        for row in self._rows.get(phase, ()):
            if (reason := row.guard(situation)) is not None:
                return row, reason
        return None

    def order(self, order: Order, phase: P) -> OrderRow[P, S] | None:
        """The row of an order that is legal in `phase`."""
        return next((r for r in self.orders if r.order is order and phase in r.sources), None)

    def known(self, order: Order) -> bool:
        """Whether this behaviour has the order at all."""
        return any(row.order is order for row in self.orders)


def mermaid(table: "Table[P, S]", phases: Iterable[P]) -> str:
    """The table as a Mermaid state diagram; aborts are marked with a cross, orders with their name."""
    order = list(phases)
    lines = [
        f"    {source.name} --> {row.target.name}: order {row.order.name}"
        for row in table.orders
        for source in order
        if source in row.sources and source is not row.target
    ]
    lines += [
        f"    {source.name} --> {row.target.name}: {'✗ ' if row.fails else ''}{row.label}"
        for row in table.transitions
        for source in order
        if source in row.sources
    ]
    return "\n".join(["stateDiagram-v2", *lines]) + "\n"
