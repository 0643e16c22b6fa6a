"""The MAVLink ports of a real flight stack in simulated time: UDP on its side, pipes of the simulated loop on ours."""

import contextlib
import socket
from collections.abc import Sequence
from functools import partial

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Transport

_LOOPBACK = "127.0.0.1"


class Relay:
    """The ports, read when the flight stack has had its turn.

    Args:
        ports: that the flight stack sends to; one for each pipe.

    Raises:
        LinkError: a port is taken.
    """

    def __init__(self, ports: Sequence[int]) -> None:
        self._sockets: list[socket.socket] = []
        self._peers: list[tuple[str, int] | None] = [None] * len(ports)
        self._ends: list[Transport | None] = [None] * len(ports)
        for port in ports:
            plain = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._sockets.append(plain)
            plain.setblocking(False)
            try:
                plain.bind((_LOOPBACK, port))
            except OSError as error:
                self.close()
                raise LinkError(f"UDP port {port} for the flight stack's MAVLink: {error.strerror}") from error

    def close(self) -> None:
        """Leave the ports."""
        for plain in self._sockets:
            plain.close()

    async def connect(self, openers: Sequence[Opener]) -> None:
        """Open the pipes."""
        for i, opener in enumerate(openers):
            self._ends[i] = await opener(partial(self._out, i))

    def poll(self) -> None:
        """Take in what the flight stack has sent."""
        for i, (plain, end) in enumerate(zip(self._sockets, self._ends, strict=True)):
            while True:
                try:
                    data, self._peers[i] = plain.recvfrom(65_536)
                except OSError:  # nothing more
                    break
                if end is not None:
                    end.write(data)

    def _out(self, i: int, data: bytes) -> None:
        peer = self._peers[i]
        if peer is not None:
            with contextlib.suppress(OSError):  # a flight stack that boots is not there for a while
                self._sockets[i].sendto(data, peer)
