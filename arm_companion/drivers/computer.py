"""How the companion computer does: ONBOARD_COMPUTER_STATUS, from what Linux tells of itself.

The looking is done in a thread: a dying disk may keep whoever asks it waiting.
"""

import asyncio
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from arm_companion.drivers.writer import Writer
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

_PERIOD_S: Final = 5.0
_MIB: Final = 1024 * 1024
_CORES: Final = 8  # that have a place in the message
_FULL_SHARE: Final = 0.98
_UNKNOWN8: Final = 255
_NO_TEMPERATURE: Final = 127
_UNKNOWN16: Final = 32_767
_UNKNOWN32: Final = 0xFFFFFFFF

# bits of the Raspberry Pi firmware's `get_throttled`, and what they mean now
_THROTTLED: Final = (
    (0x1, mav.COMPUTER_STATUS_FLAGS_UNDER_VOLTAGE),
    (0x2 | 0x4, mav.COMPUTER_STATUS_FLAGS_CPU_THROTTLE),
    (0x8, mav.COMPUTER_STATUS_FLAGS_THERMAL_THROTTLE),
)


@dataclass(frozen=True, slots=True)
class Load:
    """Jiffies of one processor core since the start."""

    busy: int
    total: int


@dataclass(frozen=True, slots=True)
class Computer:
    """One look at the machine; what it does not tell is nan or None.

    Attributes:
        uptime_s: since it was switched on.
        cores: what each core has done so far.
        temperature_c: of the processor.
        memory: used and in all, bytes.
        storage: used and in all, bytes, of the disk that the daemon writes to.
        flags: COMPUTER_STATUS_FLAGS.
    """

    uptime_s: float = math.nan
    cores: tuple[Load, ...] = ()
    temperature_c: float = math.nan
    memory: tuple[float, float] | None = None
    storage: tuple[float, float] | None = None
    flags: int = 0


def look(root: Path = Path("/"), disk: Path = Path("/")) -> Computer:
    """Look at the machine whose /proc and /sys are below `root`; `disk` is any path on the disk of interest.

    Nothing is raised: what cannot be read is not known.
    """
    storage = _storage(disk)
    flags = 0
    with suppress(OSError, ValueError):
        bits = int((root / "sys/devices/platform/soc/soc:firmware/get_throttled").read_text(), 16)
        for mask, flag in _THROTTLED:
            flags |= flag if bits & mask else 0
    if storage is not None and storage[0] > _FULL_SHARE * storage[1]:
        flags |= mav.COMPUTER_STATUS_FLAGS_DISK_FULL
    uptime = math.nan
    with suppress(OSError, ValueError, IndexError):
        uptime = float((root / "proc/uptime").read_text().split()[0])
    return Computer(uptime, _cores(root), _temperature(root), _memory(root), storage, flags)


class ComputerWatch:
    """Looks every few seconds, and makes the message of the newest look.

    Args:
        disk: any path on the disk that the daemon writes to.
        root: below which /proc and /sys are.
    """

    def __init__(self, disk: Path = Path("/"), root: Path = Path("/")) -> None:
        self._disk, self._root = disk, root
        self._before = self._now = Computer()
        self._looker = Writer("computer")

    async def run(self) -> None:
        """Look until cancelled."""
        try:
            while True:
                # not asyncio.to_thread: the loop's end would wait for a look that hangs
                self.see(await asyncio.wrap_future(self._looker.submit(look, self._root, self._disk)))
                await asyncio.sleep(_PERIOD_S)
        finally:
            self._looker.end()

    def see(self, computer: Computer) -> None:
        """Take in a look."""
        self._before, self._now = self._now, computer

    def message(self, stamp: int) -> Message:
        """ONBOARD_COMPUTER_STATUS; what is not known has the value that says so.

        Args:
            stamp: Unix time, us.
        """
        now = self._now
        shares = _shares(self._before.cores, now.cores)
        ram_used, ram_all = _mib(now.memory)
        disk_used, disk_all = _mib(now.storage)
        degrees = _NO_TEMPERATURE if math.isnan(now.temperature_c) else max(-128, min(126, round(now.temperature_c)))
        return mav.MAVLink_onboard_computer_status_message(
            stamp,
            0 if math.isnan(now.uptime_s) else int(now.uptime_s * 1e3) & _UNKNOWN32,
            0,
            _padded(shares[:_CORES], _CORES, _UNKNOWN8),
            [_UNKNOWN8] * 10,
            [_UNKNOWN8] * 4,
            [_UNKNOWN8] * 10,
            _NO_TEMPERATURE,
            _padded([degrees], 8, _NO_TEMPERATURE),
            [_UNKNOWN16] * 4,
            ram_used,
            ram_all,
            [_UNKNOWN32] * 4,
            _padded([disk_used], 4, _UNKNOWN32),
            _padded([disk_all], 4, _UNKNOWN32),
            *([[_UNKNOWN32] * 6] * 5),
            now.flags,
        )


def _cores(root: Path) -> tuple[Load, ...]:
    found = []
    with suppress(OSError, ValueError):
        for line in (root / "proc/stat").read_text().splitlines():
            name, *fields = line.split()
            if name.startswith("cpu") and name != "cpu":
                jiffies = [int(field) for field in fields[:8]]  # guest time counts as user time already
                idle = sum(jiffies[3:5])
                found.append(Load(sum(jiffies) - idle, sum(jiffies)))
    return tuple(found)


def _shares(before: Sequence[Load], now: Sequence[Load]) -> list[int]:
    """Per cent of the time between two looks that each core was busy; none when they cannot be compared."""
    if len(before) != len(now):
        return []
    spans = [(b.busy - a.busy, b.total - a.total) for a, b in zip(before, now, strict=True)]
    return [max(0, min(100, round(100 * busy / total))) if total > 0 else 0 for busy, total in spans]


def _temperature(root: Path) -> float:
    """Of the hottest thermal zone, degC."""
    degrees = []
    for zone in root.glob("sys/class/thermal/thermal_zone*/temp"):
        with suppress(OSError, ValueError):
            degrees.append(int(zone.read_text()) / 1000.0)
    return max(degrees, default=math.nan)


def _memory(root: Path) -> tuple[float, float] | None:
    with suppress(OSError, ValueError, KeyError):
        rows = dict(line.split(":", 1) for line in (root / "proc/meminfo").read_text().splitlines())
        total, free = (1024.0 * int(rows[name].split()[0]) for name in ("MemTotal", "MemAvailable"))
        return total - free, total
    return None


def _storage(disk: Path) -> tuple[float, float] | None:
    with suppress(OSError):
        facts = os.statvfs(disk)
        total = float(facts.f_frsize * facts.f_blocks)
        return total - float(facts.f_frsize * facts.f_bavail), total
    return None


def _mib(pair: tuple[float, float] | None) -> tuple[int, int]:
    if pair is None:
        return _UNKNOWN32, _UNKNOWN32
    used, total = (min(round(value / _MIB), _UNKNOWN32 - 1) for value in pair)
    return used, total


def _padded(values: Sequence[int], length: int, filler: int) -> list[int]:
    return [*values, *[filler] * (length - len(values))]
