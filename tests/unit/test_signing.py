"""Signing: pymavlink's own signatures are accepted and ours by it; what is old, altered or foreign is not."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.mavlink_frames import Header
from arm_companion.protocol.signing import EPOCH_S, MOST_STREAMS, OLDEST_S, Signing, stamp_at

KEY = bytes(range(32))
NOW = EPOCH_S + 300_000_000.0


def beat() -> mav.MAVLink_heartbeat_message:
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)


def peer(key: bytes = KEY, stamp: int = stamp_at(NOW)) -> mav.MAVLink:
    """pymavlink as a signing system 255/190."""
    other = mav.MAVLink(None, 255, 190)
    other.signing.secret_key = key
    other.signing.link_id = 3
    other.signing.timestamp = stamp
    other.signing.sign_outgoing = True
    return other


def guarded(signing: Signing, now: float = NOW) -> MavlinkCodec:
    codec = MavlinkCodec(1, 192)
    codec.guard = lambda frame, head: signing.accept(frame, head, now)
    codec.seal = lambda frame: signing.sign(frame, now)
    return codec


def test_pymavlink_and_we_believe_each_other() -> None:
    codec, other = guarded(Signing(KEY, link_id=7)), peer()
    for _ in range(3):
        (got,) = codec.feed(beat().pack(other))
        assert got.get_signed()
        frame = codec.encode(beat())
        (read,) = other.parse_buffer(frame)
        assert read.get_signed()
        assert read.get_link_id() == 7
    assert codec.counters.refused == 0


def test_a_replay_is_refused_and_so_is_anything_older() -> None:
    codec, other = guarded(Signing(KEY)), peer()
    frames = [beat().pack(other) for _ in range(3)]
    assert len(codec.feed(frames[0])) == len(codec.feed(frames[2])) == 1
    for frame in frames:
        assert codec.feed(frame) == []
    assert codec.counters.refused == 3


def test_a_stranger_may_be_a_minute_behind_and_no_more() -> None:
    for behind, allowed in ((OLDEST_S - 1.0, True), (OLDEST_S + 1.0, False)):
        codec = guarded(Signing(KEY))
        assert bool(codec.feed(beat().pack(peer(stamp=stamp_at(NOW - behind))))) is allowed


def test_wrong_keys_unsigned_and_altered_frames_are_refused() -> None:
    codec = guarded(Signing(KEY))
    assert codec.feed(beat().pack(peer(key=bytes(32)))) == []
    assert codec.feed(beat().pack(mav.MAVLink(None, 255, 190))) == []
    good = beat().pack(peer())
    for place in range(len(good) - 13, len(good)):  # in the signature; before it the checksum tells
        assert codec.feed(good[:place] + bytes((good[place] ^ 1,)) + good[place + 1 :]) == []
    assert codec.feed(good)


def test_our_stamps_grow_whatever_the_clock_does_and_survive_a_restart() -> None:
    signing = Signing(KEY, stamp=stamp_at(NOW) + 1000)
    frame = MavlinkCodec(1, 192).encode(beat())
    stamps = []
    for now in (NOW, NOW, NOW - 1e6, 0.0, NOW + 1.0):
        signed = signing.sign(frame, now)
        stamps.append(int.from_bytes(signed[-12:-6], "little"))
    assert stamps == sorted(set(stamps))
    assert stamps[0] > stamp_at(NOW) + 1000
    assert signing.stamp == stamps[-1]


def test_senders_are_remembered_up_to_a_number() -> None:
    codec = guarded(Signing(KEY))
    taken = 0
    for number in range(MOST_STREAMS + 20):
        other = peer()
        other.srcSystem, other.srcComponent = 1 + number // 200, 1 + number % 200
        taken += len(codec.feed(beat().pack(other)))
    assert taken == MOST_STREAMS


def test_a_key_has_32_bytes_and_unknown_ids_cannot_be_signed() -> None:
    with pytest.raises(ProtocolError, match="32 bytes"):
        Signing(b"short")
    frame = MavlinkCodec(1, 192).encode(beat())
    with pytest.raises(ProtocolError, match="unknown id"):
        Signing(KEY).sign(frame[:7] + b"\xff\xff\xff" + frame[10:], NOW)


@given(st.binary(max_size=300))
def test_bytes_are_never_taken_for_a_signature(data: bytes) -> None:
    signing = Signing(KEY)
    head = Header(1, 0, 255, 190, 0, 0, 10, max(len(data) - 15, 0))
    assert not signing.accept(data, head, NOW)
    assert guarded(signing).feed(data) == []
