"""A process beside the daemon for what strangers may make work: the broker's client, the field page, the live view.

The daemon's side is a bounded queue that drops its oldest entry, and two pipes. Neither the interpreter's lock nor the
memory of the flight program is the process's to use up. It runs at ordinary priority, and is started again when it
ends. Lines of JSON pass: the settings first, then `[topic, payload]`; back come `[kind, text]`. `side_child` is
its end.
"""

import asyncio
import contextlib
import json
import logging
import os
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

log = logging.getLogger(__name__)

_FIRST_DELAY_S: Final = 1.0
_LONGEST_DELAY_S: Final = 60.0
_STEADY_S: Final = 60.0  # a process that lived so long is started again soon
_END_WITHIN_S: Final = 2.0
_LINE_LIMIT: Final = 16_384


class Entry(NamedTuple):
    """One message for the process."""

    topic: str
    payload: bytes


class SideProcess:
    """Keeps one process alive and feeds it.

    Args:
        name: of what it is, for the log.
        module: that is run, as with `python -m`.
        settings: its first line, ready for JSON.
        queue_length: entries that may wait.
        hear: takes kind and text of each line that comes back; "log" goes to the log by itself.
    """

    def __init__(
        self,
        name: str,
        module: str,
        settings: Mapping[str, Any],
        queue_length: int,
        hear: Callable[[str, str], None] = lambda _kind, _text: None,
    ) -> None:
        self.dropped = 0
        """Entries that were dropped from the queue."""
        self.malformed = 0
        """Lines of the process that were no messages."""
        self._name = name
        self._module = module
        self._settings = settings
        self._hear = hear
        self._queue: deque[Entry] = deque(maxlen=queue_length)
        self._filled = asyncio.Event()
        self._failed = False

    def put(self, topic: str, payload: bytes) -> None:
        """Queue a message; the oldest is dropped when too many wait."""
        if len(self._queue) == self._queue.maxlen:
            self.dropped += 1
        self._queue.append(Entry(topic, payload))
        self._filled.set()

    def take(self) -> Entry | None:
        """The oldest message that waits."""
        return self._queue.popleft() if self._queue else None

    def safely(self, work: Callable[[], None]) -> None:
        """Make messages; what fails in that never costs a cycle, and is told once."""
        try:
            work()
        except Exception:
            if not self._failed:
                log.exception("%s: telemetry failed; further failures are not told", self._name)
            self._failed = True

    async def run(self) -> None:
        """Keep the process alive, until cancelled."""
        delay = _FIRST_DELAY_S
        loop = asyncio.get_running_loop()
        while True:
            started = loop.time()
            try:
                code = await self._serve()
                log.warning("%s: its process ended with code %s", self._name, code)
            except (OSError, ValueError) as error:
                log.warning("%s: its process failed: %s", self._name, error)
            self._hear("gone", "")
            delay = _FIRST_DELAY_S if loop.time() - started > _STEADY_S else min(2.0 * delay, _LONGEST_DELAY_S)
            await asyncio.sleep(delay)

    async def _serve(self) -> int | None:
        """One life of the process; its exit code."""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", self._module,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=_LINE_LIMIT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        tasks: Sequence[asyncio.Task[None]] = ()
        try:
            if process.stdin is None or process.stdout is None:
                return None
            process.stdin.write(json.dumps(self._settings).encode() + b"\n")
            tasks = (
                asyncio.create_task(self._feed(process.stdin)),
                asyncio.create_task(self._listen(process.stdout)),
            )
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await _end(process)
        return process.returncode

    async def _feed(self, pipe: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await self._filled.wait()
                self._filled.clear()
                while (entry := self.take()) is not None:
                    pipe.write(json.dumps([entry.topic, entry.payload.decode()]).encode() + b"\n")
                    await pipe.drain()

    async def _listen(self, pipe: asyncio.StreamReader) -> None:
        while line := await pipe.readline():
            match _read(line):
                case None:
                    self.malformed += 1
                    if self.malformed == 1:
                        log.warning("%s: its process says what is no message: %.80r", self._name, line)
                case ["log", text]:
                    log.info("%s: %s", self._name, text)
                case [kind, text]:
                    self._hear(kind, text)


def _read(line: bytes) -> list[str] | None:
    """Kind and text of a line; None: it is none of ours, such as what a library prints."""
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return said if isinstance(said, list) and len(said) == 2 and all(isinstance(word, str) for word in said) else None


async def _end(process: asyncio.subprocess.Process) -> None:
    """Let the process say goodbye; its end of input asks it to."""
    if process.stdin is not None:
        process.stdin.close()
    try:
        async with asyncio.timeout(_END_WITHIN_S):
            await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
