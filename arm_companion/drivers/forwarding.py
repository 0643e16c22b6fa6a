"""Frames that pass from link to link, by MAVLink's routing rules.

A frame for everybody goes to every other link; one for a component goes where that component has been heard; one
for all components of a system where any of them has been heard. A frame never goes back where it came from, what is
for us alone goes nowhere. SETUP_SIGNING, which carries a key, never leaves the link that it came on, and neither does
what a telemetry radio reports of itself: an autopilot takes it for the state of its own line, and sends less there. An
unsigned one that may only tell (`unsigned = "listen"`) may tell the ground, and asks nothing of anybody else.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink_frames import SIGNED, Header, addressee

MOST_ROUTES: Final = 256
"""Components that are remembered on each link."""

_RADIO: Final = 166  # of older radios; our dialect lacks it
_STAYS: Final = frozenset({mav.MAVLINK_MSG_ID_SETUP_SIGNING, mav.MAVLINK_MSG_ID_RADIO_STATUS, _RADIO})


@dataclass(slots=True)
class ForwardingCounters:
    """What passed since the start."""

    frames: int = 0
    unrouted: int = 0  # for somebody who has not been heard on any other link
    echoes: int = 0  # our own frames, come back


class Forwarding:
    """Passes frames between links.

    Args:
        links: those between which frames pass; with fewer than two nothing does.
    """

    def __init__(self, links: Sequence[MavlinkLink]) -> None:
        self.counters = ForwardingCounters()
        self._links = links
        self._routes: dict[str, dict[tuple[int, int], None]] = {link.name: {} for link in links}
        if len(links) > 1:
            for link in links:
                self._listen(link)

    def _listen(self, link: MavlinkLink) -> None:
        link.listen_in(lambda frame, head: self._pass(frame, head, link))

    def _pass(self, frame: bytes, head: Header, source: MavlinkLink) -> None:
        sender = (head.system, head.component)
        if sender == (source.system_id, source.component_id):
            self.counters.echoes += 1
            return
        heard = self._routes[source.name]
        heard[sender] = None
        if len(heard) > MOST_ROUTES:
            del heard[next(iter(heard))]
        target = addressee(frame, head)
        if target == (source.system_id, source.component_id) or head.id in _STAYS:
            return
        ways = [link for link in self._links if link is not source and self._reaches(link, target)]
        if not source.trusts(signed=bool(head.flags & SIGNED)):
            # it may tell people something, but not ask the autopilot, or a peer, through us
            ways = [link for link in ways if link.role == "ground"]
        if not ways:
            self.counters.unrouted += 1
        for link in ways:
            self.counters.frames += 1
            link.pass_on(frame)

    def _reaches(self, link: MavlinkLink, target: tuple[int, int]) -> bool:
        system, component = target
        if system == 0:
            return True
        heard = self._routes[link.name]
        return target in heard if component else any(known == system for known, _ in heard)
