"""One file to attach to a bug report: what doctor found, the configuration, the log's end. Secrets stay here."""

import io
import json
import os
import stat
import subprocess
import tarfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from arm_companion.config.layers import files_of
from arm_companion.config.schema import Config
from arm_companion.doctor.check import Finding
from arm_companion.doctor.redaction import literal_secrets, redact, secret_files, secrets_in
from arm_companion.drivers.settings import state_directory
from arm_companion.errors import ConfigError

_LOG_LINES: Final = 2000
_LONGEST: Final = 2_000_000  # bytes of one file
_STATE: Final = ("parameters.json", "tendons.json", "tension.json", "parked.json")
_FOLDER: Final = "arm-companion-report"


def journal(lines: int = _LOG_LINES) -> str:
    """The end of the service's log, or in words why it cannot be had."""
    words = ["journalctl", "--unit=arm-companion", f"--lines={lines}", "--no-pager", "--output=short-precise"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=20.0, check=False)  # noqa: S603 - fixed words
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"no journal: {error}\n"
    return done.stdout or f"no journal: {done.stderr.strip()}\n"


def contents(
    findings: Sequence[Finding],
    file: str,
    settings: Sequence[str],
    config: Config | None,
    log: Callable[[], str] = journal,
) -> dict[str, str]:
    """The report's files by name, without secrets.

    Args:
        findings: what doctor found.
        file: the configuration file, as named on the command line.
        settings: `KEY=VALUE` of the command line.
        config: what came of them; None when it cannot be used.
        log: gives the service's log.
    """
    raw = {
        "doctor.json": json.dumps([finding.as_json() for finding in findings], indent=2) + "\n",
        "packages.txt": "".join(sorted(f"{d.name}=={d.version}\n" for d in metadata.distributions())),
        "system.txt": _system(),
        "log.txt": log(),
        "settings.txt": "".join(f"{setting}\n" for setting in settings),
    }
    tables: list[Any] = []
    for path in _config_files(file):
        text = _text(path)
        raw[f"config/{path.name}"] = text
        try:
            tables.append(tomllib.loads(text))
        except tomllib.TOMLDecodeError:
            continue
    for setting in settings:
        name, _, value = setting.partition("=")
        tables.append({name: value.strip("\"'")})
    for path in _state_files(config):
        raw[f"state/{path.name}"] = _text(path)
    known = secrets_in(path for table in tables for path in secret_files(table))
    for table in tables:
        known |= literal_secrets(table)
    return {name: redact(text, known) for name, text in raw.items()}


def write(path: Path, files: Mapping[str, str], unix_s: float) -> None:
    """Write the report as a tar.gz that only its maker may read.

    Raises:
        OSError: it cannot be written.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):  # one that was there keeps its mode, and a device is not ours
        os.fchmod(descriptor, 0o600)
    with os.fdopen(descriptor, "wb") as stream, tarfile.open(fileobj=stream, mode="w:gz") as archive:
        for name, text in files.items():
            data = text.encode()
            info = tarfile.TarInfo(f"{_FOLDER}/{name}")
            info.size, info.mtime, info.mode = len(data), int(unix_s), 0o600
            archive.addfile(info, io.BytesIO(data))


def _config_files(file: str) -> list[Path]:
    try:
        return files_of(file)
    except ConfigError:
        return [Path(file)] if Path(file).is_file() else []


def _state_files(config: Config | None) -> list[Path]:
    if config is None:
        return []
    places = [state_directory(config), Path(config.calibration.directory) if config.calibration.directory else None]
    return [place / name for place in places if place is not None for name in _STATE if (place / name).is_file()]


def _text(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return stream.read(_LONGEST).decode(errors="replace")
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}\n"


def _system() -> str:
    name = os.uname()
    lines = [f"{name.sysname} {name.release} {name.machine}", f"processors: {os.cpu_count()}"]
    for path in ("/etc/os-release", "/proc/cpuinfo", "/proc/device-tree/model"):
        if Path(path).exists():
            lines += [f"--- {path}", _text(Path(path)).strip("\0\n ")[:4000]]
    return "\n".join(lines) + "\n"
