"""UDP sockets as byte pipes: one that calls out, one that waits and answers who speaks to it, one that broadcasts."""

import asyncio
import logging
import socket
from collections.abc import Callable
from typing import Any, cast

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

_log = logging.getLogger(__name__)

Address = tuple[Any, ...]

MOST_PEERS = 8
"""A waiting socket answers so many; a further one takes the place of who has been silent for longest."""

PEER_SILENCE_S = 10.0
"""A peer that has been silent for this long is not written to any more, unless it is the only one."""

LOOK_EVERY_S = 1.0
"""How often a calling socket that cannot send looks whether a new one would have another address."""

_MOST_AT_ONCE = 64
_LARGEST = 65_536


class UdpTransport(asyncio.DatagramProtocol):
    """One open socket.

    Args:
        plain: the socket below asyncio's transport.
        receiver: takes every datagram.
        learns: whether `write` goes to everybody who has spoken lately (a waiting socket), so that it has nobody
            to send to before somebody has. A calling socket is connected and has only one.
        broadcast: where `write` goes instead.
    """

    def __init__(
        self, plain: socket.socket, receiver: Receiver, *, learns: bool = False, broadcast: Address | None = None
    ) -> None:
        self._plain = plain
        self._receiver = receiver
        self._learns = learns
        self._broadcast = broadcast
        self._socket: asyncio.DatagramTransport | None = None
        self._closed = asyncio.Event()
        self._full = False
        self._peers: dict[Address, float] = {}  # loop time at which each spoke last, the newest at the end
        self._look_at = float("-inf")  # loop time of the next look
        self.dropped = 0
        self.refused = 0
        """Times that the network said that nobody listens at the other end, or that there is no way."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The socket is open (called by asyncio)."""
        self._socket = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """Hand on a datagram, and those behind it: asyncio would go round its loop for each."""
        self._take(data, addr)
        for _ in range(_MOST_AT_ONCE):
            try:
                more, sender = self._plain.recvfrom(_LARGEST)
            except OSError:  # nothing more; or an error, which the next wait tells
                return
            self._take(more, sender)

    def _take(self, data: bytes, addr: Address) -> None:
        """Remember who sent a datagram, and hand it on."""
        if self._learns:
            self._remember(addr)
        self._receiver(data)

    def error_received(self, exc: Exception) -> None:
        """Survive what ICMP reports, as a peer that is not there yet may come.

        But a calling socket keeps the address that it was opened with. When this computer gets another one (DHCP, a
        mobile network) only a new socket can send, so this one ends.
        """
        self.refused += 1
        if self._socket is None or self._learns or self._broadcast or isinstance(exc, ConnectionRefusedError):
            return
        now = asyncio.get_running_loop().time()
        if now < self._look_at:
            return
        self._look_at = now + LOOK_EVERY_S
        fresh = _address_towards(self._plain.family, self._socket.get_extra_info("peername"))
        if fresh not in ("", self.local[0]):
            _log.warning("udp: this computer is %s now, it was %s (%s)", fresh, self.local[0], exc)
            self._socket.abort()

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

    @property
    def peers(self) -> tuple[Address, ...]:
        """Whom a waiting socket writes to, the newest speaker last."""
        return tuple(self._peers)

    def write(self, data: bytes) -> None:
        """Send `data` as one datagram; dropped and counted when there is no peer or the kernel is full."""
        if self._socket is None or self._socket.is_closing() or not data:
            return
        if self._full or (self._learns and not self._peers):
            self.dropped += 1
            return
        if not self._learns:
            self._socket.sendto(data, self._broadcast)
            return
        for peer in self._peers:
            self._socket.sendto(data, peer)

    def _remember(self, peer: Address) -> None:
        now = asyncio.get_running_loop().time()
        self._peers.pop(peer, None)
        self._peers[peer] = now
        oldest = next(iter(self._peers))
        if len(self._peers) > MOST_PEERS or now - self._peers[oldest] > PEER_SILENCE_S:
            del self._peers[oldest]

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()

    async def wait_closed(self) -> None:
        """Return once the socket is gone."""
        await self._closed.wait()


def udp_in(host: str, port: int) -> Opener:
    """An `Opener` for a socket bound to host and port, that sends to everybody who has spoken to it lately."""

    async def open_socket(receiver: Receiver) -> UdpTransport:
        try:
            plain, address = await _socket(host, port)
            return await _start(plain, lambda: plain.bind(address), UdpTransport(plain, receiver, learns=True))
        except OSError as error:
            raise LinkError(f"cannot listen on udp {host}:{port}: {error}") from error

    return open_socket


def udp_out(host: str, port: int) -> Opener:
    """An `Opener` for a socket that sends to host and port and hears only them."""

    async def open_socket(receiver: Receiver) -> UdpTransport:
        try:
            plain, address = await _socket(host, port)
            return await _start(plain, lambda: plain.connect(address), UdpTransport(plain, receiver))
        except OSError as error:
            raise LinkError(f"cannot reach udp {host}:{port}: {error}") from error

    return open_socket


def udp_broadcast(host: str, port: int) -> Opener:
    """An `Opener` for a socket that sends to everybody on a network, and hears who answers.

    Args:
        host: the network's broadcast address, such as 192.168.1.255.
        port: on which the others listen.
    """

    async def open_socket(receiver: Receiver) -> UdpTransport:
        try:
            plain, address = await _socket(host, port)

            def prepare() -> None:
                plain.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                plain.bind(("", 0))  # answers come over whichever network they come

            return await _start(plain, prepare, UdpTransport(plain, receiver, broadcast=address))
        except OSError as error:
            raise LinkError(f"cannot broadcast to udp {host}:{port}: {error}") from error

    return open_socket


def _address_towards(family: int, peer: Address) -> str:
    """The address that a new socket would send to a peer from; empty when there is no way."""
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(peer)  # sends nothing
        except OSError:
            return ""
        return str(probe.getsockname()[0])


async def _socket(host: str, port: int) -> tuple[socket.socket, Address]:
    """A socket that does not wait, of the family of the first address of `host`, and that address."""
    found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, kind, protocol, _, address = found[0]
    plain = socket.socket(family, kind, protocol)
    plain.setblocking(False)
    return plain, address


async def _start(plain: socket.socket, prepare: Callable[[], None], pipe: UdpTransport) -> UdpTransport:
    """Hand a socket to asyncio once it is prepared; one that cannot be is closed."""
    try:
        prepare()
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: pipe, sock=plain)
    except OSError:
        plain.close()
        raise
    return pipe
