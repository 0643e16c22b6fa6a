"""TIMESYNC: how the autopilot's clock stands against ours, and how well that is known.

We send our time; the autopilot sends it back with its own. Its answer was made somewhere between, so that its clock
less ours is known to half of the round trip. Of the round trips of a while the shortest is the one to believe. A
crystal drifts: the bound grows with the age of that round trip.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

from arm_companion.clock import Clock, ticks
from arm_companion.drivers.access import sender_of
from arm_companion.drivers.flight_stack import AUTOPILOT_COMPONENT
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message
from arm_companion.protocol.mavlink_frames import MAGIC_V2

PERIOD_S: Final = 0.5
WINDOW: Final = 20
"""Round trips among which the shortest is looked for."""

DRIFT: Final = 100e-6
"""Greatest rate at which two clocks go apart: twice 50 ppm."""

_LONGEST_TRIP_S: Final = 0.5
_ADDRESS: Final = 10 + 16
"""Where a MAVLink 2 frame has target_system and target_component, if it has them: behind header and time stamps."""

_NS: Final = 1e-9


@dataclass(frozen=True, slots=True)
class _Trip:
    at: float  # loop time of the answer
    offset_s: float  # autopilot's clock less ours
    error_s: float  # half of the round trip


@dataclass(slots=True)
class TimesyncCounters:
    """What was exchanged since the start."""

    asked: int = 0
    answered: int = 0  # answers to what we asked
    strange: int = 0  # answers to what we did not ask, or that took too long
    jumps: int = 0  # times that the other clock was another one all of a sudden


def addressee(message: Message) -> tuple[int, int]:
    """System and component that a TIMESYNC is for; zeros are everybody.

    Newer definitions have them as extensions, which the generated message lacks.
    """
    frame = message.get_msgbuf()
    if frame[0] != MAGIC_V2:
        return 0, 0
    system, component = frame[_ADDRESS : 10 + frame[1]][:2].ljust(2, b"\0")
    return system, component


class Timesync:
    """The autopilot's clock on our loop's.

    Args:
        link: connection to the autopilot.
        clock: ours.
    """

    def __init__(self, link: MavlinkLink, clock: Clock) -> None:
        self.counters = TimesyncCounters()
        self._link = link
        self._clock = clock
        self._trips: deque[_Trip] = deque(maxlen=WINDOW)
        self._best: _Trip | None = None  # which one it is does not change with time: all bounds grow alike
        self._asked: deque[int] = deque(maxlen=8)
        link.subscribe(self._on_timesync, (mav.MAVLINK_MSG_ID_TIMESYNC,))

    @property
    def error_s(self) -> float:
        """Greatest error of a time that is taken over from the autopilot; inf before the first answer."""
        best = self._best
        return float("inf") if best is None else self._bound(best)

    def loop_time(self, autopilot_s: float) -> float | None:
        """Our loop's time of an instant of the autopilot's clock (s since its boot); None while it is not known."""
        best = self._best
        return None if best is None else autopilot_s - best.offset_s

    def autopilot_time(self, loop_s: float) -> float | None:
        """The autopilot's time (s since its boot) of an instant of our loop; None while it is not known."""
        best = self._best
        return None if best is None else loop_s + best.offset_s

    def forget(self) -> None:
        """The autopilot has booted anew: its clock is another one."""
        self._trips.clear()
        self._best = None
        self._asked.clear()

    async def run(self) -> None:
        """Ask again and again, until cancelled."""
        async for _ in ticks(PERIOD_S):
            now = round(self._clock.now() / _NS)
            self._asked.append(now)
            self.counters.asked += 1
            self._link.send(mav.MAVLink_timesync_message(0, now), Priority.NOW)  # waiting would spoil it

    def _bound(self, trip: _Trip) -> float:
        return trip.error_s + DRIFT * (self._clock.now() - trip.at)

    def _on_timesync(self, message: Message, link: MavlinkLink) -> None:
        now = self._clock.now()
        if message.tc1 == 0:
            return  # a question, which the component answers
        sender = sender_of(message, link)
        if not (sender.ours and sender.component == AUTOPILOT_COMPONENT) or message.ts1 not in self._asked:
            self.counters.strange += 1
            return
        self._asked.remove(message.ts1)
        sent = message.ts1 * _NS
        if now - sent > _LONGEST_TRIP_S:
            self.counters.strange += 1
            return
        self.counters.answered += 1
        trip = _Trip(now, message.tc1 * _NS - (sent + now) / 2.0, (now - sent) / 2.0)
        best = self._best
        if best is not None and abs(trip.offset_s - best.offset_s) > trip.error_s + self._bound(best):
            self.counters.jumps += 1
            self._trips.clear()
        self._trips.append(trip)
        self._best = min(self._trips, key=self._bound)
