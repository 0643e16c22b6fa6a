"""Options with bounds: a dataclass field that knows its unit, range and meaning, and the reader for them.

A section is a frozen dataclass whose fields are made by `option`. `read` turns a TOML table into such a
section and refuses, with file, key, value and allowed range, whatever does not fit: unknown keys, wrong
types, numbers out of bounds or not finite, and lists of the wrong length.
"""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from arm_companion.errors import ConfigError

T = TypeVar("T")
Source = Callable[[str], str]
"""Who gave the value of a dotted key: a file, a variable, a setting."""

_META = "option"
_LARGEST = 2**63


@dataclass(frozen=True)
class Option:
    """What is known of one option besides its type and default."""

    doc: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    choices: tuple[str, ...] = ()
    length: int | None = None

    def allowed(self) -> str:
        """The allowed values in words, for messages and generated documentation."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.lower) and math.isinf(self.upper):
            return f"any finite number{unit}"
        if math.isinf(self.upper):
            return f"at least {self.lower:.10g}{unit}"
        return f"{self.lower:.10g} to {self.upper:.10g}{unit}"


def option(
    doc: str,
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    lower: float = -math.inf,
    upper: float = math.inf,
    choices: tuple[str, ...] = (),
    length: int | None = None,
) -> Any:
    """A dataclass field with bounds.

    Args:
        doc: one line for people.
        default: value when the key is absent; without one the key is required.
        unit: SI unit, or the one that the key's suffix names.
        lower: smallest allowed number, inclusive; for a list, of each entry.
        upper: largest allowed number, inclusive; for a list, of each entry.
        choices: allowed strings.
        length: exact number of entries of a list.
    """
    metadata = {_META: Option(doc, unit, lower, upper, choices, length)}
    if default is dataclasses.MISSING:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


def options(doc: str, *, unit: str = "", lower: float = 0.0, upper: float = math.inf) -> Any:
    """A dataclass field that holds a table of numbers by name, all with the same bounds; empty by default."""
    return field(default_factory=dict, metadata={_META: Option(doc, unit, lower, upper)})


def section(cls: type[T]) -> T:
    """A nested section whose own defaults apply when the table is absent."""
    return field(default_factory=cls)


def describe(f: "dataclasses.Field[Any]") -> Option | None:
    """The `Option` of a field made by `option`, None for a nested section."""
    return typing.cast("Option | None", f.metadata.get(_META))


def spelling(cls: Any, parts: Sequence[str]) -> list[str]:
    """The parts of a dotted key as the options are spelt, capitals in `parts` aside; unknown parts stay as they are."""
    if not parts or not dataclasses.is_dataclass(cls):
        return list(parts)
    hints = typing.get_type_hints(cls)
    known = {f.name.lower(): f.name for f in dataclasses.fields(cls)}
    name = known.get(parts[0].lower(), parts[0])
    inner, below = hints.get(name), list(parts[1:])
    if typing.get_origin(inner) in (dict, Mapping) and below:  # [links.NAME]: the name is the user's
        return [name, below[0], *spelling(typing.get_args(inner)[1], below[1:])]
    return [name, *spelling(inner, below)]


def read(cls: type[T], table: Mapping[str, Any], source: Source, path: str = "") -> T:
    """Build section `cls` from a TOML table.

    Args:
        cls: a frozen dataclass of options and nested sections.
        table: what the TOML file holds at this place.
        source: tells the origin of a key, for messages.
        path: dotted key of `table` in the file, for messages.

    Raises:
        ConfigError: with file, key, value and allowed range.
    """
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in table:
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1)
            hint = f"; did you mean '{_join(path, close[0])}'?" if close else ""
            known = ", ".join(sorted(fields))
            raise ConfigError(
                f"{source(_join(path, key))}: unknown key '{_join(path, key)}'{hint} (known here: {known})"
            )
    values: dict[str, Any] = {}
    for name, f in fields.items():
        key = _join(path, name)
        if name not in table:
            if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
                meta = describe(f)
                needs = f" ({meta.doc}; {meta.allowed()})" if meta else ""
                raise ConfigError(f"{source(key)}: required key '{key}' is missing{needs}")
            continue
        values[name] = _convert(hints[name], table[name], describe(f) or Option(""), source, key)
    try:
        return cls(**values)
    except ConfigError as error:  # a rule that spans several keys, from __post_init__
        where = f"[{path}]: " if path else ""
        raise ConfigError(f"{source(path)}: {where}{error}") from None


def _convert(hint: Any, value: Any, meta: Option, source: Source, key: str) -> Any:
    origin = typing.get_origin(hint)
    if origin is types.UnionType or origin is typing.Union:
        (hint,) = (a for a in typing.get_args(hint) if a is not type(None))
        origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise _refusal(source, key, value, "a table")
        return read(typing.cast("type[Any]", hint), value, source, key)
    if origin in (dict, Mapping):  # named tables, such as [links.autopilot]
        if not isinstance(value, Mapping):
            raise _refusal(source, key, value, "a table of named tables")
        inner = typing.get_args(hint)[1]
        return types.MappingProxyType(
            {name: _convert(inner, item, meta, source, _join(key, name)) for name, item in value.items()}
        )
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _refusal(source, key, value, "a list")
        if meta.length is not None and len(value) != meta.length:
            raise _refusal(source, key, value, f"a list of {meta.length} entries")
        inner = typing.get_args(hint)[0]
        return tuple(_convert(inner, item, meta, source, f"{key}[{i}]") for i, item in enumerate(value))
    return _scalar(hint, value, meta, source, key)


def _scalar(hint: Any, value: Any, meta: Option, source: Source, key: str) -> Any:
    if isinstance(value, int) and abs(value) > _LARGEST:  # TOML's whole numbers have no end, floats have
        raise _refusal(source, key, value, meta.allowed())
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not hint:
        names = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}
        range_ = f" ({meta.allowed()})" if hint in (float, int) or meta.choices else ""
        raise _refusal(source, key, value, names.get(hint, str(hint)) + range_)
    if isinstance(value, str):
        if meta.choices and value not in meta.choices:
            raise _refusal(source, key, value, meta.allowed())
    elif not isinstance(value, bool) and not (math.isfinite(value) and meta.lower <= value <= meta.upper):
        raise _refusal(source, key, value, meta.allowed())
    return value


def _refusal(source: Source, key: str, value: Any, allowed: str) -> ConfigError:
    return ConfigError(f"{source(key)}: {key} = {value!r} is not allowed: {allowed}")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
