"""PARAM_* and PARAM_EXT_*: our options to read and change, for every ground station that has a parameter editor.

A whole list is sent one value at a time: back to back most of it would be lost in an autopilot's forward buffer. A
change that is refused is answered, as the protocol has it, with the value that stays; the reason goes out as text.
"""

import asyncio
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from arm_companion.config.parameters import PARAMETERS, Parameter
from arm_companion.drivers.access import Access, sender_of
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.settings import Settings
from arm_companion.drivers.status_text import Speaker
from arm_companion.errors import CommandRejected, ProtocolError
from arm_companion.mission.facts import Notice, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message
from arm_companion.protocol.param_value import from_bytes, from_float, kind_of, to_bytes, to_float

log = logging.getLogger(__name__)

PACE_S: Final = 0.01
"""From one value of a list to the next."""

_MOST_WAITING: Final = 8
"""The list waits while so much waits on the link already."""

IDS: Final = (
    mav.MAVLINK_MSG_ID_PARAM_REQUEST_LIST,
    mav.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
    mav.MAVLINK_MSG_ID_PARAM_SET,
    mav.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_LIST,
    mav.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_READ,
    mav.MAVLINK_MSG_ID_PARAM_EXT_SET,
)
_LISTS: Final = frozenset({mav.MAVLINK_MSG_ID_PARAM_REQUEST_LIST, mav.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_LIST})

Values = Callable[[int], Message]
"""Makes the message for the parameter of an index."""


@dataclass(slots=True)
class ParameterCounters:
    """What came in since the start."""

    lists: int = 0
    reads: int = 0
    changes: int = 0
    refused: int = 0
    unknown: int = 0  # names and indices that there are not


class ParameterService:
    """Answers PARAM_* and PARAM_EXT_*.

    Args:
        settings: the values.
        access: who may change them.
        speaker: says why a change is refused.
    """

    def __init__(self, settings: Settings, access: Access, speaker: Speaker) -> None:
        self.counters = ParameterCounters()
        self._settings = settings
        self._access = access
        self._speaker = speaker
        self._index = {parameter.name: i for i, parameter in enumerate(PARAMETERS)}
        self._lists: dict[tuple[MavlinkLink, bool], asyncio.TimerHandle] = {}

    @staticmethod
    def is_for_everybody(message: Message) -> bool:
        """Whether component 0 means us too: a list is asked of all, a change is not."""
        return message.get_msgId() in _LISTS

    def handle(self, message: Message, link: MavlinkLink) -> None:
        """Take one of `IDS` that is addressed to us."""
        match message.get_msgId():
            case mav.MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
                self._list(link, extended=False)
            case mav.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_LIST:
                self._list(link, extended=True)
            case mav.MAVLINK_MSG_ID_PARAM_REQUEST_READ:
                self._read(message, link, self._value)
            case mav.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_READ:
                self._read(message, link, self._extended_value)
            case mav.MAVLINK_MSG_ID_PARAM_SET:
                self._set(message, link)
            case mav.MAVLINK_MSG_ID_PARAM_EXT_SET:
                self._set_extended(message, link)

    def close(self) -> None:
        """Stop lists that are being sent."""
        for timer in self._lists.values():
            timer.cancel()
        self._lists.clear()

    def _list(self, link: MavlinkLink, *, extended: bool) -> None:
        """Send all values from the first on; a list that was under way begins anew."""
        self.counters.lists += 1
        key = (link, extended)
        if (running := self._lists.pop(key, None)) is not None:
            running.cancel()
        make = self._extended_value if extended else self._value
        self._send_next(key, map(make, range(len(PARAMETERS))))

    def _send_next(self, key: tuple[MavlinkLink, bool], left: Iterator[Message]) -> None:
        link = key[0]
        if link.waiting < _MOST_WAITING:
            message = next(left, None)
            if message is None or not link.connected:
                self._lists.pop(key, None)
                return
            link.send(message)
        self._lists[key] = asyncio.get_running_loop().call_later(PACE_S, partial(self._send_next, key, left))

    def _read(self, message: Message, link: MavlinkLink, make: Values) -> None:
        self.counters.reads += 1
        index = message.param_index if message.param_index >= 0 else self._index.get(message.param_id, -1)
        if 0 <= index < len(PARAMETERS):
            link.send(make(index))
        else:
            self.counters.unknown += 1

    def _set(self, message: Message, link: MavlinkLink) -> None:
        index = self._index.get(message.param_id)
        if index is None:
            self.counters.unknown += 1
            return
        parameter = PARAMETERS[index]
        self._change(
            message, link, parameter, lambda: from_float(message.param_value, message.param_type, whole=parameter.whole)
        )
        link.send(self._value(index))

    def _set_extended(self, message: Message, link: MavlinkLink) -> None:
        index = self._index.get(message.param_id)
        if index is None:
            self.counters.unknown += 1
            return
        parameter = PARAMETERS[index]
        raw = message._param_value_raw  # noqa: SLF001 - the generated class shows it as text only
        taken = self._change(
            message, link, parameter, lambda: from_bytes(raw, message.param_type, whole=parameter.whole)
        )
        value = to_bytes(self._settings.value(parameter), whole=parameter.whole)
        result = mav.PARAM_ACK_ACCEPTED if taken else mav.PARAM_ACK_VALUE_UNSUPPORTED
        kind = kind_of(whole=parameter.whole)
        link.send(mav.MAVLink_param_ext_ack_message(parameter.name.encode(), value, kind, result))

    def _change(self, message: Message, link: MavlinkLink, parameter: Parameter, read: Callable[[], float]) -> bool:
        """Set a parameter; False, with the reason told, when it stays as it is."""
        try:
            self._access.require(sender_of(message, link))
            self._settings.set(parameter, read())
        except (CommandRejected, ProtocolError) as refused:
            self.counters.refused += 1
            text = f"parameter refused: {refused}"
            log.info("link %s: %s", link.name, text)
            self._speaker.say(Notice(Severity.WARNING, text), link)
            return False
        self.counters.changes += 1
        return True

    def _value(self, index: int) -> Message:
        parameter = PARAMETERS[index]
        value = to_float(self._settings.value(parameter), whole=parameter.whole)
        kind = kind_of(whole=parameter.whole)
        return mav.MAVLink_param_value_message(parameter.name.encode(), value, kind, len(PARAMETERS), index)

    def _extended_value(self, index: int) -> Message:
        parameter = PARAMETERS[index]
        value = to_bytes(self._settings.value(parameter), whole=parameter.whole)
        kind = kind_of(whole=parameter.whole)
        return mav.MAVLink_param_ext_value_message(parameter.name.encode(), value, kind, len(PARAMETERS), index)
