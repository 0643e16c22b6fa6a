"""A serial device that goes while it is opened: what pyserial passes on from termios is no OSError."""

import asyncio
import os
import pty
import termios
from pathlib import Path

import pytest

from arm_companion.errors import LinkError
from arm_companion.transport.serial import open_serial


async def opening(device: str) -> None:
    await open_serial(device, 115_200)(lambda _: None)


@pytest.mark.parametrize(
    ("call", "good"), [("tcsetattr", 0), ("tcflush", 0), ("tcflush", 1)], ids=["configuring", "flushing", "afterwards"]
)
def test_a_plug_that_bounces_while_the_device_is_opened_is_a_link_error(
    call: str, good: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the calls of one kind the first `good` succeed, and then the device is gone."""
    real, calls = getattr(termios, call), 0

    def gone(*arguments: int) -> None:
        nonlocal calls
        calls += 1
        if calls > good:
            raise termios.error(5, "Input/output error")
        real(*arguments)

    master, slave = pty.openpty()
    try:
        before = set(Path("/proc/self/fd").iterdir())
        monkeypatch.setattr(termios, call, gone)
        with pytest.raises(LinkError, match="Input/output error"):
            asyncio.run(opening(os.ttyname(slave)))
        assert calls == good + 1
        assert set(Path("/proc/self/fd").iterdir()) == before, "a descriptor is left open"
    finally:
        os.close(master)
        os.close(slave)
