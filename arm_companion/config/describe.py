"""What there is to configure: every option with its key, type, unit, range, default and meaning."""

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from arm_companion.config.options import Option, describe
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table

NAME: Final = "NAME"
"""Stands in a key for a name that the user chooses, as in `links.NAME.url`."""

_TYPES: Final = {float: "number", int: "integer", bool: "boolean", str: "string"}


@dataclass(frozen=True, slots=True)
class Described:
    """One option.

    Attributes:
        key: dotted; `NAME` stands for a name of the user's, `[]` for any entry of a list of tables.
        section: the docstring of the section that it stands in.
        hint: its type.
        option: unit, range and meaning.
        default: its value when nobody gives one; `dataclasses.MISSING`: it must be given.
    """

    key: str
    section: str
    hint: Any
    option: Option
    default: Any

    @property
    def required(self) -> bool:
        """Whether it must be given."""
        return self.default is dataclasses.MISSING

    @property
    def kind(self) -> str:
        """Its type in words."""
        return _words(self.hint, self.option.length)

    @property
    def allowed(self) -> str:
        """The allowed values in words; empty where the type says it all."""
        numbers = _number(self.hint)
        return self.option.allowed() if self.option.choices or numbers else ""

    def fits(self, key: str) -> bool:
        """Whether a dotted key with real names means this option."""
        theirs = key.split("[", maxsplit=1)[0].split(".")
        return len(self._parts) == len(theirs) and self._begins_with(theirs)

    def is_below(self, section: str) -> bool:
        """Whether this option stands in a section, which may have real names in it, as `links.ground`."""
        theirs = section.split(".")
        return len(self._parts) > len(theirs) and self._begins_with(theirs)

    def within(self, section: str) -> str:
        """The key, with the real names of a section that it stands in."""
        theirs = section.split(".")
        mine = self.key.split(".")
        named = [real if part == NAME else part for part, real in zip(mine, theirs, strict=False)]
        return ".".join([*named, *mine[len(named) :]])

    @property
    def _parts(self) -> list[str]:
        return self.key.replace("[]", "").split(".")

    def _begins_with(self, parts: list[str]) -> bool:
        return all(mine in (theirs, NAME) for mine, theirs in zip(self._parts, parts, strict=False))


def every(cls: Any = Config, path: str = "") -> Iterator[Described]:
    """Every option of a section and of those below it, in the order of the schema."""
    hints = typing.get_type_hints(cls)
    doc = (cls.__doc__ or "").strip().partition("\n")[0]
    for f in dataclasses.fields(cls):
        hint, key = hints[f.name], f"{path}.{f.name}" if path else f.name
        option = describe(f)
        if (inner := _section(hint)) is not None:
            named = {Mapping: f"{key}.{NAME}", dict: f"{key}.{NAME}", tuple: f"{key}[]"}
            yield from every(inner, named.get(typing.get_origin(hint), key))
        elif option is not None:
            yield Described(key, doc, hint, option, _default(f))


def json_schema(cls: Any = Config) -> dict[str, Any]:
    """The configuration file as JSON Schema (draft 2020-12), for editors and other tools.

    Rules that span several options are the reader's alone.
    """
    body = _object(cls)
    body["properties"]["extends"] = {"type": "string", "description": "a file whose values this one overrides"}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "arm_companion", **body}


def _object(cls: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    properties, required = {}, []
    for f in dataclasses.fields(cls):
        properties[f.name] = _schema(hints[f.name], describe(f))
        default = _default(f)
        if describe(f) is None:
            continue
        if default is dataclasses.MISSING:
            required.append(f.name)
        elif default is not None:
            properties[f.name]["default"] = as_table(default)
    body: dict[str, Any] = {"type": "object", "additionalProperties": False, "properties": properties}
    if cls.__doc__:
        body["description"] = cls.__doc__.strip().partition("\n")[0]
    if required:
        body["required"] = required
    return body


def _schema(hint: Any, option: Option | None) -> dict[str, Any]:
    hint = _bare(hint)
    origin = typing.get_origin(hint)
    described = {"description": option.doc + (f" ({option.unit})" if option.unit else "")} if option else {}
    if dataclasses.is_dataclass(hint):
        return _object(hint)
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _schema(typing.get_args(hint)[1], option), **described}
    if origin is tuple:
        array: dict[str, Any] = {
            "type": "array",
            "items": _schema(typing.get_args(hint)[0], _entry(option)),
            **described,
        }
        if option is not None and option.length is not None:
            array |= {"minItems": option.length, "maxItems": option.length}
        return array
    scalar: dict[str, Any] = {"type": _TYPES[hint], **described}
    if option is not None and option.choices:
        scalar["enum"] = list(option.choices)
    if option is not None and hint in (int, float):
        inf = float("inf")
        scalar |= {"minimum": option.lower} if option.lower > -inf else {}
        scalar |= {"maximum": option.upper} if option.upper < inf else {}
    return scalar


def _words(hint: Any, length: int | None = None, *, several: bool = False) -> str:
    """A type in words."""
    hint = _bare(hint)
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple:
        return f"{length or 'list of'} {_words(inner[0], several=True)}".replace("list of list of", "list of lists of")
    if origin in (dict, Mapping):
        return f"table of {_words(inner[1], several=True)} by name"
    names = {"number": "number", "integer": "whole number", "boolean": "true or false", "string": "text"}
    return names[_TYPES[hint]] + ("s" if several else "")


def _entry(option: Option | None) -> Option | None:
    return None if option is None else dataclasses.replace(option, length=None)


def _bare(hint: Any) -> Any:
    """A type without `| None`."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        (hint,) = (a for a in typing.get_args(hint) if a is not type(None))
    return hint


def _section(hint: Any) -> Any:
    """The section in a type: itself, or what a mapping or a list holds; None where there is none."""
    hint = _bare(hint)
    if dataclasses.is_dataclass(hint):
        return hint
    inner = typing.get_args(hint)
    return next((a for a in inner if dataclasses.is_dataclass(a)), None)


def _number(hint: Any) -> bool:
    hint = _bare(hint)
    return hint in (int, float) or any(_number(inner) for inner in typing.get_args(hint))


def _default(f: "dataclasses.Field[Any]") -> Any:
    if f.default is not dataclasses.MISSING:
        return f.default
    return f.default_factory() if f.default_factory is not dataclasses.MISSING else dataclasses.MISSING
