"""The page for the field, from the daemon's side: what browsers are shown, and ABORT on its way in.

The server lives in a process of its own (`arm_companion.page.server`). While no browser looks, it is sent only
sentences.
"""

import json
import logging
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from arm_companion.clock import Clock
from arm_companion.config.schema import Config
from arm_companion.drivers import mqtt_payloads as payloads
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.drivers.remote_commands import RemoteCommands
from arm_companion.drivers.secret_file import check_file
from arm_companion.drivers.side_process import Entry, SideProcess
from arm_companion.drivers.streams import Streams
from arm_companion.errors import ConfigError
from arm_companion.mission.facts import Commands, Notice
from arm_companion.mission.outline import Outline, outline
from arm_companion.mission.situation import Situation
from arm_companion.protocol.mqtt import Order, Packet

log = logging.getLogger(__name__)

SHORTEST_TOKEN: Final = 16

_MODULE: Final = "arm_companion.page.server"
_QUEUE: Final = 64
_ABORT_AGE_S: Final = 5.0
_SHOWN, _HEALTH = 1, 2
_HEALTH_HZ: Final = 1.0


class FieldPage:
    """Feeds the page, and hands on its ABORT.

    Args:
        config: of the whole daemon.
        clock: Unix time of the stamps.
        commands: where ABORT goes, as any order does.

    Raises:
        ConfigError: the token's file cannot be used.
    """

    def __init__(self, config: Config, clock: Clock, commands: CommandService) -> None:
        page = config.page
        check_token(page.token_file)
        self._clock = clock
        self._settings = {"page": asdict(page), "setup": _setup(config)}
        self._process = SideProcess("page", _MODULE, self._settings, _QUEUE, self._hear)
        self._commands = (
            RemoteCommands("page", page.command_system, commands, clock, self._put, age_s=_ABORT_AGE_S)
            if page.abort
            else None
        )
        self._viewers = 0
        self._due: list[str] = []
        self._streams = Streams()
        self._streams.offer(_SHOWN, page.rate_hz)
        self._streams.offer(_HEALTH, _HEALTH_HZ)

    def take(self) -> Entry | None:
        """The oldest message that waits for the process."""
        return self._process.take()

    def event(self, notice: Notice) -> None:
        """Tell a sentence for people."""
        self._process.safely(lambda: self._put(payloads.event(self._unix(), notice)))

    def configure(self, config: Config) -> None:
        """This configuration is in force from now on."""
        self._settings["setup"] = _setup(config)  # for a process that is started later
        self._process.safely(lambda: self._process.put("limits", json.dumps(_limits(config)).encode()))

    def publish(self, now: float, cycle: Situation, commands: Commands, health: Callable[[], Health]) -> None:
        """Queue what is due; called once a cycle, and never raises.

        Args:
            now: loop time, s.
            cycle: what it saw, with the memory after its step.
            commands: what it asked for, with the reports.
            health: how the daemon does, when that is due.
        """
        if self._viewers:
            self._process.safely(lambda: self._publish(now, cycle, commands, health))

    async def run(self) -> None:
        """Keep the process alive, until cancelled."""
        await self._process.run()

    def _publish(self, now: float, cycle: Situation, commands: Commands, health: Callable[[], Health]) -> None:
        """One kind a cycle: together they would take a millisecond of the same one."""
        if self._streams.take_due(_SHOWN, now):
            self._due = ["arm", "tendons", "wrench", "state"]
        if self._streams.take_due(_HEALTH, now):
            self._due.insert(0, "health")
        if not self._due:
            return
        unix, facts = self._clock.unix(now), cycle.facts
        match self._due.pop():
            case "state":
                self._put(payloads.state(unix, commands.status, facts.tendons, commands.wrench, facts.vehicle))
            case "wrench":
                self._put(payloads.wrench(unix, commands.wrench))
            case "tendons":
                self._put(payloads.tendons(unix, facts.tendons, commands.tensions))
            case "arm":
                self._process.put("arm", _drawn(outline(cycle)))
            case "health":
                self._put(payloads.health(unix, health(), facts.tendons, facts.vehicle, self._process.dropped))

    def _put(self, packet: Packet) -> None:
        self._process.put(packet.topic, packet.payload)

    def _hear(self, kind: str, text: str) -> None:
        match kind:
            case "viewers":
                self._viewers = int(text)
            case "gone":  # the process, and with it whoever looked
                self._viewers = 0
            case "abort" if self._commands is not None:
                self._commands.give(Order("ABORT", (), text, self._unix()))

    def _unix(self) -> float:
        return self._clock.unix(self._clock.now())


def check_token(name: str) -> None:
    """That the token's file can be read, by nobody else, and that the token cannot be guessed.

    Raises:
        ConfigError: when not.
    """
    if not name:
        return
    check_file("page.token_file", Path(name), secret=True)
    try:
        token = Path(name).read_text(encoding="utf-8").strip()
    except UnicodeDecodeError:
        raise ConfigError(f"page.token_file {name}: it is no text") from None
    if len(token) < SHORTEST_TOKEN:
        raise ConfigError(f"page.token_file {name}: the token has {len(token)} characters, at least {SHORTEST_TOKEN}")


def _setup(config: Config) -> dict[str, Any]:
    """What the page has to know once."""
    return {
        "abort": config.page.abort,
        **_limits(config),
        "mount": list(config.mount.position_m),
        "disk_radius": config.perch.disk_radius_m,
    }


def _limits(config: Config) -> dict[str, float]:
    """What the ground may change while the page is open."""
    return {
        "tension_max": config.limits.tension_max_n,
        "tension_min": config.limits.tension_min_n,
        "force_max": config.limits.wrench_force_n,
        "torque_max": config.limits.wrench_moment_nm,
    }


def _drawn(seen: Outline) -> bytes:
    """Tenths of a millimetre are enough to look at."""
    bar = None
    if seen.bar is not None:
        bar = {"point": _rounded(seen.bar.point_b), "axis": _rounded(seen.bar.axis_b), "radius": seen.bar.radius}
    line = [_rounded(point) for point in seen.backbone_b]
    return json.dumps({"backbone": line, "held": seen.held, "bar": bar}, separators=(",", ":")).encode()


def _rounded(v: tuple[float, ...]) -> list[float | None]:
    return [round(x, 4) if math.isfinite(x) else None for x in v]
