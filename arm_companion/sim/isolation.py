"""A network of its own for this process and what it starts: real SITLs listen on every address of the machine.

A network namespace (Linux, `unshare(2)`) has nothing but a loopback of its own. The process enters it before anything
opens a socket; everything it starts afterwards is inside as well, and from outside no port of theirs can be reached.
"""

import contextlib
import ctypes
import fcntl
import os
import socket
import struct
from pathlib import Path

from arm_companion.errors import ArmError

_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000  # linux/sched.h
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 1  # linux/sockios.h, linux/if.h


class NotIsolated(ArmError):
    """This machine does not let the process have a network of its own."""


def isolate() -> None:
    """Leave this machine's network for one with a loopback alone. There is no way back.

    As root, or with CAP_SYS_ADMIN, the network namespace is enough; other users get it within a user namespace, where
    the system allows these. That needs a process that has started no thread yet.

    Raises:
        NotIsolated: with the system's reason; the process is where it was.
    """
    try:
        _unshare(_CLONE_NEWNET)
    except PermissionError:
        user, group = os.getuid(), os.getgid()
        try:
            _unshare(_CLONE_NEWUSER | _CLONE_NEWNET)
        except OSError as error:
            raise NotIsolated(f"no network of its own: {error.strerror}") from error
        with contextlib.suppress(OSError):  # who we are outside is of no matter to the network
            Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
            Path("/proc/self/uid_map").write_text(f"{user} {user} 1", encoding="ascii")
            Path("/proc/self/gid_map").write_text(f"{group} {group} 1", encoding="ascii")
    except (OSError, AttributeError) as error:  # AttributeError: no Linux
        raise NotIsolated(f"no network of its own: {error}") from error
    _raise_loopback()


def _unshare(flags: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(flags) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _raise_loopback() -> None:
    """Bring `lo` up, which is down in a new network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        request = struct.pack("16sh14x", b"lo", 0)
        (flags,) = struct.unpack_from("16xh", fcntl.ioctl(any_socket, _SIOCGIFFLAGS, request))
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", flags | _IFF_UP))
