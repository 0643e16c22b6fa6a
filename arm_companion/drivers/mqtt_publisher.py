"""Telemetry over MQTT, from the daemon's side: what is due goes into a bounded queue, and on to a process of its own.

The connection lives in another process (`mqtt_client`), since a hostile broker can make its client work and allocate as
much as it likes.
"""

import importlib.util
import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import MqttConfig
from arm_companion.drivers import mqtt_payloads as payloads
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.drivers.remote_commands import RemoteCommands
from arm_companion.drivers.secret_file import check_file
from arm_companion.drivers.side_process import SideProcess
from arm_companion.drivers.streams import Streams
from arm_companion.mission.facts import Commands, Facts, Notice
from arm_companion.protocol.mqtt import Packet

log = logging.getLogger(__name__)

_MODULE: Final = "arm_companion.drivers.mqtt_client"
_TOPICS: Final = {"state": 1, "wrench": 2, "tendons": 3, "health": 4}


class MqttPublisher:
    """Publishes what the daemon does, and hands on commands where they are allowed.

    Args:
        config: broker, rates and queue.
        clock: Unix time of the stamps.
        commands: where commands go, when they are allowed.

    Raises:
        ConfigError: a file of the configuration cannot be used.
    """

    def __init__(self, config: MqttConfig, clock: Clock, commands: CommandService | None = None) -> None:
        check_files(config)
        self._config = config
        self._clock = clock
        self._process = SideProcess("mqtt", _MODULE, asdict(config), config.queue_length, self._hear)
        self._streams = Streams()
        for name, rate in (
            ("state", config.state_hz),
            ("wrench", config.wrench_hz),
            ("tendons", config.tendons_hz),
            ("health", config.health_hz),
        ):
            self._streams.offer(_TOPICS[name], rate)
        self._shown: object = None
        self._commands: RemoteCommands | None = None
        if config.commands and commands:
            # the broker's own access lists and TLS stand for a signature; the configuration demands them
            self._commands = RemoteCommands(
                "mqtt", config.command_system, commands, clock, self.put, age_s=config.command_age_s
            )

    @property
    def dropped(self) -> int:
        """Messages that were dropped from the queue."""
        return self._process.dropped

    def put(self, packet: Packet) -> None:
        """Queue a message; the oldest is dropped when too many wait."""
        self._process.put(packet.topic, packet.payload)

    def take(self) -> Packet | None:
        """The oldest message that waits."""
        entry = self._process.take()
        return None if entry is None else Packet(*entry)

    def event(self, notice: Notice) -> None:
        """Tell a sentence for people."""
        self._process.safely(lambda: self.put(payloads.event(self._clock.unix(self._clock.now()), notice)))

    def publish(self, now: float, facts: Facts, commands: Commands, health: Callable[[], Health]) -> None:
        """Queue whatever is due; called once a cycle, and never raises.

        Args:
            now: loop time, s.
            facts: what the cycle saw.
            commands: what it asked for, with the reports.
            health: how the daemon does, when that is due.
        """
        self._process.safely(lambda: self._publish(now, facts, commands, health))

    def _publish(self, now: float, facts: Facts, commands: Commands, health: Callable[[], Health]) -> None:
        unix, status = self._clock.unix(now), commands.status
        shown = (status.behaviour, status.state, status.error_bits, status.flags, status.calibration)
        if self._due("state", now) or (self._config.state_hz and shown != self._shown):
            self._shown = shown
            self.put(payloads.state(unix, status, facts.tendons, commands.wrench, facts.vehicle))
        if self._due("wrench", now):
            self.put(payloads.wrench(unix, commands.wrench))
        if self._due("tendons", now):
            self.put(payloads.tendons(unix, facts.tendons, commands.tensions))
        if self._due("health", now):
            self.put(payloads.health(unix, health(), facts.tendons, facts.vehicle, self.dropped))

    def _due(self, name: str, now: float) -> bool:
        return self._streams.take_due(_TOPICS[name], now)

    async def run(self) -> None:
        """Keep the process with the connection alive, until cancelled."""
        if importlib.util.find_spec("aiomqtt") is None:
            log.error("mqtt: nothing is published: aiomqtt is missing (pip install 'arm-companion[mqtt]')")
            return
        await self._process.run()

    def _hear(self, kind: str, text: str) -> None:
        if kind == "command" and self._commands is not None:
            self._commands.take(text.encode())


def check_files(config: MqttConfig) -> None:
    """That the files of the configuration can be read, and secret ones by nobody else.

    Raises:
        ConfigError: when not, with key and path.
    """
    for key in ("ca_file", "certificate_file", "key_file", "user_file", "password_file"):
        if name := getattr(config, key):
            check_file(f"mqtt.{key}", Path(name), secret=key in {"key_file", "password_file"})
