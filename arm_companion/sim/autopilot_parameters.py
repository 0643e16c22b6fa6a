"""The stand-in's parameter table and its two ways to put a number into a PARAM_VALUE."""

import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any

from arm_companion.protocol.dialect import mav

_FLOAT = struct.Struct("<f")
_INT = struct.Struct("<i")


class Parameters(Mapping[str, float]):
    """Named numbers of fixed type, whole or real.

    Args:
        defaults: an int makes a whole-number parameter, a float a real one.
        bytewise: whole numbers travel as the bytes of an int32 (PX4) or as a float's value (ArduPilot).
    """

    def __init__(self, defaults: Mapping[str, float], *, bytewise: bool) -> None:
        self._values = dict(sorted(defaults.items()))
        self._names = list(self._values)
        self._bytewise = bytewise

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def answers(self, message: Any) -> list[Any]:
        """PARAM_VALUEs that answer PARAM_REQUEST_READ, _LIST or PARAM_SET; an unknown name gets none."""
        kind = message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            return [self._value(name) for name in self._names]
        if kind == "PARAM_REQUEST_READ" and message.param_index >= 0:
            return [self._value(name) for name in self._names[message.param_index :][:1]]
        name = message.param_id
        if name not in self._values:
            return []
        if kind == "PARAM_SET":
            self._set(name, message.param_value, message.param_type)
        return [self._value(name)]

    def _set(self, name: str, value: float, param_type: int) -> None:
        """Take a new value unless it is of the wrong type or not finite; the answer shows which."""
        whole = isinstance(self._values[name], int)
        if self._bytewise and whole != (param_type == mav.MAV_PARAM_TYPE_INT32):
            return
        if self._bytewise and whole:
            self._values[name] = _INT.unpack(_FLOAT.pack(value))[0]
        elif math.isfinite(value):
            self._values[name] = round(value) if whole else value

    def _value(self, name: str) -> Any:
        value = self._values[name]
        whole = isinstance(value, int)
        wire = _FLOAT.unpack(_INT.pack(value))[0] if whole and self._bytewise else float(value)
        kind = mav.MAV_PARAM_TYPE_INT32 if whole else mav.MAV_PARAM_TYPE_REAL32
        return mav.MAVLink_param_value_message(name.encode(), wire, kind, len(self._names), self._names.index(name))
