"""Dataclasses <-> JSON text, exactly: floats keep every bit, and types come from annotations.

They are best plain ones, as `values` has them: no slots, no `__post_init__`. Others take longer.

JSON has no numbers for what is not finite; these are the strings "nan", "inf" and "-inf", so that every reader of
JSON takes the text.
"""

import dataclasses
import enum
import functools
import json
import operator
import types
import typing
from collections.abc import Callable
from typing import Any, TypeVar

from arm_companion.values import of

T = TypeVar("T")
UNRECORDED = {"unrecorded": True}
"""Metadata of a dataclass field that is left out of the text and gets its default when read."""


def dumps(value: Any) -> str:
    """One line of JSON for a dataclass made of plain values, tuples, enums and other such dataclasses."""
    return json.dumps(plain(value), separators=(",", ":"))


def plain(value: Any) -> dict[str, Any]:
    """What JSON knows of a dataclass, for any encoder; the caller must not change it."""
    hint: Any = type(value)
    table: dict[str, Any] = _writer(hint)(value)
    return table


def loads(cls: type[T], text: str | bytes) -> T:
    """The value that `dumps` wrote.

    Raises:
        ValueError: the text is not such a value.
    """
    return build(cls, json.loads(text))


def build(cls: type[T], value: Any) -> T:
    """The value that stands in JSON as `value`.

    Raises:
        ValueError: it is not of this class.
    """
    hint: Any = cls
    try:
        return typing.cast("T", _builder(hint)(value))
    except (AttributeError, TypeError, KeyError, IndexError) as error:
        raise ValueError(f"not a {cls.__name__}: {error}") from error


@functools.cache
def fields(cls: Any) -> dict[str, Any]:
    """Names and types of the fields of a dataclass that are in its text."""
    hints = typing.get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.metadata != UNRECORDED}


def _number(value: float) -> float | str:
    return value if value - value == 0.0 else repr(value)


def _numbers(value: tuple[float, ...]) -> Any:
    total = sum(value)
    return value if total - total == 0.0 else [_number(number) for number in value]


def _same(value: Any) -> Any:
    return value


@functools.cache
def _writer(hint: Any) -> Callable[[Any], Any]:
    """What turns a value of this type into what JSON knows; found out once for each type."""
    hint, optional = _optional(hint)
    if optional:
        inner = _writer(hint)
        return lambda value: None if value is None else inner(value)
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is tuple:
        return _tuple_writer(arguments)
    if origin is frozenset:
        each = _writer(arguments[0])
        return lambda value: sorted(each(item) for item in value)
    if isinstance(hint, type) and issubclass(hint, enum.Flag):
        return operator.attrgetter("_value_")  # `value` and `name` are slow properties
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return operator.attrgetter("_name_")
    if dataclasses.is_dataclass(hint):
        return _record_writer(hint)
    return _number if hint is float else _same


def _tuple_writer(inner: tuple[Any, ...]) -> Callable[[Any], Any]:
    if set(inner) <= {float, Ellipsis}:
        return _numbers
    if len(inner) == 2 and inner[1] is Ellipsis:  # tuple[x, ...]
        each = _writer(inner[0])
        return lambda value: [each(item) for item in value]
    writers = [_writer(hint) for hint in inner]
    return lambda value: [write(item) for write, item in zip(writers, value, strict=True)]


def _content(value: Any) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}


def _optional(hint: Any) -> tuple[Any, bool]:
    """The type without None, and whether None was there."""
    if typing.get_origin(hint) not in (types.UnionType, typing.Union):
        return hint, False
    (inner,) = (a for a in typing.get_args(hint) if a is not type(None))
    return inner, True


_TABLE_OF = """
def make():
    seen = table = None
    def table_of(value):
        nonlocal seen, table
        if value is not seen:
            t = {copy}
            total = 0.0
            {changes}
            if total - total != 0.0:
                {infinite}
            seen, table = value, t
        return table
    return table_of
"""


