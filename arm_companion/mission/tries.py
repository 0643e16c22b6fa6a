"""A try at a bar or an object that comes to nothing, and the next one (docs/adr/0035).

What a try shows to be no hazard, only bad luck, does not fail the order yet: the arm lets go, the vehicle goes back to
the stand-off, and from there sets out again. Everything else ends the order at once, as do a person, a pilot and any
fault on the way back.
"""

from collections.abc import Callable

from arm_companion.mission.facts import ArmFault, Order
from arm_companion.mission.machine import Transition
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, Running

Row = Transition[Phase, Situation]
Guard = Callable[[Situation], str | None]

SETS_OUT = frozenset({Order.PERCH, Order.GRASP})
_GIVEN_UP = frozenset({Phase.STOWING, Phase.STOWED, Phase.HOLDING})


def or_fail(phase: Phase, guard: Guard, target: Phase, label: str, error: ArmFault) -> tuple[Row, Row]:
    """The rows of a try that came to nothing: another follows, or the order has failed."""

    def another(s: Situation) -> str | None:
        most = s.config.perch.attempts
        if not setting_out(s) or s.state.tries >= most or (reason := guard(s)) is None:
            return None
        return f"{reason}; another try follows, {s.state.tries + 1} of {most}"

    sources = frozenset({phase})
    return Row(sources, another, target, f"{label}, another try"), Row(sources, guard, target, label, error)


def setting_out(s: Situation) -> bool:
    """Whether someone still waits for a perch or a grasp: nothing has failed it, nobody has ended it."""
    return s.state.running is not None and s.state.running.order in SETS_OUT


def given_up(running: Running, phase: Phase) -> bool:
    """Whether a perch or a grasp has ended without success, on a way that is no fault."""
    return running.order in SETS_OUT and phase in _GIVEN_UP
