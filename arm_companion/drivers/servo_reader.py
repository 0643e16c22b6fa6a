"""Hearing every servo once a cycle: the Sync Read, its repairs, and what a cycle alone does not show."""

import asyncio
from collections import deque
from collections.abc import Mapping, Sequence

from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_health import ServoRecord
from arm_companion.drivers.servo_link import ServoLink
from arm_companion.drivers.servo_setup import Settings
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.dynamixel import Packet

_RETRIES = 3
_PROBE_S = 0.05  # between attempts to hear each silent servo
_AUDIT_S = 0.08
_SHORTEST_BOOT_S = 0.05  # no servo is back sooner after losing its power
_SLOW_READS = 100
_FAST = ct.FIRST_FIRMWARE_WITH_FAST_SYNC_READ
_STATUS = (ct.TORQUE_ENABLE.address, ct.HARDWARE_ERROR_STATUS.address + 1 - ct.TORQUE_ENABLE.address)
_WATCHDOG = (ct.BUS_WATCHDOG.address, ct.BUS_WATCHDOG.size)
_ECHO = (ct.ECHO_ADDRESS, ct.ECHO_SIZE)
_FEEDBACK = (ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE)
_RAM = (ct.BUS_WATCHDOG.address, ct.ECHO_ADDRESS + ct.ECHO_SIZE - ct.BUS_WATCHDOG.address)
_ERROR_NOT_READ = dxl.ALERT  # stands for hardware errors that are reported and not yet looked up


