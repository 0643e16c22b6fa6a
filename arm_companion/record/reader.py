"""Reads records: all parts in order, as far as the bytes go."""

import struct
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from arm_companion.errors import RecordError
from arm_companion.record import storage
from arm_companion.record.topics import FORMAT, METADATA

_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQ8x")  # channel, sequence, log time; the time of publishing is the same
_LARGEST = 64 * 1024 * 1024
"""No record of ours is longer; a damaged length must not ask for all the memory."""


class Item(NamedTuple):
    """One message as it stands in the file."""

    topic: str
    sequence: int
    unix_ns: int
    data: bytes


class Reader:
    """A record and the parts that follow it.

    Args:
        path: of the first part to read.

    Attributes:
        versions: metadata of the first part.
        part: which one of the record that is, from 1.
        remarks: after reading: in words, what is missing or damaged.

    Raises:
        RecordError: the file cannot be read, is no record of ours or of another format.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.remarks: list[str] = []
        self.versions = _versions(path)
        self.part = _number(self.versions.get("part", "1"))

    def begins(self, cycle: int) -> list[str]:
        """What is to be said of a record whose first cycle has this number."""
        if self.part != 1:
            what = f"this is part {self.part} of a record, which begins with cycle {cycle} of the flight"
            return [f"{what}: what came before is not looked at"]
        return [f"its first {cycle} cycles are missing"] if cycle else []

    def __iter__(self) -> Iterator[Item]:
        """All messages."""
        return self.messages(None)

    def messages(self, topics: Collection[str] | None) -> Iterator[Item]:
        """The messages of some channels, or of all, part by part in the order of the file."""
        for path in self._parts():
            yield from self._part(path, topics)

    def count(self, topic: str) -> int | None:
        """Messages of a channel as the ends of the files tell them; None when one was cut off before its end."""
        total = 0
        for path in self._parts():
            with path.open("rb") as stream:
                try:
                    summary = make_reader(stream).get_summary()
                except Exception:  # noqa: BLE001 - whatever damaged bytes lead to
                    return None
            if summary is None or summary.statistics is None:
                return None
            numbers = [channel.id for channel in summary.channels.values() if channel.topic == topic]
            total += sum(summary.statistics.channel_message_counts.get(number, 0) for number in numbers)
        return total

    def _parts(self) -> Iterator[Path]:
        path = self.path
        yield path
        if self.versions.get("content") == "truth":
            return
        while (path := storage.following(path)).is_file():
            try:
                begun = _versions(path).get("begun")
            except RecordError as error:  # the power went, or the disk was full, as it was opened
                self._remark(str(error))
                continue
            if begun != self.versions.get("begun"):
                return
            yield path

    def _remark(self, text: str) -> None:
        if text not in self.remarks:
            self.remarks.append(text)

    def _part(self, path: Path, topics: Collection[str] | None) -> Iterator[Item]:
        names: dict[int, str] = {}
        with path.open("rb") as stream:
            records = StreamReader(stream, emit_chunks=True, record_size_limit=_LARGEST).records
            while True:
                try:
                    record = next(records, None)
                    inside = _content(record) if isinstance(record, Chunk) else b""
                except Exception as error:  # noqa: BLE001 - damaged bytes show in any way, in zstd's as well
                    end = isinstance(error, EndOfFile) or _at_end(stream)
                    self.remarks.append(
                        f"{path.name} is cut off: read up to its last whole chunk"
                        if end
                        else f"{path.name} is damaged at byte {stream.tell()}: read up to there"
                    )
                    return
                if record is None:
                    return
                yield from _messages(inside, names, topics)


def truth_beside(path: Path) -> Path:
    """Where the simulator puts the plant's truth that belongs to a record."""
    return path.with_name(f"{path.stem}.truth.mcap")


def _number(text: str) -> int:
    return int(text) if text.isdecimal() else 1


def _content(chunk: Chunk) -> bytes:
    """The records inside a chunk, still as bytes; raises whatever damaged ones lead to."""
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(length)


def _messages(inside: bytes, names: dict[int, str], topics: Collection[str] | None) -> Iterator[Item]:
    """The wanted messages of a chunk; the library's own way makes an object of every record, wanted or not.

    Args:
        inside: the records.
        names: topic of each channel so far; those of the chunk are added.
        topics: that are wanted; None: all.
    """
    at = 0
    while at < len(inside):
        opcode, length = _RECORD.unpack_from(inside, at)
        at += _RECORD.size
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time = _MESSAGE.unpack_from(inside, at)
            topic = names.get(channel, "")
            if topics is None or topic in topics:
                yield Item(topic, sequence, log_time, inside[at + _MESSAGE.size : at + length])
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(inside[at : at + length])))
            names[channel.id] = channel.topic
        at += length


def _at_end(stream: IO[bytes]) -> bool:
    return not stream.read(1)


def _versions(path: Path) -> dict[str, str]:
    """The metadata of a record.

    Raises:
        RecordError: see `Reader`.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        left = storage.oldest_left(path) if isinstance(error, FileNotFoundError) else None
        hint = f"; the oldest part that is left is {left.name}" if left else ""
        raise RecordError(f"{path}: cannot be read: {error.strerror}{hint}") from None
    with stream:
        try:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=_LARGEST).records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    return _checked(path, dict(record.metadata))
                if isinstance(record, Chunk):
                    break
        except InvalidMagic:
            raise RecordError(f"{path}: not an MCAP file") from None
        except (McapError, EndOfFile, OSError, ValueError, ArithmeticError, LookupError, struct.error):
            raise RecordError(f"{path}: cut off before its first cycle") from None
        except Exception as error:  # noqa: BLE001 - whatever damaged bytes lead to
            raise RecordError(f"{path}: damaged at its beginning: {error}") from None
    raise RecordError(f"{path}: an MCAP file, but not a record of arm-companion")


def _checked(path: Path, versions: dict[str, str]) -> dict[str, str]:
    found = versions.get("format")
    if found != FORMAT:
        raise RecordError(f"{path}: a record of format {found}, this version reads format {FORMAT}")
    return versions
