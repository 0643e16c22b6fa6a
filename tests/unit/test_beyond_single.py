"""Numbers that no float of 32 bits holds: what only reports goes out as infinite, what commands is refused."""

import math
from collections.abc import Callable, Iterator

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given, settings

from arm_companion.drivers.mirrors import mirror_array, mirror_values
from arm_companion.drivers.telemetry import (
    payload_message,
    status_message,
    stiffness_messages,
    tendon_messages,
    wrench_message,
)
from arm_companion.errors import ProtocolError
from arm_companion.mission.facts import (
    ArmFault,
    ArmFlag,
    PayloadReport,
    StatusReport,
    StiffnessReport,
    TendonState,
    TensionEstimate,
    WrenchReport,
    WrenchSource,
)
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message

Take = Callable[[], float]


def single(value: float) -> float:
    """What IEEE 754 makes of it."""
    with np.errstate(over="ignore"):
        return float(np.float32(value))


def reports(take: Take) -> Iterator[Message]:
    """Every message that tells of the arm in floats, of numbers that are taken in turn."""

    def three() -> tuple[float, float, float]:
        return take(), take(), take()

    tendons = [
        TendonState(take(), take(), take(), take(), take(), take(), take(), 0, False, 0.0, True) for _ in range(5)
    ]
    wrench = WrenchReport(three(), three(), three(), three(), WrenchSource.FREE, True, take(), take())
    status = StatusReport("ready", "READY", 1, 255, ArmFlag(0), ArmFault(0), take(), take(), three(), take(), take())
    payload = PayloadReport(take(), take(), three(), three(), True)
    yield status_message(1, status, tendons, wrench)
    yield wrench_message(1, wrench)
    yield from tendon_messages(
        1, tendons, [take() for _ in tendons], [TensionEstimate(take(), take()) for _ in tendons]
    )
    yield from stiffness_messages(1, StiffnessReport(tuple(take() for _ in range(21))))
    yield payload_message(1, payload)
    yield from mirror_values(1, status, tendons, wrench)
    yield mirror_array(1, status, tendons, wrench)


@given(st.lists(st.one_of(st.floats(), st.floats(1e38, 1e39), st.floats(-1.0, 1.0)), min_size=1, max_size=40))
@example([1e39])
@example([-1e39])
@example([1.7e308])
@example([3.4028235e38, 3.5e38, 1.0])
@example([math.inf, 1.0])
@example([math.nan])
@settings(deadline=None)
def test_whatever_the_numbers_are_every_report_is_sent(numbers: list[float]) -> None:
    at = 0

    def take() -> float:
        nonlocal at
        at += 1
        return numbers[(at - 1) % len(numbers)]

    names = set()
    for message in reports(take):
        (back,) = MavlinkCodec(1, 1).feed(MavlinkCodec(1, 192).encode(message))
        names.add(back.get_type())
        for name, kind in zip(back.fieldnames, back.fieldtypes, strict=True):
            if kind == "float":
                sent, got = (np.atleast_1d(getattr(m, name)) for m in (message, back))
                np.testing.assert_array_equal(
                    got, [single(float(value)) for value in sent], f"{back.get_type()}.{name}"
                )
    assert len(names) == 7


@pytest.mark.parametrize(
    "message",
    [
        mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0, *[0.0] * 10, 1e39),
        mav.MAVLink_command_long_message(1, 192, 1, 0, 1e39, *[0.0] * 6),
        mav.MAVLink_arm_setpoint_message(1, 192, 0, 1, 1e39, 0.0, [0.0] * 3, 0.3),
    ],
)
def test_what_somebody_is_to_do_is_sent_as_it_was_meant_or_not_at_all(message: Message) -> None:
    with pytest.raises(ProtocolError, match="too large"):
        MavlinkCodec(1, 192).encode(message)
