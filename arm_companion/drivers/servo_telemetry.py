"""The health of the servo bus as ARM_SERVOS messages, at each link's rate."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import RatesConfig
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.drivers.servo_health import BusCounters, ServoState
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

SERVOS: Final = mav.MAVLINK_MSG_ID_ARM_SERVOS
PER_MESSAGE: Final = 4


class ServoTelemetry:
    """Sends ARM_SERVOS where it is due.

    Args:
        links: all links; each has its own rate, which SET_MESSAGE_INTERVAL changes.
        rates: rate at the start.
        clock: Unix time of the stamps.
    """

    def __init__(self, links: Sequence[MavlinkLink], rates: RatesConfig, clock: Clock) -> None:
        self._links = links
        self._clock = clock
        for link in links:
            link.streams.offer(SERVOS, rates.servos_hz)

    def publish(self, now: float, servos: Sequence[ServoState], counters: Callable[[], BusCounters]) -> None:
        """Send what is due; called once a cycle.

        Args:
            now: loop time, s.
            servos: as last heard, in the tendons' order.
            counters: history of the bus, asked for only when a message is due.
        """
        due = [link for link in self._links if link.connected and link.streams.take_due(SERVOS, now)]
        if not due:
            return
        for message in servo_messages(round(self._clock.unix(now) * 1e6), servos, counters()):
            for link in due:
                link.send(message, Priority.BULK)


def servo_messages(stamp: int, servos: Sequence[ServoState], counters: BusCounters) -> Iterator[Message]:
    """ARM_SERVOS, one for each four servos.

    Args:
        stamp: Unix time, us.
        servos: state of each.
        counters: history of the bus and of each servo.
    """
    for first in range(0, len(servos), PER_MESSAGE):
        group = servos[first : first + PER_MESSAGE]
        counted = [counters.servos[servo.id] for servo in group]
        yield mav.MAVLink_arm_servos_message(
            stamp,
            _within(counters.frames, 32),
            _within(counters.crc_errors, 32),
            _within(counters.garbage_bytes, 32),
            _four((c.lost for c in counted), 32),
            _four((c.missed_cycles for c in counted), 32),
            _four((c.goals_lost for c in counted), 16),
            _within(round(1e6 * counters.latency_s), 16),
            _within(counters.reconnects, 16),
            _four((servo.id for servo in group), 8),
            _four((c.watchdog_trips for c in counted), 8),
            _four((c.power_losses for c in counted), 8),
            first,
            len(group),
            _bits(servo.ready for servo in group),
            _bits(servo.tripped for servo in group),
            _bits(servo.turns_lost for servo in group),
        )


def _within(value: int, bits: int) -> int:
    """A counter that stops where its field ends."""
    return min(max(value, 0), (1 << bits) - 1)


def _four(values: Iterable[int], bits: int) -> list[int]:
    filled = [_within(value, bits) for value in values]
    return filled + [0] * (PER_MESSAGE - len(filled))


def _bits(facts: Iterable[bool]) -> int:
    return sum(fact << i for i, fact in enumerate(facts))
