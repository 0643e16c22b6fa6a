"""A read-only MAVLink FTP server for a few files in memory: our component's metadata."""

import asyncio
import dataclasses
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.ftp import DATA, Failure, FtpPayload, Opcode, crc32, unpack
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

PACE_S: Final = 0.01
"""From one packet of a burst to the next: an autopilot between us and the reader drops what comes faster."""

BURST_S: Final = 1.5
"""A burst ends after so long; the client asks for the next one."""

MOST_SESSIONS: Final = 8
_MOST_CLIENTS: Final = 32
_MOST_WAITING: Final = 8  # a burst waits while so much waits on the link already
_WRITES: Final = frozenset(
    {
        Opcode.CREATE_FILE,
        Opcode.WRITE_FILE,
        Opcode.REMOVE_FILE,
        Opcode.CREATE_DIRECTORY,
        Opcode.REMOVE_DIRECTORY,
        Opcode.OPEN_FILE_WO,
        Opcode.TRUNCATE_FILE,
        Opcode.RENAME,
    }
)

_Client = tuple[MavlinkLink, int, int]
"""Who asks: link, system, component."""


_Execute = Callable[[_Client, FtpPayload], tuple[int, bytes]]
"""Carries out a request: session and data of the answer."""


class _Refused(Exception):
    """A request gets a NAK."""

    def __init__(self, failure: Failure) -> None:
        self.failure = failure
        super().__init__(failure.name)


@dataclass(slots=True)
class _Session:
    client: _Client
    content: bytes


@dataclass(slots=True)
class FtpCounters:
    """What came in since the start."""

    requests: int = 0
    repeated: int = 0
    refused: int = 0
    bad: int = 0  # payloads that cannot be read


