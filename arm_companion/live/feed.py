"""The live view from the daemon's side: messages of a record and a scene, some times a second, while somebody looks.

The server lives in a process of its own (`live.server`); here is a bounded queue. Sentences and transitions are passed
on always, and every one.
"""

import dataclasses
import importlib.util
import ipaddress
import math
from dataclasses import dataclass
from typing import Any, Final

from arm_companion.clock import Clock
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table
from arm_companion.drivers.side_process import Entry, SideProcess
from arm_companion.drivers.streams import Streams
from arm_companion.errors import ConfigError
from arm_companion.geometry import so3
from arm_companion.mission.facts import Notice
from arm_companion.mission.outline import outline
from arm_companion.mission.situation import Situation
from arm_companion.record.recorder import Record
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, LOG, STATE, TRANSITIONS, log_message, transition
from arm_companion.record_codec import plain

RATE_HZ: Final = 20.0
"""Of facts, state, commands and scene: more than an eye follows, and a fifth of the cycles."""

_MODULE: Final = "arm_companion.live.server"
_NEEDS: Final = {"foxglove": "foxglove-sdk", "orjson": "orjson"}
_QUEUE: Final = 256
_SHOWN: Final = 1


@dataclass(frozen=True, slots=True)
class Address:
    """Where the live view is served."""

    host: str = "127.0.0.1"
    port: int = 8765

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @classmethod
    def read(cls, text: str) -> "Address":
        """From HOST:PORT, HOST being an IP address or localhost.

        Raises:
            ValueError: it is not.
        """
        host, _, port = text.rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        if host != "localhost":
            ipaddress.ip_address(host)
        if not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536):
            raise ValueError(f"{port} is no port")
        return cls(host, int(port))


class LiveView:
    """Feeds the live view.

    Args:
        config: of the daemon.
        clock: Unix time of the stamps.
        address: where it is served.

    Raises:
        ConfigError: what it needs is not installed.
    """

    def __init__(self, config: Config, clock: Clock, address: Address) -> None:
        missing = [package for module, package in _NEEDS.items() if importlib.util.find_spec(module) is None]
        if missing:
            raise ConfigError(f"--live needs {' and '.join(missing)}: pip install 'arm-companion[live]'")
        self._clock = clock
        self._viewers = 0
        settings = {"name": "arm_companion", **dataclasses.asdict(address)}
        self._process = SideProcess("live", _MODULE, settings, _QUEUE, self._hear)
        self._streams = Streams()
        self._streams.offer(_SHOWN, RATE_HZ)
        self._config = config

    async def run(self) -> None:
        """Keep the process alive, until cancelled."""
        self.configure(self._config)
        await self._process.run()

    def take(self) -> Entry | None:
        """The oldest message that waits for the process."""
        return self._process.take()

    def configure(self, config: Config) -> None:
        """This configuration is in force from now on."""
        self._config = config
        now = self._clock.now()
        self._process.safely(lambda: self._put(CONFIGURATION, now, {"t": now, "config": as_table(config)}))

    def event(self, notice: Notice) -> None:
        """Tell a sentence for people."""
        self._process.safely(lambda: self._notice(notice))

    def publish(self, record: Record, cycle: Situation) -> None:
        """Queue what is due; called once a cycle, and never raises.

        Args:
            record: the cycle, as it is recorded.
            cycle: the same with the memory after its step.
        """
        if self._viewers and self._streams.take_due(_SHOWN, record.t):
            self._process.safely(lambda: self._publish(record, cycle))

    def _publish(self, record: Record, cycle: Situation) -> None:
        stamp = {"t": record.t}
        self._put(FACTS, record.t, stamp | plain(record.facts))
        self._put(STATE, record.t, plain(record.state))
        self._put(COMMANDS, record.t, stamp | plain(record.commands))
        self._put("scene", record.t, _drawn(record, cycle))

    def _notice(self, notice: Notice) -> None:
        now = self._clock.now()
        self._put(LOG, now, log_message(self._ns(now), notice))
        if (change := transition(notice.text)) is not None:
            before, after, cause = change
            self._put(TRANSITIONS, now, {"t": now, "before": before, "after": after, "cause": cause})

    def _put(self, topic: str, t: float, value: dict[str, Any]) -> None:
        import orjson  # noqa: PLC0415 - of an extra

        self._process.put(topic, b"%d %b" % (self._ns(t), orjson.dumps(value)))

    def _hear(self, kind: str, text: str) -> None:
        if kind == "viewers":
            self._viewers = int(text)
        elif kind == "gone":  # the next one has to be told again
            self._viewers = 0
            self.configure(self._config)

    def _ns(self, t: float) -> int:
        return round(self._clock.unix(t) * 1e9)


def _drawn(record: Record, cycle: Situation) -> dict[str, Any]:
    """What `live.scene` draws; everything finite, in body axes (FRD)."""
    seen, wrench, vehicle = outline(cycle), record.commands.wrench, record.facts.vehicle
    known = wrench.valid and all(map(math.isfinite, (*wrench.force_b, *wrench.torque_b)))
    return {
        "fresh": cycle.vehicle_fresh,
        "position_w": vehicle.position_w,
        "attitude_wb": vehicle.attitude_wb,
        "mount": cycle.config.mount.position_m,
        "mount_attitude": so3.to_quaternion(cycle.mount.rotation),
        "disk_radius": cycle.config.perch.disk_radius_m,
        "backbone": seen.backbone_b,
        "bar": None if seen.bar is None else dataclasses.asdict(seen.bar),
        "keep_out": _keep_out(cycle),
        "force": wrench.force_b if known else None,
        "torque": wrench.torque_b if known else None,
    }


def _keep_out(cycle: Situation) -> dict[str, Any] | None:
    """The keep-out cone, body axes; None: there is none."""
    cone, mount = cycle.parameters.keep_out, cycle.mount
    if cone is None:
        return None
    apex, axis = mount @ cone.apex, mount.rotation @ cone.axis
    return {"apex": apex.tolist(), "axis": axis.tolist(), "half_angle": cone.half_angle}
