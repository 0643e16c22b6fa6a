"""The compiled rod (extra `fast`) for programs that must not wait for a compiler.

Compiling takes the better part of a minute; numba keeps what it made in a cache on disk, and loading that takes a
second. The daemon loads it at its start, or flies on NumPy: it never compiles. `arm-companion model warm` does.
Importing this module imports no numba.
"""

import importlib.util
from contextlib import nullcontext
from typing import Any

from arm_companion.errors import ArmError


class NotCompiled(ArmError):
    """The compiled rod cannot be had without what was not allowed; the message says why."""


def installed() -> bool:
    """Whether the extra `fast` is there."""
    return importlib.util.find_spec("numba") is not None


def load(*, compiling: bool) -> str:
    """Make `RodModel(..., fast=True)` ready; blocks for a second when cached, for a minute when it compiles.

    Args:
        compiling: whether what is not in numba's cache may be compiled now.

    Returns:
        Where numba keeps the compiled code.

    Raises:
        NotCompiled: numba is not installed, has no place for a cache, or may not compile what its cache lacks.
    """
    if not installed():
        raise NotCompiled("numba is not installed (extra 'fast')")
    try:
        with nullcontext() if compiling else _only_from_cache():
            from arm_companion.arm import fast_newton  # noqa: PLC0415 - numba is optional, and slow to import
    except ImportError as error:
        raise NotCompiled(f"numba cannot be used: {error}") from error
    except RuntimeError as error:  # numba finds no directory that it may write to
        raise NotCompiled(f"{error} (NUMBA_CACHE_DIR names one)") from error
    return str(fast_newton.newton.stats.cache_path)


def _only_from_cache() -> Any:
    """While it is entered numba compiles nothing: an attempt raises `NotCompiled`."""
    from numba.core import event  # noqa: PLC0415 - see above

    class Refuse(event.Listener):
        def on_start(self, _: Any) -> None:
            raise NotCompiled("not in numba's cache: `arm-companion model warm` compiles it")

        def on_end(self, _: Any) -> None:
            pass

    return event.install_listener("numba:compile", Refuse())
