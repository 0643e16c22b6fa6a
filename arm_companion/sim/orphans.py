"""What this process starts ends with it, even when it is killed and can end nothing itself."""

import ctypes
import signal
from typing import Final

_PR_SET_PDEATHSIG: Final = 1
_PRCTL: Final = getattr(ctypes.CDLL(None), "prctl", None)  # found before a fork, after which as little as possible runs


def end_with_parent(number: int = signal.SIGTERM) -> None:
    """Ask the system for a signal when the thread that started this process ends (prctl(2)); without Linux, nothing.

    For a process that has just been started, such as in its `preexec_fn`: a parent that ended before is not noticed.

    Args:
        number: the signal.
    """
    if _PRCTL is not None:
        _PRCTL(_PR_SET_PDEATHSIG, int(number))
