"""What is examined: the machine, the configuration, and what was seen of vehicle and servos. All of it injected."""

import itertools
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from arm_companion.config.schema import Config
from arm_companion.drivers.servo_health import ServoState


@dataclass(frozen=True, slots=True)
class Machine:
    """The computer. Files are read below `root`, so that a test can lay out a machine of its own."""

    unix_s: float
    synchronised: bool | None  # by a time service; None: cannot be told
    free_bytes: Callable[[Path], int]
    """Free space at a directory that exists; raises OSError."""
    version: Callable[[str], str | None]
    """Of an installed package; None: it is not."""
    mechanics: Callable[[], str]
    """Loads the compiled mechanics and says from where; raises `NotCompiled`."""
    root: Path = Path("/")
    environ: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))

    def text(self, path: str) -> str | None:
        """A small file below the root, stripped; None where there is none."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip("\0\n ")
        except OSError:
            return None

    def daemons(self) -> list[int]:
        """Processes that are the daemon."""
        found = []
        for entry in (self.root / "proc").glob("[0-9]*/cmdline"):
            try:
                words = entry.read_bytes().decode(errors="replace").split("\0")
            except OSError:
                continue
            if is_daemon(words):
                found.append(int(entry.parent.name))
        return sorted(found)


def is_daemon(words: list[str]) -> bool:
    """Whether a command line is `arm-companion run`, however it was started."""
    for before, word in itertools.pairwise(words):
        if word == "run" and (Path(before).name in {"arm-companion", "arm_companion"} or "arm_companion/" in before):
            return True
    return False


@dataclass(frozen=True, slots=True)
class VehicleSeen:
    """What came from the autopilot's link in a few seconds of listening."""

    error: str = ""  # why the link could not be opened
    received_bytes: int = 0
    frames: int = 0
    lost: int = 0  # frames missing from the senders' sequences
    damaged: int = 0  # candidates with a wrong checksum
    refused: int = 0  # frames that signing did not let in
    system_id: int = 0  # of the autopilot, 0: not heard
    fits: bool = True  # it is the configured flight stack
    parameters: Mapping[str, float] = field(default_factory=dict)
    rates_hz: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # by message: asked, got
    clock_error_s: float = float("inf")  # of TIMESYNC
    stations: tuple[int, ...] = ()  # ground stations heard through the autopilot


@dataclass(frozen=True, slots=True)
class ServosSeen:
    """What the servos said in a few reads."""

    error: str = ""  # why the port could not be opened
    servos: tuple[ServoState, ...] = ()
    firmware: tuple[int, ...] = ()
    answers: int = 0
    lost: int = 0  # requests without a good answer
    latency_s: float = 0.0  # of a transaction beyond its time on the wire


@dataclass(frozen=True, slots=True)
class Subject:
    """All that the checks see."""

    machine: Machine
    config: Config | None = None
    config_error: str = ""
    vehicle: VehicleSeen | str = "not looked at"
    """What was seen, or why nobody looked."""
    servos: ServosSeen | str = "not looked at"
    """What was seen, or why nobody looked."""
    daemons: tuple[int, ...] = ()
