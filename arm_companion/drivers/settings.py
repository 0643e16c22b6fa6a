"""The configuration as the ground may change it: checked, applied where that is safe, and kept on disk.

The file holds only what was changed, by the option's path, so that everything else stays as the configuration files
say. It is written beside itself and moved into place: a power cut leaves the old file or the new one.
"""

import json
import logging
import math
import os
from collections.abc import Callable
from pathlib import Path

from arm_companion.config.parameters import PARAMETERS, Parameter, When, overlay
from arm_companion.config.schema import Config
from arm_companion.drivers.keeper import Keeper
from arm_companion.errors import CommandRejected, ConfigError

log = logging.getLogger(__name__)

FILE = "parameters.json"


class Settings:
    """The configuration in force, and what changes it.

    Args:
        config: as the daemon was started with.
        directory: where changes are kept; None keeps none.
        keeper: writes them.

    Attributes:
        stowed: says why the arm is not stowed; None when it is. The composition root sets it.
        apply: takes a configuration that is in force from now on. The composition root sets it.
    """

    def __init__(self, config: Config, directory: Path | None = None, keeper: Keeper | None = None) -> None:
        self.config = config
        self.stowed: Callable[[], str | None] = lambda: None
        self.apply: Callable[[Config], None] = lambda _: None
        self._next = config  # with what waits for a restart
        self._file = None if directory is None else directory / FILE
        self._changed = read_changes(directory)
        self._keeper = keeper

    def value(self, parameter: Parameter) -> float:
        """What was set last, in force or not yet."""
        return parameter.read(self._next)

    def set(self, parameter: Parameter, value: float) -> None:
        """Change an option.

        Raises:
            CommandRejected: the value does not fit, or this is not the time.
        """
        if not math.isfinite(value):
            raise CommandRejected(f"{parameter.name}: the value is not a number")
        try:
            changed = parameter.write(self._next, value)
            live = None if parameter.when is When.RESTART else parameter.write(self.config, value)
        except ConfigError as error:
            raise CommandRejected(str(error)) from None
        if parameter.read(changed) == parameter.read(self._next):
            return
        if parameter.when is When.STOWED and (reason := self.stowed()) is not None:
            raise CommandRejected(f"{parameter.name} can change only while the arm is stowed: {reason}")
        log.info("%s = %.7g (%s)", parameter.path, parameter.read(changed), parameter.when.value)
        self._next = changed
        self._changed[parameter.path] = parameter.read(changed)
        if self._file is not None and self._keeper is not None:
            changes = json.dumps(dict(sorted(self._changed.items())), indent=1)
            self._keeper.put(self._file, changes.encode() + b"\n")
        if live is not None:
            self.config = live
            self.apply(live)


def state_directory(config: Config) -> Path | None:
    """Where the daemon keeps what it must remember: as configured, or as systemd says; None: nowhere."""
    directory = config.mavlink.state_directory or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(directory) if directory else None


def with_kept_changes(config: Config) -> Config:
    """The configuration with what a ground station has changed in earlier runs."""
    changed, complaints = overlay(config, read_changes(state_directory(config)))
    for complaint in complaints:
        log.warning("kept parameters: %s; the configuration file counts", complaint)
    for parameter in PARAMETERS:
        if (value := parameter.read(changed)) != (configured := parameter.read(config)):
            log.info("%s = %.7g as set from the ground (file: %.7g)", parameter.path, value, configured)
    return changed


def read_changes(directory: Path | None) -> dict[str, float]:
    """What was changed in earlier runs, by path; a file that cannot be read counts as empty, with a warning."""
    if directory is None:
        return {}
    try:
        table = json.loads((directory / FILE).read_text(encoding="utf-8"))
        return {str(path): float(value) for path, value in table.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        log.warning("%s is left aside: %s", directory / FILE, error)
        return {}
