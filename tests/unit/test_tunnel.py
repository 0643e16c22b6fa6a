"""TUNNEL framing: what goes in comes out, and nothing else does."""

import hypothesis.strategies as st
import pytest
from hypothesis import given

from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.mavlink_frames import LAYOUTS, decode
from arm_companion.protocol.tunnel import CAPACITY, PAYLOAD_TYPE, tunnel, unwrap, wrap

OURS = range(64000, 64007)


def longest(id_: int) -> bytes:
    """A frame of the message without a zero byte to cut off."""
    layout = LAYOUTS[id_]
    return MavlinkCodec(1, 192).encode(decode(layout, b"\x01" * layout.size))


@pytest.mark.parametrize("id_", OURS)
def test_every_message_of_ours_fits_and_comes_out_whole(id_: int) -> None:
    frame = longest(id_)
    carrier = MavlinkCodec(1, 192).encode(tunnel(frame, 255, 190))
    (message,) = MavlinkCodec(255, 190).feed(carrier)
    assert (message.target_system, message.target_component) == (255, 190)
    assert message.payload_length == len(frame) <= CAPACITY
    inner = unwrap(message.payload_type, bytes(message.payload))
    assert inner == frame
    assert inner == unwrap(message.payload_type, bytes(message.payload[: message.payload_length]))
    (read,) = MavlinkCodec(255, 190).feed(inner)
    assert (read.get_msgId(), read.get_srcSystem(), read.get_srcComponent()) == (id_, 1, 192)


@given(st.integers(0, 0xFFFF), st.binary(max_size=140))
def test_unwrap_never_raises_and_returns_only_whole_frames(payload_type: int, payload: bytes) -> None:
    inner = unwrap(payload_type, payload)
    if inner is not None:
        assert payload_type == PAYLOAD_TYPE
        assert wrap(inner) == inner
        assert payload.startswith(inner)


def test_another_payload_type_is_not_ours() -> None:
    assert PAYLOAD_TYPE > 32767
    assert unwrap(PAYLOAD_TYPE + 1, wrap(longest(64000))) is None


@pytest.mark.parametrize("cut", range(1, 128, 7))
def test_half_a_frame_is_refused(cut: int) -> None:
    frame = longest(64001)
    half = frame[: min(cut, len(frame) - 1)]
    assert unwrap(PAYLOAD_TYPE, half) is None
    with pytest.raises(ProtocolError, match="not one whole"):
        wrap(half)


def test_what_does_not_fit_or_is_signed_or_old_is_refused() -> None:
    big = MavlinkCodec(1, 192).encode(mav.MAVLink_tunnel_message(1, 1, 1, 128, [1] * 128))
    with pytest.raises(ProtocolError, match="does not fit"):
        wrap(big)
    frame = longest(64000)
    signed = frame[:2] + b"\x01" + frame[3:]
    version_1 = b"\xfe" + frame[1:]
    two = (beat := MavlinkCodec(1, 192).encode(mav.MAVLink_heartbeat_message(0, 0, 0, 0, 0, 3))) + beat
    for bad in (signed, version_1, two, b""):
        with pytest.raises(ProtocolError, match="not one whole"):
            wrap(bad)
