"""One connection of MAVSDK: messages of our dialect in and out, and nothing decided.

MAVSDK opens the connection, beats the heart of a ground station, finds systems and speaks the wire. Here its JSON
becomes the same message objects that the rest of this package has, and back.
"""

import asyncio
import contextlib
import json
import logging
import math
from collections.abc import AsyncIterator, Callable
from typing import Any, Final

from mavsdk.asyncio import Configuration, Mavsdk, MavsdkConnectionError
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync, MavlinkDirectError, MavlinkMessage
from mavsdk.logging import LogLevel, log_subscribe

from arm_companion.errors import LinkError, ProtocolError
from arm_companion.ground.channel import Address
from arm_companion.protocol.dialect import XML, mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

HEARD: Final = (
    "HEARTBEAT",
    "COMMAND_ACK",
    "STATUSTEXT",
    "TUNNEL",
    "PARAM_VALUE",
    "MESSAGE_INTERVAL",
    "ARM_STATUS",
    "ARM_REACTION_WRENCH",
    "ARM_TENDONS",
    "ARM_STIFFNESS",
    "ARM_PAYLOAD",
    "ARM_TARGET",
)
"""What is asked of MAVSDK; the rest of a vehicle's traffic never reaches Python."""

_CLASSES: Final = {cls.msgname: cls for cls in mav.mavlink_map.values()}
_LOOK_S: Final = 0.1
"""How often to look for new systems. MAVSDK can call when one appears, but not for those that it knows already."""
_REFUSED: Final = {
    "CONNECTION_URL_INVALID": "no address like udpin://HOST:PORT, udpout://HOST:PORT, tcpout://HOST:PORT "
    "or serial://DEVICE:BAUD",
    "BIND_ERROR": "another program has this port, or no network of this machine has this address",
    "CONNECTION_ERROR": "it cannot be opened",
    "DESTINATION_IP_UNKNOWN": "no such host is known",
    "BAUDRATE_UNKNOWN": "not a speed of a serial line",
}
_LEVELS: Final = {LogLevel.ERROR: logging.WARNING, LogLevel.WARN: logging.INFO}


class Station:
    """A ground station on one connection. Made by `Station.open`.

    Args:
        mavsdk: runs the connection.
        address: our own system and component id.
        deliver: called on the event loop with every message of `HEARD`, whoever sent it.
    """

    def __init__(self, mavsdk: Mavsdk, address: Address, deliver: Callable[[Message], None]) -> None:
        self.address = address
        self._mavsdk = mavsdk
        self._deliver = deliver
        self._direct: dict[int, MavlinkDirectAsync] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    @classmethod
    @contextlib.asynccontextmanager
    async def open(cls, url: str, address: Address, deliver: Callable[[Message], None]) -> "AsyncIterator[Station]":
        """Open a connection for an `async with` block.

        Args:
            url: as MAVSDK has them: `udpin://HOST:PORT`, `udpout://...`, `tcpout://...`, `serial://DEVICE:BAUD`.
            address: our own system and component id.
            deliver: called on the event loop with every message of `HEARD`, whoever sent it.

        Raises:
            LinkError: MAVSDK cannot open the URL.
        """
        log_subscribe(_take_log)
        # Heartbeats from the start: behind an autopilot or a router nothing comes to a station that was not heard.
        mavsdk = Mavsdk(Configuration.create_manual(*address, always_send_heartbeats=True))
        station = cls(mavsdk, address, deliver)
        try:
            try:
                await mavsdk.add_any_connection(url)
            except MavsdkConnectionError as error:
                raise LinkError(f"{url}: {_why(error)}") from error
            station._start(station._find_systems())
            yield station
        finally:
            await station._close()

    async def send(self, message: Message) -> None:
        """Send a message of the dialect to its `target_system`.

        Raises:
            LinkError: the system has not been heard, or MAVSDK could not send.
            ProtocolError: a field does not fit.
        """
        direct = self._direct.get(message.target_system)
        if direct is None:
            raise LinkError(f"system {message.target_system} has not been heard")
        outgoing = MavlinkMessage(
            message.get_type(), *self.address, message.target_system, message.target_component, _fields_json(message)
        )
        try:
            await direct.send_message(outgoing)
        except MavlinkDirectError as error:
            if error.result.name in ("INVALID_MESSAGE", "INVALID_FIELD"):
                raise ProtocolError(f"{message.get_type()} cannot be sent: {error.result.name}") from error
            raise LinkError(f"{message.get_type()} cannot be sent: {error.result.name}") from error

    def _start(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("listening ended", exc_info=error)

    async def _find_systems(self) -> None:
        while True:
            for system in await self._mavsdk.get_systems():
                id_ = await system.get_system_id()
                if id_ not in self._direct:
                    await self._listen(id_, system)
            await asyncio.sleep(_LOOK_S)

    async def _listen(self, id_: int, system: Any) -> None:
        direct = MavlinkDirectAsync(system)
        await direct.load_custom_xml(XML.read_text(encoding="utf-8"))
        self._direct[id_] = direct
        for name in HEARD:
            self._start(self._pump(direct, name))

    async def _pump(self, direct: MavlinkDirectAsync, name: str) -> None:
        stream = direct.subscribe_message(name)
        try:
            async for incoming in stream:
                try:
                    message = _message(incoming)
                except (KeyError, TypeError, ValueError):
                    log.debug("%s cannot be read: %s", name, incoming.fields_json)
                    continue
                self._deliver(message)
        finally:
            await stream.aclose()

    async def _close(self) -> None:
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for direct in self._direct.values():
            direct.destroy()
        await asyncio.to_thread(self._mavsdk.destroy)


def _why(error: MavsdkConnectionError) -> str:
    """MAVSDK's name for what is wrong, in words where a person has typed something wrong."""
    name = str(error).removeprefix("Connection failed: ")
    return _REFUSED.get(name, name)


def _fields_json(message: Message) -> str:
    """The fields as MAVSDK takes them: NaN is null (measured: "NaN" becomes 0, a bare NaN is refused)."""
    fields = {name: _to_json(getattr(message, name)) for name in message.fieldnames}
    return json.dumps({"message_name": message.get_type(), **fields})


def _to_json(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, (list, tuple)):
        return [_to_json(entry) for entry in value]
    return value


def _message(incoming: MavlinkMessage) -> Message:
    """A message of the dialect with its sender.

    Raises:
        KeyError, TypeError, ValueError: MAVSDK's definition differs from ours.
    """
    cls = _CLASSES[incoming.message_name]
    fields = json.loads(incoming.fields_json)
    message = cls(*(_from_json(fields[name], kind) for name, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True)))
    header = message.get_header()
    header.srcSystem, header.srcComponent = incoming.system_id, incoming.component_id
    return message


def _from_json(value: Any, kind: str) -> Any:
    if kind == "char":
        return value.encode("ascii", errors="replace")
    if isinstance(value, list):
        return [_from_json(entry, kind) for entry in value]
    return math.nan if value is None else value


def _take_log(level: LogLevel, text: str, _file: str | None, _line: int) -> bool:
    """MAVSDK's own log, into ours; it would go to standard output otherwise."""
    log.log(_LEVELS.get(level, logging.DEBUG), "mavsdk: %s", text)
    return True
