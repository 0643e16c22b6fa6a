"""A configuration as a plain table, and back."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from arm_companion.config.layers import apply_setting
from arm_companion.config.options import read
from arm_companion.config.schema import Config


def as_table(value: Any) -> Any:
    """What JSON knows of a configuration or a part of one."""
    if dataclasses.is_dataclass(value):
        return {f.name: as_table(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: as_table(item) for key, item in value.items()}
    return [as_table(item) for item in value] if isinstance(value, tuple) else value


def from_table(table: Mapping[str, Any], source: str, settings: Iterable[str] = ()) -> Config:
    """The configuration that `as_table` wrote, with `section.key=value` settings over it.

    Raises:
        ConfigError: naming `source`, key, value and allowed range.
    """
    known = _without_none(table)
    for setting in settings:
        apply_setting(known, setting)
        source = f"{source} with --set"
    return read(Config, known, lambda _: source)


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return [_without_none(item) for item in value] if isinstance(value, list) else value
