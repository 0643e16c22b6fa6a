"""An MQTT broker for tests: 3.1.1 and 5, QoS 0 and 1, retained messages, wills; and it can behave badly.

What is published goes on to whoever has subscribed to it, with QoS 0.
"""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from paho.mqtt.client import topic_matches_sub

CONNECT, PUBLISH, PUBACK, SUBSCRIBE, PING, DISCONNECT = 1, 3, 4, 8, 12, 14


@dataclass
class Session:
    writer: asyncio.StreamWriter
    version: int = 4
    filters: list[str] = field(default_factory=list)
    will: tuple[str, bytes, bool] | None = None
    user: str = ""
    password: str = ""


@dataclass
class Published:
    topic: str
    payload: bytes
    qos: int
    retain: bool


class Broker:
    """What it was sent is in `messages`; `versions` are the protocol levels that it knows (4: 3.1.1, 5: 5)."""

    def __init__(self, versions: tuple[int, ...] = (4, 5)) -> None:
        self.versions = versions
        self.messages: list[Published] = []
        self.retained: dict[str, bytes] = {}
        self.sessions: list[Session] = []
        self.connects = 0
        self.deaf = False  # takes connections and answers nothing
        self.noise = b""  # sent in place of an answer to CONNECT
        self.port = 0
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._server is not None:
            await self._server.wait_closed()

    def payloads(self, topic: str) -> list[bytes]:
        return [m.payload for m in self.messages if m.topic == topic]

    async def send(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        """To whoever has subscribed."""
        for session in self._subscribers(topic):
            session.writer.write(_publish(session, topic, payload, retain))
            await session.writer.drain()

    def _subscribers(self, topic: str) -> list[Session]:
        return [session for session in self.sessions if any(topic_matches_sub(f, topic) for f in session.filters)]

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._tasks.add(task)
        session = Session(writer)
        try:
            await self._serve(session, reader)
        except (asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            if session.will is not None:
                self._keep(Published(session.will[0], session.will[1], 1, session.will[2]))
        finally:
            with contextlib.suppress(ValueError):
                self.sessions.remove(session)
            writer.close()
            if task is not None:
                self._tasks.discard(task)

    async def _serve(self, session: Session, reader: asyncio.StreamReader) -> None:
        while True:
            first = (await reader.readexactly(1))[0]
            body = await reader.readexactly(await _length(reader))
            kind = first >> 4
            if self.deaf:
                continue
            if kind == CONNECT:
                self.connects += 1
                if self.noise:
                    session.writer.write(self.noise)
                    continue
                if not self._connect(session, body):
                    return
            elif kind == PUBLISH:
                self._take(session, first, body)
            elif kind == SUBSCRIBE:
                self._subscribe(session, body)
            elif kind == PING:
                session.writer.write(b"\xd0\x00")
            elif kind == DISCONNECT:
                session.will = None
                return
            await session.writer.drain()

    def _connect(self, session: Session, body: bytes) -> bool:
        session.version, flags = body[6], body[7]
        if session.version not in self.versions:
            session.writer.write(b"\x20\x02\x00\x01")
            return False
        rest = _skip_properties(body[10:]) if session.version == 5 else body[10:]
        _, rest = _text(rest)
        if flags & 4:
            rest = _skip_properties(rest) if session.version == 5 else rest
            topic, rest = _text(rest)
            payload, rest = _text(rest)
            session.will = (topic.decode(), payload, bool(flags & 32))
        if flags & 128:
            user, rest = _text(rest)
            session.user = user.decode()
        if flags & 64:
            session.password = _text(rest)[0].decode()
        self.sessions.append(session)
        session.writer.write(b"\x20\x03\x00\x00\x00" if session.version == 5 else b"\x20\x02\x00\x00")
        return True

    def _take(self, session: Session, first: int, body: bytes) -> None:
        qos = first >> 1 & 3
        topic, rest = _text(body)
        if qos:
            session.writer.write(b"\x40\x02" + rest[:2])
            rest = rest[2:]
        payload = _skip_properties(rest) if session.version == 5 else rest
        self._keep(Published(topic.decode(), payload, qos, bool(first & 1)))

    def _keep(self, message: Published) -> None:
        self.messages.append(message)
        if message.retain:
            self.retained[message.topic] = message.payload
        for session in self._subscribers(message.topic):
            session.writer.write(_publish(session, message.topic, message.payload, retain=False))

    def _subscribe(self, session: Session, body: bytes) -> None:
        rest = _skip_properties(body[2:]) if session.version == 5 else body[2:]
        topic, _ = _text(rest)
        session.filters.append(topic.decode())
        answer = body[:2] + (b"\x00" if session.version == 5 else b"") + b"\x01"
        session.writer.write(bytes([0x90, len(answer)]) + answer)
        for known, payload in self.retained.items():
            if topic_matches_sub(session.filters[-1], known):
                session.writer.write(_publish(session, known, payload, retain=True))


@contextlib.asynccontextmanager
async def serving(broker: Broker) -> AsyncIterator[Broker]:
    await broker.start()
    try:
        yield broker
    finally:
        await broker.stop()


async def _length(reader: asyncio.StreamReader) -> int:
    value = shift = 0
    while True:
        byte = (await reader.readexactly(1))[0]
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value


def _text(data: bytes) -> tuple[bytes, bytes]:
    (length,) = struct.unpack(">H", data[:2])
    return data[2 : 2 + length], data[2 + length :]


def _skip_properties(data: bytes) -> bytes:
    value = shift = at = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return data[at + value :]


def _publish(session: Session, topic: str, payload: bytes, retain: bool) -> bytes:
    body = struct.pack(">H", len(topic)) + topic.encode() + (b"\x00" if session.version == 5 else b"") + payload
    length, size = b"", len(body)
    while True:
        size, low = divmod(size, 128)
        length += bytes([low | (128 if size else 0)])
        if not size:
            return bytes([0x30 | retain]) + length + body
