"""Which messages are due on one link: at a rate, changed by SET_MESSAGE_INTERVAL, or asked for once."""

from dataclasses import dataclass
from typing import Final

SHORTEST_PERIOD_S: Final = 0.005
"""Fastest stream that anybody may ask for."""

_EARLY_S: Final = 0.002
"""A message goes out in the cycle that is nearest to its due time, also when that is a little early."""


@dataclass(slots=True)
class _Stream:
    default_s: float  # 0: not sent unless asked for
    period_s: float
    fixed: bool
    due: float = float("-inf")
    asked: bool = False


class Streams:
    """Periods and due times by message id. Pure bookkeeping: the time is always given.

    Ids may be floats, as they come in the parameters of a command; one that is no id finds nothing.
    """

    def __init__(self) -> None:
        self._streams: dict[float, _Stream] = {}

    def offer(self, id_: int, rate_hz: float, *, fixed: bool = False) -> None:
        """Declare a message that can be sent.

        Args:
            id_: its id.
            rate_hz: default rate; 0 sends it only when somebody asks.
            fixed: nobody may change the rate.
        """
        period = 1.0 / rate_hz if rate_hz > 0.0 else 0.0
        self._streams[id_] = _Stream(period, period, fixed)

    def set_default(self, id_: int, rate_hz: float) -> None:
        """Change the default rate of a message; who has asked for another one keeps it."""
        stream = self._streams[id_]
        period = 1.0 / rate_hz if rate_hz > 0.0 else 0.0
        if stream.period_s == stream.default_s:
            stream.period_s = period
            stream.due = float("-inf")
        stream.default_s = period

    def offered(self, id_: int) -> bool:
        """Whether the message can be sent at all."""
        return id_ in self._streams

    def interval_us(self, id_: float) -> int:
        """Present interval as MESSAGE_INTERVAL has it: microseconds, -1 when off, 0 when not offered."""
        stream = self._streams.get(id_)
        if stream is None:
            return 0
        return round(stream.period_s * 1e6) if stream.period_s else -1

    def set_interval(self, id_: float, interval_us: float) -> bool:
        """Change a period as SET_MESSAGE_INTERVAL asks: -1 stops, 0 is the default.

        Returns:
            False, and nothing changed, when the message is not offered or the interval is not allowed.
        """
        stream = self._streams.get(id_)
        if stream is None or stream.fixed:
            return False
        if interval_us == -1:
            period = 0.0
        elif interval_us == 0:
            period = stream.default_s
        elif SHORTEST_PERIOD_S * 1e6 <= interval_us <= 3600e6:
            period = interval_us * 1e-6
        else:
            return False
        stream.period_s = period
        stream.due = float("-inf")
        return True

    def ask(self, id_: float) -> bool:
        """Send the message once, as soon as there is one; False when it is not offered."""
        stream = self._streams.get(id_)
        if stream is not None:
            stream.asked = True
        return stream is not None

    def take_asked(self, id_: float) -> bool:
        """Whether somebody has asked for the message since the last call."""
        stream = self._streams.get(id_)
        if stream is None:
            return False
        asked, stream.asked = stream.asked, False
        return asked

    def take_due(self, id_: int, now: float) -> bool:
        """Whether the message goes out now. The due times keep their phase and never burst after a stall."""
        stream = self._streams.get(id_)
        if stream is None:
            return False
        asked = self.take_asked(id_)
        if not stream.period_s or now < stream.due - min(_EARLY_S, stream.period_s / 4.0):
            return asked
        due = stream.due + stream.period_s
        stream.due = due if due > now else now + stream.period_s
        return True
