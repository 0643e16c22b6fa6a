"""How a link does: LINK_NODE_STATUS, from the counters of link and codec."""

from typing import Final

from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

_UINT16: Final = 0xFFFF
_UINT32: Final = 0xFFFFFFFF


class LinkWatch:
    """Counters of one link, and rates between two looks at them."""

    def __init__(self, link: MavlinkLink) -> None:
        self._link = link
        self._before = (0.0, 0, 0)  # loop time, bytes sent, bytes received

    def message(self, now: float) -> Message:
        """LINK_NODE_STATUS at the loop time `now`, s, which its time stamp is: MAVLink wants that since boot."""
        link, codec = self._link.counters, self._link.codec.counters
        then, sent, received = self._before
        self._before = (now, link.sent_bytes, link.received_bytes)
        elapsed = max(now - then, 1e-3)
        return mav.MAVLink_link_node_status_message(
            int(now * 1e3),
            0,
            0,
            min(round((link.sent_bytes - sent) / elapsed), _UINT32),
            min(round((link.received_bytes - received) / elapsed), _UINT32),
            min(codec.bad_crc + codec.bad_frame, _UINT16),
            min(link.crowded_out + self._link.dropped, _UINT16),
            0,
            codec.sent & _UINT32,
            codec.frames & _UINT32,
            min(codec.lost, _UINT32),
        )
