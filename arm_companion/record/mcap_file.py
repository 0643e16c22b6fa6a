"""One MCAP file being written: channels made when first used, chunks that survive a power loss.

The `mcap` library says what its records look like. Its writer makes an object and a dozen small writes of every
message, a third of what recording took of a core at 200 Hz, so messages are put into their chunk here.
"""

import contextlib
import os
import struct
import zlib
from array import array
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import orjson
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from arm_companion.record.topics import METADATA, SCHEMAS, schema_text

_CHUNK: Final = 256 * 1024
"""Bytes of a chunk before compression: what a power loss costs at most, a quarter of a second at 200 Hz."""
_LEVEL: Final = 1
"""Of zstd: cycles are alike, and more effort makes them no smaller."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, time of logging, of publishing
_BEFORE_DATA: Final = _MESSAGE.size - 9  # what counts as the message's length beside its data
_INDEX: Final = struct.Struct("<BQHI")  # opcode, length, channel, bytes of the entries
_FOOTER: Final = struct.Struct("<BQQQ")  # opcode, length, begin of the summary, of its offsets
_OPCODES: Final = {
    Schema: Opcode.SCHEMA,
    Channel: Opcode.CHANNEL,
    Statistics: Opcode.STATISTICS,
    ChunkIndex: Opcode.CHUNK_INDEX,
    MetadataIndex: Opcode.METADATA_INDEX,
}


class McapFile:
    """Open for writing.

    Args:
        path: overwritten.
        versions: what the record is of, as metadata.

    Raises:
        OSError: here and in every method, when the disk does not take it.
    """

    def __init__(self, path: Path, versions: dict[str, str]) -> None:
        self._stream = path.open("wb")
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._numbers: dict[str, int] = {}  # of the channels, by topic
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}  # messages of each channel
        self._open = _OpenChunk()
        try:
            self._stream.write(MCAP0_MAGIC)
            self._append(Header(profile="", library="arm-companion"))
            at = self._stream.tell()
            length = self._append(Metadata(name=METADATA, metadata=versions))
            self._metadata = MetadataIndex(offset=at, length=length, name=METADATA)
            for topic in SCHEMAS:
                self._add_channel(topic)
        except OSError:
            self._stream.close()
            raise

    @property
    def size(self) -> int:
        """Bytes so far, without the open chunk."""
        return self._stream.tell()

    def count(self, topic: str) -> int:
        """Messages of a channel in whole chunks."""
        return self._counts.get(self._numbers.get(topic, 0), 0)

    def json(self, topic: str, unix_ns: int, value: dict[str, Any], sequence: int = 0) -> None:
        """Add a structured message."""
        self.text(topic, unix_ns, orjson.dumps(value), sequence)

    def text(self, topic: str, unix_ns: int, data: bytes, sequence: int = 0) -> None:
        """Add a message that is JSON already."""
        channel = self._numbers.get(topic) or self._add_channel(topic)
        self._open.add(channel, unix_ns, data, sequence)
        if self._open.size > _CHUNK:
            self._end_chunk()

    def sync(self) -> None:
        """Have the whole chunks so far on the disk."""
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Write index and end."""
        try:
            self._end_chunk()
            self._append(DataEnd(data_section_crc=0))
            self._end()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close without an end, after the disk has failed."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _add_channel(self, topic: str) -> int:
        name, text = schema_text(topic)
        schema = next((known.id for known in self._schemas if known.name == name), 0)
        if not schema:
            schema = len(self._schemas) + 1
            self._schemas.append(Schema(id=schema, name=name, encoding="jsonschema", data=text))
            self._open.define(self._schemas[-1])
        number = len(self._channels) + 1
        self._channels.append(Channel(id=number, topic=topic, message_encoding="json", metadata={}, schema_id=schema))
        self._open.define(self._channels[-1])
        self._numbers[topic] = number
        return number

    def _end_chunk(self) -> None:
        chunk, self._open = self._open, _OpenChunk()
        if not chunk.entries:
            return
        content = b"".join(chunk.parts)
        packed = self._compressor.compress(content)
        times = [entries[0::2] for entries in chunk.entries.values()]
        begin, end = min(map(min, times)), max(map(max, times))
        at = self._stream.tell()
        length = self._append(
            Chunk(
                compression="zstd",
                data=packed,
                message_start_time=begin,
                message_end_time=end,
                uncompressed_crc=zlib.crc32(content),
                uncompressed_size=len(content),
            )
        )
        offsets = {}
        for channel, entries in chunk.entries.items():
            offsets[channel] = self._stream.tell()
            self._counts[channel] = self._counts.get(channel, 0) + len(entries) // 2
            count = len(entries) * entries.itemsize
            self._stream.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + count, channel, count) + _little(entries))
        self._chunks.append(
            ChunkIndex(
                message_start_time=begin,
                message_end_time=end,
                chunk_start_offset=at,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=self._stream.tell() - at - length,
                compression="zstd",
                compressed_size=len(packed),
                uncompressed_size=len(content),
            )
        )

    def _end(self) -> None:
        """The summary, by which a reader finds any time without reading everything, and the file's last bytes."""
        begin = self._stream.tell()
        summary, groups = RecordBuilder(), RecordBuilder()
        for kind, records in groupby(
            (*self._schemas, *self._channels, self._statistics(), *self._chunks, self._metadata), type
        ):
            start = summary.count
            for record in records:
                record.write(summary)
            offset = SummaryOffset(_OPCODES[kind], begin + start, summary.count - start)
            offset.write(groups)
        offsets = begin + summary.count
        text: bytes = summary.end() + groups.end()  # type: ignore[no-untyped-call]
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, begin, offsets), zlib.crc32(text))
        self._stream.write(text)
        self._append(Footer(summary_start=begin, summary_offset_start=offsets, summary_crc=crc))
        self._stream.write(MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max(map(attrgetter("message_end_time"), self._chunks), default=0),
            message_start_time=min(map(attrgetter("message_start_time"), self._chunks), default=0),
            metadata_count=1,
            schema_count=len(self._schemas),
        )

    def _append(self, record: McapRecord) -> int:
        """Write one of the library's records; bytes that it takes."""
        data = _bytes(record)
        self._stream.write(data)
        return len(data)


class _OpenChunk:
    """Records that wait to be compressed together.

    Attributes:
        parts: their bytes.
        size: how many these are.
        entries: of each channel's index: time and place of every message, in turn.
    """

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.entries: dict[int, array[int]] = {}

    def define(self, record: Schema | Channel) -> None:
        data = _bytes(record)
        self.parts.append(data)
        self.size += len(data)

    def add(self, channel: int, unix_ns: int, data: bytes, sequence: int) -> None:
        if channel not in self.entries:
            self.entries[channel] = array("Q")
        self.entries[channel].extend((unix_ns, self.size))
        length = _BEFORE_DATA + len(data)
        self.parts += (_MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, unix_ns, unix_ns), data)
        self.size += 9 + length


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def _little(numbers: "array[int]") -> bytes:
    """In the byte order of the file."""
    return struct.pack(f"<{len(numbers)}Q", *numbers)
