"""A serial device that goes while it is opened: what pyserial passes on from termios is no OSError."""

import asyncio
import contextlib
import os
import pty
import termios
import tty
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


def test_an_overflow_drops_whole_chunks_and_never_the_rest_of_one_that_has_begun() -> None:
    """Half a frame on the line spoils the frame behind it, too, and is counted as one."""
    size = 63  # of which no whole number fits into the kernel's buffer

    async def main() -> None:
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        port = await open_serial(os.ttyname(slave), 115_200)(lambda _: None)
        got = b""

        def read() -> None:
            nonlocal got
            with contextlib.suppress(BlockingIOError):
                got += os.read(master, 4096)

        for first in (0, 1000):  # the second time chunks wait already when one of them is cut
            for i in range(first, first + 600):
                port.write(b"%04d" % i * (size // 4) + b"end")
            for _ in range(50):
                read()
                await asyncio.sleep(0.001)
        port.close()
        os.close(master)
        os.close(slave)
        chunks = [got[at : at + size] for at in range(0, len(got), size)]
        assert all(chunk == chunk[:4] * (size // 4) + b"end" for chunk in chunks)
        assert len(chunks) == 1200 - port.dropped
        assert port.dropped > 100

    asyncio.run(main())
