"""A thread that does one slow job after another, and keeps nobody from ending when a disk hangs.

Not a `ThreadPoolExecutor`: the interpreter waits for the threads of those without a limit.
"""

import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Final, ParamSpec, TypeVar

_log = logging.getLogger(__name__)

_CLOSE_WITHIN_S: Final = 2.0  # systemd gives the whole daemon ten
P = ParamSpec("P")
T = TypeVar("T")


class Writer:
    """Jobs in the order in which they come; the thread starts with the first."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> "Future[T]":
        """Do `work` soon; the future says what became of it."""
        future: Future[T] = Future()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()
        self._jobs.put(partial(_do, future, partial(work, *args, **kwargs)))
        return future

    def close(self, within_s: float = _CLOSE_WITHIN_S) -> None:
        """Do what is left, and end; give up on a job that hangs."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(within_s)
            if self._thread.is_alive():
                _log.error("%s: the disk does not answer; what is left to be written is lost", self._name)
            self._thread = None

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()


def _do(future: "Future[T]", work: Callable[[], T]) -> None:
    try:
        future.set_result(work())
    except BaseException as error:  # noqa: BLE001 - whoever waits gets it
        future.set_exception(error)
