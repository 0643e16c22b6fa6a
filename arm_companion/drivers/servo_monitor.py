"""Watching servos without touching them: reads, never writes, never switches anything."""

import asyncio

from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_health import BusCounters, ServoRecord, ServoState
from arm_companion.drivers.servo_link import ServoLink
from arm_companion.drivers.servo_reader import ServoReader
from arm_companion.drivers.servo_scan import ping
from arm_companion.drivers.servo_setup import settings_of
from arm_companion.transport.base import Opener, Transport


class ServoMonitor:
    """The arm's servos, seen from the side.

    Bus watchdogs hear its questions as they hear the daemon's: while it runs, they do not trip.
    """

    def __init__(self, opener: Opener, config: ServosConfig) -> None:
        """Nothing is opened before `open`."""
        self._opener = opener
        self._config = config
        self._link = ServoLink(config.baud, config.reply_timeout_s)
        self._records = tuple(ServoRecord(servo, config.silent_after) for servo in config.ids)
        self._reader = ServoReader(self._link, self._records, config, dict.fromkeys(config.ids, settings_of(config)))
        self._transport: Transport | None = None

    async def open(self) -> None:
        """Open the port and learn the servos' firmware.

        Raises:
            LinkError: the port cannot be opened.
        """
        self._transport = await self._opener(self._link.receive)
        self._link.attach(self._transport)
        for record in self._records:
            answer = await ping(self._link, record.id)
            record.firmware = 0 if answer is None else answer[1]
            record.missed = record.missed if answer is None else 0

    async def read(self) -> tuple[ServoState, ...]:
        """One cycle's read; what went wrong is in the states."""
        await self._reader.read()
        now = asyncio.get_running_loop().time()
        return tuple(record.state(now, self._config.silent_after) for record in self._records)

    async def survey(self) -> tuple[ServoState, ...]:
        """A read, with torque, hardware errors and watchdogs looked up as well."""
        for check in (self._reader.check_torque, self._reader.check_watchdog):
            deadline = asyncio.get_running_loop().time() + self._config.reply_timeout_s
            await check([record for record in self._records if not record.missed], deadline)
        return await self.read()

    def firmware(self) -> tuple[int, ...]:
        """Of each servo; 0: not known."""
        return tuple(record.firmware for record in self._records)

    def counters(self) -> BusCounters:
        """History since the port was opened."""
        return BusCounters.of(self._link, self._records)

    async def close(self) -> None:
        """Release the port."""
        self._link.detach()
        if self._transport is not None:
            self._transport.close()
            await self._transport.wait_closed()
