"""The server of the field page, in a process of its own: `python -m arm_companion.page.server`.

What it is fed (see `side_process`) goes to every browser as server-sent events; ABORT goes back as `["abort", nonce]`,
and the number of browsers as `["viewers", number]`. Each connection serves one request.
"""

import asyncio
import collections
import contextlib
import importlib.resources
import json
import re
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs

from arm_companion.config.page_options import PageConfig
from arm_companion.drivers.side_child import Take, run, tell
from arm_companion.page.audience import Audience
from arm_companion.page.gate import Gate
from arm_companion.page.wire import Refused, Request, Wire

_MOST_MEMORY: Final = 256 << 20
_MOST_CONNECTIONS: Final = 64
_MOST_OF_ONE: Final = 16
"""Connections of one address; a browser has six at most."""
_MOST_VIEWERS: Final = 16
_KEEP_ALIVE_S: Final = 3.0
_WRONG_TOKEN_S: Final = 1.0
"""With the limit of connections, this is 64 guesses a second at most."""
_ABORTS_PER_S: Final = 5
_OPEN_AGAIN_S: Final = 5.0
_NONCE: Final = re.compile(r"[A-Za-z0-9-]{8,64}")

_FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/drawing.js": ("drawing.js", "text/javascript; charset=utf-8"),
}
_OPEN_TO_ALL: Final = frozenset({"/page.css"})
"""Files that the form for the token needs."""