def _record_writer(cls: Any) -> Callable[[Any], Any]:
    """Python made for this class, as `dataclasses` makes it, because it runs for all of a record in every cycle.

    Much of a record is the very object of the cycle before, so what it became last is kept. Fields are copied as they
    are, and only those that JSON does not know are changed. Numbers are added up; where the sum is not finite, which
    is seldom, each of them is looked at.
    """
    kinds = fields(cls)
    used: dict[str, Any] = {"content": _content, "number": _number, "numbers": _numbers}
    changes = [f"del t[{f.name!r}]" for f in dataclasses.fields(cls) if f.name not in kinds]
    infinite = ["pass"]
    for name, kind in kinds.items():
        hint, optional = _optional(kind)
        each = _writer(hint)
        field = f"t[{name!r}]"
        present = f"if {field} is not None: " if optional else ""
        if each is _number:
            changes.append(f"{present}total += {field}")
            infinite.append(f"{present}{field} = number({field})")
        elif each is _numbers:
            changes.append(f"{present}total += sum({field})")
            infinite.append(f"{present}{field} = numbers({field})")
        elif each is not _same:
            used[f"write_{name}"] = each
            changes.append(f"{present}{field} = write_{name}({field})")
    slotted = hasattr(cls, "__slots__")  # calibrations, written once in a while
    source = _TABLE_OF.format(
        copy="content(value)" if slotted else "value.__dict__.copy()",
        changes="\n            ".join(changes),
        infinite="\n                ".join(infinite),
    )
    exec(source, used)  # noqa: S102 - made of the names of fields alone
    return typing.cast("Callable[[Any], Any]", used["make"]())


@functools.cache
def _builder(hint: Any) -> Callable[[Any], Any]:
    """What turns JSON into a value of this type; found out once for each type."""
    hint, optional = _optional(hint)
    if optional:
        inner = _builder(hint)
        return lambda value: None if value is None else inner(value)
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is tuple:
        return _tuple_builder(arguments)
    if origin is frozenset:
        each = _builder(arguments[0])
        return lambda value: frozenset(each(item) for item in value)
    if hint is float or (isinstance(hint, type) and issubclass(hint, enum.Flag)):
        return typing.cast("Callable[[Any], Any]", hint)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return hint.__getitem__
    if dataclasses.is_dataclass(hint):
        return _record_builder(hint)
    return _same


def _floats(count: int, value: list[Any]) -> tuple[float, ...]:
    numbers = tuple(map(float, value))
    if len(numbers) != count:
        raise ValueError(f"{count} numbers are expected, not {len(numbers)}")
    return numbers


def _tuple_builder(inner: tuple[Any, ...]) -> Callable[[Any], Any]:
    if len(inner) == 2 and inner[1] is Ellipsis:  # tuple[x, ...]
        each = _builder(inner[0])
        return lambda value: tuple(map(each, value))
    if set(inner) == {float}:
        return functools.partial(_floats, len(inner))
    builders = [_builder(hint) for hint in inner]
    return lambda value: tuple([make(item) for make, item in zip(builders, value, strict=True)])


def _record_builder(cls: Any) -> Callable[[Any], Any]:
    kinds = fields(cls)
    names = kinds.keys()
    numbers = tuple(name for name, hint in kinds.items() if hint is float)
    others = [(name, each) for name, hint in kinds.items() if hint is not float and (each := _builder(hint)) != _same]
    # in the order of the class, in which they are written again
    every: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(cls)}
    needed = {name for name, default in every.items() if default is dataclasses.MISSING}
    bare = not hasattr(cls, "__slots__") and not hasattr(cls, "__post_init__")

    def make(table: dict[str, Any]) -> Any:
        if not table.keys() <= names:
            raise KeyError(*(table.keys() - names))
        if not needed <= table.keys():
            raise KeyError(*(needed - table.keys()))
        value = every | table
        for name in numbers:
            if type(value[name]) is not float:
                value[name] = float(value[name])
        for name, each in others:
            if name in table:
                value[name] = each(table[name])
        return of(cls, value) if bare else cls(**value)

    return make
