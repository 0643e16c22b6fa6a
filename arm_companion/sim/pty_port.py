"""A pseudo-terminal that stands at a path of its own, like the device of a serial adapter.

The path is a symbolic link to the terminal's slave side. A lock beside it tells a simulation that is alive
from what a dead one left behind: a stale link is replaced, a living one is an error, and anything that is not
a link is never touched.
"""

import asyncio
import contextlib
import errno
import fcntl
import os
import struct
import tty
from pathlib import Path

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

_READ_SIZE = 4096
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("4I20x2I")  # flags, line discipline and characters, speeds as numbers


class PtyTransport:
    """Master side of a pseudo-terminal.

    The slave side is kept open too, so that the other program may close and open the device as it likes.
    """

    def __init__(self, path: Path, receiver: Receiver) -> None:
        """Make the terminal and the link to it.

        Raises:
            LinkError: when the path is taken, or cannot be made.
        """
        self.dropped = 0
        self._path = path
        self._receiver = receiver
        self._closed = asyncio.Event()
        with contextlib.ExitStack() as undo:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._lock = _take_lock(path)
                undo.callback(os.close, self._lock)
                self._master, self._slave = os.openpty()
                undo.callback(os.close, self._slave)
                undo.callback(os.close, self._master)
                tty.setraw(self._slave)
                os.set_blocking(self._master, False)
                self._target = os.ttyname(self._slave)
                _link(path, self._target)
            except OSError as error:
                raise LinkError(f"cannot serve a serial port at {path}: {error}") from error
            undo.pop_all()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._master, self._read)

    @property
    def baud(self) -> int:
        """Bits per second that the other side has set."""
        settings = fcntl.ioctl(self._slave, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(settings)[-1])

    def write(self, data: bytes) -> None:
        """Send; what does not fit because nobody reads is dropped and counted."""
        if self._closed.is_set():
            return
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        except OSError:
            self.close()
            return
        if sent < len(data):
            self.dropped += 1

    def close(self) -> None:
        """Remove the link and the terminal; whoever has it open sees it hang up."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._loop.remove_reader(self._master)
        with contextlib.suppress(OSError):
            if self._path.readlink() == Path(self._target):
                self._path.unlink()
        with contextlib.suppress(OSError):
            _lock_path(self._path).unlink()
        for descriptor in (self._master, self._slave, self._lock):
            os.close(descriptor)

    async def wait_closed(self) -> None:
        """Return once it is closed."""
        await self._closed.wait()

    def _read(self) -> None:
        try:
            data = os.read(self._master, _READ_SIZE)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        if data:
            self._receiver(data)


def pty_opener(path: str | Path) -> Opener:
    """An `Opener` of the device's end of a serial line whose other end programs open at `path`."""

    async def open_port(receiver: Receiver) -> PtyTransport:
        return PtyTransport(Path(path), receiver)

    return open_port


def _lock_path(path: Path) -> Path:
    return path.with_name(path.name + ".lock")


def _take_lock(path: Path) -> int:
    """Descriptor of the locked lock file.

    Raises:
        LinkError: when another simulation holds it.
    """
    lock_path = _lock_path(path)
    while True:
        descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            if error.errno not in {errno.EAGAIN, errno.EACCES}:
                raise
            raise LinkError(f"another simulation is running on {path}") from None
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(descriptor).st_ino == lock_path.stat().st_ino:
                return descriptor
        os.close(descriptor)  # its last owner removed it in the meantime: try the new one


def _link(path: Path, target: str) -> None:
    """Point `path` at `target` in one step.

    Raises:
        LinkError: when something that is not a link stands there.
    """
    if os.path.lexists(path) and not path.is_symlink():
        raise LinkError(f"{path} exists and is no simulated port")
    fresh = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        fresh.unlink()
    fresh.symlink_to(target)
    fresh.replace(path)
