"""The codec: every message survives the wire in any cut, and nothing that arrives can hurt."""

import math
import struct

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from arm_companion.errors import ProtocolError
from arm_companion.protocol import mavlink, mavlink_frames
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.mavlink_frames import MAGIC_V1, MAGIC_V2, _slow_crc

RANGES = {
    "B": (0, 0xFF), "b": (-0x80, 0x7F), "H": (0, 0xFFFF), "h": (-0x8000, 0x7FFF),
    "I": (0, 2**32 - 1), "i": (-(2**31), 2**31 - 1), "Q": (0, 2**64 - 1), "q": (-(2**63), 2**63 - 1),
}  # fmt: skip
TYPES = {
    "uint8_t": "B", "int8_t": "b", "uint16_t": "H", "int16_t": "h", "uint32_t": "I", "int32_t": "i",
    "uint64_t": "Q", "int64_t": "q",
}  # fmt: skip
USED = sorted({0, 4, 31, 32, 75, 76, 77, 84, 245, 253, 385, *range(64000, 64008)})


def scalars(type_: str) -> st.SearchStrategy[float]:
    if type_ in ("float", "double"):
        return st.floats(width=32)
    return st.integers(*RANGES[TYPES[type_]])


@st.composite
def messages(draw: st.DrawFn) -> Message:
    cls = mav.mavlink_map[draw(st.sampled_from(USED))]
    arguments = []
    for name, type_ in zip(cls.fieldnames, cls.fieldtypes, strict=True):
        count = cls.array_lengths[cls.ordered_fieldnames.index(name)]
        if type_ == "char":
            arguments.append(draw(st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=count)).encode())
        elif name == "mavlink_version":
            arguments.append(3)
        elif count:
            arguments.append(draw(st.lists(scalars(type_), min_size=count, max_size=count)))
        else:
            arguments.append(draw(scalars(type_)))
    return cls(*arguments)


def same(a: object, b: object) -> bool:
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("<f", a) == struct.pack("<f", b) or (math.isnan(a) and math.isnan(b))
    return a == b


def heartbeat() -> Message:
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)


@given(st.lists(messages(), min_size=1, max_size=4), st.data())
@settings(max_examples=150, deadline=None)
def test_messages_survive_the_wire_in_any_cut(sent: list[Message], data: st.DataObject) -> None:
    sender, reader = MavlinkCodec(7, 42), MavlinkCodec(1, 192)
    stream = b"".join(sender.encode(m) for m in sent)
    received = []
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        received += reader.feed(stream[:cut])
        stream = stream[cut:]
    assert [m.get_type() for m in received] == [m.get_type() for m in sent]
    for a, b in zip(sent, received, strict=True):
        assert (b.get_srcSystem(), b.get_srcComponent()) == (7, 42)
        for name in a.fieldnames:
            assert same(getattr(a, name), getattr(b, name)), (a.get_type(), name)
    assert reader.counters.lost == reader.counters.bad_crc == reader.counters.garbage == 0
    assert not reader.pending


@given(st.lists(st.tuples(st.binary(max_size=40), messages()), min_size=1, max_size=3), st.binary(max_size=40))
@settings(max_examples=300, deadline=None)
def test_noise_between_frames_costs_no_frame(pieces: list[tuple[bytes, Message]], tail: bytes) -> None:
    sender, reader = MavlinkCodec(1, 1), MavlinkCodec(1, 192)
    stream = b"".join(noise + sender.encode(m) for noise, m in pieces) + tail
    received = [*reader.feed(stream), *reader.flush()]
    assert [m.get_type() for m in received] == [m.get_type() for _, m in pieces]
    assert not reader.pending


@given(st.binary(max_size=600))
@settings(max_examples=300, deadline=None)
def test_nothing_received_can_raise_or_pile_up(noise: bytes) -> None:
    reader = MavlinkCodec(1, 192)
    reader.feed(noise)
    assert len(reader._rest) < 300
    reader.flush()
    assert not reader.pending
    assert reader.feed(MavlinkCodec(1, 1).encode(heartbeat()))


