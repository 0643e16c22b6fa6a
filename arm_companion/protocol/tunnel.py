"""Our frames inside TUNNEL, so that the whole dialect passes an autopilot that forwards no private message ids.

One TUNNEL carries one whole MAVLink 2 frame, unsigned, as it would stand on a direct link: magic, header with the
true sender and its sequence number, payload, checksum. The dialect keeps every payload of ours under 117 bytes for
this: 10 + 116 + 2 = 128 bytes, all that TUNNEL holds. The other side takes the frame out and reads it with the same
parser, under the same checks, as if it had come directly. A signature would not fit; it belongs to the outer frame.
"""

from typing import Final

from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

PAYLOAD_TYPE: Final = 64_000
"""TUNNEL.payload_type of our frames: private (over 32767), and the first id of our message block."""

CAPACITY: Final = 128
"""Bytes that one TUNNEL holds."""

_MAGIC: Final = 0xFD
_AROUND_PAYLOAD: Final = 12  # header 10, checksum 2


def wrap(frame: bytes) -> bytes:
    """What goes into TUNNEL.payload: the frame itself, not padded; TUNNEL.payload_length is its length.

    Args:
        frame: one whole unsigned MAVLink 2 frame.

    Raises:
        ProtocolError: it is none, or does not fit into one TUNNEL.
    """
    if len(frame) > CAPACITY:
        raise ProtocolError(f"frame of {len(frame)} bytes does not fit into a TUNNEL of {CAPACITY}")
    if _frame_in(frame) != frame:
        raise ProtocolError("not one whole unsigned MAVLink 2 frame")
    return frame


def unwrap(payload_type: int, payload: bytes) -> bytes | None:
    """The frame in a TUNNEL, or None when it holds none of ours.

    The checksum is left to the parser that reads the frame.

    Args:
        payload_type: TUNNEL.payload_type.
        payload: TUNNEL.payload, cut to TUNNEL.payload_length or padded with anything.
    """
    return _frame_in(payload) if payload_type == PAYLOAD_TYPE else None


def tunnel(frame: bytes, system: int, component: int) -> Message:
    """The TUNNEL message that carries `frame`.

    Args:
        frame: one whole unsigned MAVLink 2 frame.
        system: target system, 0 for all.
        component: target component, 0 for all.

    Raises:
        ProtocolError: as `wrap`.
    """
    payload = wrap(frame)
    return mav.MAVLink_tunnel_message(system, component, PAYLOAD_TYPE, len(payload), payload.ljust(CAPACITY, b"\0"))


def _frame_in(payload: bytes) -> bytes | None:
    """The frame at the start of `payload`; None when there is no whole unsigned one."""
    if len(payload) < _AROUND_PAYLOAD or payload[0] != _MAGIC or payload[2] != 0:
        return None
    size = payload[1] + _AROUND_PAYLOAD
    return payload[:size] if size <= min(len(payload), CAPACITY) else None
