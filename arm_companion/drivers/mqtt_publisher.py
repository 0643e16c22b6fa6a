"""Telemetry over MQTT, from the daemon's side: what is due goes into a bounded queue, and on to a process of its own.

The connection lives in another process (`mqtt_client`), since a hostile broker can make its client work and allocate as
much as it likes: neither the interpreter's lock nor the memory of the flight program is touched. The process runs at
ordinary priority, and is started again when it ends.
"""

import asyncio
import contextlib
import importlib.util
import json
import logging
import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import MqttConfig
from arm_companion.drivers import mqtt_payloads as payloads
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.mqtt_commands import MqttCommands
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.drivers.streams import Streams
from arm_companion.errors import ConfigError
from arm_companion.mission.facts import Commands, Facts, Notice
from arm_companion.protocol.mqtt import Packet

log = logging.getLogger(__name__)

_MODULE: Final = "arm_companion.drivers.mqtt_client"
_FIRST_DELAY_S: Final = 1.0
_LONGEST_DELAY_S: Final = 60.0
_STEADY_S: Final = 60.0  # a process that lived so long is started again soon
_END_WITHIN_S: Final = 2.0
_LINE_LIMIT: Final = 16_384
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
        self.dropped = 0
        """Messages that were dropped from the queue."""
        self._config = config
        self._clock = clock
        self._queue: deque[Packet] = deque(maxlen=config.queue_length)
        self._filled = asyncio.Event()
        self._streams = Streams()
        for name, rate in (
            ("state", config.state_hz),
            ("wrench", config.wrench_hz),
            ("tendons", config.tendons_hz),
            ("health", config.health_hz),
        ):
            self._streams.offer(_TOPICS[name], rate)
        self._shown: object = None
        self._failed = False
        self._commands = MqttCommands(config, commands, clock, self.put) if config.commands and commands else None

    def put(self, packet: Packet) -> None:
        """Queue a message; the oldest is dropped when too many wait."""
        if len(self._queue) == self._queue.maxlen:
            self.dropped += 1
        self._queue.append(packet)
        self._filled.set()

    def take(self) -> Packet | None:
        """The oldest message that waits."""
        return self._queue.popleft() if self._queue else None

    def event(self, notice: Notice) -> None:
        """Tell a sentence for people."""
        self._safely(lambda: self.put(payloads.event(self._clock.unix(self._clock.now()), notice)))

    def publish(self, now: float, facts: Facts, commands: Commands, health: Callable[[], Health]) -> None:
        """Queue whatever is due; called once a cycle, and never raises.

        Args:
            now: loop time, s.
            facts: what the cycle saw.
            commands: what it asked for, with the reports.
            health: how the daemon does, when that is due.
        """
        self._safely(lambda: self._publish(now, facts, commands, health))

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

    def _safely(self, work: Callable[[], None]) -> None:
        """Telemetry for people never costs a cycle."""
        try:
            work()
        except Exception:
            if not self._failed:
                log.exception("mqtt: telemetry failed; further failures are not told")
            self._failed = True

    # --- the process ---

    async def run(self) -> None:
        """Keep the process with the connection alive, until cancelled."""
        if importlib.util.find_spec("aiomqtt") is None:
            log.error("mqtt: nothing is published: aiomqtt is missing (pip install 'arm-companion[mqtt]')")
            return
        delay = _FIRST_DELAY_S
        loop = asyncio.get_running_loop()
        while True:
            started = loop.time()
            try:
                code = await self._serve()
                log.warning("mqtt: the process with the connection ended with code %s", code)
            except (OSError, ValueError) as error:
                log.warning("mqtt: the process with the connection failed: %s", error)
            delay = _FIRST_DELAY_S if loop.time() - started > _STEADY_S else min(2.0 * delay, _LONGEST_DELAY_S)
            await asyncio.sleep(delay)

    async def _serve(self) -> int | None:
        """One life of the process; its exit code."""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", _MODULE,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=_LINE_LIMIT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        tasks: Sequence[asyncio.Task[None]] = ()
        try:
            if process.stdin is None or process.stdout is None:
                return None
            process.stdin.write(json.dumps(asdict(self._config)).encode() + b"\n")
            tasks = (
                asyncio.create_task(self._feed(process.stdin)),
                asyncio.create_task(self._listen(process.stdout)),
            )
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await _end(process)
        return process.returncode

    async def _feed(self, pipe: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await self._filled.wait()
                self._filled.clear()
                while (packet := self.take()) is not None:
                    pipe.write(json.dumps([packet.topic, packet.payload.decode()]).encode() + b"\n")
                    await pipe.drain()

    async def _listen(self, pipe: asyncio.StreamReader) -> None:
        while line := await pipe.readline():
            kind, value = json.loads(line)
            if kind == "command" and self._commands is not None:
                self._commands.take(str(value).encode())
            elif kind == "log":
                log.info("mqtt: %s", value)


async def _end(process: asyncio.subprocess.Process) -> None:
    """Let the process say goodbye; its end of input asks it to."""
    if process.stdin is not None:
        process.stdin.close()
    try:
        async with asyncio.timeout(_END_WITHIN_S):
            await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def check_files(config: MqttConfig) -> None:
    """That the files of the configuration can be read, and secret ones by nobody else.

    Raises:
        ConfigError: when not, with key and path.
    """
    for key in ("ca_file", "certificate_file", "key_file", "user_file", "password_file"):
        name = getattr(config, key)
        if not name:
            continue
        try:
            with Path(name).open("rb") as stream:
                mode = os.fstat(stream.fileno()).st_mode
        except OSError as error:
            raise ConfigError(f"mqtt.{key} {name}: {error.strerror}") from None
        if key in {"key_file", "password_file"} and mode & 0o007:
            raise ConfigError(f"mqtt.{key} {name}: others may use it (mode {mode & 0o777:04o}); chmod 640 {name}")
