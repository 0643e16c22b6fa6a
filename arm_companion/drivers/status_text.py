"""STATUSTEXT: sentences for people, cut into the chunks that the message carries."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Final

from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.mission.facts import Notice
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

CHUNK: Final = 50
LONGEST: Final = 5 * CHUNK
"""Characters of a sentence that are sent; the log has the rest."""


def status_texts(severity: int, text: str, id_: int) -> Iterator[Message]:
    """The messages that carry `text`.

    Args:
        severity: MAV_SEVERITY.
        text: the sentence; what is not ASCII becomes a question mark, as receivers would show it.
        id_: ties the chunks of one long sentence together, 1 to 65535; a short one has none.
    """
    data = text[:LONGEST].encode("ascii", errors="replace")
    if len(data) <= CHUNK:
        yield mav.MAVLink_statustext_message(severity, data)
        return
    # The receiver knows by a chunk that is not full that the text is complete: a full one gets a follower.
    for sequence, start in enumerate(range(0, len(data) + 1, CHUNK)):
        yield mav.MAVLink_statustext_message(severity, data[start : start + CHUNK], id_, sequence)


class Speaker:
    """Says sentences on links.

    Args:
        links: where to say what is meant for everybody.
    """

    def __init__(self, links: Sequence[MavlinkLink]) -> None:
        self._links = links
        self._ids = itertools.cycle(range(1, 0x10000))

    def say(self, notice: Notice, link: MavlinkLink | None = None) -> None:
        """Send a notice on one link, or on all."""
        id_ = next(self._ids)
        for where in self._links if link is None else (link,):
            for message in status_texts(notice.severity, notice.text, id_):
                where.send(message)
