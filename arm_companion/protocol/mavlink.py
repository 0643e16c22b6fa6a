"""MAVLink codec without I/O: bytes in, messages out, and back.

A companion hears far more than it needs. So the reader walks from header to header, checks each frame's
checksum (cheap) and builds messages only for the ids that are wanted (dear). What fails the checksum is taken
for noise: one byte is skipped and the search for the next frame goes on, so that no real frame is lost behind a
false start.
"""

import copy
import math
import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink_frames import (
    LAYOUTS,
    MAGICS,
    SIGNED,
    Header,
    are_frames,
    checksum_fits,
    decode,
    find_frame,
    frame_end,
    header_at,
    next_magic,
    place_of,
)

Message: TypeAlias = Any
"""A message of the generated dialect, `mav.MAVLink_<name>_message`."""

_FLOAT: Final = struct.Struct("<f")


@dataclass(slots=True)
class Counters:
    """What a reader has seen. All count from the start of the link."""

    frames: int = 0  # good frames, wanted or not
    decoded: int = 0  # messages handed out
    bad_crc: int = 0  # candidates whose checksum was wrong
    bad_frame: int = 0  # right checksum, but flags or content that cannot be read
    unknown: int = 0  # frames with ids that the dialect lacks
    garbage: int = 0  # bytes outside of any frame
    lost: int = 0  # frames missing from the senders' sequences
    refused: int = 0  # good frames that the guard did not let in
    sent: int = 0  # frames encoded


@dataclass(slots=True)
class _NoSigning:
    """Stands where the generated code looks for the signing state of the sender."""

    sign_outgoing: bool = False


@dataclass(slots=True)
class _Sender:
    """What the generated `pack` needs to know of the sender."""

    srcSystem: int
    srcComponent: int
    seq: int = 0
    signing: _NoSigning = field(default_factory=_NoSigning)


Guard: TypeAlias = Callable[[bytes, Header], bool]
Tap: TypeAlias = Callable[[bytes, Header], None]