@given(messages(), st.data())
@settings(max_examples=150, deadline=None)
def test_one_flipped_bit_is_never_taken_for_the_message(message: Message, data: st.DataObject) -> None:
    frame = bytearray(MavlinkCodec(1, 1).encode(message))
    bit = data.draw(st.integers(8, len(frame) * 8 - 1))
    frame[bit // 8] ^= 1 << bit % 8
    reader = MavlinkCodec(1, 192)
    received = [*reader.feed(bytes(frame)), *reader.flush()]
    assert [m for m in received if m.get_msgId() == message.get_msgId()] == []
    counters = reader.counters
    assert counters.bad_crc + counters.bad_frame + counters.unknown + counters.garbage > 0


def test_only_wanted_messages_are_built_but_all_are_counted() -> None:
    sender, reader = MavlinkCodec(1, 1), MavlinkCodec(1, 192, wanted={31})
    attitude = mav.MAVLink_attitude_quaternion_message(5, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
    stream = b"".join(sender.encode(m) for m in (heartbeat(), attitude, heartbeat()))
    assert [m.get_msgId() for m in reader.feed(stream)] == [31]
    assert (reader.counters.frames, reader.counters.decoded, reader.counters.lost) == (3, 1, 0)


def test_missing_frames_are_counted_for_each_sender() -> None:
    one, other, reader = MavlinkCodec(1, 1), MavlinkCodec(1, 100), MavlinkCodec(1, 192)
    frames = [one.encode(heartbeat()) for _ in range(300)]
    reader.feed(frames[0] + other.encode(heartbeat()))
    reader.feed(frames[4])  # 1 to 3 are missing
    reader.feed(frames[2])  # late: neither lost again nor a jump of 250
    reader.feed(b"".join(frames[5:]))
    reader.feed(other.encode(heartbeat()))
    assert reader.counters.lost == 3


def test_frames_with_ids_that_the_dialect_lacks_are_not_missing() -> None:
    """An ArduPilot sends many of its own: a line that loses nothing must not be said to."""
    sender, reader = MavlinkCodec(1, 1), MavlinkCodec(1, 192)
    frames = [bytearray(sender.encode(heartbeat())) for _ in range(300)]
    for frame in frames[1::2]:
        frame[7:10] = b"\x11\xee\x00"
    del frames[100:104]
    reader.feed(b"".join(frames))
    assert (reader.counters.unknown, reader.counters.lost) == (148, 4)


def unknown_frame(length: int = 9) -> bytes:
    return bytes([MAGIC_V2, length, 0, 0, 0, 1, 1, 0x39, 0x30, 0x00]) + bytes(length + 2)


def test_unknown_ids_are_stepped_over_and_counted() -> None:
    reader = MavlinkCodec(1, 192)
    real = MavlinkCodec(1, 1).encode(heartbeat())
    assert len(reader.feed(unknown_frame() + real + unknown_frame())) == 1
    assert reader.counters.unknown == 2
    assert reader.counters.garbage == 0


def test_a_false_start_that_spans_a_real_frame_does_not_swallow_it() -> None:
    real = MavlinkCodec(1, 1).encode(heartbeat())
    fake = unknown_frame(len(real) + 20)[: 10 + 22]
    reader = MavlinkCodec(1, 192)
    assert len(reader.feed(fake + real)) == 1


def mavlink_1(message: Message, payload: bytes) -> bytes:
    head = bytes([len(payload), 9, 255, 190, message.get_msgId()])
    crc = _slow_crc(head + payload + bytes([message.crc_extra]), 0xFFFF)
    return bytes([MAGIC_V1]) + head + payload + struct.pack("<H", crc)


def test_no_noise_makes_the_reader_look_at_the_same_bytes_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = 0
    real = mavlink_frames.frame_end

    def counted(data: bytes, at: int) -> int:
        nonlocal looks
        looks += 1
        return real(data, at)

    for module in (mavlink, mavlink_frames):
        monkeypatch.setattr(module, "frame_end", counted)
    good = mavlink_1(heartbeat(), b"")
    # At every other byte a start of a long frame with an unknown id, and in all of them the same good one.
    noise = (bytes([MAGIC_V1, 240]) * 120 + good) * 40
    reader = MavlinkCodec(1, 192)
    assert len(reader.feed(noise)) == 39  # in the last piece the candidates wait for more
    assert looks < 2 * len(noise)
    assert len(reader.flush()) == 1


def test_a_good_frame_is_found_in_each_of_the_candidates_around_it() -> None:
    # The second candidate ends inside of the frame that the first one hides: it hides another one.
    inner = mavlink_1(heartbeat(), b"")
    outer = mavlink_1(heartbeat(), inner)
    short = bytes([MAGIC_V1, 6 + 6 + len(inner), 0, 0, 0, 240])
    long = bytes([MAGIC_V1, 6 + len(short) + len(outer), 0, 0, 0, 240])
    reader = MavlinkCodec(1, 192)
    received = [*reader.feed(long + short + outer + bytes([MAGIC_V1]) * 20), *reader.flush()]
    assert [len(m.get_msgbuf()) for m in received] == [len(outer)]


def test_half_a_frame_holds_a_real_one_back_only_until_the_line_is_silent() -> None:
    real = MavlinkCodec(1, 1).encode(heartbeat())
    reader = MavlinkCodec(1, 192)
    assert reader.feed(bytes([MAGIC_V2, 255, 0]) + real) == []
    assert reader.pending
    assert [m.get_type() for m in reader.flush()] == ["HEARTBEAT"]


@pytest.mark.parametrize("half", [bytes([MAGIC_V2, 255, 0]), b"frame"], ids=["noise", "another sender's"])
def test_whole_frames_do_not_wait_for_the_rest_of_another_one(half: bytes) -> None:
    """Several stations on one TCP port: each sends whole frames, and the network may cut one anywhere."""
    one, other, reader = MavlinkCodec(255, 190), MavlinkCodec(254, 190), MavlinkCodec(1, 192)
    cut = one.encode(mav.MAVLink_command_long_message(1, 192, 64005, 0, *[0.0] * 7))
    begun = half == b"frame"
    assert reader.feed(cut[:20] if begun else half) == []
    whole = other.encode(heartbeat()) + other.encode(heartbeat())
    for _ in range(3):
        assert [m.get_srcSystem() for m in reader.feed(whole)] == [254, 254]
    assert reader.pending
    if begun:
        assert [m.get_type() for m in reader.feed(cut[20:])] == ["COMMAND_LONG"]
        assert not reader.pending
    assert reader.counters.bad_crc == 0


def test_frames_with_unknown_incompatibility_flags_are_dropped() -> None:
    frame = bytearray(MavlinkCodec(1, 1).encode(heartbeat()))
    frame[2] = 0x02
    reader = MavlinkCodec(1, 192)
    assert [*reader.feed(bytes(frame)), *reader.flush()] == []
    assert reader.counters.bad_frame == 1


def test_mavlink_1_is_understood() -> None:
    message = heartbeat()
    (received,) = MavlinkCodec(1, 192).feed(mavlink_1(message, bytes([0, 0, 0, 0, 6, 8, 0, 4, 3])))
    assert (received.get_srcSystem(), received.type, received.mavlink_version) == (255, 6, 3)


def test_signed_frames_are_read_whole() -> None:
    frame = bytearray(MavlinkCodec(1, 1).encode(heartbeat()))[:-2]
    frame[2] = 0x01
    crc = _slow_crc(bytes(frame[1:]) + bytes([heartbeat().crc_extra]), 0xFFFF)
    signed = bytes(frame) + struct.pack("<H", crc) + bytes(13)
    reader = MavlinkCodec(1, 192)
    assert len(reader.feed(signed + signed)) == 2
    assert reader.counters.garbage == 0


@given(st.binary(max_size=200))
def test_the_plain_checksum_equals_the_compiled_one(data: bytes) -> None:
    assert mav.mcrf4xx is not None
    assert _slow_crc(data, 0xFFFF) == mav.mcrf4xx(data, 0xFFFF)


def test_a_value_that_does_not_fit_is_our_own_bug_and_uses_no_sequence_number() -> None:
    codec = MavlinkCodec(1, 192)
    with pytest.raises(ProtocolError, match="COMMAND_ACK"):
        codec.encode(mav.MAVLink_command_ack_message(70_000, 0))
    assert codec.encode(heartbeat())[4] == 0
    assert codec.encode(heartbeat())[4] == 1
