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
_PROCESSOR: Final = {  # entries of /proc/cpuinfo, on Intel's and AMD's and on Arm's
    "model name": "",
    "cpu family": "family ",
    "model": "model ",
    "CPU implementer": "implementer ",
    "CPU part": "part ",
}


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
    """Linear algebra picks its code by the processor, and with it the last bits; a name alone has many generations."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    lines = (line.partition(":") for line in text.partition("\n\n")[0].splitlines())
    first = {name.strip(): value.strip() for name, _, value in lines}
    return (
        ", ".join(f"{word}{first[name]}" for name, word in _PROCESSOR.items() if name in first) or platform.processor()
    )
