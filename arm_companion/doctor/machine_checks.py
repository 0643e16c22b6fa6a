"""Checks of the computer: versions, clock, disk, processor, USB adapter, compiled mechanics."""

import os
import platform
import re
import shutil
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Final

from arm_companion.arm import compiled
from arm_companion.config.schema import Config
from arm_companion.doctor.check import Check, Outcome, fail, ok, skipped, warn
from arm_companion.doctor.subject import Subject
from arm_companion.drivers import calibration_files
from arm_companion.drivers.calibration import TendonCalibration
from arm_companion.drivers.settings import state_directory
from arm_companion.transport.serial import LONGEST_LATENCY_TIMER_MS, latency_timer_ms

NEEDED: Final = ("fastcrc", "numpy", "pyserial")
_OPTIONAL: Final = ("numba", "aiomqtt", "mavsdk", "mujoco")
_OLDEST: Final = (3, 11)

_EPOCH_S: Final = datetime(2026, 1, 1, tzinfo=UTC).timestamp()
"""No machine that runs this program can be earlier."""

_DAY_S: Final = 86_400.0
RECORD_BYTES_PER_S: Final = 1.2e9 / 3600.0
"""Of the record at 100 Hz, measured."""

_SPARE_BYTES: Final = 50e6  # parameters, calibrations, time stamps: some kilobytes each; less than this is no disk
_ENOUGH_H: Final = 2.0


def no_config(subject: Subject) -> Outcome:
    """What a check says that has no configuration to go by."""
    return skipped("the configuration cannot be used" if subject.config_error else "there is no configuration")


def versions(subject: Subject) -> Iterator[Outcome]:
    """Program, Python, and the packages that flight needs."""
    found = {name: subject.machine.version(name) for name in ("arm-companion", *NEEDED, *_OPTIONAL)}
    listed = ", ".join(f"{name} {version}" for name, version in found.items() if version)
    if sys.version_info < _OLDEST:
        yield fail(f"Python {platform.python_version()}", "install Python 3.11 or newer")
    for name in NEEDED:
        if found[name] is None:
            yield fail(f"{name} is missing", "install the program again: systemd/install.sh")
        elif old := _older(name, found[name] or ""):
            yield fail(f"{name} {found[name]} is older than {old}", "install the program again: systemd/install.sh")
    yield ok(f"{listed}; Python {platform.python_version()}, {platform.system()} {platform.machine()}")


def _older(name: str, version: str) -> str:
    """The least version that this program asks for, if `version` is below it."""
    try:
        asked = metadata.requires("arm-companion") or []
    except metadata.PackageNotFoundError:
        return ""
    for requirement in asked:
        match = re.fullmatch(rf"{re.escape(name)}>=([\d.]+)", requirement.replace(" ", ""))
        if match and _numbers(version) < _numbers(match[1]):
            return match[1]
    return ""


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def clock(subject: Subject) -> Iterator[Outcome]:
    """The wall clock, which stamps telemetry, records and calibrations, and signs MAVLink."""
    machine = subject.machine
    now = datetime.fromtimestamp(machine.unix_s, UTC)
    if machine.unix_s < _EPOCH_S:
        yield fail(f"the clock says {now:%Y-%m-%d}: it was never set", "set it: NTP, GPS, or `timedatectl set-time`")
    config = subject.config
    if config is not None and config.calibration.directory:
        made = calibration_files.tendons(config.calibration.directory)
        if isinstance(made, TendonCalibration) and made.made_unix_s > machine.unix_s + _DAY_S:
            yield fail(f"the clock says {now:%Y-%m-%d}, before the calibration of {made.made}", "set the clock")
    if machine.synchronised is False:
        yield warn(
            f"{now:%Y-%m-%d %H:%M:%S} UTC, and no time service keeps it right",
            "`timedatectl set-ntp true`; in the field a GPS or a battery clock",
        )
    else:
        kept = "kept right by a time service" if machine.synchronised else "whether it is right cannot be told"
        yield ok(f"{now:%Y-%m-%d %H:%M:%S} UTC, {kept}")


