"""ARM_SERVOS: what the bus counts, in the fields of the message."""

import dataclasses

from arm_companion.drivers.servo_health import BusCounters, ServoCounters, ServoState
from arm_companion.drivers.servo_telemetry import servo_messages

WELL = ServoState(1, 2048, 0.0, 0.0, 12.0, 30.0, 0, True, False, False, True, False, 0.001)


def test_every_servo_has_its_place_and_counters_stop_at_the_end_of_their_field() -> None:
    servos = [dataclasses.replace(WELL, id=10 + i) for i in range(6)]
    servos[1] = dataclasses.replace(servos[1], ready=False, turns_lost=True)
    servos[4] = dataclasses.replace(servos[4], ready=False, tripped=True)
    counted = {s.id: ServoCounters(lost=s.id, missed_cycles=1, goals_lost=70_000, power_losses=300) for s in servos}
    counters = BusCounters(counted, 2**33, 8, 7, 9, 70_000, 0.00035)
    first, second = servo_messages(1_000_000, servos, counters)
    assert (first.first, first.count, second.first, second.count) == (0, 4, 4, 2)
    assert (list(first.id), list(second.id)) == ([10, 11, 12, 13], [14, 15, 0, 0])
    assert list(first.lost) == [10, 11, 12, 13]
    assert list(second.missed) == [1, 1, 0, 0]
    assert (list(first.goals_lost), list(first.power_losses)) == ([65_535] * 4, [255] * 4)
    assert (first.frames, first.crc_errors, first.garbage) == (2**32 - 1, 7, 8)
    assert (first.latency, first.reconnects) == (350, 65_535)
    assert (first.ready, first.turns_lost, first.tripped) == (0b1101, 0b0010, 0)
    assert (second.ready, second.turns_lost, second.tripped) == (0b10, 0, 0b01)
