"""Transports: UDP sockets on the loopback, the memory pipe, and the URLs that name them."""

import asyncio
import errno
import socket
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from arm_companion.clock import run_simulated
from arm_companion.errors import ConfigError, LinkError
from arm_companion.transport import udp
from arm_companion.transport.memory import MemoryPipe
from arm_companion.transport.udp import UdpTransport, udp_broadcast, udp_in, udp_out
from arm_companion.transport.urls import open_url

HOST = "127.0.0.1"


async def until(condition: Callable[[], object]) -> None:
    """Wait for what the kernel will do in a moment."""
    async with asyncio.timeout(2.0):
        while not condition():  # noqa: ASYNC110 - the kernel sets no event
            await asyncio.sleep(0.001)


def run(main: Coroutine[Any, Any, None]) -> None:
    asyncio.run(main)


async def waiting(received: list[bytes], host: str = HOST) -> tuple[UdpTransport, int]:
    pipe = await udp_in(host, 0)(received.append)
    assert isinstance(pipe, UdpTransport)
    return pipe, pipe.local[1]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


# --- UDP ---


def test_datagrams_pass_both_ways() -> None:
    async def main() -> None:
        heard: list[bytes] = []
        answers: list[bytes] = []
        pipe, port = await waiting(heard)
        caller = await udp_out(HOST, port)(answers.append)
        caller.write(b"question")
        await until(lambda: heard)
        pipe.write(b"answer")
        await until(lambda: answers)
        assert (heard, answers) == ([b"question"], [b"answer"])
        caller.close()
        pipe.close()
        await asyncio.gather(caller.wait_closed(), pipe.wait_closed())

    run(main())


