"""The connection to the broker, in a process of its own: `python -m arm_companion.drivers.mqtt_client`.

What it is fed goes to the broker; commands of the broker's go back as `["command", payload]`: see `side_process`.
"""

import asyncio
import contextlib
import random
import ssl
from collections import deque
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

import aiomqtt
from aiomqtt import ProtocolVersion

from arm_companion.config.mqtt_options import MqttConfig
from arm_companion.drivers.side_child import Take, run, tell
from arm_companion.protocol.mqtt import LONGEST_COMMAND, OFFLINE, ONLINE, Packet, topic

_FIRST_DELAY_S: Final = 0.5
_ANSWER_WITHIN_S: Final = 5.0
_FAREWELL_S: Final = 1.0
_MOST_MEMORY: Final = 512 << 20
_COMMANDS_PER_S: Final = 20
_MOST_INCOMING: Final = 64

_VERSIONS: Final = {
    "auto": (ProtocolVersion.V5, ProtocolVersion.V311),
    "5": (ProtocolVersion.V5,),
    "3.1.1": (ProtocolVersion.V311,),
}


class Backlog:
    """Messages on their way out: bounded, the oldest is dropped; the newest of retained topics is known by heart."""

    def __init__(self, length: int) -> None:
        self.dropped = 0
        self._kept: dict[str, Packet] = {}
        self._waiting: deque[Packet] = deque(maxlen=length)
        self._filled = asyncio.Event()

    def put(self, packet: Packet) -> None:
        """Add one."""
        self.dropped += len(self._waiting) == self._waiting.maxlen
        self._waiting.append(packet)
        if packet.retain:
            self._kept[packet.topic] = packet
        self._filled.set()

    def to_repeat(self) -> list[Packet]:
        """What a broker that was gone must be told again: the newest of retained topics, unless that waits anyway."""
        waiting = {packet.topic for packet in self._waiting}
        return [packet for name, packet in self._kept.items() if name not in waiting]

    async def take(self) -> Packet:
        """The oldest, as soon as there is one."""
        while not self._waiting:
            self._filled.clear()
            await self._filled.wait()
        return self._waiting.popleft()

    def give_back(self, packet: Packet) -> None:
        """One that could not be sent: it is the oldest again, unless others have taken its place."""
        if len(self._waiting) < (self._waiting.maxlen or 0):
            self._waiting.appendleft(packet)
            self._filled.set()


