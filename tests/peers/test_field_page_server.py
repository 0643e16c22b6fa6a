"""The field page on real sockets: hostile and clumsy clients, a real browser, and the whole daemon behind it."""

import asyncio
import contextlib
import dataclasses
import json
import os
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import Clock, ticks
from arm_companion.config.schema import PageConfig
from arm_companion.drivers.component import Component
from arm_companion.drivers.field_page import FieldPage
from arm_companion.page import server as page_server
from arm_companion.page import wire as page_wire
from arm_companion.page.server import FieldPageServer
from tests.browser import CHROMIUM, MISSING, chromium
from tests.peers.test_mqtt_connection import free_udp_port
from tests.unit.test_field_page import CONFIG, TOKEN

pytestmark = pytest.mark.realtime


class Desk:
    """A server in this process, and what it told the daemon."""

    def __init__(self, token: str = "", **options: Any) -> None:
        self.aborts: list[str] = []
        self.viewers: list[int] = []
        self.said: list[str] = []
        config = PageConfig(host="127.0.0.1", **options)
        self.server = FieldPageServer(config, token, self.aborts.append, self.viewers.append, self.said.append)
        self.port = 0

    @property
    def host(self) -> str:
        return f"127.0.0.1:{self.port}"

    async def call(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port)

    async def raw(self, data: bytes) -> bytes:
        """What comes back until the server hangs up."""
        reader, writer = await self.call()
        with contextlib.suppress(ConnectionError):
            writer.write(data)
            await writer.drain()
        answer = b""
        with contextlib.suppress(ConnectionError):
            while part := await asyncio.wait_for(reader.read(65_536), 10.0):
                answer += part
        writer.close()
        return answer

    async def ask(self, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, str]:
        """Status, and the answer with its head."""
        every = {"host": self.host, "content-length": str(len(body))} | headers
        head = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in every.items() if value)
        answer = (await self.raw(f"{method} {path} HTTP/1.1\r\n{head}\r\n".encode() + body)).decode()
        return int(answer.split(" ", 2)[1]), answer

    async def abort(self, nonce: str = "0123456789", **headers: str) -> int:
        body = json.dumps({"nonce": nonce}).encode()
        return (await self.ask("POST", "/abort", body, **{"origin": f"http://{self.host}"} | headers))[0]

    async def cookie(self) -> str:
        _, answer = await self.ask("POST", "/token", f"token={TOKEN}".encode(), origin=f"http://{self.host}")
        return answer.partition("Set-Cookie: ")[2].partition(";")[0]


@contextlib.asynccontextmanager
async def desk(token: str = "", **options: Any) -> AsyncIterator[Desk]:
    made = Desk(token, **options)
    server = await made.server.serve(0)
    made.port = server.sockets[0].getsockname()[1]
    try:
        yield made
    finally:
        server.close()


def at_a_desk(test: Callable[[Desk], Awaitable[None]], token: str = "", **options: Any) -> None:
    async def main() -> None:
        async with desk(token, **options) as made:
            await test(made)

    asyncio.run(main())


# manners


def test_files_come_with_the_headers_that_keep_others_out() -> None:
    async def test(at: Desk) -> None:
        for path in ("/", "/page.css", "/page.js", "/drawing.js", "/?x=1"):
            status, answer = await at.ask("GET", path)
            assert status == 200
            assert "default-src 'none'" in answer
            assert "frame-ancestors 'none'" in answer
            assert "nosniff" in answer
        assert (await at.ask("GET", "/../server.py"))[0] == 404
        assert (await at.ask("GET", "/static/page.js"))[0] == 404
        assert (await at.ask("DELETE", "/"))[0] == 405
        assert (await at.ask("GET", "/abort"))[0] == 405
        assert (await at.ask("HEAD", "/"))[0] == 200

    at_a_desk(test)


def test_abort_is_taken_from_our_own_page_only() -> None:
    async def test(at: Desk) -> None:
        assert await at.abort() == 202
        assert at.aborts == ["0123456789"]
        assert await at.abort(origin="http://evil.example") == 403
        assert await at.abort(origin="") == 403
        assert await at.abort(origin="null") == 403
        assert await at.abort(sec_fetch_site="cross-site") == 403
        evil = f"evil.example:{at.port}"
        assert await at.abort(host=evil, origin=f"http://{evil}") == 421, "DNS rebinding"
        assert await at.abort(nonce="x") == 400
        assert (await at.ask("POST", "/abort", b"[" * 900, origin=f"http://{at.host}"))[0] == 400
        assert (await at.ask("GET", "/events", sec_fetch_site="cross-site"))[0] == 403
        assert len(at.aborts) == 1
        assert any("unknown name" in words or "another site" in words for words in at.said)

    at_a_desk(test)


