"""The last writes of an orderly end: waited for while a disk gets on with them, and given up when it is dead.

All threads that write are told to end first, and then waited for side by side. They mostly write to the same disk: one
that gets something done shows that it is alive, and the others have to wait for its bytes.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

STALL_S: Final = 2.0
"""A disk that has done nothing for so long is dead. A card that tidies up takes a second at most."""
MOST_S: Final = 6.0
"""So long may it take in all, however slowly the disk gets on: systemd gives the whole daemon ten seconds."""
_LOOK_S: Final = 0.05


@dataclass(frozen=True)
class Ending:
    """A thread that has been told to write what is left, and to end.

    Attributes:
        thread: ends by itself, unless the disk hangs.
        done: a number that grows with all that the thread gets done.
        tell: called in the end with whether the thread has ended, to say what is lost if not.
        patient: is waited for however long it takes.
    """

    thread: threading.Thread
    done: Callable[[], int]
    tell: Callable[[bool], None]
    patient: bool = False


def wait_for(endings: Sequence[Ending]) -> None:
    """Return when all have ended, when none has got anything done for `STALL_S`, or after `MOST_S`."""
    present: tuple[object, ...] = ()
    idle = taken = 0.0
    while alive := [ending for ending in endings if ending.thread.is_alive()]:
        before, present = present, tuple((ending.thread.ident, ending.done()) for ending in alive)
        idle = 0.0 if present != before else idle + _LOOK_S
        if (idle >= STALL_S or taken >= MOST_S) and not any(ending.patient for ending in alive):
            break
        alive[0].thread.join(_LOOK_S)  # which may be back sooner, and all the sooner it is seen
        taken += _LOOK_S
    for ending in endings:
        ending.tell(not ending.thread.is_alive())
