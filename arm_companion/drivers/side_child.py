"""The other end of `side_process`, for the process itself: lines in, lines out, and modest demands on the machine."""

import asyncio
import contextlib
import json
import os
import resource
import signal
import sys
from collections.abc import Awaitable, Callable
from typing import Any, Final

_LINE_LIMIT: Final = 1 << 20
_END_WITHIN_S: Final = 5.0

Take = Callable[[str, str], None]
"""Takes topic and payload of one message."""
Body = Callable[[dict[str, Any]], tuple[Take, Awaitable[None]]]
"""Of the settings: what takes the daemon's messages, and the work that goes on meanwhile."""


def tell(kind: str, text: str) -> None:
    """One line for the daemon; when that is gone, we soon are, too."""
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.write(json.dumps([kind, text]) + "\n")
        sys.stdout.flush()


def run(body: Body, most_memory: int) -> None:
    """Serve until standard input ends or SIGTERM comes.

    A terminal sends Ctrl-C to all processes at once. The daemon acts on it, and closes our input when it has said all.

    Args:
        body: what this process is for.
        most_memory: bytes of data that it may have.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError, ValueError):  # the unit's system calls may lack it
        resource.setrlimit(resource.RLIMIT_DATA, (most_memory, most_memory))
    with contextlib.suppress(OSError):
        os.nice(5)
    asyncio.run(_main(body))


async def _main(body: Body) -> None:
    lines = await _standard_input()
    take, working = body(json.loads(await lines.readline() or "{}"))

    async def read() -> None:
        while line := await lines.readline():
            take(*json.loads(line))

    tasks = (asyncio.ensure_future(working), asyncio.create_task(read()))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, tasks[0].cancel)
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    # The kernel's own alarm: a task may not heed its end, and the interpreter waits for every thread, such as one that
    # looks a name up. A daemon that was killed cannot kill us.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, _END_WITHIN_S)
    for task in tasks:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def _standard_input() -> asyncio.StreamReader:
    reader = asyncio.StreamReader(limit=_LINE_LIMIT)
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    return reader
