"""Small files that must survive a power cut, written by a thread of their own: a slow disk costs nobody's time."""

import contextlib
import logging
import os
from collections import deque
from pathlib import Path

from arm_companion.drivers.writer import Writer
from arm_companion.last_writes import Ending

log = logging.getLogger(__name__)


class Keeper:
    """Writes files, of each the newest content."""

    def __init__(self) -> None:
        self._newest: dict[Path, bytes] = {}  # only the thread takes out of it
        self._unkept: set[Path] = set()
        self._troubles: deque[str] = deque()
        self._writer = Writer("keeper")

    def put(self, file: Path, data: bytes) -> None:
        """Write `data` to `file` soon; an error is logged and told, and the old file is left."""
        self._newest[file] = data
        self._writer.submit(self._write)

    def troubles(self) -> list[str]:
        """What people should know: of each file once that it is not kept, until it is."""
        return [self._troubles.popleft() for _ in range(len(self._troubles))]

    def end(self) -> list[Ending]:
        """Have what is left written, and stop; nothing waits here."""
        return self._writer.end()

    def close(self) -> None:
        """Write what is left and stop; give up on a disk that hangs."""
        self._writer.close()

    def _write(self) -> None:
        """One file: at the end it shows that the disk gets on."""
        if self._newest:
            file, data = self._newest.popitem()
            try:
                write_atomically(file, data)
            except OSError as error:
                log.error("%s is not kept: %s", file, error)  # noqa: TRY400 - the error says it all
                if file not in self._unkept:
                    self._troubles.append(f"{file.name} is not kept: {error.strerror or error}")
                self._unkept.add(file)
            else:
                self._unkept.discard(file)


def write_atomically(file: Path, data: bytes) -> None:
    """Replace a file's content so that a power cut leaves the old one or the new one.

    Raises:
        OSError: the disk does not take it; the old file is left then.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    folder = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
