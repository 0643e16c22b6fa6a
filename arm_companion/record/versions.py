"""What a record was made with: versions, machine and calibration, as text by name."""

import platform
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy as np

from arm_companion import __version__
from arm_companion.config.schema import Config
from arm_companion.drivers.calibration_files import TENDONS, TENSION
from arm_companion.record.topics import FORMAT

_PACKAGES: Final = ("numba", "orjson", "mcap")


def versions(config: Config) -> dict[str, str]:
    """The metadata of a record: what must be the same for the same bits, and the calibration that was flown on."""
    found = {
        "format": FORMAT,
        "version": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    for name in (TENDONS, TENSION):
        found[f"calibration/{name}"] = _text(config.calibration.directory, name)
    return {name: text for name, text in found.items() if text}


def _text(directory: str, name: str) -> str:
    if not directory:
        return ""
    try:
        return (Path(directory) / name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):  # missing or damaged: the daemon has said so
        return ""


def _processor() -> str:
    """Linear algebra picks its code by the processor, and with it the last bits."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    named = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "CPU part")))
    return next(named, platform.processor())