def test_a_page_without_the_button_takes_none_and_a_flood_is_stemmed() -> None:
    async def without(at: Desk) -> None:
        assert await at.abort() == 404

    async def flood(at: Desk) -> None:
        statuses = [await at.abort(nonce=f"nonce-{i:04d}") for i in range(20)]
        assert statuses.count(202) >= 5
        assert 429 in statuses
        assert len(at.aborts) == statuses.count(202)

    at_a_desk(without, abort=False)
    at_a_desk(flood)


def test_without_the_token_there_is_a_form_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_server, "_WRONG_TOKEN_S", 0.3)

    async def test(at: Desk) -> None:
        status, answer = await at.ask("GET", "/")
        assert (status, 'name="token"' in answer, "ABORT" in answer) == (200, True, False)
        for path in ("/events", "/page.js", "/drawing.js"):
            assert (await at.ask("GET", path))[0] == 401
        assert await at.abort() == 401
        origin = f"http://{at.host}"
        start = time.monotonic()
        status, answer = await at.ask("POST", "/token", b"token=wrong", origin=origin)
        assert (status, "Set-Cookie" in answer) == (401, False)
        assert time.monotonic() - start >= 0.3, "guessing is slow"
        assert (await at.ask("POST", "/token", f"token={TOKEN}".encode(), origin="http://evil.example"))[0] == 403
        cookie = await at.cookie()
        assert (await at.ask("GET", "/page.js", cookie=cookie))[0] == 200
        assert await at.abort(cookie=cookie) == 202
        assert await at.abort(cookie=cookie, origin="http://evil.example") == 403
        assert any("wrong token" in words for words in at.said)

    at_a_desk(test, TOKEN)


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)) + b"\r\n\r\n", 400),  # TLS by mistake
        (b"GET / HTTP/1.1\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * 100_000 + b"\r\n\r\n", 431),
        (b"GET /" + b"x" * 100_000, 431),
        (b"POST /abort HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999\r\n\r\n" + b"x" * 50_000, 413),
        (b"POST /abort HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n800\r\n" + b"x" * 2048, 413),
        (b"POST /abort HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n", 400),
    ],
)
def test_what_is_no_request_or_too_long_is_refused(data: bytes, status: int) -> None:
    async def test(at: Desk) -> None:
        answer = await at.raw(data)
        assert answer.startswith(f"HTTP/1.1 {status} ".encode()), answer[:80]
        assert at.aborts == []
        assert (await at.ask("GET", "/"))[0] == 200, "and the next one is served"

    at_a_desk(test)


def test_a_request_that_dribbles_is_hung_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_wire, "REQUEST_WITHIN_S", 0.5)

    async def test(at: Desk) -> None:
        reader, writer = await at.call()
        answer = asyncio.create_task(reader.read())
        start = time.monotonic()
        for letter in b"GET / HTTP/1.1\r\nHost: x\r\nX-Slow: " + b"x" * 100:
            if answer.done():
                break  # only when it is hung up on, which is a moment after the answer
            writer.write(bytes((letter,)))
            await asyncio.sleep(0.05)
        assert (await answer).startswith(b"HTTP/1.1 408 ")
        assert time.monotonic() - start < 5.0
        writer.close()

    at_a_desk(test)


def test_too_many_connections_of_one_address_are_refused_and_come_free_again() -> None:
    async def test(at: Desk) -> None:
        held = [await at.call() for _ in range(16)]
        await asyncio.sleep(0.2)
        assert (await at.ask("GET", "/"))[0] == 503
        for _, writer in held:
            writer.close()
        await asyncio.sleep(0.2)
        assert (await at.ask("GET", "/"))[0] == 200

    at_a_desk(test)


# the stream


async def event(reader: asyncio.StreamReader, topic: str) -> dict[str, Any]:
    while True:
        line = (await asyncio.wait_for(reader.readline(), 10.0)).decode()
        assert line, "the stream ended"
        if line.strip() == f"event: {topic}":
            data: dict[str, Any] = json.loads((await reader.readline()).decode().removeprefix("data: "))
            return data


