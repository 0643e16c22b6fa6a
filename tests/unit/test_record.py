"""Records on disk: what stands in them, power cuts, slow and full disks, rotation, and what is no record."""

import asyncio
import base64
import contextlib
import dataclasses
import errno
import functools
import itertools
import json
import math
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, Message, Schema, SummaryOffset
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from arm_companion.clock import Clock, run_simulated
from arm_companion.config import Config, load
from arm_companion.config.schema import RecordConfig
from arm_companion.config.table import as_table, from_table
from arm_companion.errors import ConfigError, RecordError
from arm_companion.mission.facts import Commands, Notice, Severity, VehicleState
from arm_companion.mission.state import State
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.record import configured_recorder, mcap_file, storage
from arm_companion.record.file_recorder import FileRecorder
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.raw import KeyGuard, Taps
from arm_companion.record.reader import Reader
from arm_companion.record.recorder import Frame, Record, Recorder
from arm_companion.record.replay import Cycle, cycles, differences
from arm_companion.record.topics import COMMANDS, FACTS, LOG, METADATA, SCHEMAS, TRANSITIONS, schema_text, transition
from arm_companion.record.versions import versions
from arm_companion.record_codec import build, dumps, loads
from arm_companion.transport.memory import MemoryPipe

GOLDEN = Path(__file__).parents[1] / "golden" / "perch.mcap"
CONFIG = load("sim.toml")


@functools.cache
def records() -> list[Record]:
    """Cycles of the golden flight."""
    found = []
    for cycle in itertools.islice(cycles(Reader(GOLDEN)), 300):
        if isinstance(cycle, Cycle):
            table = orjson.loads(cycle.commands)
            table.pop("t")
            found.append(Record(cycle.t, cycle.facts, State(t=cycle.t), build(Commands, table)))
    return found


def recorder(
    path: Path, open_file: Callable[[Path, dict[str, str]], McapFile] = McapFile, **options: object
) -> FileRecorder:
    made = FileRecorder(
        path, RecordConfig(**options), versions(CONFIG), lambda t: 1.7e9 + t, patient=True, open_file=open_file
    )
    made.configure(0.0, CONFIG)
    made.mechanics("numpy")
    return made


def write(path: Path, **options: object) -> None:
    made = recorder(path, **options)
    for record in records():
        made.frame(Frame(record.t, "mavlink/autopilot", True, bytes(1500)))
        made.notice(record.t, Notice(Severity.INFO, "READY -> APPROACH: order PERCH"))
        made.put(record)
    made.close()
    assert made.troubles() == []


def facts(path: Path) -> tuple[int, list[str]]:
    reader = Reader(path)
    return len(list(reader.messages((FACTS,)))), reader.remarks


@given(st.floats(), st.floats())
def test_every_float_comes_back_with_every_bit(a: float, b: float) -> None:
    state = VehicleState(position_w=(a, b, -0.0), heartbeat_age_s=b)
    text = dumps(state)
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    back = loads(VehicleState, text)
    for x, y in zip((*back.position_w, back.heartbeat_age_s), (a, b, -0.0, b), strict=True):
        assert (math.isnan(x) and math.isnan(y)) or (x == y and math.copysign(1, x) == math.copysign(1, y))


def test_what_was_read_is_written_again_byte_for_byte() -> None:
    """Memory that is taken up from a record is compared as text (record/shares.py)."""
    for cycle in itertools.islice(cycles(Reader(GOLDEN)), 300):
        if isinstance(cycle, Cycle):
            text = dumps(loads(State, cycle.state))
            assert dumps(loads(State, text)) == text
            changed = differences(json.loads(cycle.state), json.loads(text))
            assert all(before == "(absent)" for _, before, _ in changed), "the flight may be older than a field"