class MavlinkCodec:
    """Reader and writer of one link.

    Args:
        system_id: our system id in what we send; may be changed later.
        component_id: our component id.
        wanted: ids of messages to decode; None decodes every known one.
    """

    def __init__(self, system_id: int, component_id: int, wanted: Collection[int] | None = None) -> None:
        self.counters = Counters()
        self.wanted: frozenset[int] | None = None if wanted is None else frozenset(wanted)
        self.guard: Guard | None = None
        """Decides which of the good frames are let in; None lets all in."""
        self.tap: Tap | None = None
        """Gets every frame that is let in, wanted or not."""
        self.seal: Callable[[bytes], bytes] | None = None
        """Turns each frame that leaves into a signed one."""
        self._sender = _Sender(system_id, component_id)
        self._rest = b""
        self._hidden = (-1, -1)  # where the good frame stands that the last look into a candidate found
        self._sequences: dict[int, int] = {}

    @property
    def system_id(self) -> int:
        """System id in what we send."""
        return self._sender.srcSystem

    @system_id.setter
    def system_id(self, value: int) -> None:
        self._sender.srcSystem = value

    @property
    def component_id(self) -> int:
        """Component id in what we send."""
        return self._sender.srcComponent

    def encode(self, message: Message) -> bytes:
        """One MAVLink 2 frame with the next sequence number.

        A float that 32 bits do not hold goes out as infinite, as IEEE 754 has it, where nobody is asked to act on it.

        Raises:
            ProtocolError: when a field does not fit its type; nothing is counted as sent then.
        """
        try:
            data = self._packed(message)
        except (struct.error, TypeError, ValueError, OverflowError) as error:
            raise ProtocolError(f"{message.get_type()} cannot be encoded: {error}") from error
        if self.seal is not None:
            data = self.seal(data)
        self._sender.seq = (self._sender.seq + 1) & 0xFF
        self.counters.sent += 1
        return data

    def _packed(self, message: Message) -> bytes:
        try:
            data: bytes = message.pack(self._sender)
        except OverflowError:  # of floats alone
            if place_of(type(message), "target_system") >= 0:  # who is addressed gets what was meant, or nothing
                raise
            data = _in_single_precision(message).pack(self._sender)
        return data

    @property
    def pending(self) -> bool:
        """Whether half a frame waits for the rest of its bytes."""
        return bool(self._rest)

    def reset(self) -> None:
        """Forget half a frame, as after a reconnect."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Take received bytes, in any cut.

        Returns:
            The wanted messages that are complete now, in order. Never raises for anything received.
        """
        if not (self._rest and are_frames(data)):
            return self._scan(self._rest + data if self._rest else data, final=False)
        # whoever began the half frame, these came from somebody else, or noise began it: they need not wait for it
        begun = self._rest
        messages = self._scan(data, final=False)
        self._rest = begun
        return messages

    def flush(self) -> list[Message]:
        """The line has been silent for long: give up on half a frame, and read what hides behind it.

        A noise byte that looks like the start of a long frame would otherwise hold back a real one.
        """
        return self._scan(self._rest, final=True)

    def _scan(self, data: bytes, *, final: bool) -> list[Message]:
        messages: list[Message] = []
        counters, size, at = self.counters, len(data), 0
        self._rest, self._hidden = b"", (-1, -1)
        while at < size:
            if (start := next_magic(data, at)) > at:
                counters.garbage += start - at
                at = start
                continue
            end = frame_end(data, at)
            if end <= size:
                head = header_at(data, at)
                if self._genuine(data, end, head):
                    at = end
                    if self._let_in(data, end, head) and (self.wanted is None or head.id in self.wanted):
                        messages += self._build(data, end, head)
                    continue
            elif not final:
                self._rest = data[at:]
                break
            counters.garbage += 1
            at += 1
        return messages

    def _let_in(self, data: bytes, end: int, head: Header) -> bool:
        """Show the frame to guard and tap; whether it may be read."""
        if self.guard is not None and not self.guard(data[head.magic : end], head):
            self.counters.refused += 1
            return False
        if self.tap is not None:
            self.tap(data[head.magic : end], head)
        return head.id in LAYOUTS

    def _genuine(self, data: bytes, end: int, head: Header) -> bool:
        """Whether the candidate with this header, which ends before `end`, is a frame and not noise."""
        counters = self.counters
        if head.flags & ~SIGNED:  # the standard: drop frames with flags that we do not understand
            counters.bad_frame += 1
            return False
        layout = LAYOUTS.get(head.id)
        if layout is None:
            # Without CRC_EXTRA there is no check but what follows (the next frame, or nothing yet), and that
            # it is not noise in front of a real frame.
            if (end < len(data) and data[end] not in MAGICS) or self._hides_frame(data, head.magic + 1, end):
                return False
            counters.unknown += 1
            if (sender := head.system << 8 | head.component) in self._sequences:
                self._count_losses(sender, head.sequence)  # it came: its number is not missing
            return True
        if not checksum_fits(data, head, layout):
            counters.bad_crc += 1
            return False
        counters.frames += 1
        self._count_losses(head.system << 8 | head.component, head.sequence)
        return True

    def _hides_frame(self, data: bytes, start: int, end: int) -> bool:
        """Whether a whole good frame with a known id stands somewhere between start and end.

        What was found once is not searched again for the next candidate: noise may have one at every other byte,
        and a search costs as much as all that are in it.
        """
        where, until = self._hidden
        if not (start <= where and until <= end):
            self._hidden = find_frame(data, start, end)
        return self._hidden[0] >= 0

    def _build(self, data: bytes, end: int, head: Header) -> list[Message]:
        """The message in a genuine frame; none, and counted, when its content cannot be read."""
        try:
            message = decode(LAYOUTS[head.id], data[head.payload : head.crc])
        except (TypeError, ValueError, struct.error):
            self.counters.bad_frame += 1
            return []
        self.counters.decoded += 1
        # The generated decoder fills the same private fields.
        message._header = mav.MAVLink_header(  # noqa: SLF001
            head.id, head.flags, 0, head.crc - head.payload, head.sequence, head.system, head.component
        )
        message._msgbuf = data[head.magic : end]  # noqa: SLF001
        message._signed = bool(head.flags & SIGNED)  # noqa: SLF001 - where there is no guard it only says: claims to be
        return [message]

    def _count_losses(self, sender: int, sequence: int) -> None:
        last = self._sequences.get(sender)
        if last is not None:
            gap = (sequence - last - 1) & 0xFF
            if gap >= 0x80:  # an old frame that came late, or the same one twice
                return
            self.counters.lost += gap
        self._sequences[sender] = sequence


def _in_single_precision(message: Message) -> Message:
    """The message with what its floats cannot hold as infinite."""
    fitting = copy.copy(message)
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        if kind == "float":
            value = getattr(message, name)
            setattr(fitting, name, list(map(_single, value)) if isinstance(value, list | tuple) else _single(value))
    return fitting


def _single(value: float) -> float:
    try:
        _FLOAT.pack(value)
    except OverflowError:
        return math.copysign(math.inf, value)
    return value
