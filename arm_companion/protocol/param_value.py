"""Numbers in PARAM_* and PARAM_EXT_*.

PARAM_VALUE and PARAM_SET have one float field. We use it bytewise, as PX4 does and as the guide recommends: a whole
number puts the four bytes of its int32 there. PARAM_EXT has room for the bytes of any type.
"""

import struct
from typing import Final

from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav

INT32: Final = mav.MAV_PARAM_TYPE_INT32
REAL32: Final = mav.MAV_PARAM_TYPE_REAL32
_INT: Final = struct.Struct("<i")
_FLOAT: Final = struct.Struct("<f")


def kind_of(*, whole: bool) -> int:
    """MAV_PARAM_TYPE of a number; MAV_PARAM_EXT_TYPE has the same values."""
    return int(INT32 if whole else REAL32)


def to_bytes(value: float, *, whole: bool) -> bytes:
    """The four bytes that stand for a number.

    Raises:
        ProtocolError: it does not fit.
    """
    try:
        return _INT.pack(round(value)) if whole else _FLOAT.pack(value)
    except (struct.error, OverflowError, ValueError) as error:
        raise ProtocolError(f"{value} is no parameter value: {error}") from None


def from_bytes(data: bytes, kind: int, *, whole: bool) -> float:
    """The number that the first four bytes stand for; missing ones are zero, as MAVLink cuts them.

    Raises:
        ProtocolError: the type is not that of the parameter.
    """
    if kind != kind_of(whole=whole):
        raise ProtocolError(f"type {kind} is not the parameter's, which is {kind_of(whole=whole)}")
    word = data[:4].ljust(4, b"\0")
    number: float = _INT.unpack(word)[0] if whole else _FLOAT.unpack(word)[0]
    return number


def to_float(value: float, *, whole: bool) -> float:
    """What PARAM_VALUE.param_value holds for a number."""
    number: float = _FLOAT.unpack(to_bytes(value, whole=whole))[0]
    return number


def from_float(field: float, kind: int, *, whole: bool) -> float:
    """The number that PARAM_SET.param_value stands for.

    Raises:
        ProtocolError: the type is not that of the parameter.
    """
    return from_bytes(_FLOAT.pack(field), kind, whole=whole)
