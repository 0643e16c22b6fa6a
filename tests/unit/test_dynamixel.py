"""The Dynamixel codec: the maker's own example frames, and laws that hold for every frame and every stream."""

import itertools

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from arm_companion.errors import ProtocolError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.dynamixel import Instruction, Packet, Parser


def frame_hex(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


# The maker's examples, from the instruction details of its protocol manual.
GOLDEN = [
    (dxl.ping(1), "FF FF FD 00 01 03 00 01 19 4E"),
    (dxl.ping(dxl.BROADCAST_ID), "FF FF FD 00 FE 03 00 01 31 42"),
    (dxl.status(1, 0, b"\x06\x04\x26"), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    (dxl.status(2, 0, b"\x06\x04\x26"), "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D"),
    (dxl.read(1, 132, 4), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    (dxl.status(1, 0, (166).to_bytes(4, "little")), "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
    (dxl.write(1, 116, (512).to_bytes(4, "little")), "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    (dxl.status(1), "FF FF FD 00 01 04 00 55 00 A1 0C"),
    (dxl.reg_write(1, 104, (200).to_bytes(4, "little")), "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E"),
    (dxl.action(1), "FF FF FD 00 01 03 00 05 02 CE"),
    (dxl.reboot(1), "FF FF FD 00 01 03 00 08 2F 4E"),
    (dxl.clear_turns(1), "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC"),
    (dxl.sync_read((1, 2), 132, 4), "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
    (dxl.sync_read((3, 7, 4), 132, 4, fast=True), "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2"),
    (
        dxl.sync_write(116, {1: (150).to_bytes(4, "little"), 2: (170).to_bytes(4, "little")}),
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
]


@pytest.mark.parametrize(("made", "golden"), GOLDEN)
def test_frames_are_the_makers(made: bytes, golden: str) -> None:
    assert made == frame_hex(golden)


@pytest.mark.parametrize("golden", [golden for _, golden in GOLDEN])
def test_the_makers_frames_are_understood(golden: str) -> None:
    raw = frame_hex(golden)
    (packet,) = Parser().feed(raw)
    assert packet.id == raw[4]
    assert packet.instruction == raw[7]
    skip = 9 if packet.instruction == Instruction.STATUS else 8
    assert packet.parameters == raw[skip:-2]


def bitwise_crc(data: bytes) -> int:
    """The definition: polynomial 0x8005, initial value 0, most significant bit first."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


@given(st.binary(max_size=200))
def test_crc_is_the_defined_one(data: bytes) -> None:
    assert dxl.crc16(data) == bitwise_crc(data)


tricky_bytes = st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 0xFE]) | st.integers(0, 255)
payloads = st.lists(tricky_bytes, max_size=60).map(bytes)
servo_ids = st.integers(0, dxl.MAX_ID)
instructions = st.sampled_from([i for i in Instruction if i is not Instruction.STATUS])


@st.composite
def packets(draw: st.DrawFn) -> tuple[bytes, Packet]:
    """A frame and what it must be understood as."""
    servo, data = draw(servo_ids), draw(payloads)
    if draw(st.booleans()):
        error = draw(st.integers(0, 255))
        return dxl.status(servo, error, data), Packet(servo, Instruction.STATUS, error, data)
    instruction = draw(instructions)
    return dxl.frame(servo, instruction, data), Packet(servo, instruction, 0, data)


def feed_in_pieces(parser: Parser, stream: bytes, cuts: list[int]) -> list[Packet]:
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [p for a, b in itertools.pairwise(edges) for p in parser.feed(stream[a:b])]


@given(st.lists(packets(), max_size=5), st.lists(st.integers(0, 1000), max_size=8))
def test_round_trip_in_any_pieces(items: list[tuple[bytes, Packet]], cuts: list[int]) -> None:
    parser = Parser()
    stream = b"".join(raw for raw, _ in items)
    assert feed_in_pieces(parser, stream, cuts) == [packet for _, packet in items]
    assert (parser.garbage, parser.crc_errors, parser.frames) == (0, 0, len(items))


@given(packets())
@example((dxl.write(1, 0xFFFF, b"\xfd"), Packet(1, Instruction.WRITE, 0, b"\xff\xff\xfd")))
def test_no_header_occurs_inside_a_frame(item: tuple[bytes, Packet]) -> None:
    raw, _ = item
    assert dxl.HEADER not in raw[1:-2]
    assert b"\xff\xff\xfd" not in raw[4:-2].replace(b"\xff\xff\xfd\xfd", b"")


garbage = st.lists(tricky_bytes, max_size=40).map(bytes).filter(lambda data: dxl.HEADER not in data)


@given(st.lists(st.tuples(garbage, packets()), max_size=4), st.lists(st.integers(0, 1000), max_size=8))
def test_frames_are_found_among_garbage(items: list[tuple[bytes, tuple[bytes, Packet]]], cuts: list[int]) -> None:
    parser = Parser()
    stream = b"".join(noise + raw for noise, (raw, _) in items)
    assert feed_in_pieces(parser, stream, cuts) == [packet for _, (_, packet) in items]
    assert parser.garbage == sum(len(noise) for noise, _ in items)


@given(packets(), st.integers(0, 1000), st.integers(1, 255), packets(), st.lists(st.integers(0, 1000), max_size=4))
def test_a_damaged_frame_is_dropped_and_the_next_is_found_at_once(
    first: tuple[bytes, Packet], at: int, change: int, second: tuple[bytes, Packet], cuts: list[int]
) -> None:
    parser = Parser()
    damaged = bytearray(first[0])
    damaged[at % len(damaged)] ^= change
    if damaged[4] == dxl.BROADCAST_ID and damaged[7] == Instruction.STATUS:
        return  # taken for a Fast Sync Read's answer, whose data may contain headers: see its own test
    found = feed_in_pieces(parser, bytes(damaged) + second[0], cuts)
    assert found == [second[1]]
    assert parser.garbage == len(damaged)


@given(packets(), st.integers(0, 1000), packets())
def test_a_frame_that_lost_a_byte_does_not_take_the_next_with_it(
    first: tuple[bytes, Packet], at: int, second: tuple[bytes, Packet]
) -> None:
    cut = at % len(first[0])
    shortened = first[0][:cut] + first[0][cut + 1 :]
    if len(shortened) > 7 and shortened[4] == dxl.BROADCAST_ID and shortened[7] == Instruction.STATUS:
        return
    assert Parser().feed(shortened + second[0])[-1] == second[1]


@given(st.binary(max_size=300), st.lists(st.integers(0, 1000), max_size=6))
def test_any_bytes_are_survived_and_accounted_for(stream: bytes, cuts: list[int]) -> None:
    parser = Parser()
    found = feed_in_pieces(parser, stream, cuts)
    parser.reset()
    assert parser.garbage + sum(len(dxl.frame(p.id, p.instruction, p.parameters)) for p in found) == len(stream)


def test_an_absurd_length_is_damage_and_not_waited_for() -> None:
    parser = Parser()
    assert parser.feed(dxl.HEADER + b"\x01\xff\xff") == []
    assert parser.feed(dxl.ping(3)) == [Packet(3, Instruction.PING, 0, b"")]


def test_a_frame_that_broke_off_ends_where_the_next_begins() -> None:
    parser = Parser()
    broken = dxl.status(1, 0, bytes(23))[:-5]
    assert parser.feed(broken) == []
    assert parser.feed(dxl.status(2, 0, b"\x07")) == [Packet(2, Instruction.STATUS, 0, b"\x07")]
    assert parser.garbage == len(broken)


def test_reset_forgets_what_has_begun() -> None:
    parser = Parser()
    parser.feed(dxl.ping(1)[:6])
    parser.reset()
    assert parser.garbage == 6
    assert len(parser.feed(dxl.ping(1))) == 1


fast_items = st.integers(1, 30).flatmap(
    lambda size: st.tuples(
        st.just(size),
        st.lists(
            st.tuples(servo_ids, st.integers(0, 255), st.lists(tricky_bytes, min_size=size, max_size=size).map(bytes)),
            min_size=1,
            max_size=6,
        ),
    )
)


@given(fast_items, st.lists(st.integers(0, 1000), max_size=6))
@example((4, [(1, 0, dxl.HEADER), (2, 0, b"\xff\xff\xfd\xfd")]), [12])
def test_fast_sync_read_answers_hold_any_data(sized: tuple[int, list[tuple[int, int, bytes]]], cuts: list[int]) -> None:
    size, items = sized
    (packet,) = feed_in_pieces(Parser(), dxl.fast_sync_answer(items), cuts)
    assert dxl.split_fast_sync_answer(packet, size) == [
        Packet(servo, Instruction.STATUS, error, data) for servo, error, data in items
    ]


def test_a_fast_sync_answer_is_the_makers() -> None:
    values = {3: 166, 7: 2079, 4: 1023}
    made = dxl.fast_sync_answer([(servo, 0, value.to_bytes(4, "little")) for servo, value in values.items()])
    assert made == frame_hex(
        "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA 00 04 FF 03 00 00 D1 9E"
    )
    assert len(made) == dxl.fast_sync_size(3, 4)
    for end in (16, 24, 32):
        assert int.from_bytes(made[end - 2 : end], "little") == bitwise_crc(made[: end - 2])


@given(fast_items, st.integers(0, 1000), st.integers(1, 255), st.booleans())
def test_a_damaged_fast_sync_answer_gives_nothing_and_the_next_is_found(
    sized: tuple[int, list[tuple[int, int, bytes]]], at: int, change: int, cut: bool
) -> None:
    size, items = sized
    good = dxl.fast_sync_answer(items)
    at %= len(good)
    damaged = good[:at] + good[at + 1 :] if cut else good[:at] + bytes((good[at] ^ change,)) + good[at + 1 :]
    parser = Parser()
    assert all(p.id != dxl.BROADCAST_ID or p.instruction != Instruction.STATUS for p in parser.feed(damaged))
    parser.reset()  # as the driver does before it asks again
    (packet,) = parser.feed(good)
    assert dxl.split_fast_sync_answer(packet, size) == [Packet(i, Instruction.STATUS, e, d) for i, e, d in items]


def test_a_fast_sync_answer_of_another_size_is_refused() -> None:
    (packet,) = Parser().feed(dxl.fast_sync_answer([(1, 0, b"1234")]))
    with pytest.raises(ProtocolError, match="does not hold"):
        dxl.split_fast_sync_answer(packet, 5)


def test_too_long_a_frame_is_refused() -> None:
    with pytest.raises(ProtocolError, match="longer"):
        dxl.write(1, 0, bytes(dxl.MAX_LENGTH))


@pytest.mark.parametrize("data", [{}, {1: b"\x00", 2: b"\x00\x00"}])
def test_sync_write_refuses_uneven_data(data: dict[int, bytes]) -> None:
    with pytest.raises(ProtocolError, match="one length"):
        dxl.sync_write(116, data)


@given(st.sampled_from(sorted(ct.REGISTERS.values(), key=lambda r: r.address)), st.data())
def test_registers_keep_their_values(register: ct.Register, data: st.DataObject) -> None:
    value = data.draw(st.integers(register.lower, register.upper))
    raw = register.encode(value)
    assert len(raw) == register.size
    assert register.decode(raw) == value


def test_registers_do_not_overlap_and_fill_no_more_than_the_table() -> None:
    end = 0
    for register in sorted(ct.REGISTERS.values(), key=lambda r: r.address):
        assert register.address >= end
        end = register.address + register.size
    assert end == ct.TABLE_SIZE


def test_blocks_are_where_the_design_reads_them() -> None:
    assert (ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE) == (124, 23)
    assert ct.FEEDBACK_ADDRESS + ct.FEEDBACK_SIZE - 1 == ct.PRESENT_TEMPERATURE.address == 146
    assert (ct.ECHO_ADDRESS, ct.ECHO_SIZE) == (116, 8)
    block = bytes(range(23))
    feedback = ct.decode_feedback(block)
    at = ct.PRESENT_POSITION.address - ct.FEEDBACK_ADDRESS
    assert feedback.position == ct.PRESENT_POSITION.decode(block[at : at + 4])
    at = ct.PRESENT_VOLTAGE.address - ct.FEEDBACK_ADDRESS
    assert feedback.voltage == ct.PRESENT_VOLTAGE.decode(block[at : at + 2])
