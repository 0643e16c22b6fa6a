"""Where a configuration's values come from: files, drop-ins, environment and settings, each over the one before.

1. the file, and the files that it names by `extends`, the farthest first;
2. drop-ins: `*.toml` in the folder beside it that is called as the file, with `.d` for `.toml`, by name;
3. environment variables `ARM_COMPANION__SECTION__KEY=VALUE`;
4. settings `section.key=value`, as given with `--set`.
"""

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

from arm_companion.config.options import spelling
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError

SYSTEM_FILE: Final = Path("/etc/arm-companion/config.toml")
PREFIX: Final = "ARM_COMPANION__"
_EXTENDS = "extends"


@dataclass(frozen=True)
class Layer:
    """Values of one origin.

    Attributes:
        name: the origin for people: a file, a variable, or a setting.
        table: its values, as TOML has them.
        path: the file; None where there is none.
    """

    name: str
    table: Mapping[str, Any]
    path: Path | None = None

    def value(self, key: str) -> Any:
        """What it says of the dotted `key`.

        Raises:
            KeyError: nothing.
        """
        at: Any = self.table
        for part in key.split("."):
            if not isinstance(at, Mapping):
                raise KeyError(key)
            at = at[part]
        return at

    def has(self, key: str) -> bool:
        """Whether it says something of the dotted `key`, or of part of it."""
        try:
            self.value(key)
        except KeyError:
            return False
        return True


class Layers(tuple[Layer, ...]):
    """All layers of one configuration, the weakest first."""

    __slots__ = ()

    @property
    def table(self) -> dict[str, Any]:
        """What they say together."""
        merged: dict[str, Any] = {}
        for layer in self:
            merged = merge(merged, layer.table)
        return merged

    def origin(self, key: str) -> Layer | None:
        """The strongest layer that says something of the dotted `key` (entries of lists are not told apart)."""
        bare = key.partition("[")[0]
        return next((layer for layer in reversed(self) if layer.has(bare)), None)

    def source(self, key: str) -> str:
        """Who is to blame for the value of a key, for messages."""
        while True:
            if (layer := self.origin(key)) is not None:
                return layer.name
            if "." not in key:
                return self[0].name if self else "configuration"
            key = key.rpartition(".")[0]


def collect(file: str | Path, settings: Iterable[str] = (), environment: Mapping[str, str] | None = None) -> Layers:
    """All layers of a configuration.

    Args:
        file: a TOML file, or the bare name of one that ships with the package (`sim.toml`).
        settings: `section.key=value`; the value is TOML, or else a string.
        environment: variables to look into; without it none are.

    Raises:
        ConfigError: naming what cannot be read or understood.
    """
    path = locate(file)
    files = [*_with_bases(path, ()), *(_read(drop_in, drop_in.name) for drop_in in drop_ins(path))]
    variables = [_variable(name, value) for name, value in sorted((environment or {}).items()) if _ours(name)]
    return Layers((*files, *variables, *(_setting(setting) for setting in settings)))


def drop_ins(path: Path) -> list[Path]:
    """The drop-ins of a file, in their order."""
    return sorted(found for found in path.with_suffix(".d").glob("*.toml") if found.is_file())


def files_of(file: str | Path) -> list[Path]:
    """A configuration file, those that it extends and its drop-ins, as far as they can be found and read.

    Raises:
        ConfigError: there is no such file.
    """
    found: list[Path] = []
    path: Path | None = locate(file)
    after = drop_ins(path) if path is not None else []
    while path is not None and path not in found:
        found.append(path)
        try:
            base = tomllib.loads(path.read_text(encoding="utf-8")).get(_EXTENDS)
            path = _base(path, base) if isinstance(base, str) else None
        except (ConfigError, OSError, ValueError):  # TOML and UTF-8 errors are ValueErrors
            path = None
    return found + after


def locate(file: str | Path, *, plain: bool = False) -> Path:
    """The file itself, or the shipped one of that name.

    Args:
        file: a path; a bare name, or one in a folder `configs`, may be that of a shipped file.
        plain: it was given as a bare name.

    Raises:
        ConfigError: when there is neither.
    """
    path = Path(file)
    try:
        if path.is_file():
            return path
        if path.is_dir():
            raise ConfigError(f"{file}: a folder, and no configuration file")
    except OSError as error:  # a folder that this user may not look into
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None
    if plain or path.name == str(file) or path.parent.name == "configs":
        for folder in shipped():
            if (folder / path.name).is_file():
                return folder / path.name
    elsewhere = "; name another with --config" if path == SYSTEM_FILE else ""
    raise ConfigError(f"{file}: no such configuration file{elsewhere}")


def shipped() -> Iterator[Path]:
    """Folders of the configurations that come with the package, in a wheel or in a checkout."""
    yield Path(str(resources.files("arm_companion"))) / "configs"
    yield Path(__file__).resolve().parents[2] / "configs"


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`; tables are merged, everything else is replaced."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def apply_setting(table: dict[str, Any], setting: str) -> None:
    """Put one `section.key=value` into a table.

    Raises:
        ConfigError: it is not of that form, or runs through a value.
    """
    *parents, last = _key(setting).split(".")
    for name in parents:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError(f"--set {setting}: {name} is a value, not a section")
    table[last] = _value(setting.partition("=")[2])


def _setting(setting: str) -> Layer:
    table: dict[str, Any] = {}
    apply_setting(table, setting)
    return Layer(f"--set {_key(setting)}", table)


def _ours(name: str) -> bool:
    return name.startswith(PREFIX) and len(name) > len(PREFIX)


def _variable(name: str, value: str) -> Layer:
    """Names of variables are in capitals; those of options are looked up as the schema spells them."""
    key = spelling(Config, [part.lower() for part in name.removeprefix(PREFIX).split("__")])
    if not all(key):
        raise ConfigError(f"{name}: expected {PREFIX}SECTION__KEY")
    table: dict[str, Any] = {}
    apply_setting(table, f"{'.'.join(key)}={value}")
    return Layer(f"environment {name}", table)


def _key(setting: str) -> str:
    key, equals, _ = setting.partition("=")
    if not equals or not all(part.strip() for part in key.split(".")):
        raise ConfigError(f"--set {setting}: expected KEY=VALUE")
    return key.strip()


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _with_bases(path: Path, seen: tuple[Path, ...]) -> list[Layer]:
    if path in seen:
        raise ConfigError(f"{path.name}: 'extends' runs in a circle")
    layer = _read(path, path.name, may_extend=True)
    table = dict(layer.table)
    base = table.pop(_EXTENDS, None)
    layer = Layer(layer.name, table, path)
    if base is None:
        return [layer]
    if not isinstance(base, str):
        raise ConfigError(f"{path.name}: {_EXTENDS} = {base!r} is not allowed: a file name")
    return [*_with_bases(_base(path, base), (*seen, path)), layer]


def _base(path: Path, name: str) -> Path:
    """The file that `path` extends: beside it, or else the shipped one of that name, wherever `path` is."""
    return locate(path.parent / name, plain=Path(name).name == name)


def _read(path: Path, name: str, *, may_extend: bool = False) -> Layer:
    try:
        with path.open("rb") as stream:
            table = tomllib.load(stream)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{name}: not valid TOML: it is not UTF-8") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if _EXTENDS in table and not may_extend:
        raise ConfigError(f"{path}: a drop-in extends the configuration by itself; '{_EXTENDS}' has no place in it")
    return Layer(name, table, path)
