"""A stock pymavlink ground station commands our component over UDP, well and badly."""

import asyncio
import contextlib
import math
import random
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractAsyncContextManager
from typing import Any

import pytest

from arm_companion.mission.facts import Order
from arm_companion.protocol.dialect import mav

pytestmark = pytest.mark.realtime

Serve = Callable[[], AbstractAsyncContextManager[Any]]


@pytest.fixture
def ground_station(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], contextlib.AbstractContextManager[Any]]:
    """A maker of mavutil connections as 255/190, speaking MAVLink 2 in the stock dialect."""
    monkeypatch.setenv("MAVLINK20", "1")
    from pymavlink import mavutil

    @contextlib.contextmanager
    def connect(port: int) -> Iterator[Any]:
        connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{port}", source_system=255, source_component=190, dialect="common"
        )
        try:
            yield connection
        finally:
            connection.close()

    return connect


def command(station: Any, id_: int, *parameters: float, to: tuple[int, int] = (1, 192)) -> None:
    station.mav.command_long_send(*to, id_, 0, *parameters, *[0.0] * (7 - len(parameters)))


def acks(station: Any, id_: int, last: int) -> list[int]:
    """Results for a command until `last` has come; at most three seconds."""
    results: list[int] = []
    while not results or results[-1] != last:
        ack = station.recv_match(type="COMMAND_ACK", blocking=True, timeout=3.0)
        assert ack is not None, f"no answer; so far {results}"
        assert (ack.get_srcSystem(), ack.get_srcComponent()) == (1, 192)
        assert (ack.target_system, ack.target_component) == (255, 190)
        if ack.command == id_:
            results.append(ack.result)
    return results


def heard(station: Any) -> Any:
    """Our heartbeat: only then does a ground station know where to send to."""
    beat = station.recv_match(type="HEARTBEAT", blocking=True, timeout=3.0)
    assert beat is not None
    return beat


def test_a_command_is_carried_out_and_answered(serve: Serve, ground_station: Any) -> None:
    def operate(port: int) -> None:
        with ground_station(port) as station:
            beat = heard(station)
            assert (beat.type, beat.autopilot) == (mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID)
            for id_ in (mav.MAV_CMD_ARM_PERCH, mav.MAV_CMD_ARM_RELEASE):
                command(station, id_)
                assert acks(station, id_, mav.MAV_RESULT_ACCEPTED) == [
                    mav.MAV_RESULT_IN_PROGRESS,
                    mav.MAV_RESULT_ACCEPTED,
                ]

    async def main() -> None:
        async with serve() as harness:
            await asyncio.to_thread(operate, harness.port)
            assert [r.order for r in harness.requests] == [Order.PERCH, Order.RELEASE]

    asyncio.run(main())


def test_the_vehicle_is_told_apart_by_its_heartbeat_within_a_second(serve: Serve, ground_station: Any) -> None:
    async def main() -> None:
        async with serve() as harness:
            start = asyncio.get_running_loop().time()

            def listen() -> None:
                with ground_station(harness.port) as station:
                    heard(station)

            await asyncio.to_thread(listen)
            assert asyncio.get_running_loop().time() - start < 1.3

    asyncio.run(main())


def test_bad_commands_are_denied_with_a_reason(serve: Serve, ground_station: Any) -> None:
    def operate(port: int) -> str:
        with ground_station(port) as station:
            heard(station)
            words = []
            for parameters in ((math.nan,), (9.0,)):
                command(station, mav.MAV_CMD_ARM_PERCH, *parameters)
                text = station.recv_match(type="STATUSTEXT", blocking=True, timeout=3.0)
                words.append(text.text)
                assert acks(station, mav.MAV_CMD_ARM_PERCH, mav.MAV_RESULT_DENIED) == [mav.MAV_RESULT_DENIED]
            command(station, mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
            acks(station, mav.MAV_CMD_COMPONENT_ARM_DISARM, mav.MAV_RESULT_UNSUPPORTED)
            return " ".join(words)

    async def main() -> None:
        async with serve() as harness:
            words = await asyncio.to_thread(operate, harness.port)
            assert "PERCH denied: param1 (kind) is not a number" in words
            assert "outside 0 to 1" in words
            assert harness.requests == []

    asyncio.run(main())


def test_hostile_bytes_are_survived_and_counted(serve: Serve, ground_station: Any) -> None:
    noise = random.Random(3)

    def operate(port: int) -> None:
        with ground_station(port) as station:
            heard(station)
            good = station.mav.command_long_encode(1, 192, mav.MAV_CMD_ARM_ABORT, 0, 0, 0, 0, 0, 0, 0, 0).pack(
                station.mav
            )
            bad = [noise.randbytes(noise.randrange(1, 400)) for _ in range(200)]
            bad += [good[:cut] for cut in range(1, len(good))]
            for bit in range(0, 8 * len(good), 3):
                broken = bytearray(good)
                broken[bit // 8] ^= 1 << bit % 8
                bad.append(bytes(broken))
            for datagram in bad:
                station.write(datagram)
                time.sleep(0.0005)  # or the kernel's buffer drops what this is about
            for to in ((1, 1), (2, 192), (1, 191)):
                command(station, mav.MAV_CMD_ARM_STOW, to=to)
            station.write(b"\xfd\xff\x00\x00")
            command(station, mav.MAV_CMD_ARM_RELEASE)
            acks(station, mav.MAV_CMD_ARM_RELEASE, mav.MAV_RESULT_ACCEPTED)

    async def main() -> None:
        async with serve() as harness:
            await asyncio.to_thread(operate, harness.port)
            # Pieces of one command in a row may add up to it; nothing else may come of all this.
            assert {r.order for r in harness.requests} <= {Order.ABORT, Order.RELEASE}
            assert harness.requests[-1].order is Order.RELEASE
            counters = harness.link.codec.counters
            assert counters.garbage > 10_000
            assert counters.bad_crc > 50
            assert harness.component.counters.not_for_us == 3
            assert harness.link.counters.handler_errors == 0

    asyncio.run(main())
