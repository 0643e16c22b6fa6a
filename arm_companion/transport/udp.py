"""UDP sockets as byte pipes: one that calls out, and one that waits and answers whoever spoke last."""

import asyncio
from typing import Any, cast

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

Address = tuple[Any, ...]


class UdpTransport(asyncio.DatagramProtocol):
    """One open socket. `peer` is where `write` goes; without a peer there is nobody to send to.

    Args:
        receiver: takes every datagram.
        learns: whether the sender of the newest datagram becomes the peer (a waiting socket), or the socket
            is connected and has only one (a calling socket).
    """

    def __init__(self, receiver: Receiver, *, learns: bool) -> None:
        self._receiver = receiver
        self._learns = learns
        self._socket: asyncio.DatagramTransport | None = None
        self._closed = asyncio.Event()
        self._full = False
        self.peer: Address | None = None
        self.dropped = 0
        self.refused = 0
        """Times that the network said that nobody listens at the other end."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The socket is open (called by asyncio)."""
        self._socket = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """Hand a datagram on and remember who sent it."""
        if self._learns:
            self.peer = addr
        self._receiver(data)

    def error_received(self, exc: Exception) -> None:  # noqa: ARG002 - asyncio's signature
        """Survive what ICMP reports: a peer that is not there yet may come."""
        self.refused += 1

    def pause_writing(self) -> None:
        """The kernel takes no more and enough waits here already: drop until it does."""
        self._full = True

    def resume_writing(self) -> None:
        """The kernel takes data again."""
        self._full = False

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's signature
        """The socket is gone."""
        self._closed.set()

    @property
    def local(self) -> Address:
        """Address that the socket is bound to."""
        address: Address = () if self._socket is None else self._socket.get_extra_info("sockname")
        return address

    def write(self, data: bytes) -> None:
        """Send `data` as one datagram; dropped and counted when there is no peer or the kernel is full."""
        if self._socket is None or self._socket.is_closing() or not data:
            return
        if self._full or (self._learns and self.peer is None):
            self.dropped += 1
            return
        self._socket.sendto(data, self.peer if self._learns else None)

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()

    async def wait_closed(self) -> None:
        """Return once the socket is gone."""
        await self._closed.wait()


def udp_in(host: str, port: int) -> Opener:
    """An `Opener` for a socket bound to host and port, that sends to whoever spoke last."""

    async def open_socket(receiver: Receiver) -> UdpTransport:
        loop = asyncio.get_running_loop()
        try:
            _, pipe = await loop.create_datagram_endpoint(
                lambda: UdpTransport(receiver, learns=True), local_addr=(host, port)
            )
        except OSError as error:
            raise LinkError(f"cannot listen on udp {host}:{port}: {error}") from error
        return pipe

    return open_socket


def udp_out(host: str, port: int) -> Opener:
    """An `Opener` for a socket that sends to host and port and hears only them."""

    async def open_socket(receiver: Receiver) -> UdpTransport:
        loop = asyncio.get_running_loop()
        try:
            _, pipe = await loop.create_datagram_endpoint(
                lambda: UdpTransport(receiver, learns=False), remote_addr=(host, port)
            )
        except OSError as error:
            raise LinkError(f"cannot reach udp {host}:{port}: {error}") from error
        return pipe

    return open_socket
