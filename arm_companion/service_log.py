"""Log lines on standard error, with their levels for journald where that is who reads them.

systemd takes a line that begins with `<N>` as one of syslog's priority N (sd-daemon(3)). Without it all that a service
says has the same one, and `journalctl -p warning` is empty.
"""

import contextlib
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, TextIO

_FORMAT: Final = "%(levelname)s %(name)s: %(message)s"
_PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG: Final = 7


def priority(level: int) -> int:
    """Syslog's priority of a level of `logging`."""
    return next((number for least, number in _PRIORITIES if level >= least), _DEBUG)


class JournalFormatter(logging.Formatter):
    """Puts the priority before every line: those of a traceback would else be ordinary ones."""

    def format(self, record: logging.LogRecord) -> str:
        """The text of a record."""
        mark = f"<{priority(record.levelno)}>"
        return "\n".join(mark + line for line in super().format(record).splitlines())


def read_by_journald(stream: TextIO) -> bool:
    """Whether `stream` goes to journald: systemd names the device and inode that it has connected."""
    try:
        device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
        facts = os.fstat(stream.fileno())
        return (int(device), int(inode)) == (facts.st_dev, facts.st_ino)
    except (OSError, ValueError):
        return False


def log_to_stderr(*, verbose: bool) -> None:
    """Send the log to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter((JournalFormatter if read_by_journald(sys.stderr) else logging.Formatter)(_FORMAT))
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler])


@contextlib.contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Send the program's log to a file for a while: a daemon within a process that has a terminal for other things.

    Raises:
        OSError: the file cannot be written.
    """
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter(_FORMAT))
    log = logging.getLogger("arm_companion")
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(handler)
        handler.close()
