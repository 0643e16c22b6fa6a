"""Hearing every servo once a cycle: the Sync Read, its repairs, and what a cycle alone does not show."""

import asyncio
from collections.abc import Iterable, Sequence

from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_health import ServoRecord
from arm_companion.drivers.servo_link import ServoLink
from arm_companion.drivers.servo_setup import Settings
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.dynamixel import Packet

_RETRIES = 3
_PROBE_S = 0.05  # between attempts to hear each silent servo
_AUDIT_EVERY = 8  # cycles
_SHORTEST_BOOT_S = 0.05  # no servo is back sooner after losing its power
_STATUS = (ct.TORQUE_ENABLE.address, ct.HARDWARE_ERROR_STATUS.address + 1 - ct.TORQUE_ENABLE.address)
_WATCHDOG = (ct.BUS_WATCHDOG.address, ct.BUS_WATCHDOG.size)
_ECHO = (ct.ECHO_ADDRESS, ct.ECHO_SIZE)
_FEEDBACK = (ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE)
_RAM = (ct.BUS_WATCHDOG.address, ct.ECHO_ADDRESS + ct.ECHO_SIZE - ct.BUS_WATCHDOG.address)
_ERROR_NOT_READ = dxl.ALERT  # stands for hardware errors that are reported and not yet looked up


class ServoReader:
    """Keeps the records of all servos up to date."""

    def __init__(
        self, link: ServoLink, records: Sequence[ServoRecord], config: ServosConfig, settings: Settings
    ) -> None:
        """Read through `link` into `records`; `settings` tell a servo that was set up from a fresh one."""
        self._link = link
        self._records = records
        self._timeout_s = config.reply_timeout_s
        self._silent_after = config.silent_after
        self._settings = settings
        self._cycle = 0
        self._next_probe_at = 0.0
        self._requests: dict[tuple[int, ...], bytes] = {}
        self._audits = (self.check_torque, self.check_watchdog, self.check_goals)

    async def read(self) -> None:
        """Hear every servo, within the configuration's deadline."""
        now = asyncio.get_running_loop().time()
        deadline = now + self._timeout_s
        self._cycle += 1
        if self._cycle % _AUDIT_EVERY == 0:
            audit = self._audits[self._cycle // _AUDIT_EVERY % len(self._audits)]
            await audit([r for r in self._records if not r.missed], deadline)
        answers: dict[int, Packet] = {}
        if self._link.connected:
            present = [r for r in self._records if r.missed < self._silent_after]
            # A servo answers a Sync Read once the one before it has: doubtful ones come last.
            present.sort(key=lambda r: r.missed > 0)
            answers = await self._ask_all(present, *_FEEDBACK, deadline)
            if len(answers) < len(present):
                await self._repair(answers, present, deadline)
            if len(answers) < len(self._records):
                answers |= await self._probe(now, deadline)
        for record in self._records:
            packet = answers.get(record.id)
            if packet is None or not await self._accept(record, packet, deadline):
                record.missed += 1
                record.counters.missed_cycles += 1

    async def _repair(self, answers: dict[int, Packet], present: Iterable[ServoRecord], deadline: float) -> None:
        """Ask those one by one whose answers did not come."""
        for _ in range(_RETRIES):
            for record in present:
                if record.id not in answers:
                    record.counters.lost += 1
                    answers |= await self._ask_one(record, *_FEEDBACK, deadline)

    async def _probe(self, now: float, deadline: float) -> dict[int, Packet]:
        """Ask one of the silent servos now and then."""
        silent = [r for r in self._records if r.missed >= self._silent_after]
        if not silent or now < self._next_probe_at:
            return {}
        self._next_probe_at = now + _PROBE_S / len(silent)
        return await self._ask_one(silent[self._cycle % len(silent)], *_FEEDBACK, deadline)

    async def _accept(self, record: ServoRecord, packet: Packet, deadline: float) -> bool:
        """Take what a servo measured; False if a gap before it could not be explained."""
        now = asyncio.get_running_loop().time()
        gap = record.missed > 0 and record.set_up and now - record.answered_at > _SHORTEST_BOOT_S
        if gap and not await self._explain_gap(record, deadline):
            return False
        record.take(ct.decode_feedback(packet.parameters), now)
        if packet.error & dxl.ALERT:
            record.counters.alerts += 1
            if record.error_bits in {0, _ERROR_NOT_READ}:
                record.error_bits = _ERROR_NOT_READ
                await self.check_torque([record], deadline)
        else:
            record.error_bits = 0
        return True

    async def _explain_gap(self, record: ServoRecord, deadline: float) -> bool:
        """Find out whether a servo that was not heard for a while lost power or was stopped meanwhile."""
        answers = await self._ask_one(record, *_RAM, deadline)
        if record.id not in answers:
            return False
        ram = answers[record.id].parameters
        at = ct.PROFILE_VELOCITY.address - _RAM[0]
        if ct.PROFILE_VELOCITY.decode(ram[at : at + ct.PROFILE_VELOCITY.size]) != self._settings.profile_velocity:
            record.lose_power()
            return True
        record.take_watchdog(tripped=ct.BUS_WATCHDOG.decode(ram[:1]) == ct.WATCHDOG_TRIPPED)
        record.take_echo(ct.decode_echo(ram[_ECHO[0] - _RAM[0] :]), asyncio.get_running_loop().time())
        return True

    async def check_torque(self, records: Sequence[ServoRecord], deadline: float) -> None:
        """Look up torque and hardware errors."""
        for record, data in await self._look_up(records, *_STATUS, deadline):
            record.torque = data[0] == 1
            record.error_bits = data[-1]

    async def check_watchdog(self, records: Sequence[ServoRecord], deadline: float) -> None:
        """Look up whether bus watchdogs have tripped."""
        for record, data in await self._look_up(records, *_WATCHDOG, deadline):
            record.take_watchdog(tripped=ct.BUS_WATCHDOG.decode(data) == ct.WATCHDOG_TRIPPED)

    async def check_goals(self, records: Sequence[ServoRecord], deadline: float) -> None:
        """Look up which goals servos really have, and compare their clocks with ours."""
        for record, data in await self._look_up(records, *_ECHO, deadline):
            record.take_echo(ct.decode_echo(data), asyncio.get_running_loop().time())

    async def _look_up(
        self, records: Sequence[ServoRecord], address: int, size: int, deadline: float
    ) -> list[tuple[ServoRecord, bytes]]:
        answers = await self._ask_all(records, address, size, deadline)
        return [(r, answers[r.id].parameters) for r in records if r.id in answers]

    async def _ask_all(
        self, records: Sequence[ServoRecord], address: int, size: int, deadline: float
    ) -> dict[int, Packet]:
        servos = tuple(r.id for r in records)
        key = (address, size, *servos)
        request = self._requests.get(key)
        if request is None:
            request = self._requests[key] = dxl.sync_read(servos, address, size)
        return _whole(await self._link.ask(request, servos, size, deadline), size)

    async def _ask_one(self, record: ServoRecord, address: int, size: int, deadline: float) -> dict[int, Packet]:
        request = dxl.read(record.id, address, size)
        return _whole(await self._link.ask(request, (record.id,), size, deadline), size)


def _whole(answers: dict[int, Packet], size: int) -> dict[int, Packet]:
    """Answers with data, without refusals."""
    return {servo: packet for servo, packet in answers.items() if len(packet.parameters) == size}
