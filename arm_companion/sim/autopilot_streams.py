"""How often each message is due on a port, by the habits of the flight stack."""

import math
from collections.abc import Iterator, Mapping

from arm_companion.sim.autopilot_flavours import Flavour


class StreamTable:
    """Which message is sent how often on one port."""

    def __init__(self, flavour: Flavour, defaults_hz: Mapping[int, float]) -> None:
        self._flavour = flavour
        self._defaults = {message: 1.0 / hz for message, hz in defaults_hz.items()}
        self._period: dict[int, float] = {}
        self._due: dict[int, float] = {}
        self._earliest = -math.inf
        self.reset()

    def reset(self) -> None:
        """Back to the defaults, as after a reboot."""
        self._period, self._due = {}, {}
        for message, period in self._defaults.items():
            self._set(message, period)

    def request(self, message: int, interval_us: float) -> bool:
        """SET_MESSAGE_INTERVAL: -1 stops, 0 is the default. False when the rate is refused."""
        if interval_us < 0:
            self._period.pop(message, None)
            return True
        period = interval_us * 1e-6 if interval_us > 0 else self._defaults.get(message, math.inf)
        if period < self._flavour.least_period_s and self._flavour.refuse_faster:
            return False
        self._set(message, period)
        return True

    def _set(self, message: int, period: float) -> None:
        if math.isinf(period):
            self._period.pop(message, None)
            return
        self._period[message] = max(period * self._flavour.period_share, self._flavour.least_period_s)
        self._due[message] = self._earliest = -math.inf

    def interval_us(self, message: int) -> int:
        """For MESSAGE_INTERVAL: -1 when the message is not streamed."""
        period = self._period.get(message)
        return -1 if period is None else round(period * 1e6)

    def due(self, now: float) -> Iterator[int]:
        """Messages to send now, each at most once; what was missed is skipped."""
        if now < self._earliest:
            return
        self._earliest = math.inf
        for message, period in self._period.items():
            due = self._due[message]
            if due <= now:
                yield message
                due = due + period if due + period > now else now + period
                self._due[message] = due
            self._earliest = min(self._earliest, due)
