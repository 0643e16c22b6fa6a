"""From files, environment and settings to one checked `Config`."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from arm_companion.config.layers import Layers, collect
from arm_companion.config.options import read
from arm_companion.config.schema import Config


def load(file: str | Path, settings: Iterable[str] = (), environment: Mapping[str, str] | None = None) -> Config:
    """Read a configuration in all its layers (`layers`).

    Args:
        file: a TOML file, or the bare name of one that ships with the package (`sim.toml`).
        settings: `section.key=value` strings that override everything else; the value is TOML, or else a string.
        environment: variables that may override the files; without it none do.

    Raises:
        ConfigError: naming file, variable or setting, key, value and allowed range.
    """
    return checked(collect(file, settings, environment))


def checked(layers: Layers) -> Config:
    """The configuration of layers that were collected before.

    Raises:
        ConfigError: naming file, variable or setting, key, value and allowed range.
    """
    return read(Config, layers.table, layers.source)