def disk(subject: Subject) -> Iterator[Outcome]:
    """Room for records, and directories that can be written."""
    config = subject.config
    if config is None:
        yield no_config(subject)
        return
    wanted = _directories(config)
    if not wanted:
        yield warn(
            "nothing is kept: no record, no parameters, no calibration",
            "set record.directory, mavlink.state_directory and calibration.directory",
        )
    for what, directory in wanted.items():
        standing = _standing(directory)
        free = subject.machine.free_bytes(standing)
        writable = os.access(standing, os.W_OK, effective_ids=True)
        if standing != directory and not writable:
            yield fail(f"{what}: {directory} does not exist and cannot be made", f"make {directory}")
        elif standing == directory and not writable:
            yield fail(
                f"{what}: {directory} cannot be written by this user",
                f"give it to the service: chown arm-companion {directory}",
            )
        elif free < _SPARE_BYTES:
            yield fail(f"{what}: {free / 1e6:.0f} MB are free at {directory}", "delete old records")
        elif what == "record" and (hours := free / RECORD_BYTES_PER_S / 3600.0) < _ENOUGH_H:
            yield warn(f"{what}: room for {hours:.1f} h at {directory}", "delete old records")
        else:
            yield ok(f"{what}: {free / 1e9:.1f} GB are free at {directory}")


def _directories(config: Config) -> dict[str, Path]:
    """What is kept, and where."""
    record = Path(config.record.file).parent if config.record.file else Path(config.record.directory)
    state = state_directory(config)
    found = {}
    if config.record.file or config.record.directory:
        found["record"] = record
    if state is not None:
        found["parameters"] = state
    if config.calibration.directory:
        found["calibration"] = Path(config.calibration.directory)
    return found


def _standing(directory: Path) -> Path:
    """The directory, or the nearest above it that exists."""
    return next((path for path in (directory, *directory.absolute().parents) if path.is_dir()), Path("/"))


def governor(subject: Subject) -> Outcome:
    """How the processor chooses its speed."""
    policies = sorted(subject.machine.root.glob("sys/devices/system/cpu/cpufreq/policy*/scaling_governor"))
    found = {path.read_text(encoding="ascii").strip() for path in policies}
    if not found:
        return skipped("this machine shows no governor")
    if found <= {"performance"}:
        return ok("performance")
    return warn(", ".join(sorted(found)), "`cpupower frequency-set -g performance`, at each boot")


def latency_timer(subject: Subject) -> Outcome:
    """How long the servo bus' USB adapter holds bytes back."""
    if subject.config is None:
        return no_config(subject)
    port = subject.config.servos.port
    if port.startswith("tcp:"):
        return skipped(f"{port} is a bridge: its own adapter is elsewhere")
    timer = latency_timer_ms(port, subject.machine.root / "sys")
    if timer is None:
        return skipped(f"{port} has no such timer, or is not there")
    if timer <= LONGEST_LATENCY_TIMER_MS:
        return ok(f"{timer} ms")
    return warn(f"{timer} ms at {port}", "install systemd/99-arm-companion.rules as a udev rule, which sets 1 ms")


def mechanics(subject: Subject) -> Outcome:
    """Whether the daemon will find its compiled mechanics."""
    try:
        return ok(f"compiled, in {subject.machine.mechanics()}")
    except compiled.NotCompiled as reason:
        mend = "as the service's user: NUMBA_CACHE_DIR=/var/cache/arm-companion arm-companion model warm"
        if subject.machine.version("numba") is None:
            mend = "pip install 'arm-companion[fast]', then arm-companion model warm"
        return warn(f"the daemon will fly on NumPy: {reason}", mend)


def free_bytes(directory: Path) -> int:
    """Free space of the disk at a directory."""
    return shutil.disk_usage(directory).free


CHECKS: Final = (
    Check("versions", "a package that is missing or too old fails in flight rather than now", versions),
    Check("clock", "time stamps, ages of calibrations and MAVLink signing go by it", clock),
    Check("disk", "a full disk ends the record; parameters and calibrations need a directory", disk),
    Check("cpu governor", "a processor that saves power misses cycles", governor),
    Check("latency timer", "every answer of a servo waits for it, and the cycle for the servos", latency_timer),
    Check("compiled mechanics", "a tenth of the time for each cycle's mechanics", mechanics),
)
