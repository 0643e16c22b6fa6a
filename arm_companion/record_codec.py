"""Dataclasses <-> JSON text, exactly: floats keep every bit, and types come from annotations."""

import dataclasses
import enum
import functools
import json
import types
import typing
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")
UNRECORDED = {"unrecorded": True}
"""Metadata of a dataclass field that is left out of the text and gets its default when read."""


def dumps(value: Any) -> str:
    """One line of JSON for a dataclass made of plain values, tuples, enums and other such dataclasses."""
    return json.dumps(_plain(value), separators=(",", ":"))


def loads(cls: type[T], text: str) -> T:
    """The value that `dumps` wrote.

    Raises:
        ValueError: the text is not such a value.
    """
    try:
        return typing.cast("T", _build(cls, json.loads(text)))
    except (TypeError, KeyError, IndexError) as error:
        raise ValueError(f"not a {cls.__name__}: {error}") from error


@functools.cache
def _names(cls: Any) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(cls) if f.metadata != UNRECORDED)


@functools.cache
def _hints(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _plain(value: Any) -> Any:
    kind: Any = type(value)
    return _writer(kind)(value)


@functools.cache
def _writer(kind: Any) -> Callable[[Any], Any]:
    """What turns a value of exactly this type into what JSON knows; found out once for each type."""
    if kind in (float, int, str, bool, type(None)):
        return lambda value: value
    if issubclass(kind, enum.Flag):
        return lambda value: value.value
    if issubclass(kind, enum.Enum):
        return lambda value: value.name
    if issubclass(kind, (tuple, list)):
        return lambda value: [item if type(item) is float else _plain(item) for item in value]
    if issubclass(kind, frozenset):
        return lambda value: sorted(_plain(item) for item in value)
    names = _names(kind)
    return lambda value: {name: _plain(getattr(value, name)) for name in names}


def _build(hint: Any, value: Any) -> Any:
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None:
            return None
        (hint,) = (a for a in typing.get_args(hint) if a is not type(None))
        return _build(hint, value)
    if origin is tuple:
        inner = typing.get_args(hint)
        if len(inner) == 2 and inner[1] is Ellipsis:  # tuple[x, ...]
            return tuple(_build(inner[0], item) for item in value)
        return tuple(_build(h, item) for h, item in zip(inner, value, strict=True))
    if origin is frozenset:
        return frozenset(_build(typing.get_args(hint)[0], item) for item in value)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return hint(value) if issubclass(hint, enum.Flag) else hint[value]
    if dataclasses.is_dataclass(hint):
        return _make(hint, value)
    return hint(value) if hint is float else value


def _make(cls: Any, table: dict[str, Any]) -> Any:
    hints = _hints(cls)
    return cls(**{name: _build(hints[name], item) for name, item in table.items()})