class FieldPageServer:
    """Serves the page.

    Args:
        config: names, and whether there is a button.
        token: that is asked for; empty: none.
        abort: takes the nonce of an ABORT.
        viewers: told how many browsers look.
        say: takes a sentence for the log.
    """

    def __init__(
        self,
        config: PageConfig,
        token: str,
        abort: Callable[[str], None],
        viewers: Callable[[int], None],
        say: Callable[[str], None],
    ) -> None:
        self.audience = Audience(viewers)
        self._config = config
        self._gate = Gate(token, config.names)
        self._abort = abort
        self._say = say
        self._open: collections.Counter[str] = collections.Counter()
        self._aborts: collections.deque[float] = collections.deque(maxlen=_ABORTS_PER_S)
        self._told_at = float("-inf")
        folder = importlib.resources.files("arm_companion.page") / "static"
        self._files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
        self._form = (folder / "token.html").read_bytes()

    async def serve(self, port: int | None = None) -> asyncio.Server:
        """Open the port.

        Raises:
            OSError: it cannot be had.
        """
        where = self._config.port if port is None else port
        return await asyncio.start_server(self._connected, self._config.host, where, limit=16_384, backlog=32)

    async def run(self) -> None:
        """Serve until cancelled; a port that is taken is tried again."""
        told = False
        while True:
            try:
                server = await self.serve()
            except OSError as error:
                if not told:
                    self._say(f"{self._config.host} port {self._config.port}: {error.strerror or error}; tried again")
                told = True
                await asyncio.sleep(_OPEN_AGAIN_S)
                continue
            self._say(f"served at http://{self._config.host}:{self._config.port}/")
            async with server:
                await server.serve_forever()

    # --- a connection ---

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = str((writer.get_extra_info("peername") or ("",))[0])
        wire = Wire(reader, writer)
        self._open[peer] += 1
        failed = True
        try:
            # a peer that is gone or too slow (TimeoutError), and our own end, of which asyncio's streams would complain
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await self._serve_one(wire, peer)
                failed = False
        finally:
            self._open[peer] -= 1
            self._open += collections.Counter()  # forgets who has none
            wire.close(at_once=failed)

    async def _serve_one(self, wire: Wire, peer: str) -> None:
        try:
            if self._open.total() > _MOST_CONNECTIONS or self._open[peer] > _MOST_OF_ONE:
                raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections")
            request = await wire.request()
            if request is not None:
                await self._answer(wire, request, peer)
        except Refused as refused:
            await wire.respond(refused.status, f"{refused}\n".encode())
            if refused.status is not HTTPStatus.SERVICE_UNAVAILABLE:  # of those there may be too many to hear out
                await wire.hear_out()

    async def _answer(self, wire: Wire, request: Request, peer: str) -> None:
        if not self._gate.knows_host(request.headers.get("host", "")):
            self._warn(f"{peer} called us by an unknown name; page.names has those that are allowed")
            raise Refused(HTTPStatus.MISDIRECTED_REQUEST, "this is not my name: see page.names")
        match request.method, request.path:
            case "POST", "/token":
                await self._take_token(wire, request, peer)
            case "POST", "/abort":
                await self._take_abort(wire, request, peer)
            case "GET", "/events":
                self._require(request)
                await self._stream(wire)
            case "GET" | "HEAD", path if path in self._files:
                await self._send_file(wire, request)
            case _, path if path in self._files or path in ("/token", "/abort", "/events"):
                raise Refused(HTTPStatus.METHOD_NOT_ALLOWED)
            case _:
                raise Refused(HTTPStatus.NOT_FOUND)

    def _require(self, request: Request) -> None:
        if not self._gate.not_cross_site(request.headers):
            raise Refused(HTTPStatus.FORBIDDEN, "another site asks")
        if not self._gate.admits(request.headers):
            raise Refused(HTTPStatus.UNAUTHORIZED, "the token is missing")

    async def _send_file(self, wire: Wire, request: Request) -> None:
        body, kind = self._files[request.path]
        if request.path not in _OPEN_TO_ALL and not self._gate.admits(request.headers):
            if request.path != "/":
                raise Refused(HTTPStatus.UNAUTHORIZED, "the token is missing")
            body = self._form
        await wire.respond(HTTPStatus.OK, b"" if request.method == "HEAD" else body, kind)

    async def _take_token(self, wire: Wire, request: Request, peer: str) -> None:
        if not self._gate.from_our_page(request.headers):
            raise Refused(HTTPStatus.FORBIDDEN, "another site asks")
        words = parse_qs(request.body.decode("latin-1")).get("token", [""])
        if not self._gate.is_token(words[0].strip()):
            self._warn(f"{peer} gave a wrong token")
            await asyncio.sleep(_WRONG_TOKEN_S)
            wrong = self._form.replace(b"<!-- wrong -->", b'<p class="bad" role="alert">That was not the token.</p>')
            await wire.respond(HTTPStatus.UNAUTHORIZED, wrong, _FILES["/"][1])
            return
        await wire.respond(
            HTTPStatus.SEE_OTHER, b"", "text/plain", ("Location", "/"), ("Set-Cookie", self._gate.cookie)
        )

    async def _take_abort(self, wire: Wire, request: Request, peer: str) -> None:
        if not self._config.abort:
            raise Refused(HTTPStatus.NOT_FOUND)
        if not self._gate.from_our_page(request.headers):
            self._warn(f"{peer} sent an ABORT from another site")
            raise Refused(HTTPStatus.FORBIDDEN, "another site asks")
        self._require(request)
        try:
            nonce = json.loads(request.body)["nonce"]
        except (ValueError, LookupError, TypeError, RecursionError):
            nonce = None
        if not isinstance(nonce, str) or not _NONCE.fullmatch(nonce):
            raise Refused(HTTPStatus.BAD_REQUEST, "no nonce")
        now = asyncio.get_running_loop().time()
        if len(self._aborts) == _ABORTS_PER_S and now - self._aborts[0] < 1.0:
            raise Refused(HTTPStatus.TOO_MANY_REQUESTS)
        self._aborts.append(now)
        self._abort(nonce)
        await wire.respond(HTTPStatus.ACCEPTED, b"{}", "application/json")

    async def _stream(self, wire: Wire) -> None:
        if len(self.audience) >= _MOST_VIEWERS:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "too many look already")
        viewer = self.audience.join()
        hangup = asyncio.ensure_future(wire.reader.read(1))  # a browser sends nothing more, so this is its end
        try:
            await wire.begin("text/event-stream; charset=utf-8")
            while not hangup.done():
                found = await viewer.take(_KEEP_ALIVE_S)
                text = "".join(f"event: {topic}\ndata: {payload}\n\n" for topic, payload in found)
                await wire.more((text or ": nothing new\n\n").encode())
        finally:
            self.audience.leave(viewer)
            hangup.cancel()
            with contextlib.suppress(asyncio.CancelledError, OSError):
                await hangup

    def _warn(self, words: str) -> None:
        """Say it, but not for each request of a flood."""
        now = asyncio.get_running_loop().time()
        if now - self._told_at >= 1.0:
            self._told_at = now
            self._say(words)


def main(settings: dict[str, Any]) -> tuple[Take, Awaitable[None]]:
    """The page for what the daemon sends."""
    config = PageConfig(**settings["page"])
    token = Path(config.token_file).read_text(encoding="utf-8").strip() if config.token_file else ""
    server = FieldPageServer(
        config,
        token,
        lambda nonce: tell("abort", nonce),
        lambda number: tell("viewers", str(number)),
        lambda words: tell("log", words),
    )
    server.audience.put("setup", json.dumps(settings["setup"]))
    return server.audience.put, server.run()


if __name__ == "__main__":
    run(main, _MOST_MEMORY)