def test_the_stock_reader_finds_every_channel_with_a_schema_that_fits(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    write(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        topics = {channel.topic: channel for channel in summary.channels.values()}
        assert SCHEMAS.keys() < topics.keys()
        seen, raw = set(), []
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            fits(json.loads(message.data), json.loads(schema.data), channel.topic)
            seen.add(channel.topic)
            if channel.topic.startswith("/raw/"):
                raw.append(base64.b64decode(json.loads(message.data)["data"], validate=True))
    assert {FACTS, "/state", COMMANDS, LOG, TRANSITIONS, "/configuration", "/raw/mavlink/autopilot/sent"} <= seen
    assert raw == [bytes(1500)] * len(records())


@pytest.mark.parametrize("topic", [*SCHEMAS, "/raw/servos/sent"])
def test_every_schema_is_one_that_foxglove_takes(topic: str) -> None:
    """Foxglove's reader refuses the whole channel for one field of another kind."""

    def check(table: dict[str, Any], where: str) -> None:
        assert table["type"] in {"object", "array", "string", "number", "integer", "boolean"}, where
        for name, inner in table.get("properties", {}).items():
            check(inner, f"{where}.{name}")
        if table["type"] == "array":
            assert table["items"]["type"] != "array", f"{where}: an array of arrays"
            assert "contentEncoding" not in table["items"], where
            check(table["items"], where)

    table = json.loads(schema_text(topic)[1])
    assert table["type"] == "object"
    check(table, topic)


MESSAGES = st.lists(
    st.tuples(
        st.sampled_from([*SCHEMAS, "/raw/servos/sent", "/raw/mavlink/autopilot/received"]),
        st.integers(0, 2**63),  # Unix time, ns; it may step back
        st.binary(max_size=70).map(lambda seed: seed * 900),  # up to a quarter of a chunk
        st.integers(0, 2**32 - 1),
    ),
    max_size=30,
)


@settings(max_examples=30, deadline=None)
@given(MESSAGES)
def test_the_librarys_own_writer_would_have_said_the_same(messages: list[tuple[str, int, bytes, int]]) -> None:
    with TemporaryDirectory() as directory:
        ours, theirs = Path(directory) / "ours.mcap", Path(directory) / "theirs.mcap"
        file = McapFile(ours, {"format": "1"})
        with theirs.open("wb") as stream:
            writer = Writer(stream, chunk_size=mcap_file._CHUNK)
            writer.start(profile="", library="arm-companion")
            writer.add_metadata(METADATA, {"format": "1"})
            channels: dict[str, int] = {}
            raw = 0
            for topic in SCHEMAS:
                name, text = schema_text(topic)
                schema = writer.register_schema(name, "jsonschema", text)
                channels[topic] = writer.register_channel(topic, "json", schema)
            for topic, t, data, sequence in messages:
                file.text(topic, t, data, sequence)
                if topic not in channels:
                    name, text = schema_text(topic)
                    raw = raw or writer.register_schema(name, "jsonschema", text)
                    channels[topic] = writer.register_channel(topic, "json", raw)
                writer.add_message(channels[topic], t, data, t, sequence)
            writer.finish()
        file.close()
        times = sorted(t for _, t, _, _ in messages[::3]) or [0]  # some of them
        window = (times[0], times[-1])
        assert told(ours, *window) == told(theirs, *window)


def told(path: Path, start: int, end: int) -> list[Any]:
    """What the library's readers say of a file; the one that goes by the index needs all offsets to be right."""
    with path.open("rb") as stream:
        in_order = [
            (kind.__name__, vars(record)) if kind in (Schema, Channel, Message, DataEnd) else kind.__name__
            for record in StreamReader(stream, validate_crcs=True).records
            for kind in [type(record)]
            if not (kind is SummaryOffset and record.group_length == 0)
        ]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        chunks = [(c.message_start_time, c.message_end_time, c.uncompressed_size) for c in summary.chunk_indexes]
        found = [message for _, _, message in reader.iter_messages(starting_at=start, ending_at=end, reverse=True)]
        metadata = [(record.name, record.metadata) for record in reader.iter_metadata()]
        return [in_order, summary.statistics, summary.schemas, summary.channels, chunks, found, metadata]


def fits(value: object, schema: dict, where: str) -> None:
    if value is None or value in ("nan", "inf", "-inf"):
        return
    kinds = {"object": dict, "array": list, "number": (int, float), "integer": int, "string": str, "boolean": bool}
    assert isinstance(value, kinds[schema["type"]]), where
    if isinstance(value, dict) and "properties" in schema and schema["properties"]:
        for name, item in value.items():
            if name in schema["properties"]:
                fits(item, schema["properties"][name], f"{where}.{name}")
            else:
                assert name in {"jumps", "covariance"}, f"{where}.{name}: only what has two dimensions is left out"
    if isinstance(value, list):
        for item in value:
            fits(item, schema["items"], where)


def test_configuration_versions_and_calibration_are_in_it(tmp_path: Path) -> None:
    directory = tmp_path / "calibration"
    directory.mkdir()
    (directory / "tendons.json").write_text('{"version": 1}')
    config = load("sim.toml", [f'calibration.directory="{directory}"'])
    made = FileRecorder(tmp_path / "r.mcap", config.record, versions(config), lambda t: t, patient=True)
    made.configure(0.0, config)
    made.put(records()[0])
    made.close()
    reader = Reader(tmp_path / "r.mcap")
    assert reader.versions["calibration/tendons.json"] == '{"version": 1}'
    assert {"version", "python", "numpy", "processor"} <= reader.versions.keys()
    assert next(c for c in cycles(reader) if isinstance(c, Config)) == config


def test_a_change_before_the_first_cycle_opens_no_file_that_knows_too_little(tmp_path: Path) -> None:
    """Parameters may be set while the mechanics are still being loaded."""
    made = FileRecorder(tmp_path / "r.mcap", RecordConfig(), {"format": "1"}, lambda t: t)
    made.configure(0.0, CONFIG)
    made.configure(0.1, CONFIG)
    threading.Event().wait(0.3)  # the thread has looked
    made.mechanics("numba")
    made.put(records()[0])
    made.close()
    reader = Reader(tmp_path / "r.mcap")
    assert reader.versions["mechanics"] == "numba"
    assert sum(isinstance(found, Config) for found in cycles(reader)) == 2


def test_a_configuration_comes_back_and_settings_over_it_are_checked() -> None:
    table = json.loads(json.dumps(as_table(CONFIG)))
    assert from_table(table, "x") == CONFIG
    assert from_table(table, "x", ["perch.grip_tension_n=25"]).perch.grip_tension_n == 25.0
    with pytest.raises(ConfigError, match="grip_tension_n"):
        from_table(table, "x", ["perch.grip_tension_n=-1"])
    with pytest.raises(ConfigError, match="unknown key"):
        from_table(table | {"nonsense": 1}, "x")


def test_a_power_cut_anywhere_leaves_all_that_was_whole(tmp_path: Path) -> None:
    path, cut = tmp_path / "r.mcap", tmp_path / "cut.mcap"
    write(path)
    data = path.read_bytes()
    whole, remarks = facts(path)
    assert (whole, remarks) == (len(records()), [])
    counts = []
    for share in (0.2, 0.5, 0.8, 0.99):
        cut.write_bytes(data[: int(share * len(data))])
        count, remarks = facts(cut)
        counts.append(count)
        assert count == whole or "cut off" in remarks[0]
    assert counts == sorted(counts)
    assert 0 < counts[1] < whole


def test_flipped_bytes_are_noticed_and_what_stands_before_them_is_read(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    write(path)
    data = bytearray(path.read_bytes())
    with path.open(
        "rb"
    ) as stream:  # ends of the chunks; what lies between them is an index, which reading does not need
        read = StreamReader(stream, emit_chunks=True).records
        ends = [stream.tell() for record in read if isinstance(record, Chunk)]
    middle = ends[len(ends) // 2] - 1000
    data[middle : middle + 64] = os.urandom(64)
    path.write_bytes(data)
    count, remarks = facts(path)
    assert 0 < count < len(records())
    assert "damaged" in remarks[0] or "cut off" in remarks[0]


def no_records(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    yield tmp_path / "absent.mcap", "cannot be read"
    yield tmp_path, "cannot be read"
    for name, data, why in (
        ("empty.mcap", b"", "cut off"),
        ("text.mcap", b"no record, but a long enough text\n", "not an MCAP file"),
        ("magic.mcap", b"\x89MCAP0\r\n", "cut off"),
    ):
        (tmp_path / name).write_bytes(data)
        yield tmp_path / name, why
    with (tmp_path / "foreign.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    yield tmp_path / "foreign.mcap", "not a record of arm-companion"
    McapFile(tmp_path / "future.mcap", {"format": "99"}).close()
    yield tmp_path / "future.mcap", "format 99"


def test_what_is_no_record_is_refused_in_words(tmp_path: Path) -> None:
    for path, why in no_records(tmp_path):
        with pytest.raises(RecordError, match=why):
            Reader(path)


@pytest.mark.parametrize("part_mb", [1.0, 200.0])
def test_a_record_goes_on_in_parts_and_the_oldest_make_room(tmp_path: Path, part_mb: float) -> None:
    path = tmp_path / "20260101-120000.mcap"
    others = [tmp_path / "20250101-000000.mcap", tmp_path / "notes.mcap"]
    for other in others:
        other.write_bytes(bytes(3_000_000))
        os.utime(other, (1.0, 1.0))

    made = recorder(path, part_mb=part_mb, budget_mb=4.0, keep_free_mb=0.0, raw_kb_per_s=10_000.0)
    totals = []
    for i in range(9):
        for record in records():
            made.frame(Frame(record.t + i, "servos", False, os.urandom(4000)))
            made.put(record)
            with contextlib.suppress(FileNotFoundError):  # deleted as we look
                totals.append(sum(part.stat().st_size for part in tmp_path.glob("20*")))
    made.close()
    assert made.troubles() == []
    assert not others[0].exists()
    assert others[1].exists()
    parts = sorted(tmp_path.glob("2026*"))
    assert len(parts) >= 2
    assert max(totals) < 4.5e6, "a part that still grows is counted as the whole that it becomes"
    late = Reader(parts[0])
    assert list(late.messages((FACTS,)))
    assert any(isinstance(c, Config) for c in cycles(late)), "every part has its configuration"


def test_parts_are_read_in_their_order(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    made = recorder(path, part_mb=1.0, raw_kb_per_s=10_000.0)
    for record in records():
        made.frame(Frame(record.t, "servos", False, os.urandom(8000)))
        made.put(record)
    made.close()
    assert (tmp_path / "r-002.mcap").exists()
    sequences = [item.sequence for item in Reader(path).messages((FACTS,))]
    assert sequences == list(range(len(records())))
    assert Reader(tmp_path / "r-002.mcap").part == 2


@pytest.mark.parametrize(
    ("name", "after"),
    [
        ("20260101-120000.mcap", "20260101-120000-002.mcap"),
        ("20260101-120000-002.mcap", "20260101-120000-003.mcap"),
        ("r.mcap", "r-002.mcap"),
        ("r-009.mcap", "r-010.mcap"),
    ],
)
def test_names_of_parts(name: str, after: str) -> None:
    assert storage.following(Path(name)) == Path(after)
    first, number = storage.first_of(Path(after))
    assert storage.part(first, number) == Path(after)
    assert storage.part(first, number - 1) == Path(name)


class Held(McapFile):
    """A disk that hangs until it is told otherwise."""

    go = threading.Event()

    def json(self, topic: str, unix_ns: int, value: dict, sequence: int = 0) -> None:
        assert self.go.wait(10.0)
        super().json(topic, unix_ns, value, sequence)


def test_a_hanging_disk_costs_records_and_no_time(tmp_path: Path) -> None:
    Held.go.clear()
    made = FileRecorder(tmp_path / "r.mcap", RecordConfig(), {"format": "1"}, lambda t: t, open_file=Held)
    made.configure(0.0, CONFIG)
    for i in range(1300):
        made.put(records()[i % len(records())])  # would wait here for ever if it waited at all
    assert made.dropped >= 290
    assert made.troubles() == ["record: the disk is too slow, cycles are missing"]
    Held.go.set()
    done = threading.Event()
    for _ in range(200):
        made.put(records()[0])
        if any("complete again" in text for text in made.troubles()):
            break
        done.wait(0.05)
    else:
        pytest.fail("never caught up")
    made.close()
    sequences = [item.sequence for item in Reader(tmp_path / "r.mcap").messages((FACTS,))]
    assert len(sequences) < sequences[-1] + 1, "the gap shows in the numbers"


def test_a_full_disk_is_told_and_recording_goes_on_when_there_is_room(tmp_path: Path) -> None:
    opened = []

    def full_twice(path: Path, about: dict[str, str]) -> McapFile:
        opened.append(path.name)
        if len(opened) <= 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return McapFile(path, about)

    made = recorder(tmp_path / "r.mcap", open_file=full_twice)
    for record in records():  # 24 s of flight: tries again each 10 s
        made.put(record)
    made.close()
    assert opened == ["r.mcap"] * 3, "where a reader begins"
    assert made.dropped > 200
    found = list(cycles(Reader(tmp_path / "r.mcap")))
    assert isinstance(found[0], Config)
    assert len([c for c in found if isinstance(c, Cycle)]) == len(records()) - made.dropped


def test_what_a_full_disk_interrupts_is_one_record_and_what_it_cost_is_counted(tmp_path: Path) -> None:
    class Filling(McapFile):
        """Takes nothing once this much stands in it, nor do those that are opened meanwhile."""

        most, tries = 100_000, 0

        def text(self, topic: str, unix_ns: int, data: bytes, sequence: int = 0) -> None:
            super().text(topic, unix_ns, data, sequence)
            if self.size > self.most and topic == FACTS:
                Filling.tries += 1
                Filling.most = 0 if Filling.tries < 4 else 10**9
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    made = recorder(tmp_path / "r.mcap", open_file=Filling)
    count = 1500
    for i in range(count):
        made.put(dataclasses.replace(records()[i % len(records())], t=0.1 * i))
    made.close()
    assert Filling.tries == 4, "full for more than three tries"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["r-002.mcap", "r.mcap"]
    assert facts(tmp_path / "r.mcap")[0] == count - made.dropped


def test_a_disk_with_too_little_left_costs_nothing_that_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = iter([1e6, 0.0, 0.0, *[1e6] * 100])
    monkeypatch.setattr(storage, "free_mb", lambda _: next(left))
    made = recorder(tmp_path / "r.mcap")
    for record in records():
        made.put(record)
    made.close()
    assert (tmp_path / "r-002.mcap").exists()
    count, remarks = facts(tmp_path / "r.mcap")
    assert (count, remarks) == (len(records()) - made.dropped, [])


@pytest.mark.parametrize("cut", [0, 8, 100])
def test_a_part_that_was_only_begun_hides_nothing(tmp_path: Path, cut: int) -> None:
    write(tmp_path / "r.mcap")
    other = tmp_path / "r-002.mcap"
    other.write_bytes((tmp_path / "r.mcap").read_bytes()[:cut])
    count, remarks = facts(tmp_path / "r.mcap")
    assert count == len(records())
    assert len(remarks) == 1
    assert "r-002.mcap: cut off before its first cycle" in remarks[0]


def test_a_shorter_record_of_the_same_name_and_time_has_no_parts_of_the_longer_one(tmp_path: Path) -> None:
    write(tmp_path / "r.mcap")
    made = recorder(tmp_path / "r.mcap", part_mb=1.0, raw_kb_per_s=10_000.0)
    for record in records():
        made.frame(Frame(record.t, "servos", False, os.urandom(8000)))
        made.put(record)
    made.close()
    assert (tmp_path / "r-002.mcap").exists()
    write(tmp_path / "r.mcap")
    assert facts(tmp_path / "r.mcap") == (len(records()), [])


def test_a_start_at_the_same_second_leaves_the_earlier_record(tmp_path: Path) -> None:
    config = load("sim.toml", [f'record.directory="{tmp_path}"'])
    (tmp_path / "20231114-221321-002.mcap").write_bytes(b"a part of another")
    clock = Clock(asyncio.new_event_loop(), 0.0)
    try:
        clock._unix_offset_s = 1.7e9 - clock.now()
        for count in (30, 20):
            made = configured_recorder(config, clock)
            made.configure(0.0, config)
            for record in records()[:count]:
                made.put(record)
            made.close()
    finally:
        clock._loop.close()
    assert facts(tmp_path / "20231114-221320.mcap") == (30, [])
    assert facts(tmp_path / "20231114-221322.mcap") == (20, [])


def test_raw_bytes_are_bounded(tmp_path: Path) -> None:
    made = recorder(tmp_path / "r.mcap", raw_kb_per_s=1.0)
    for record in records()[:50]:
        made.frame(Frame(record.t, "servos", True, bytes(100)))
        made.put(record)
    assert made.troubles() == ["record: raw bytes beyond 1 kB/s are left out"]
    made.close()
    raw = [json.loads(item.data)["data"] for item in Reader(tmp_path / "r.mcap").messages(("/raw/servos/sent",))]
    assert 1000 <= sum(len(base64.b64decode(data)) for data in raw) < 5000


@pytest.mark.parametrize("cut", [0, 1, 7, 9, 12, 40])
def test_a_signing_key_is_never_written(cut: int) -> None:
    codec = MavlinkCodec(255, 190)
    key = bytes(range(32))
    frame = codec.encode(mav.MAVLink_setup_signing_message(1, 1, key, 1))
    beat = codec.encode(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    guard = KeyGuard()
    chunks = [beat, frame[:cut], frame[cut:]]
    written = b"".join(chunk for i, chunk in enumerate(chunks) if guard.passes(0.001 * i, chunk))
    assert beat in written
    assert key[:8] not in written
    assert guard.passes(1.0, beat)


class Kept(Recorder):
    """Keeps raw bytes."""

    raw = True

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def frame(self, frame: Frame) -> None:
        self.frames.append(frame)


def test_what_passes_is_told_joined_by_pipe_and_without_keys() -> None:
    codec = MavlinkCodec(255, 190)
    beat = codec.encode(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    secret = codec.encode(mav.MAVLink_setup_signing_message(1, 1, bytes(range(32)), 1))

    async def pass_bytes() -> None:
        link, servos = MemoryPipe(), MemoryPipe()
        kept = Kept()
        taps = Taps(kept)
        ours = await taps.tapped(link.opener(0), "mavlink/x")(lambda _: None)
        theirs = await link.opener(1)(lambda _: None)
        bus = await taps.tapped(servos.opener(0), "servos")(lambda _: None)
        ours.write(beat)
        ours.write(bytearray(beat))
        theirs.write(b"answer")
        bus.write(b"ping")
        await asyncio.sleep(0.01)
        taps.hand_over(0.0)
        assert [frame[1:] for frame in kept.frames] == [
            ("mavlink/x", False, b"answer"),
            ("mavlink/x", True, beat + beat),
            ("servos", True, b"ping"),
        ]
        ours.write(secret[:8])
        taps.hand_over(0.01)
        assert len(kept.frames) == 3, "they wait, so that little is written at once"
        taps.hand_over(0.06)
        ours.write(secret[8:] + beat)
        bus.write(b"pong")
        taps.hand_over(0.12)
        assert kept.frames[3:] == [(0.06, "mavlink/x", True, secret[:8]), (0.12, "servos", True, b"pong")]
        ours.write(beat)
        taps.hand_over(0.33)
        assert kept.frames[-1].data == beat, "and on"

    run_simulated(pass_bytes())


def test_who_wants_no_raw_bytes_is_given_the_pipe_itself() -> None:
    opener = MemoryPipe().opener(0)
    assert Taps(Recorder()).tapped(opener, "servos") is opener


def test_only_states_of_the_machine_make_a_transition() -> None:
    assert transition("READY -> APPROACH: order PERCH") == ("READY", "APPROACH", "order PERCH")
    assert transition("READY -> NOWHERE: x") is None
    assert transition("tendon 1 broken; the arm holds") is None


def test_a_daemon_that_should_record_and_cannot_says_so_at_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    config = load("sim.toml", ['record.directory="x"'])
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    clock = Clock(asyncio.new_event_loop(), 0.0)
    try:
        with pytest.raises(ConfigError, match=r"arm-companion\[record\]"):
            configured_recorder(config, clock)
        assert type(configured_recorder(CONFIG, clock)) is Recorder, "none is asked for"
    finally:
        clock._loop.close()


@pytest.mark.parametrize(
    ("cpuinfo", "named"),
    [
        (
            "processor\t: 0\ncpu family\t: 26\nmodel\t\t: 2\nmodel name\t: AMD EPYC\n\nprocessor\t: 1\nmodel\t\t: 9\n",
            "AMD EPYC, family 26, model 2",
        ),
        (
            "processor\t: 0\nCPU implementer\t: 0x41\nCPU part\t: 0xd0b\n\nRevision\t: d04170\n",
            "implementer 0x41, part 0xd0b",
        ),
    ],
)
def test_a_processor_is_named_with_its_generation(monkeypatch: pytest.MonkeyPatch, cpuinfo: str, named: str) -> None:
    """Two machines called the same rounded differently, and a replay blamed the code."""
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: cpuinfo)
    assert versions(Config())["processor"] == named