def test_a_waiting_socket_answers_everybody_who_has_spoken_lately(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        heard: list[bytes] = []
        answers: tuple[list[bytes], list[bytes]] = ([], [])
        pipe, port = await waiting(heard)
        pipe.write(b"nobody is there")
        assert pipe.dropped == 1
        callers = [await udp_out(HOST, port)(answer.append) for answer in answers]
        for caller in callers:
            heard.clear()
            caller.write(b"?")
            await until(lambda: heard)
        pipe.write(b"!")
        await until(lambda: all(answers))
        assert answers == ([b"!"], [b"!"])
        monkeypatch.setattr(udp, "PEER_SILENCE_S", 0.0)  # from now on only the newest counts
        heard.clear()
        callers[0].write(b"?")
        await until(lambda: heard)
        pipe.write(b"!!")
        await until(lambda: b"!!" in answers[0])
        await asyncio.sleep(0.01)
        assert answers[1] == [b"!"]
        for transport in (*callers, pipe):
            transport.close()
            await transport.wait_closed()

    run(main())


def test_a_crowd_of_speakers_does_not_pile_up() -> None:
    async def main() -> None:
        heard: list[bytes] = []
        pipe, port = await waiting(heard)
        callers = [await udp_out(HOST, port)(lambda _: None) for _ in range(udp.MOST_PEERS + 3)]
        for caller in callers:
            caller.write(b"?")
        await until(lambda: len(heard) == len(callers))
        assert pipe.peers == tuple(caller.local for caller in callers[-udp.MOST_PEERS :])
        for transport in (*callers, pipe):
            transport.close()
            await transport.wait_closed()

    run(main())


def test_a_broadcast_reaches_everybody_on_the_network_and_answers_come_back() -> None:
    async def main() -> None:
        everybody = "127.255.255.255"  # of the loopback network
        heard: list[bytes] = []
        answers: list[bytes] = []
        ear, port = await waiting(heard, everybody)
        caster = await udp_broadcast(everybody, port)(answers.append)
        caster.write(b"who is there?")
        await until(lambda: heard)
        ear.write(b"I am")
        await until(lambda: answers)
        caster.write(b"and now?")  # it goes on telling everybody, not only who has answered
        await until(lambda: len(heard) == 2)
        for transport in (ear, caster):
            transport.close()
            await transport.wait_closed()

    run(main())


def test_a_calling_socket_hears_only_whom_it_calls() -> None:
    async def main() -> None:
        heard: list[bytes] = []
        pipe, port = await waiting([])
        caller = await udp_out(HOST, port)(heard.append)
        stranger, _ = await waiting([])
        stranger._remember(caller.local)
        stranger.write(b"lies")
        caller.write(b"hello")
        await until(lambda: pipe.peers)
        pipe.write(b"truth")
        await until(lambda: heard)
        assert heard == [b"truth"]
        for transport in (caller, stranger, pipe):
            transport.close()
            await transport.wait_closed()

    run(main())


def test_a_refusal_is_survived_and_the_peer_may_come_later() -> None:
    async def main() -> None:
        port = free_port()
        caller = await udp_out(HOST, port)(lambda _: None)
        assert isinstance(caller, UdpTransport)
        for _ in range(4):
            caller.write(b"anybody?")
            await asyncio.sleep(0.005)
        assert caller.refused > 0
        heard: list[bytes] = []
        pipe = await udp_in(HOST, port)(heard.append)
        caller.write(b"now?")
        caller.write(b"now?")  # the kernel may spend one write on telling of the last refusal
        await until(lambda: heard)
        caller.close()
        pipe.close()
        await asyncio.gather(caller.wait_closed(), pipe.wait_closed())

    run(main())


def test_a_calling_socket_ends_once_this_computer_has_another_address(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[str] = []

    def towards(address: str) -> None:
        def look(*_: Any) -> str:
            looks.append(address)
            return address

        monkeypatch.setattr(udp, "_address_towards", look)

    async def main() -> None:
        pipe, port = await waiting([])
        caller = await udp_out(HOST, port)(lambda _: None)
        assert isinstance(caller, UdpTransport)
        gone = asyncio.create_task(caller.wait_closed())
        no_way = OSError(errno.ENETUNREACH, "Network is unreachable")
        monkeypatch.setattr(udp, "LOOK_EVERY_S", 0.0)
        for address in ("", HOST):  # no network yet; and as it was: a new socket would do no better
            towards(address)
            caller.error_received(no_way)
        towards("127.0.0.2")
        caller.error_received(ConnectionRefusedError())
        await asyncio.sleep(0.01)
        assert not gone.done()
        caller.error_received(no_way)
        await asyncio.wait_for(gone, 1.0)
        assert looks == ["", HOST, "127.0.0.2"]
        pipe.error_received(no_way)  # one that waits has no address to keep
        pipe.write(b"!")
        pipe.close()
        await pipe.wait_closed()
        assert len(looks) == 3

    run(main())


def test_a_flood_of_errors_costs_one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        pipe, port = await waiting([])
        caller = await udp_out(HOST, port)(lambda _: None)
        assert isinstance(caller, UdpTransport)
        looks: list[Any] = []
        monkeypatch.setattr(udp, "LOOK_EVERY_S", 1000.0)
        monkeypatch.setattr(udp, "_address_towards", lambda *seen: looks.append(seen) or "")
        for _ in range(100):
            caller.error_received(OSError(errno.EHOSTUNREACH, "No route to host"))
        assert looks == [(socket.AF_INET, (HOST, port))]
        for transport in (caller, pipe):
            transport.close()
            await transport.wait_closed()

    run(main())


def test_the_address_towards_a_peer_is_what_a_new_socket_has() -> None:
    assert udp._address_towards(socket.AF_INET, (HOST, 9)) == HOST
    assert udp._address_towards(socket.AF_INET, ("255.255.255.255", 9)) == ""  # a broadcast is not allowed


def test_a_closed_socket_stays_closed() -> None:
    async def main() -> None:
        pipe, port = await waiting([])
        gone = asyncio.create_task(pipe.wait_closed())
        await asyncio.sleep(0)
        assert not gone.done()
        pipe.close()
        pipe.close()
        await asyncio.wait_for(gone, 1.0)
        pipe.write(b"too late")
        again = await udp_in(HOST, port)(lambda _: None)
        again.close()
        await again.wait_closed()

    run(main())


def test_a_port_that_is_taken_is_a_link_error() -> None:
    async def main() -> None:
        pipe, port = await waiting([])
        with pytest.raises(LinkError, match=f"cannot listen on udp {HOST}:{port}"):
            await udp_in(HOST, port)(lambda _: None)
        pipe.close()
        await pipe.wait_closed()

    run(main())


def test_a_name_that_does_not_resolve_is_a_link_error() -> None:
    async def main() -> None:
        with pytest.raises(LinkError, match="cannot reach udp"):
            await udp_out("no-such-host.invalid", 14550)(lambda _: None)

    run(main())


def test_what_the_kernel_cannot_take_is_dropped_and_counted() -> None:
    async def main() -> None:
        pipe, port = await waiting([])
        caller = await udp_out(HOST, port)(lambda _: None)
        assert isinstance(caller, UdpTransport)
        caller.pause_writing()  # as asyncio tells when too much waits
        caller.write(b"1")
        assert caller.dropped == 1
        caller.resume_writing()
        caller.write(b"2")
        assert caller.dropped == 1
        caller.close()
        pipe.close()
        await asyncio.gather(caller.wait_closed(), pipe.wait_closed())

    run(main())


# --- memory ---


def test_a_memory_pipe_delivers_what_is_written_at_one_instant_in_order_and_at_once() -> None:
    async def main() -> None:
        heard: list[bytes] = []
        pipe = MemoryPipe()
        here = await pipe.opener(0)(lambda _: None)
        there = await pipe.opener(1)(heard.append)
        sent = [bytes([i]) for i in range(100)]
        for chunk in sent:
            here.write(chunk)
        await asyncio.sleep(0.5 * pipe.latency_s)
        here.write(b"later")
        await asyncio.sleep(0.01)
        assert heard == [b"".join(sent), b"later"]
        here.close()
        there.close()

    run_simulated(main())


# --- URLs ---


@pytest.mark.parametrize(
    "url",
    [
        "udpin:127.0.0.1:14540",
        "udpout:example.org:14550",
        "udpout:[::1]:14550",
        "tcp:[::1]:5760",
        "tcpin:0.0.0.0:5760",
        "tcp:[fe80::1%eth0]:5760",
        "serial:/dev/ttyAMA0:921600",
    ],
)
def test_good_urls_name_an_opener(url: str) -> None:
    assert callable(open_url(url))


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("", "is not one of udpin:HOST:PORT"),
        ("udpin", "is not one of"),
        ("udpin:127.0.0.1", "is not one of"),
        ("udpin::14540", "is not one of"),
        ("udpin:127.0.0.1:port", "is not one of"),
        ("udpin:127.0.0.1:²", "is not one of"),
        ("udpin:127.0.0.1:-1", "is not one of"),
        ("udpin:127.0.0.1:0", "port 0 is outside 1 to 65535"),
        ("udpout:127.0.0.1:65536", "port 65536 is outside"),
        ("serial:/dev/ttyAMA0:300", "baud 300 is outside"),
        ("tcp:127.0.0.1", "is not one of"),
        ("tcpin:0.0.0.0:0", "port 0 is outside"),
        ("tcpout:127.0.0.1:5760", "is not one of"),
        ("udpout:192.168..1:14550", "'192.168..1' is no name of a host"),
        (f"tcp:{'a' * 64}:5760", "is no name of a host"),
    ],
)
def test_bad_urls_are_refused_with_the_forms_that_are_allowed(url: str, reason: str) -> None:
    with pytest.raises(ConfigError, match="link url") as refusal:
        open_url(url)
    assert reason in str(refusal.value)
    assert repr(url) in str(refusal.value)


def test_a_url_opens_what_it_names() -> None:
    async def main() -> None:
        port = free_port()
        pipe = await open_url(f"udpin:{HOST}:{port}")(lambda _: None)
        assert isinstance(pipe, UdpTransport)
        assert pipe.local == (HOST, port)
        pipe.close()
        await pipe.wait_closed()

    run(main())
