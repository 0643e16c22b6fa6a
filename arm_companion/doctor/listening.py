"""A few seconds at the autopilot's link and at the servo bus: asks, and changes nothing that lasts."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any, Final

from arm_companion.clock import Clock, ticks
from arm_companion.config.schema import Config
from arm_companion.doctor.subject import ServosSeen, VehicleSeen
from arm_companion.drivers.autopilot import ATTITUDE, POSITION, Autopilot
from arm_companion.drivers.flight_stack import fits, from_autopilot
from arm_companion.drivers.keeper import Keeper
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.servo_monitor import ServoMonitor
from arm_companion.drivers.signing_keys import SigningKeys
from arm_companion.drivers.timesync import Timesync
from arm_companion.drivers.vehicle_check import ParameterReader
from arm_companion.drivers.vehicle_expectations import names
from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message
from arm_companion.transport.base import Opener, Receiver, Transport

_LOOK_S: Final = 0.05
_SETTLE_S: Final = 2.0
"""After the autopilot was heard: streams that were asked for flow, and a route to us stands."""

_MEASURE_S: Final = 2.0
_READS: Final = 50
_READ_EVERY_S: Final = 0.02


class _Ears:
    """Counts what comes on the link and what the drivers do not keep."""

    def __init__(self, link: MavlinkLink, flavour: str) -> None:
        self.arrived = {ATTITUDE: 0, POSITION: 0}
        self.fits = True
        self.stations: set[int] = set()
        self._flavour = flavour
        link.subscribe(self._on_beat, (mav.MAVLINK_MSG_ID_HEARTBEAT,))
        link.subscribe(self._on_state, tuple(self.arrived))

    def _on_beat(self, beat: Message, _: MavlinkLink) -> None:
        if from_autopilot(beat):
            self.fits = fits(beat, self._flavour)
        elif beat.type == mav.MAV_TYPE_GCS:
            self.stations.add(beat.get_srcSystem())

    def _on_state(self, message: Message, _: MavlinkLink) -> None:
        self.arrived[message.get_msgId()] += 1


async def listen_to_vehicle(config: Config, opener: Opener, clock: Clock, patience_s: float) -> VehicleSeen:
    """What comes on the autopilot's link.

    Args:
        config: its link, ids and flight stack.
        opener: opens the link's transport.
        clock: for TIMESYNC and signing.
        patience_s: how long to wait for a first heartbeat.

    Raises:
        ConfigError: a signing key cannot be used.
    """
    (name, role), *_ = ((name, link) for name, link in config.links.items() if link.role == "autopilot")
    error = ""

    async def opened(receiver: Receiver) -> Transport:
        nonlocal error
        try:
            transport = await opener(receiver)
        except LinkError as reason:
            error = str(reason)
            raise
        error = ""
        return transport

    link = MavlinkLink(name, role.role, opened, config.vehicle, config=role)
    SigningKeys(config, Keeper()).secure([link], clock)  # time stamps are not kept: the file is the daemon's
    timesync = Timesync(link, clock)
    autopilot = Autopilot(link, config.vehicle, timesync)
    reader = ParameterReader(link, autopilot, bytewise=config.vehicle.autopilot == "px4")
    ears = _Ears(link, config.vehicle.autopilot)
    parameters: dict[str, float] = {}
    rates: dict[str, tuple[float, float]] = {}
    async with _alive(link.run(), autopilot.run(), timesync.run(), _beat(link)):
        if await _within(patience_s, lambda: autopilot.heard):
            await asyncio.sleep(_SETTLE_S)
            before, start = dict(ears.arrived), clock.now()
            parameters = await reader.read(names(config.vehicle.autopilot, config.mavlink.vehicle_instance))
            await asyncio.sleep(max(0.0, start + _MEASURE_S - clock.now()))
            elapsed = clock.now() - start
            asked = config.vehicle.state_rate_hz
            rates = {
                mav.mavlink_map[id_].msgname: (asked, (ears.arrived[id_] - before[id_]) / elapsed) for id_ in before
            }
    link.close()
    counters = link.codec.counters
    return VehicleSeen(
        error=error,
        received_bytes=link.counters.received_bytes,
        frames=counters.frames,
        lost=counters.lost,
        damaged=counters.bad_crc,
        refused=counters.refused,
        system_id=autopilot.system_id if autopilot.heard else 0,
        fits=ears.fits,
        parameters=parameters,
        rates_hz=rates,
        clock_error_s=timesync.error_s,
        stations=tuple(sorted(ears.stations)),
    )


async def listen_to_servos(config: Config, opener: Opener) -> ServosSeen:
    """What the servos answer. Nothing is written to them.

    Args:
        config: its servos, the gripper's too.
        opener: opens the bus.
    """
    monitor = ServoMonitor(opener, config.bus_servos)
    try:
        await monitor.open()
    except LinkError as error:
        return ServosSeen(error=str(error))
    try:
        await monitor.survey()
        for _ in range(_READS):
            await monitor.read()
            await asyncio.sleep(_READ_EVERY_S)
        servos = await monitor.survey()
        counters = monitor.counters()
        return ServosSeen(
            servos=servos,
            firmware=monitor.firmware(),
            answers=sum(servo.answers for servo in counters.servos.values()),
            lost=sum(servo.lost for servo in counters.servos.values()),
            latency_s=counters.latency_s,
        )
    finally:
        await monitor.close()


async def _beat(link: MavlinkLink) -> None:
    """Our heartbeat: an autopilot answers whom it has heard."""
    async for _ in ticks(1.0):
        link.send(
            mav.MAVLink_heartbeat_message(
                mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_STANDBY, 3
            )
        )


async def _within(seconds: float, happened: Callable[[], bool]) -> bool:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            async for _ in ticks(_LOOK_S):
                if happened():
                    break
    return bool(happened())


@contextlib.asynccontextmanager
async def _alive(*work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(each) for each in work]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
