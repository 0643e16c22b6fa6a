"""The daemon's life: readiness and watchdog for systemd, stop on SIGTERM, everything under one TaskGroup."""

import asyncio
import logging
import os
import signal
import socket
from collections.abc import Awaitable, Callable

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
