"""Small files that must survive a power cut, written by a thread of their own: a slow disk costs nobody's time."""

import contextlib
import logging
import os
import queue
import threading
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

_CLOSE_WITHIN_S: Final = 5.0


class Keeper:
    """Writes files, of each the newest content."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[Path, bytes] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def put(self, file: Path, data: bytes) -> None:
        """Write `data` to `file` soon; an error is logged, and the old file is left."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name="keeper", daemon=True)
            self._thread.start()
        self._queue.put((file, data))

    def close(self) -> None:
        """Write what is left and stop; give up on a disk that hangs."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join(_CLOSE_WITHIN_S)
            self._thread = None

    def _write(self) -> None:
        ended = False
        while not ended:
            newest: dict[Path, bytes] = {}
            item = self._queue.get()
            while True:
                if item is None:
                    ended = True
                    break
                newest[item[0]] = item[1]
                try:
                    item = self._queue.get_nowait()
                except queue.Empty:
                    break
            for file, data in newest.items():
                try:
                    write_atomically(file, data)
                except OSError as error:
                    log.error("%s is not kept: %s", file, error)  # noqa: TRY400 - the error says it all


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
