"""TCP as byte pipes: a client that calls, and a server that speaks with everybody who calls it."""

import asyncio
import contextlib
import os
import socket
from collections import deque
from collections.abc import Callable
from typing import cast

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

BACKLOG_BYTES = 65_536
"""What may wait for a peer that does not read before the oldest chunk is dropped, beyond the kernel's buffers."""

MOST_CLIENTS = 16
"""A server hangs up on whoever calls when it has so many."""

_CONNECT_TIMEOUT_S = 3.0
_KEEPALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 5000}
"""A peer that vanished without a word (cable out, power off) is noticed within about five seconds."""


class TcpConnection(asyncio.Protocol):
    """One connection.

    Chunks that have to wait are kept whole and dropped whole, so that a peer never sees half of one.

    Args:
        receiver: takes what arrives.
        on_lost: called once when the connection is gone.
    """

    def __init__(self, receiver: Receiver, on_lost: Callable[["TcpConnection"], None] = lambda _: None) -> None:
        self.dropped = 0
        self._receiver = receiver
        self._on_lost = on_lost
        self._transport: asyncio.Transport | None = None
        self._full = False
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._closed = asyncio.Event()

    def write(self, data: bytes) -> None:
        """Send `data`, now or when the peer takes it; the oldest that waits is dropped when it is too much."""
        if self._transport is None or self._transport.is_closing() or not data:
            return
        if not self._full:
            self._transport.write(data)
            return
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        while self._waiting_bytes > BACKLOG_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft())
            self.dropped += 1

    def close(self) -> None:
        """Hang up; what is still to be sent is lost."""
        if self._transport is not None:
            self._transport.abort()

    async def wait_closed(self) -> None:
        """Return when either side has hung up, or the network lost the peer."""
        await self._closed.wait()

    # What the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection stands; asyncio has switched Nagle's delay off."""
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=0)
        _notice_loss(self._transport.get_extra_info("socket"))

    def data_received(self, data: bytes) -> None:
        """Pass on what arrived."""
        self._receiver(data)

    def pause_writing(self) -> None:
        """The kernel takes no more."""
        self._full = True

    def resume_writing(self) -> None:
        """The kernel takes more: send what waits."""
        self._full = False
        while self._waiting and not self._full:
            chunk = self._waiting.popleft()
            self._waiting_bytes -= len(chunk)
            self.write(chunk)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's signature
        """The connection is gone."""
        self._transport = None
        self._waiting.clear()
        self._closed.set()
        self._on_lost(self)


class TcpServer:
    """A listening socket and its connections.

    What is written goes to every client, and a slow one costs the others nothing. What clients send comes
    chunk by chunk as it arrives: between the halves of a frame that the network cuts in two may stand another's.
    """

    def __init__(self, receiver: Receiver) -> None:
        self.clients: set[TcpConnection] = set()
        self._receiver = receiver
        self._server: asyncio.Server | None = None
        self._dropped = 0  # by clients that are gone, or for want of a client
        self._closed = asyncio.Event()

    async def listen(self, host: str, port: int) -> None:
        """Take the address.

        Raises:
            OSError: it is taken, not ours, or unknown.
        """
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._welcome, host, port)

    @property
    def port(self) -> int:
        """Where it listens."""
        sockets = () if self._server is None else self._server.sockets
        return int(sockets[0].getsockname()[1]) if sockets else 0

    @property
    def dropped(self) -> int:
        """Chunks that a client did not get, summed over clients; with no client, chunks that nobody got."""
        return self._dropped + sum(client.dropped for client in self.clients)

    def write(self, data: bytes) -> None:
        """Send `data` to every client."""
        if self._closed.is_set() or not data:
            return
        if not self.clients:
            self._dropped += 1
        for client in self.clients:
            client.write(data)

    def close(self) -> None:
        """Stop listening and hang up on everybody."""
        if self._server is not None:
            self._server.close()
        for client in list(self.clients):
            client.close()
        self._closed.set()

    async def wait_closed(self) -> None:
        """Return once it is closed; clients may come and go before that."""
        await self._closed.wait()

    def _welcome(self) -> asyncio.Protocol:
        if len(self.clients) >= MOST_CLIENTS or self._closed.is_set():
            return _Refusal()
        client = TcpConnection(self._receiver, self._farewell)
        self.clients.add(client)
        return client

    def _farewell(self, client: TcpConnection) -> None:
        self.clients.discard(client)
        self._dropped += client.dropped


class _Refusal(asyncio.Protocol):
    """Hangs up on a caller."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


def _notice_loss(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        with contextlib.suppress(AttributeError, OSError):  # not every system has all of them
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def tcp_out(host: str, port: int) -> Opener:
    """An `Opener` for a connection to host and port.

    The opener raises `LinkError` when nobody listens there, or nobody answers within some seconds.
    """

    async def connect(receiver: Receiver) -> TcpConnection:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_CONNECT_TIMEOUT_S):
                _, connection = await loop.create_connection(lambda: TcpConnection(receiver), host, port)
        except TimeoutError:
            raise LinkError(f"cannot reach tcp {host}:{port}: no answer in {_CONNECT_TIMEOUT_S:g} s") from None
        except OSError as error:
            # asyncio puts its own words and the address around the system's
            reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error
            raise LinkError(f"cannot reach tcp {host}:{port}: {reason}") from error
        return connection

    return connect


def tcp_in(host: str, port: int) -> Opener:
    """An `Opener` for a server on host and port, for several clients at once.

    The opener raises `LinkError` when the address cannot be taken.
    """

    async def listen(receiver: Receiver) -> TcpServer:
        server = TcpServer(receiver)
        try:
            await server.listen(host, port)
        except OSError as error:
            raise LinkError(f"cannot listen on tcp {host}:{port}: {error}") from error
        return server

    return listen
