"""The parameter protocol's client side, for one component.

MAVSDK's own parameter plugin is not used. Measured with 4.1.0: behind ArduPilot it takes every parameter for a float
that was cast, and so reads and writes other integers than the component has; it leaves 8- and 16-bit parameters out of
its list; and choosing a component raises an error.

What MAVSDK does limit: it carries no bits of a NaN, and the bytes of some whole numbers of 32 bits (-8388607 to -1, and
unsigned ones above 2139095040) are those of a NaN. Such values are shown as not known and refused, never changed.
"""

import asyncio
import contextlib
import math
import struct
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Final

from arm_companion.errors import ArmError
from arm_companion.ground.channel import ArmSilent, Channel
from arm_companion.ground.texts import Sentences
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

GAP_S: Final = 0.7
"""Nothing new for this long while a list runs: what is missing is asked for by its number."""
TRIES: Final = 5

_AT_ONCE: Final = 10
_REFUSED: Final = "parameter refused: "
_LONGEST_NAME: Final = 16
_KINDS: Final = {
    mav.MAV_PARAM_TYPE_UINT8: ("uint8", "<Bxxx"),
    mav.MAV_PARAM_TYPE_INT8: ("int8", "<bxxx"),
    mav.MAV_PARAM_TYPE_UINT16: ("uint16", "<Hxx"),
    mav.MAV_PARAM_TYPE_INT16: ("int16", "<hxx"),
    mav.MAV_PARAM_TYPE_UINT32: ("uint32", "<I"),
    mav.MAV_PARAM_TYPE_INT32: ("int32", "<i"),
    mav.MAV_PARAM_TYPE_REAL32: ("real32", "<f"),
}
"""Type to its name and to its layout in the four bytes of the value (bytewise encoding)."""


class ParameterRefused(ArmError):
    """The component does not have the parameter, or kept another value than it was asked to take."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the component."""

    name: str
    value: float  # an int for the integer types; NaN when it cannot be told
    kind: str  # real32, int32, uint8, ...
    index: int
    count: int


