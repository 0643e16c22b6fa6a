"""From files and `KEY=VALUE` settings to one checked `Config`."""

import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from arm_companion.config.options import read
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError

_EXTENDS = "extends"


def load(file: str | Path, settings: Iterable[str] = ()) -> Config:
    """Read a configuration.

    Args:
        file: a TOML file, or the bare name of one that ships with the package (`sim.toml`). Its top-level
            key `extends` names a file beside it whose values it overrides.
        settings: `section.key=value` strings that override the files; the value is TOML, or else a string.

    Raises:
        ConfigError: naming file or setting, key, value and allowed range.
    """
    path = locate(file)
    table = _read_with_bases(path, ())
    source = path.name
    for setting in settings:
        apply_setting(table, setting)
        source = f"{path.name} with --set"
    return read(Config, table, source)


def files_of(file: str | Path) -> list[Path]:
    """A configuration file and those that it extends, as far as they can be found.

    Raises:
        ConfigError: there is no such file.
    """
    found: list[Path] = []
    path: Path | None = locate(file)
    while path is not None and path not in found:
        found.append(path)
        try:
            base = tomllib.loads(path.read_text(encoding="utf-8")).get(_EXTENDS)
            path = locate(path.parent / base) if isinstance(base, str) else None
        except (ConfigError, OSError, ValueError):  # TOML and UTF-8 errors are ValueErrors
            path = None
    return found


def locate(file: str | Path) -> Path:
    """The file itself, or the shipped one of that name.

    Raises:
        ConfigError: when there is neither.
    """
    path = Path(file)
    if path.is_file():
        return path
    shipped = [
        Path(str(resources.files("arm_companion"))) / "configs",  # in a wheel
        Path(__file__).resolve().parents[2] / "configs",  # in a checkout
    ]
    if path.name == str(file) or path.parent.name == "configs":
        for folder in shipped:
            if (folder / path.name).is_file():
                return folder / path.name
    raise ConfigError(f"{file}: no such configuration file")


def _read_with_bases(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    if path in seen:
        raise ConfigError(f"{path.name}: 'extends' runs in a circle")
    try:
        with path.open("rb") as stream:
            table = tomllib.load(stream)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path.name}: not valid TOML: {error}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    base = table.pop(_EXTENDS, None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise ConfigError(f"{path.name}: {_EXTENDS} = {base!r} is not allowed: a file name")
    return _merge(_read_with_bases(locate(path.parent / base), (*seen, path)), table)


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def apply_setting(table: dict[str, Any], setting: str) -> None:
    """Put one `section.key=value` into a table.

    Raises:
        ConfigError: it is not of that form.
    """
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {setting}: expected KEY=VALUE")
    try:
        value: Any = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *parents, last = key.strip().split(".")
    for name in parents:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError(f"--set {setting}: {name} is a value, not a section")
    table[last] = value
