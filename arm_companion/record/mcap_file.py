"""One MCAP file being written: channels made when first used, chunks that survive a power loss."""

import contextlib
import os
from pathlib import Path
from typing import Any, Final

import orjson
from mcap.writer import CompressionType, Writer

from arm_companion.record.topics import METADATA, SCHEMAS, schema_text

_CHUNK: Final = 256 * 1024
"""Bytes of a chunk before compression: what a power loss costs at most, a quarter of a second at 200 Hz."""


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
        self._writer = Writer(self._stream, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        try:
            self._writer.start(profile="", library="arm-companion")
            self._writer.add_metadata(METADATA, versions)
            for topic in SCHEMAS:
                self._open(topic)
        except OSError:
            self._stream.close()
            raise

    @property
    def size(self) -> int:
        """Bytes so far, without the open chunk."""
        return self._stream.tell()

    def json(self, topic: str, unix_ns: int, value: dict[str, Any], sequence: int = 0) -> None:
        """Add a structured message."""
        self.raw(topic, unix_ns, orjson.dumps(value), sequence)

    def raw(self, topic: str, unix_ns: int, data: bytes, sequence: int = 0) -> None:
        """Add bytes as they are."""
        channel = self._channels.get(topic) or self._open(topic)
        self._writer.add_message(channel, unix_ns, data, unix_ns, sequence)

    def sync(self) -> None:
        """Have the whole chunks so far on the disk."""
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Write index and end."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close without an end, after the disk has failed."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _open(self, topic: str) -> int:
        number = 0
        encoding = "application/octet-stream"
        if topic in SCHEMAS:
            name, text = schema_text(topic)
            number = self._writer.register_schema(name, "jsonschema", text)
            encoding = "json"
        self._channels[topic] = channel = self._writer.register_channel(topic, encoding, number)
        return int(channel)
