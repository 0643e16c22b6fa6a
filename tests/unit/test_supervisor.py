"""The daemon's life: notify socket, stop, and failures that end the whole group."""

import asyncio
import os
import signal
import socket
from pathlib import Path

import pytest

from arm_companion.supervisor import ServiceManager, run_until, stop_on_signals


def test_the_service_manager_hears_readiness_and_life(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(path))
        server.settimeout(1.0)
        manager = ServiceManager(str(path))
        manager.ready()
        manager.alive()
        manager.stopping()
        manager.close()
        assert [server.recv(64) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_an_abstract_notify_address_works() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(f"\0arm-companion-test-{os.getpid()}")
        server.settimeout(1.0)
        manager = ServiceManager(f"@arm-companion-test-{os.getpid()}")
        manager.ready()
        manager.close()
        assert server.recv(64) == b"READY=1"


def test_a_manager_that_is_gone_or_absent_is_survived(tmp_path: Path) -> None:
    for manager in (ServiceManager(str(tmp_path / "nobody")), ServiceManager("")):
        manager.alive()
        manager.close()


@pytest.mark.realtime
def test_sigterm_sets_the_stop() -> None:
    async def main() -> None:
        stop = asyncio.Event()
        restore = stop_on_signals(stop)
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            await asyncio.wait_for(stop.wait(), 2.0)
        finally:
            restore()

    asyncio.run(main())


def test_a_stop_ends_all_tasks_quietly_and_lets_them_clean_up() -> None:
    cleaned = []

    async def forever() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            cleaned.append(True)

    async def main() -> None:
        stop = asyncio.Event()
        asyncio.get_running_loop().call_later(0.01, stop.set)
        await run_until(stop, forever, forever)

    asyncio.run(main())
    assert cleaned == [True, True]


def test_a_task_that_fails_ends_the_others_and_is_told() -> None:
    async def forever() -> None:
        await asyncio.Event().wait()

    async def broken() -> None:
        raise OSError("no such device")

    async def main() -> None:
        await run_until(asyncio.Event(), forever, broken)

    with pytest.raises(ExceptionGroup) as caught:
        asyncio.run(main())
    assert caught.group_contains(OSError, match="no such device")
