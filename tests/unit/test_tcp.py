"""TCP pipes on the loopback: a calling and a listening end, slow peers, lost peers, and refusals."""

import asyncio
import socket
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from arm_companion.errors import ConfigError, LinkError
from arm_companion.transport import tcp
from arm_companion.transport.serial import open_serial
from arm_companion.transport.tcp import TcpConnection, TcpServer, tcp_in, tcp_out
from arm_companion.transport.urls import open_bus, open_url

HOST = "127.0.0.1"


async def until(condition: Callable[[], object]) -> None:
    """Wait for what the kernel will do in a moment."""
    async with asyncio.timeout(2.0):
        while not condition():  # noqa: ASYNC110 - the kernel sets no event
            await asyncio.sleep(0.001)


def run(main: Coroutine[Any, Any, None]) -> None:
    asyncio.run(main)


async def serve(received: list[bytes]) -> TcpServer:
    server = await tcp_in(HOST, 0)(received.append)
    assert isinstance(server, TcpServer)
    return server


async def call(server: TcpServer, received: list[bytes]) -> TcpConnection:
    before = len(server.clients)
    client = await tcp_out(HOST, server.port)(received.append)
    assert isinstance(client, TcpConnection)
    await until(lambda: len(server.clients) == before + 1)
    return client


async def close(*pipes: TcpServer | TcpConnection) -> None:
    for pipe in pipes:
        pipe.close()
        pipe.close()
        await asyncio.wait_for(pipe.wait_closed(), 1.0)


def test_bytes_pass_both_ways_and_to_every_client() -> None:
    async def main() -> None:
        heard: list[bytes] = []
        answers: list[list[bytes]] = [[], [], []]
        server = await serve(heard)
        server.write(b"nobody is there")
        assert server.dropped == 1
        clients = [await call(server, answer) for answer in answers]
        for i, client in enumerate(clients):
            client.write(bytes([i]))
        await until(lambda: len(b"".join(heard)) == 3)
        assert sorted(b"".join(heard)) == [0, 1, 2]
        server.write(b"to all")
        await until(lambda: all(answers))
        assert answers == [[b"to all"]] * 3
        await close(clients[1])
        await until(lambda: len(server.clients) == 2)
        server.write(b"!")
        await until(lambda: len(answers[0]) == len(answers[2]) == 2)
        assert answers[1] == [b"to all"]
        await close(*clients, server)

    run(main())


def test_a_client_learns_that_the_server_is_gone_and_may_call_again() -> None:
    async def main() -> None:
        server = await serve([])
        port = server.port
        client = await call(server, [])
        await close(server)
        await asyncio.wait_for(client.wait_closed(), 1.0)
        client.write(b"too late")
        with pytest.raises(LinkError, match=f"^cannot reach tcp {HOST}:{port}: Connection refused$"):
            await tcp_out(HOST, port)(lambda _: None)
        again = await tcp_in(HOST, port)(lambda _: None)
        assert isinstance(again, TcpServer)
        await close(await call(again, []), again)

    run(main())


def test_a_peer_that_does_not_read_gets_whole_chunks_and_costs_the_others_nothing() -> None:
    async def main() -> None:
        answers: list[bytes] = []
        server = await serve([])
        good = await call(server, answers)
        lazy = socket.create_connection((HOST, server.port))
        lazy.setblocking(False)
        await until(lambda: len(server.clients) == 2)
        chunks = [bytes([i % 251]) * 1000 for i in range(12_000)]
        for chunk in chunks:
            server.write(chunk)
            await asyncio.sleep(0)
        await until(lambda: sum(map(len, answers)) >= 11_000_000)
        await until(lambda: b"".join(answers).endswith(chunks[-1]))
        assert b"".join(answers) == b"".join(chunks), "the other client got all of it"
        assert server.dropped > 1000
        assert all(c.dropped == 0 for c in server.clients if c.dropped < server.dropped)
        got = b""
        async with asyncio.timeout(5.0):
            while not got.endswith(chunks[-1]):
                got += await asyncio.get_running_loop().sock_recv(lazy, 1 << 20)
        assert len(got) % 1000 == 0
        assert all(len(set(got[i : i + 1000])) == 1 for i in range(0, len(got), 1000)), "no chunk was cut"
        lazy.close()
        await close(good, server)

    run(main())


def test_a_server_hangs_up_when_it_has_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "MOST_CLIENTS", 1)

    async def main() -> None:
        server = await serve([])
        first = await call(server, [])
        second = await tcp_out(HOST, server.port)(lambda _: None)
        await asyncio.wait_for(second.wait_closed(), 1.0)
        assert len(server.clients) == 1
        await close(first)
        await until(lambda: not server.clients)
        await close(await call(server, []), server)

    run(main())


def test_addresses_that_cannot_be_used_are_link_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "_CONNECT_TIMEOUT_S", 0.05)

    async def hang(*_: Any, **__: Any) -> None:
        await asyncio.sleep(60.0)

    async def main() -> None:
        server = await serve([])
        with pytest.raises(LinkError, match="cannot listen on tcp"):
            await tcp_in(HOST, server.port)(lambda _: None)
        with pytest.raises(LinkError, match="cannot reach tcp"):
            await tcp_out("no-such-host.invalid", 5760)(lambda _: None)
        monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", hang)
        with pytest.raises(LinkError, match="no answer in"):
            await tcp_out(HOST, server.port)(lambda _: None)
        await close(server)

    run(main())


def test_a_lost_peer_is_looked_for() -> None:
    async def main() -> None:
        server = await serve([])
        client = await call(server, [])
        assert client._transport is not None
        connection = client._transport.get_extra_info("socket")
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        await close(client, server)

    run(main())


def test_urls_open_both_ends() -> None:
    async def main() -> None:
        with socket.socket() as probe:
            probe.bind((HOST, 0))
            port = int(probe.getsockname()[1])
        heard: list[bytes] = []
        server = await open_url(f"tcpin:{HOST}:{port}")(heard.append)
        for opener in (open_url(f"tcp:{HOST}:{port}"), open_bus(f"tcp:{HOST}:{port}", 1_000_000)):
            client = await opener(lambda _: None)
            client.write(b"x")
            await until(lambda: heard)
            heard.clear()
            client.close()
            await client.wait_closed()
        server.close()
        await server.wait_closed()

    run(main())


def test_a_bus_is_a_device_unless_it_is_called_tcp() -> None:
    assert open_bus("/dev/ttyUSB0", 57_600).__qualname__ == open_serial("x", 1).__qualname__
    with pytest.raises(ConfigError, match="link url"):
        open_bus("tcp:bridge", 57_600)
