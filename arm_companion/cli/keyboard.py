"""A terminal whose keys arrive one by one, given back as it was whatever happens.

The loop that drives the arm shows its screen in between, so nothing here waits for the terminal: Ctrl-S or a link that
stalls costs pictures, and not the cycles that keep the servos' watchdogs content.
"""

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

_OPEN_SCREEN, _CLOSE_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
_HOME, _TO_END_OF_LINE, _TO_END = "\x1b[H", "\x1b[K", "\x1b[J"


class Keyboard:
    """Keys from one descriptor, a screen on another.

    Use as a context manager on a running loop. Ctrl-C stays a signal.

    Args:
        keys: descriptor of the terminal's input.
        display: descriptor of its output.
        receiver: takes what is typed; empty bytes when the terminal is gone.
    """

    def __init__(self, keys: int, display: int, receiver: Callable[[bytes], None]) -> None:
        self._keys = keys
        self._display = display
        self._receiver = receiver
        self._before: list[Any] | None = None

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._keys)
        tty.setcbreak(self._keys)
        mode = termios.tcgetattr(self._keys)
        mode[0] &= ~termios.IXON  # Ctrl-S is a key like others
        termios.tcsetattr(self._keys, termios.TCSANOW, mode)
        self._display = _unblocked(self._display)
        asyncio.get_running_loop().add_reader(self._keys, self._read)
        self._write(_OPEN_SCREEN)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._keys)
        self._write(_CLOSE_SCREEN)
        os.close(self._display)
        if self._before is not None:
            with contextlib.suppress(OSError, termios.error):  # the terminal may be gone
                termios.tcsetattr(self._keys, termios.TCSANOW, self._before)  # whatever it has not shown yet

    def show(self, text: str) -> None:
        """Replace what the screen shows."""
        lines = text.replace("\n", _TO_END_OF_LINE + "\r\n")
        self._write(_HOME + lines + _TO_END_OF_LINE + _TO_END)

    def _read(self) -> None:
        try:
            data = os.read(self._keys, 256)
        except OSError:  # hung up
            data = b""
        if not data:
            asyncio.get_running_loop().remove_reader(self._keys)
        self._receiver(data)

    def _write(self, text: str) -> None:
        try:
            os.write(self._display, text.encode())
        except BlockingIOError:
            pass  # a slow terminal misses a picture
        except OSError:
            self._receiver(b"")


def _unblocked(display: int) -> int:
    """Another descriptor of a terminal, whose writes do not wait; the mode of the given one is the shell's too."""
    try:
        return os.open(os.ttyname(display), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:  # of another user, or without a name here
        return os.dup(display)