def test_a_viewer_hears_all_from_now_on_and_what_holds() -> None:
    async def test(at: Desk) -> None:
        at.server.audience.put("state", '{"state": "STOWED"}')
        at.server.audience.put("setup", "{}")
        reader, writer = await at.call()
        writer.write(f"GET /events HTTP/1.1\r\nHost: {at.host}\r\n\r\n".encode())
        assert await event(reader, "setup") == {}
        at.server.audience.put("state", '{"state": "READY"}')
        assert (await event(reader, "state"))["state"] == "READY"
        at.server.audience.put("answer", '{"nonce": "n"}')
        assert (await event(reader, "answer"))["nonce"] == "n"
        assert at.viewers == [1]
        writer.close()
        await writer.wait_closed()
        for _ in range(50):
            if at.viewers == [1, 0]:
                break
            await asyncio.sleep(0.1)
        assert at.viewers == [1, 0], "a closed browser is noticed, so that nothing is made for it"

    at_a_desk(test)


def test_a_viewer_that_reads_nothing_is_hung_up_on_and_costs_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_wire, "SEND_WITHIN_S", 1.0)

    async def test(at: Desk) -> None:
        raw = socket.socket()
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.connect(("127.0.0.1", at.port))
        raw.sendall(f"GET /events HTTP/1.1\r\nHost: {at.host}\r\n\r\n".encode())
        big = json.dumps({"text": "x" * 200_000})
        start = time.monotonic()
        while len(at.viewers) < 2 and time.monotonic() - start < 10.0:
            at.server.audience.put("state", big)
            await asyncio.sleep(0.01)
        assert at.viewers == [1, 0]
        raw.close()

    at_a_desk(test)


# its process


def test_a_flood_of_requests_does_not_touch_the_loop_of_the_daemon() -> None:
    """The page's process is kept at work by many clients: the ticks of this loop stay as they are."""

    async def main() -> None:
        port = free_udp_port()
        config = PageConfig(host="127.0.0.1", port=port)
        clock = Clock(asyncio.get_running_loop(), 1e9)
        component = Component([], CONFIG.vehicle, clock)
        page = FieldPage(dataclasses.replace(CONFIG, page=config), clock, component.commands)
        task = asyncio.create_task(page.run())
        flood = await asyncio.create_subprocess_exec(
            sys.executable, "-c",
            "import socket, sys, time\n"
            "end = time.monotonic() + 12\n"
            "while time.monotonic() < end:\n"
            "    try:\n"
            "        held = [socket.create_connection(('127.0.0.1', int(sys.argv[1])), 1) for _ in range(20)]\n"
            "        for s in held: s.sendall(b'GET / HTTP/1.1\\r\\nHost: 127.0.0.1\\r\\nX: ' + b'x' * 9000)\n"
            "        for s in held: s.close()\n"
            "    except OSError: time.sleep(0.05)\n",
            str(port),
        )  # fmt: skip
        await opened(port)
        missed = seen = 0
        start = time.monotonic()
        async for tick in ticks(0.05):
            missed, seen = missed + tick.missed, seen + 1
            if time.monotonic() - start > 3.0:
                break
        flood.kill()
        await flood.wait()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert (await reader.readline()).startswith(b"HTTP/1.1 "), "and it is still there"
        writer.close()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        assert missed <= seen // 4, "this machine alone may lose a tick now and then"

    asyncio.run(main())


async def opened(port: int) -> None:
    """Wait for the page's process."""
    for _ in range(300):
        with contextlib.suppress(OSError):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.close()
            return
        await asyncio.sleep(0.1)
    raise AssertionError(f"nothing serves port {port}")


