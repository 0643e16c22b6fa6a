"""STATUSTEXT put together again: a long sentence comes in chunks."""

from dataclasses import dataclass
from typing import Final

from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

CHUNK: Final = 50
SEVERITIES: Final = tuple(
    entry.name.removeprefix("MAV_SEVERITY_").lower() for _, entry in sorted(mav.enums["MAV_SEVERITY"].items())
)


@dataclass(frozen=True, slots=True)
class Text:
    """One sentence of the arm."""

    severity: str  # emergency, alert, critical, error, warning, notice, info, debug
    text: str


class Sentences:
    """Joins the chunks of one sender; a chunk that was lost shows as `...`."""

    def __init__(self) -> None:
        self._id = 0
        self._severity = 0
        self._chunks: dict[int, str] = {}

    def take(self, message: Message) -> list[Text]:
        """What is complete with this STATUSTEXT: the sentence, and before it one that never got its end."""
        complete = []
        if self._chunks and message.id != self._id:
            complete.append(self._join())
        if not message.id:
            return [*complete, _text(message.severity, message.text)]
        self._id, self._severity = message.id, message.severity
        self._chunks[message.chunk_seq] = message.text
        # The end is a chunk that is not full.
        return [*complete, self._join()] if len(message.text) < CHUNK else complete

    def _join(self) -> Text:
        text = "".join(self._chunks.get(i, "...") for i in range(max(self._chunks) + 1))
        self._chunks = {}
        return _text(self._severity, text)


def _text(severity: int, text: str) -> Text:
    return Text(SEVERITIES[min(severity, len(SEVERITIES) - 1)], text)