class FtpServer:
    """Serves files to whoever asks.

    Args:
        files: content by absolute path.
    """

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self.counters = FtpCounters()
        self._files = files
        self._sessions: dict[int, _Session] = {}
        self._answers: dict[_Client, tuple[FtpPayload, FtpPayload]] = {}  # last request of each, and its answer
        self._bursts: dict[_Client, asyncio.TimerHandle] = {}

    def handle(self, message: Message, link: MavlinkLink) -> None:
        """Take a FILE_TRANSFER_PROTOCOL that is addressed to us."""
        client = (link, message.get_srcSystem(), message.get_srcComponent())
        try:
            request = unpack(bytes(message.payload))
        except ProtocolError:
            self.counters.bad += 1
            return
        if request.opcode in (Opcode.ACK, Opcode.NAK):
            return  # somebody's answer
        self.counters.requests += 1
        asked, last = self._answers.get(client, (None, None))
        if last is not None and asked == request:  # all of it: a client that starts anew counts from 0 again
            self.counters.repeated += 1
            self._send(client, request, last)
            return
        if (burst := self._bursts.pop(client, None)) is not None:
            burst.cancel()
        if request.opcode == Opcode.BURST_READ_FILE:
            self._burst(client, request, request.sequence, asyncio.get_running_loop().time() + BURST_S)
        else:
            self._send(client, request, self._answer(client, request, self._execute))

    def close(self) -> None:
        """Stop bursts that are being sent."""
        for timer in self._bursts.values():
            timer.cancel()
        self._bursts.clear()

    def _answer(self, client: _Client, request: FtpPayload, execute: _Execute) -> FtpPayload:
        """ACK with what `execute` gives, or NAK."""
        try:
            session, data = execute(client, request)
        except _Refused as refused:
            self.counters.refused += 1
            reason = bytes((refused.failure,))
            return FtpPayload(
                request.sequence + 1 & 0xFFFF,
                Opcode.NAK,
                request.session,
                request.offset,
                reason,
                answers=request.opcode,
            )
        return FtpPayload(
            request.sequence + 1 & 0xFFFF, Opcode.ACK, session, request.offset, data, answers=request.opcode
        )

    def _execute(self, client: _Client, request: FtpPayload) -> tuple[int, bytes]:
        """Session and data of the answer."""
        session = request.session
        match request.opcode:
            case Opcode.NONE:
                return session, b""
            case Opcode.TERMINATE_SESSION:
                self._session(client, session)
                del self._sessions[session]
                return session, b""
            case Opcode.RESET_SESSIONS:
                self._sessions = {n: s for n, s in self._sessions.items() if s.client != client}
                return 0, b""
            case Opcode.LIST_DIRECTORY:
                return session, self._list(_path(request), request.offset)
            case Opcode.OPEN_FILE_RO:
                return self._open(client, self._file(request))
            case Opcode.READ_FILE:
                return session, self._read(client, request)
            case Opcode.CALC_FILE_CRC32:
                return session, crc32(self._file(request)).to_bytes(4, "little")
        raise _Refused(Failure.FILE_PROTECTED if request.opcode in _WRITES else Failure.UNKNOWN_COMMAND)

    def _session(self, client: _Client, number: int) -> _Session:
        session = self._sessions.get(number)
        if session is None or session.client != client:
            raise _Refused(Failure.INVALID_SESSION)
        return session

    def _file(self, request: FtpPayload) -> bytes:
        content = self._files.get(_path(request))
        if content is None:
            raise _Refused(Failure.FILE_NOT_FOUND)
        return content

    def _open(self, client: _Client, content: bytes) -> tuple[int, bytes]:
        """A free session, or that of whoever opened his first: a client that went away gives no notice."""
        number = next((n for n in range(MOST_SESSIONS) if n not in self._sessions), None)
        if number is None:
            number = next(iter(self._sessions))
            del self._sessions[number]
        self._sessions[number] = _Session(client, content)
        return number, len(content).to_bytes(4, "little")

    def _read(self, client: _Client, request: FtpPayload) -> bytes:
        content = self._session(client, request.session).content
        if request.offset >= len(content):
            raise _Refused(Failure.END_OF_FILE)
        return content[request.offset : request.offset + min(request.size or DATA, DATA)]

    def _list(self, path: str, offset: int) -> bytes:
        """Entries from number `offset` on: F, name, tab, size, each ended by a zero byte."""
        if path.rstrip("/"):
            raise _Refused(Failure.FILE_NOT_FOUND)
        entries = [f"F{name.lstrip('/')}\t{len(content)}\0".encode() for name, content in self._files.items()]
        if offset >= len(entries):
            raise _Refused(Failure.END_OF_FILE)
        data = b""
        for entry in entries[offset:]:
            if len(data) + len(entry) > DATA:
                break
            data += entry
        return data

    def _burst(self, client: _Client, request: FtpPayload, sequence: int, until: float) -> None:
        """Send one packet of the rest of a file, and come again until its end, which a NAK marks, or `until`.

        Clients take a burst that goes on for long for a server that hears them no more: pymavlink's after 3.7 s.
        """
        self._bursts.pop(client, None)
        loop = asyncio.get_running_loop()
        later = partial(self._burst, client, request, sequence, until)
        if client[0].waiting < _MOST_WAITING:
            asked = FtpPayload(sequence, request.opcode, request.session, request.offset, size=request.size)
            answer = self._answer(client, asked, lambda c, r: (r.session, self._read(c, r)))
            over = answer.opcode != Opcode.NAK and loop.time() >= until
            self._send(client, asked, dataclasses.replace(answer, burst_complete=over))
            if over or answer.opcode == Opcode.NAK or not client[0].connected:
                return
            ahead = FtpPayload(0, request.opcode, request.session, request.offset + len(answer.data), size=request.size)
            later = partial(self._burst, client, ahead, answer.sequence, until)
        self._bursts[client] = loop.call_later(PACE_S, later)

    def _send(self, client: _Client, request: FtpPayload, answer: FtpPayload) -> None:
        link, system, component = client
        self._answers.pop(client, None)
        self._answers[client] = request, answer
        if len(self._answers) > _MOST_CLIENTS:
            del self._answers[next(iter(self._answers))]
        link.send(mav.MAVLink_file_transfer_protocol_message(0, system, component, answer.pack()))


def _path(request: FtpPayload) -> str:
    return "/" + request.data.split(b"\0", 1)[0].decode("ascii", errors="replace").lstrip("/")