class Connection:
    """Keeps connected, publishes the backlog, and hands on what comes on the command topic.

    Args:
        config: broker and credentials.
        backlog: what is to be published.
        command: takes a payload of the command topic.
        say: takes a sentence for the log.
        jitter: numbers from 0 to 1 that spread the attempts of many vehicles.
    """

    def __init__(
        self,
        config: MqttConfig,
        backlog: Backlog,
        command: Callable[[bytes], None],
        say: Callable[[str], None],
        jitter: Callable[[], float] = random.random,
    ) -> None:
        self._config = config
        self._backlog = backlog
        self._command = command
        self._say = say
        self._jitter = jitter
        self._versions = _VERSIONS[config.protocol]
        self._complaint = ""
        self._budget = _COMMANDS_PER_S
        self._budget_at = float("-inf")

    async def run(self) -> None:
        """Connect, and connect again with growing, spread pauses, until cancelled."""
        delay = _FIRST_DELAY_S
        turn = 0
        while True:
            version = self._versions[turn % len(self._versions)]
            connected = False
            try:
                async with self._client(version) as client:
                    connected = True
                    self._complaint = ""
                    self._say(f"connected to {self._config.host}:{self._config.broker_port}, MQTT {_name(version)}")
                    delay = _FIRST_DELAY_S
                    await self._session(client)
            except (aiomqtt.MqttError, OSError, ValueError) as error:  # ValueError: ssl and paho on bad input
                self._complain(error)
            _heed_cancel()
            turn += not connected  # a broker that does not know MQTT 5 may know 3.1.1
            await asyncio.sleep(delay * (0.5 + 0.5 * self._jitter()))
            delay = min(2.0 * delay, self._config.reconnect_max_s)

    def _complain(self, error: Exception) -> None:
        text = f"broker {self._config.host}:{self._config.broker_port}: {error}"
        if text != self._complaint:
            self._say(text)
        self._complaint = text

    def _client(self, version: ProtocolVersion) -> aiomqtt.Client:
        config = self._config
        return aiomqtt.Client(
            config.host,
            config.broker_port,
            username=_secret(config.user_file),
            password=_secret(config.password_file),
            identifier=f"arm-companion-{config.vehicle}",
            protocol=version,
            will=aiomqtt.Will(topic(config.vehicle, "availability"), OFFLINE, qos=1, retain=True),
            keepalive=config.keepalive_s,
            timeout=_ANSWER_WITHIN_S,
            max_queued_incoming_messages=_MOST_INCOMING,
            max_queued_outgoing_messages=config.queue_length,
            tls_context=_tls(config),
        )

    async def _session(self, client: aiomqtt.Client) -> None:
        try:
            await self._greet(client)
            await self._converse(client)
        finally:
            # where the broker still takes it: after a clean goodbye it does not make our will known
            with contextlib.suppress(aiomqtt.MqttError, TimeoutError):
                async with asyncio.timeout(_FAREWELL_S):
                    await self._publish(client, Packet("availability", OFFLINE))

    async def _greet(self, client: aiomqtt.Client) -> None:
        for packet in (Packet("availability", ONLINE), *self._backlog.to_repeat()):
            _heed_cancel()
            await self._publish(client, packet)
        if self._config.commands:
            await client.subscribe(topic(self._config.vehicle, "command"), qos=1)
        _heed_cancel()

    async def _converse(self, client: aiomqtt.Client) -> None:
        """Send and hear until one of the two fails, or we are cancelled."""
        sending = asyncio.create_task(self._send(client))
        hearing = asyncio.create_task(self._hear(client))
        try:
            done, _ = await asyncio.wait((sending, hearing), return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            sending.cancel()
            hearing.cancel()
            await asyncio.gather(sending, hearing, return_exceptions=True)

    async def _send(self, client: aiomqtt.Client) -> None:
        while True:
            packet = await self._backlog.take()
            try:
                await self._publish(client, packet)
            except aiomqtt.MqttError:
                self._backlog.give_back(packet)
                raise
            _heed_cancel()

    async def _publish(self, client: aiomqtt.Client, packet: Packet) -> None:
        whole = topic(self._config.vehicle, packet.topic)
        await client.publish(whole, packet.payload, qos=packet.qos, retain=packet.retain)

    async def _hear(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            payload = message.payload
            # a retained command was given to nobody in particular, some time ago
            if message.retain or not self._config.commands or not isinstance(payload, bytes):
                continue
            if self._may_pass():
                self._command(payload[: LONGEST_COMMAND + 1])

    def _may_pass(self) -> bool:
        """So many commands a second; more than that is no person."""
        now = asyncio.get_running_loop().time()
        if now - self._budget_at >= 1.0:
            self._budget, self._budget_at = _COMMANDS_PER_S, now
        self._budget -= 1
        return self._budget >= 0


def _heed_cancel() -> None:
    """Raise a cancellation that was lost: until Python 3.12 `asyncio.wait_for` loses one that comes with an outcome."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


def _name(version: ProtocolVersion) -> str:
    return "5" if version is ProtocolVersion.V5 else "3.1.1"


def _secret(name: str) -> str | None:
    """Read anew at each attempt: a password may be changed meanwhile."""
    return Path(name).read_text(encoding="utf-8").strip("\r\n") if name else None


def _tls(config: MqttConfig) -> ssl.SSLContext | None:
    if not config.tls:
        return None
    context = ssl.create_default_context(cafile=config.ca_file or None)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if config.certificate_file:
        context.load_cert_chain(config.certificate_file, config.key_file)
    return context


def main(settings: dict[str, Any]) -> tuple[Take, Awaitable[None]]:
    """Publish what standard input brings."""
    config = MqttConfig(**settings)
    backlog = Backlog(config.queue_length)
    connection = Connection(
        config,
        backlog,
        lambda payload: tell("command", payload.decode(errors="replace")),
        lambda text: tell("log", text),
    )
    return lambda name, payload: backlog.put(Packet(name, payload.encode())), connection.run()


if __name__ == "__main__":
    run(main, _MOST_MEMORY)