class ServoReader:
    """Keeps the records of all servos up to date."""

    def __init__(
        self, link: ServoLink, records: Sequence[ServoRecord], config: ServosConfig, settings: Mapping[int, Settings]
    ) -> None:
        """Read through `link` into `records`; `settings`, by id, tell a servo that was set up from a fresh one."""
        self._link = link
        self._records = records
        self._timeout_s = config.reply_timeout_s
        self._silent_after = config.silent_after
        self._settings = settings
        self._doubtful: set[int] = set()  # heard again after a gap that is not explained yet
        self._explained_at: dict[int, float] = {}
        self._probes = 0
        self._next_probe_at = 0.0
        self._requests: dict[tuple[bool, int, int, tuple[int, ...]], bytes] = {}
        self._slow_for = 0  # Sync Reads until the next fast one is tried
        self._next_audit_at = 0.0
        self._audits = deque((self.check_torque, self.check_watchdog, self.check_goals))

    async def read(self) -> None:
        """Hear every servo, within the configuration's deadline."""
        now = asyncio.get_running_loop().time()
        deadline = now + self._timeout_s
        answers: dict[int, Packet] = {}
        if self._link.connected:
            answers = await self._look_aside(now, deadline)
            present = [r for r in self._records if r.missed < self._silent_after]
            # A servo answers a Sync Read once the one before it has: doubtful ones come last.
            present.sort(key=lambda r: r.missed > 0)
            answers |= await self._ask_all(present, *_FEEDBACK, deadline)
            await self._repair(answers, present, deadline)
        for record in self._records:
            packet = answers.get(record.id)
            if packet is None or (self._doubts(record) and not await self._explain(record, deadline)):
                record.missed += 1
                record.counters.missed_cycles += 1
                continue
            record.take(ct.decode_feedback(packet.parameters), asyncio.get_running_loop().time())
            if packet.error & dxl.ALERT:
                await self._take_alert(record, deadline)
            else:
                record.error_bits = 0

    async def _look_aside(self, now: float, deadline: float) -> dict[int, Packet]:
        """Do at most one of the things that a cycle alone does not show, before the cycle's own read.

        Returns:
            The answer of a silent servo, if one was asked and answered.
        """
        silent = [r for r in self._records if r.missed >= self._silent_after]
        doubtful = [r for r in self._records if r.id in self._doubtful]
        if doubtful:
            self._doubtful.discard(doubtful[0].id)
            await self._explain_gap(doubtful[0], deadline)
        elif silent and now >= self._next_probe_at:
            self._next_probe_at = now + _PROBE_S / len(silent)
            self._probes += 1
            return await self._ask_one(silent[self._probes % len(silent)], *_FEEDBACK, deadline)
        elif now >= self._next_audit_at:
            self._next_audit_at = now + _AUDIT_S
            self._audits.rotate()
            await self._audits[0]([r for r in self._records if not r.missed], deadline)
        return {}

    async def _repair(self, answers: dict[int, Packet], present: Sequence[ServoRecord], deadline: float) -> None:
        """Ask those one by one whose answers did not come.

        Where the chain of answers broke off, the first that is missing is the likeliest to be dead: it comes last.
        """
        for _ in range(_RETRIES):
            missing = [r for r in present if r.id not in answers]
            suspects = 1 if answers else 0
            for record in missing[suspects:] + missing[:suspects]:
                record.counters.lost += 1
                answers |= await self._ask_one(record, *_FEEDBACK, deadline)

    def _doubts(self, record: ServoRecord) -> bool:
        """Whether a servo that answers was away for so long that it may have started afresh."""
        known_at = max(record.answered_at, self._explained_at.get(record.id, 0.0))
        return bool(record.missed and record.set_up and asyncio.get_running_loop().time() - known_at > _SHORTEST_BOOT_S)

    async def _explain(self, record: ServoRecord, deadline: float) -> bool:
        """Explain a gap now, or remember to do so."""
        if await self._explain_gap(record, deadline):
            return True
        self._doubtful.add(record.id)
        return False

    async def _take_alert(self, record: ServoRecord, deadline: float) -> None:
        """A servo says that a hardware error stands: look it up in the same cycle."""
        record.counters.alerts += 1
        if record.error_bits in {0, _ERROR_NOT_READ}:
            record.error_bits = _ERROR_NOT_READ
            await self.check_torque([record], deadline)

    async def _explain_gap(self, record: ServoRecord, deadline: float) -> bool:
        """Find out whether a servo that was not heard for a while lost power or was stopped meanwhile."""
        asked = asyncio.get_running_loop().time()
        answers = await self._ask_one(record, *_RAM, deadline)
        if record.id not in answers:
            return False
        now = self._explained_at[record.id] = asyncio.get_running_loop().time()
        record.missed = 1  # it belongs to the next Sync Read again
        ram = answers[record.id].parameters
        at = ct.PROFILE_VELOCITY.address - _RAM[0]
        set_to = self._settings[record.id].profile_velocity
        if ct.PROFILE_VELOCITY.decode(ram[at : at + ct.PROFILE_VELOCITY.size]) != set_to:
            record.lose_power()
            return True
        record.take_watchdog(tripped=ct.BUS_WATCHDOG.decode(ram[:1]) == ct.WATCHDOG_TRIPPED)
        record.take_echo(ct.decode_echo(ram[_ECHO[0] - _RAM[0] :]), asked, now)
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
        now = asyncio.get_running_loop().time
        asked = now()
        for record, data in await self._look_up(records, *_ECHO, deadline):
            record.take_echo(ct.decode_echo(data), asked, now())

    async def _look_up(
        self, records: Sequence[ServoRecord], address: int, size: int, deadline: float
    ) -> list[tuple[ServoRecord, bytes]]:
        answers = await self._ask_all(records, address, size, deadline)
        return [(r, answers[r.id].parameters) for r in records if r.id in answers]

    async def _ask_all(
        self, records: Sequence[ServoRecord], address: int, size: int, deadline: float
    ) -> dict[int, Packet]:
        servos = tuple([r.id for r in records])
        fast = self._slow_for == 0 and len(servos) > 1 and min([r.firmware for r in records]) >= _FAST
        request = self._request(address, size, servos, fast=fast)
        answers = await self._link.ask(request, servos, size, deadline, fast=fast)
        if fast and not answers:
            # One lost byte costs the whole frame: a noisy bus gets further with a frame from each servo.
            self._slow_for = _SLOW_READS
        elif self._slow_for:
            self._slow_for -= 1
        return _whole(answers, size)

    def _request(self, address: int, size: int, servos: tuple[int, ...], *, fast: bool) -> bytes:
        key = (fast, address, size, servos)
        request = self._requests.get(key)
        if request is None:
            request = self._requests[key] = dxl.sync_read(servos, address, size, fast=fast)
        return request

    async def _ask_one(self, record: ServoRecord, address: int, size: int, deadline: float) -> dict[int, Packet]:
        request = dxl.read(record.id, address, size)
        return _whole(await self._link.ask(request, (record.id,), size, deadline), size)


def _whole(answers: dict[int, Packet], size: int) -> dict[int, Packet]:
    """Answers with data, without refusals."""
    return {servo: packet for servo, packet in answers.items() if len(packet.parameters) == size}