class ParameterClient:
    """Reads and writes the parameters of one component.

    Args:
        channel: to it.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    async def read_all(self, progress: Callable[[int, int], None] | None = None) -> list[Parameter]:
        """All parameters in the component's order.

        Args:
            progress: told how many have come, and of how many.

        Raises:
            ArmSilent: no answer, or some never came.
        """
        found: dict[int, Parameter] = {}
        async with self._values() as values:
            for _ in range(TRIES):
                await self._channel.send(mav.MAVLink_param_request_list_message)
                await self._collect(values, found, progress)
                if found:
                    break
            else:
                raise ArmSilent("the arm does not list its parameters")
            count = next(iter(found.values())).count
            for _ in range(TRIES):
                missing = [index for index in range(count) if index not in found][:_AT_ONCE]
                while missing:
                    for index in missing:
                        await self._channel.send(mav.MAVLink_param_request_read_message, b"", index)
                    before = len(found)
                    await self._collect(values, found, progress)
                    if len(found) == before:
                        break
                    missing = [index for index in range(count) if index not in found][:_AT_ONCE]
        if missing:
            raise ArmSilent(f"{count - len(found)} of {count} parameters never came")
        return [found[index] for index in sorted(found)]

    async def read(self, name: str) -> Parameter:
        """One parameter by its name.

        Raises:
            ParameterRefused: it has none of this name.
            ArmSilent: no answer.
        """
        _check(name)
        async with self._values() as values:
            for _ in range(TRIES):
                await self._channel.send(mav.MAVLink_param_request_read_message, name.encode("ascii"), -1)
                if (parameter := await _next(values, name)) is not None:
                    return parameter
        # Components answer a name that they do not have with silence.
        raise ParameterRefused(f"no answer for {name!r}: the arm has no such parameter, or does not hear us")

    async def write(self, name: str, value: float) -> Parameter:
        """Set one parameter, and hear from the component what it now is.

        Raises:
            ParameterRefused: it has none of this name, the value does not fit its type, or it kept another value.
            ArmSilent: no answer.
        """
        before = await self.read(name)
        type_, raw = _encode(before, value)
        after = None
        async with self._values() as values, self._reasons() as reasons:
            for _ in range(TRIES):
                await self._channel.send(mav.MAVLink_param_set_message, name.encode("ascii"), raw, type_)
                while (heard := await _next(values, name)) is not None:
                    after = heard  # another value may be a late answer to `read`: wait for what comes after it
                    if _is(after, raw):
                        return after
                if after is not None:
                    break
        if after is None:
            raise ArmSilent(f"no answer to setting {name}; it was {before.value:g}")
        why = reasons[-1] if reasons else f"the arm did not take {value:g}"
        raise ParameterRefused(f"{name} stays {after.value:g}: {why}")

    async def _collect(
        self,
        values: "asyncio.Queue[Parameter]",
        found: dict[int, Parameter],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        """Take what comes until nothing comes any more, or all is there."""
        while True:
            try:
                async with asyncio.timeout(GAP_S):
                    parameter = await values.get()
            except TimeoutError:
                return
            if parameter.index < parameter.count:  # 65535: not part of a list
                found[parameter.index] = parameter
                if progress is not None:
                    progress(len(found), parameter.count)
                if len(found) >= parameter.count:
                    return

    @contextlib.asynccontextmanager
    async def _values(self) -> "AsyncIterator[asyncio.Queue[Parameter]]":
        queue: asyncio.Queue[Parameter] = asyncio.Queue()

        def take(message: Message) -> None:
            if message.get_type() == "PARAM_VALUE" and (parameter := _decode(message)) is not None:
                queue.put_nowait(parameter)

        end = self._channel.watch(take)
        try:
            yield queue
        finally:
            end()

    @contextlib.asynccontextmanager
    async def _reasons(self) -> "AsyncIterator[list[str]]":
        """Why the component refuses changes, in its own words."""
        reasons: list[str] = []
        sentences = Sentences()

        def take(message: Message) -> None:
            if message.get_type() == "STATUSTEXT":
                said = [text.text for text in sentences.take(message)]
                reasons.extend(text.removeprefix(_REFUSED) for text in said if text.startswith(_REFUSED))

        end = self._channel.watch(take)
        try:
            yield reasons
        finally:
            end()


async def _next(values: "asyncio.Queue[Parameter]", name: str) -> Parameter | None:
    """The next value of this parameter; None when there is none for a while."""
    try:
        async with asyncio.timeout(GAP_S):
            while (parameter := await values.get()).name != name:
                pass
    except TimeoutError:
        return None
    return parameter


def _is(parameter: Parameter, raw: float) -> bool:
    """Whether the value's four bytes are those of `raw`."""
    return not math.isnan(parameter.value) and _encode(parameter, parameter.value)[1] == raw


def _check(name: str) -> None:
    if not name.isascii() or not 1 <= len(name) <= _LONGEST_NAME:
        raise ParameterRefused(f"{name!r} is no parameter name: 1 to {_LONGEST_NAME} ASCII characters")


def _decode(message: Message) -> Parameter | None:
    if message.param_type not in _KINDS:
        return None
    kind, layout = _KINDS[message.param_type]
    value: float
    if math.isnan(message.param_value):
        value = math.nan
    else:
        (value,) = struct.unpack(layout, struct.pack("<f", message.param_value))
    return Parameter(message.param_id, value, kind, message.param_index, message.param_count)


def _encode(parameter: Parameter, value: float) -> tuple[int, float]:
    """MAV_PARAM_TYPE and the number whose four bytes are the value.

    Raises:
        ParameterRefused: the value does not fit the type.
    """
    if not math.isfinite(value):
        raise ParameterRefused(f"{parameter.name} cannot be set to {value:g}")
    type_, layout = next((t, layout) for t, (kind, layout) in _KINDS.items() if kind == parameter.kind)
    if parameter.kind != "real32" and value != int(value):
        raise ParameterRefused(f"{parameter.name} takes whole numbers ({parameter.kind}), not {value:g}")
    try:
        data = struct.pack(layout, value if parameter.kind == "real32" else int(value))
    except (struct.error, OverflowError):
        raise ParameterRefused(f"{value:g} is out of range for {parameter.name} ({parameter.kind})") from None
    raw: float
    (raw,) = struct.unpack("<f", data)
    if not math.isfinite(raw):
        raise ParameterRefused(f"{parameter.name} = {value:g} cannot be sent: its bytes are those of a NaN")
    return type_, raw
