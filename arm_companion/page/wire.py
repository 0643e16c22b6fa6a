"""One HTTP request and its answer on a connection: h11 knows the protocol, here are the bytes, bounds and deadlines."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Final

import h11

REQUEST_WITHIN_S: Final = 5.0
"""A whole request has to be there by then."""
SEND_WITHIN_S: Final = 10.0
"""A peer that takes nothing for so long is hung up on."""
LINGER_S: Final = 1.0
"""For so long a peer that was refused may go on sending before it is hung up on."""
LONGEST_HEAD: Final = 8192
LONGEST_BODY: Final = 1024

_HEADERS: Final = (
    ("Cache-Control", "no-store"),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "same-origin"),  # with "no-referrer" browsers send a form with the Origin "null"
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
    (
        "Content-Security-Policy",
        (
            "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
            "form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
        ),
    ),
    ("Connection", "close"),
)


class Refused(Exception):
    """A request that is answered with a status alone."""

    def __init__(self, status: HTTPStatus, words: str = "") -> None:
        super().__init__(words or status.phrase)
        self.status = status


@dataclass(frozen=True, slots=True)
class Request:
    """A request as it came; header names are in small letters."""

    method: str
    path: str  # without the query
    headers: Mapping[str, str]
    body: bytes


class Wire:
    """A connection that serves one request."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self._writer = writer
        self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=LONGEST_HEAD)
        writer.transport.set_write_buffer_limits(high=32_768)

    async def request(self) -> Request | None:
        """The request; None when the peer hangs up without one.

        Raises:
            Refused: it is none, too long, or too slow.
        """
        try:
            async with asyncio.timeout(REQUEST_WITHIN_S):
                return await self._request()
        except TimeoutError:
            raise Refused(HTTPStatus.REQUEST_TIMEOUT) from None
        except h11.RemoteProtocolError as error:
            raise Refused(HTTPStatus(error.error_status_hint), str(error)) from None

    async def _request(self) -> Request | None:
        head: h11.Request | None = None
        body = b""
        while True:
            event = self._http.next_event()
            if event is h11.NEED_DATA:
                self._http.receive_data(await self.reader.read(4096))
            elif isinstance(event, h11.Request):
                head = event
            elif isinstance(event, h11.Data):
                body += bytes(event.data)
                if len(body) > LONGEST_BODY:
                    raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            elif isinstance(event, h11.EndOfMessage) and head is not None:
                headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in head.headers}
                path = head.target.decode("latin-1").partition("?")[0]
                return Request(head.method.decode("latin-1"), path, headers, body)
            else:  # the peer hung up
                return None

    async def respond(
        self, status: HTTPStatus, body: bytes = b"", kind: str = "text/plain; charset=utf-8", *more: tuple[str, str]
    ) -> None:
        """Send a whole answer.

        Raises:
            OSError: the peer is gone, or takes nothing (TimeoutError).
        """
        headers = [("Content-Type", kind), ("Content-Length", str(len(body))), *_HEADERS, *more]
        data = self._http.send(_response(status, headers)) or b""
        data += self._http.send(h11.Data(data=body)) or b""
        await self._send(data + (self._http.send(h11.EndOfMessage()) or b""))

    async def begin(self, kind: str) -> None:
        """Send the head of an answer without an end.

        Raises:
            OSError: as `respond`.
        """
        head = self._http.send(_response(HTTPStatus.OK, [("Content-Type", kind), *_HEADERS]))
        await self._send(head or b"")

    async def more(self, data: bytes) -> None:
        """Send more of it.

        Raises:
            OSError: as `respond`.
        """
        await self._send(self._http.send(h11.Data(data=data)) or b"")

    async def hear_out(self) -> None:
        """Swallow for a moment what a peer still sends: hanging up on unread bytes is a reset, which eats the answer.

        Raises:
            OSError: the peer is gone.
        """
        self._writer.write_eof()
        try:
            async with asyncio.timeout(LINGER_S):
                while await self.reader.read(4096):
                    pass
        except TimeoutError:
            pass  # it has had its moment

    def close(self, *, at_once: bool = False) -> None:
        """Hang up; what is not sent yet still goes out unless it is to be at once."""
        if at_once:
            self._writer.transport.abort()
        self._writer.close()

    async def _send(self, data: bytes) -> None:
        self._writer.write(data)
        async with asyncio.timeout(SEND_WITHIN_S):
            await self._writer.drain()


def _response(status: HTTPStatus, headers: list[tuple[str, str]]) -> h11.Response:
    return h11.Response(status_code=status.value, headers=headers, reason=status.phrase.encode())
