"""The daemon's life: priority, readiness and watchdog for systemd, stop on SIGTERM, all under one TaskGroup."""

import asyncio
import contextlib
import ctypes
import logging
import os
import resource
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Iterator
from types import FrameType

log = logging.getLogger(__name__)


class ServiceManager:
    """The notify socket of systemd (sd_notify protocol); silent where there is none."""

    def __init__(self, address: str | None = None) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET") if address is None else address
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def notify(self, text: str) -> None:
        """Send one assignment such as `READY=1`; a manager that does not listen is not our trouble."""
        if self._socket is None or not self._address:
            return
        # a leading @ is an abstract socket, whose first byte is NUL
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto(text.encode(), address)
        except OSError as error:
            log.debug("service manager not reached: %s", error)

    def ready(self) -> None:
        """The daemon serves."""
        self.notify("READY=1")

    def alive(self) -> None:
        """One cycle completed: feed the watchdog."""
        self.notify("WATCHDOG=1")

    def stopping(self) -> None:
        """An orderly stop has begun."""
        self.notify("STOPPING=1")

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


_PRIORITY = 20  # below the kernel's interrupt threads, 50
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def take_priority() -> list[str]:
    """Real-time priority for the calling thread, and memory that stays, as far as the limits of this process allow.

    RLIMIT_RTPRIO and RLIMIT_MEMLOCK, which the systemd unit sets, decide; at a shell nothing is taken. Threads that
    are started later have the usual priority: writing a record is not urgent.

    Returns:
        What was taken, and what was allowed and failed all the same, in words for the log.
    """
    words = []
    priority = min(_PRIORITY, _limit(resource.RLIMIT_RTPRIO))
    if priority > 0:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
            words.append(f"real-time priority {priority}")
        except OSError as error:
            words.append(f"no real-time priority: {error.strerror}")
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        # with a limit that is not infinite, a later allocation would fail that would otherwise not
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0:
            words.append("memory locked")
        else:
            words.append(f"memory not locked: {os.strerror(ctypes.get_errno())}")
    return words


def _limit(which: int) -> int:
    soft = resource.getrlimit(which)[0]
    return 99 if soft == resource.RLIM_INFINITY else soft


def stop_on_signals(stop: asyncio.Event) -> Callable[[], None]:
    """Set `stop` on SIGTERM and SIGINT; returns what takes the handlers away again."""
    loop = asyncio.get_running_loop()
    caught = (signal.SIGTERM, signal.SIGINT)
    for number in caught:
        loop.add_signal_handler(number, stop.set)

    def restore() -> None:
        for number in caught:
            loop.remove_signal_handler(number)

    return restore


@contextlib.contextmanager
def ending_on_terminate() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end this process as Ctrl-C does, so that what it started ends too."""

    def leave(number: int, _frame: FrameType | None) -> None:
        logging.getLogger("asyncio").disabled = True  # tasks that this ends in their midst are no news
        sys.exit(128 + number)

    before = {number: signal.signal(number, leave) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _StopRequested(Exception):
    """Ends the TaskGroup from inside."""


async def run_until(stop: asyncio.Event, *tasks: Callable[[], Awaitable[None]]) -> None:
    """Run all tasks under one TaskGroup until `stop` is set or one of them fails.

    Raises:
        BaseExceptionGroup: what made a task fail; never the stop itself.
    """

    async def wait_for_stop() -> None:
        await stop.wait()
        raise _StopRequested

    async def run(task: Callable[[], Awaitable[None]]) -> None:
        await task()

    try:
        async with asyncio.TaskGroup() as group:
            for task in tasks:
                group.create_task(run(task))
            group.create_task(wait_for_stop())
    except* _StopRequested:
        pass
