"""A thread that does one slow job after another, and keeps nobody from ending when a disk hangs.

Not a `ThreadPoolExecutor`: the interpreter waits for the threads of those without a limit.
"""

import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import ParamSpec, TypeVar

from arm_companion.last_writes import Ending, wait_for

_log = logging.getLogger(__name__)

P = ParamSpec("P")
T = TypeVar("T")


class Writer:
    """Jobs in the order in which they come; the thread starts with the first."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._done = 0

    def submit(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> "Future[T]":
        """Do `work` soon; the future says what became of it."""
        future: Future[T] = Future()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()
        self._jobs.put(partial(_do, future, partial(work, *args, **kwargs)))
        return future

    def end(self) -> list[Ending]:
        """Have the thread do what is left and end; nothing waits here. What is to be waited for, if it ever started."""
        thread, self._thread = self._thread, None
        if thread is None:
            return []
        self._jobs.put(None)
        return [Ending(thread, lambda: self._done, self._tell)]

    def close(self) -> None:
        """Do what is left, and end; give up on a job that hangs."""
        wait_for(self.end())

    def _tell(self, ended: bool) -> None:
        if not ended:
            _log.error("%s: the disk does not answer; what is left to be written is lost", self._name)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
            self._done += 1


def _do(future: "Future[T]", work: Callable[[], T]) -> None:
    if not future.set_running_or_notify_cancel():  # whoever waited for it does so no more
        return
    try:
        future.set_result(work())
    except BaseException as error:  # noqa: BLE001 - whoever waits gets it
        future.set_exception(error)