@contextlib.asynccontextmanager
async def whole_daemon(folder: Path, port: int, token: str) -> AsyncIterator[asyncio.subprocess.Process]:
    file = folder / "token"
    file.write_text(token)
    file.chmod(0o600)
    words = [sys.executable, "-m", "arm_companion", "run", "--config", "sim.toml"]
    for setting in (
        f"links.autopilot.url=udpin:127.0.0.1:{free_udp_port()}",
        f"links.ground.url=udpout:127.0.0.1:{free_udp_port()}",
        f"servos.port={folder / 'nothing'}",
        "page.host=127.0.0.1",
        f"page.port={port}",
        f"page.token_file={file}",
    ):
        words += ["--set", setting]
    daemon = await asyncio.create_subprocess_exec(*words, stderr=asyncio.subprocess.DEVNULL)
    try:
        await opened(port)
        yield daemon
    finally:
        with contextlib.suppress(ProcessLookupError):
            daemon.send_signal(signal.SIGTERM)
        await daemon.wait()


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_browser_gives_the_token_sees_the_arm_and_aborts(tmp_path: Path) -> None:
    port = free_udp_port()
    pictures = Path(os.environ.get("FIELD_PAGE_PICTURES", tmp_path))

    async def main() -> None:
        profile = tmp_path / "profile"
        profile.mkdir()
        async with whole_daemon(tmp_path, port, TOKEN) as daemon, chromium(profile) as tab:
            await tab.shape(390, 844, mobile=True)
            await tab.open(f"http://127.0.0.1:{port}/")
            await tab.until("document.activeElement?.id === 'token'")
            await tab.type("not the token at all")
            await tab.click("button")
            await tab.until("document.body.innerText.includes('not the token')")
            assert len(tab.complaints) <= 1, "a 401 is told by the browser itself"
            tab.complaints.clear()
            await tab.picture(pictures / "token.png")
            await tab.click("#token")
            await tab.type(TOKEN)
            await tab.click("button")
            await tab.until("document.querySelector('#link')?.textContent === 'live'")
            assert await tab.ask("document.querySelector('#state').textContent") == "STARTUP"
            assert await tab.ask("document.querySelectorAll('#tendons .row').length") == 4
            assert await tab.ask("document.querySelectorAll('#wrench .row').length") == 6
            assert "never" in await tab.ask("document.querySelector('#health').textContent")
            assert await tab.ask("document.documentElement.scrollWidth") <= 390, "nothing sticks out on a phone"
            await tab.click("#abort")
            await tab.until("/^ABORT: (accepted|denied|temp)/.test(document.querySelector('#answer').textContent)")
            for name, width, height, dark in (("phone", 390, 844, False), ("desktop", 1280, 800, True)):
                await tab.shape(width, height, dark=dark, mobile=width < 500)
                await tab.until("document.querySelector('#link').textContent === 'live'")
                await tab.picture(pictures / f"{name}.png")
                assert await tab.ask("document.documentElement.scrollWidth") <= width
            assert tab.complaints == []
            daemon.send_signal(signal.SIGTERM)
            await daemon.wait()
            await tab.until("document.body.classList.contains('stale')")
            await tab.until("/not connected|no news/.test(document.querySelector('#link').textContent)")
            await tab.click("#abort")
            await tab.until("document.querySelector('#answer').textContent.includes('did not arrive')")

    asyncio.run(main())


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_the_page_draws_what_it_is_told_and_shows_texts_as_texts(tmp_path: Path) -> None:
    async def test(at: Desk) -> None:
        put = at.server.audience.put
        put("setup", json.dumps({"abort": True, "tension_max": 45, "force_max": 12, "torque_max": 25,
                                 "mount": [0, 0, 0.1], "disk_radius": 0.02}))  # fmt: skip
        line = [[0.0, 0.0, 0.1 + 0.01 * i] for i in range(12)]
        bar = {"point": [0.2, 0.0, 0.2], "axis": [0.0, 1.0, 0.0], "radius": 0.035}
        wrench = (json.dumps({"valid": True, "source": "anchored", "force": [6.0, 0.0, 3.0],
                                  "torque": [0.0, 3.0, None], "force_sigma": [0.1, 0.1, 0.1],
                                  "torque_sigma": [0.1, 0.1, None]}))  # fmt: skip
        hostile = "<img src=x onerror=document.title='broken'><script>document.title='broken'</script>"
        put("events", json.dumps({"severity": "error", "text": hostile, "time": 1.0}))
        async with chromium(tmp_path) as tab:
            await tab.open(f"http://{at.host}/")
            await tab.until("document.querySelector('#events li') !== null")
            put("limits", json.dumps({"torque_max": 2.5}))
            put("wrench", wrench)
            put("arm", json.dumps({"backbone": line, "held": True, "bar": bar}))
            await tab.until("document.querySelectorAll('#side .spine').length === 2")
            assert await tab.ask("document.querySelectorAll('#side .bar').length") == 1, "seen along its axis"
            assert await tab.ask("document.querySelectorAll('#rear .barline').length") == 1, "seen across"
            assert await tab.ask("document.querySelectorAll('.force').length") == 2
            assert await tab.ask("document.querySelectorAll('#wrench .over').length") == 1, "beyond the limit"
            assert await tab.ask("document.querySelector('#events li').textContent.includes('<script>')")
            assert await tab.ask("document.title") == "arm_companion"
            await tab.until("document.querySelector('#link').textContent.includes('no news')")
            await tab.click("#abort")
            await tab.until("document.querySelector('#answer').textContent.includes('no answer yet')")
            assert len(at.aborts) == 1
            answer = {"nonce": at.aborts[0], "command": "ABORT", "result": "accepted", "progress": None, "reason": ""}
            put("answer", json.dumps(answer | {"nonce": "somebody else's", "result": "failed"}))
            put("answer", json.dumps(answer))
            await tab.until("document.querySelector('#answer').textContent === 'ABORT: accepted'")
            assert tab.complaints == []

    at_a_desk(test)
