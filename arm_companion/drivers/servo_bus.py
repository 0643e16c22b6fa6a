"""The Dynamixel bus and its servos: the one owner of the port.

A cycle is one Sync Read of what every servo measures and, once the mission has decided, one Sync Write of
goals. What fails is tried again while the cycle's deadline allows, and otherwise shows in the servos' states;
one servo's failure never keeps goals from the others. `run` keeps the port open through loss and return.
"""

import asyncio
import logging
import random
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_health import BusCounters, ServoRecord, ServoState, fault_of, raise_together
from arm_companion.drivers.servo_homing import adopt, doubt, home, let_out
from arm_companion.drivers.servo_link import ServoLink
from arm_companion.drivers.servo_reader import ServoReader
from arm_companion.drivers.servo_setup import SPEED_LIMIT_RAD_PER_S, ServoInfo, Settings, set_up, settings_of
from arm_companion.errors import DeviceFault, LinkError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.transport.base import Opener, Transport

_log = logging.getLogger(__name__)

_CHECK_S = 0.25  # between attempts to set up a servo that is not
_TORQUE_RETRY_S = 0.2
_BOOT_TRIES = 6
_TRIES = 4
_RECONNECT_FIRST_S = 0.05
_RECONNECT_LONGEST_S = 2.0
_STEADY_S = 1.0  # a port that is lost sooner counts as one that does not open: a bridge may accept and hang up


class ServoBus:
    """All servos of the arm: the tendons' in their order, and a gripper's behind them."""

    def __init__(
        self,
        opener: Opener,
        config: ServosConfig,
        *,
        speed_limit_rad_per_s: float = SPEED_LIMIT_RAD_PER_S,
        rng: random.Random | None = None,
        parked: Mapping[int, int] | None = None,
        parked_window: int = 0,
        own_settings: Mapping[int, Settings] | None = None,
    ) -> None:
        """Nothing is opened before `start` or `run`.

        Args:
            opener: of the serial device, or of whatever leads to it.
            config: which servos, how fast, which deadlines.
            speed_limit_rad_per_s: set in every servo as the speed of its own trajectory.
            rng: spreads reconnections in time.
            parked: where servos last stood, ticks by id: one that lost its power is expected there, and elsewhere
                at its zero.
            parked_window: ticks within which it must stand there.
            own_settings: of servos, by id, that are set to something else than the others.
        """
        self._opener = opener
        self._config = config
        self._rng = rng or random.SystemRandom()
        self._link = ServoLink(config.baud, config.reply_timeout_s)
        self._records = tuple(ServoRecord(servo, config.silent_after) for servo in config.ids)
        self._by_id = {record.id: record for record in self._records}
        self._parked, self._parked_window = dict(parked or {}), parked_window
        self._zeros = dict(zip(config.ids, config.zero_ticks, strict=True))
        common = settings_of(config, speed_limit_rad_per_s)
        self._settings = dict.fromkeys(config.ids, common) | dict(own_settings or {})
        self._reader = ServoReader(self._link, self._records, config, self._settings)
        self._transport: Transport | None = None
        self._opening = asyncio.Lock()
        self._setting_up = asyncio.Lock()
        self._next_torque_at = 0.0
        self._last_reported: dict[int, str] = {}
        self.info: dict[int, ServoInfo] = {}
        self.reconnects = 0

    # Life of the link.

    async def start(self) -> None:
        """Open the port if need be and prepare every servo for goals; also clears watchdog trips.

        Torque stays as it is. All servos are tried whatever happens to one.

        Raises:
            LinkError: the port cannot be opened.
            ExceptionGroup: of one `DeviceFault` for each servo that could not be prepared.
        """
        await self._connect()
        await self._for_each("start", self._records, self._set_up)

    async def rearm(self) -> None:
        """Clear the watchdog trips of those servos that answer.

        For the cycle, which must not wait: neither opens the port nor asks a servo that is silent.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that could not be armed again.
        """
        if self.connected:
            armable = [r for r in self._records if r.tripped and r.missed < self._config.silent_after]
            await self._for_each("re-arm", armable, self._set_up)

    async def run(self) -> None:
        """Keep the port open and new servos set up, until cancelled.

        A servo that lost its power is set up again, and stays marked as having lost its turns. A watchdog
        trip in a servo that was set up before stays until `rearm` or `start`.
        """
        loop = asyncio.get_running_loop()
        delay = _RECONNECT_FIRST_S
        while True:
            try:
                transport = await self._connect()
            except LinkError as error:
                self._report(-1, str(error))
            else:
                self._report(-1, "")
                opened_at = loop.time()
                async with asyncio.TaskGroup() as group:
                    setting_up = group.create_task(self._keep_set_up())
                    await transport.wait_closed()
                    setting_up.cancel()
                self._disconnect()
                self.reconnects += 1
                if loop.time() - opened_at >= _STEADY_S:
                    delay = _RECONNECT_FIRST_S
                    continue  # at once: the servos' watchdogs are running
            await asyncio.sleep(delay * (0.5 + 0.5 * self._rng.random()))
            delay = min(2 * delay, _RECONNECT_LONGEST_S)

    async def stop(self, *, limp: bool) -> None:
        """Release the port, with the torque off if `limp`; otherwise servos keep holding what they hold.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that may still hold, after the port is closed.
        """
        try:
            if limp:
                await self.limp()
        finally:
            transport = self._transport
            self._disconnect()
            if transport is not None:
                transport.close()
                await transport.wait_closed()

    async def _for_each(
        self, what: str, records: Iterable[ServoRecord], action: Callable[[ServoRecord], Awaitable[None]]
    ) -> None:
        faults = []
        for record in records:
            try:
                await action(record)
            except DeviceFault as fault:
                faults.append(fault)
        raise_together(what, faults)

    async def _connect(self) -> Transport:
        async with self._opening:
            if self._transport is None:
                self._transport = await self._opener(self._link.receive)
                self._link.attach(self._transport)
            return self._transport

    @property
    def connected(self) -> bool:
        """The port is open."""
        return self._link.connected

    def _disconnect(self) -> None:
        self._transport = None
        self._link.detach()

    async def _keep_set_up(self) -> None:
        while True:
            for record in self._records:
                try:
                    if not record.set_up:
                        await self._set_up(record)
                    elif record.turns_lost and record.vouched:
                        await doubt(self._link, record)
                except DeviceFault as fault:
                    self._report(record.id, str(fault))
                else:
                    lost = "its turns are not known: it must be homed" if record.turns_lost else ""
                    self._report(record.id, lost)
            await asyncio.sleep(_CHECK_S)

    async def _set_up(self, record: ServoRecord) -> None:
        async with self._setting_up:
            settings = self._settings[record.id]
            info = await set_up(self._link, record, settings)
            if record.id not in self.info or (settings.within_a_turn and record.turns_lost):
                await self._meet(record)
            self.info[record.id] = info
            record.set_up = True

    async def _meet(self, record: ServoRecord) -> None:
        """Decide whether a servo's turns can be believed; while another one holds, the arm need not hang straight."""
        deadline = asyncio.get_running_loop().time() + self._config.reply_timeout_s
        await self._reader.check_torque(self._records, deadline)
        at_rest = not any(other.torque for other in self._records if other is not record)
        near, window = self._zeros[record.id], self._config.home_window_ticks
        if self._settings[record.id].within_a_turn:
            at_rest, window = True, ct.TICKS_PER_TURN // 2
        elif record.id in self._parked:
            near, window = self._parked[record.id], self._parked_window
        await adopt(self._link, record, near, window if at_rest else -1)

    def _report(self, servo: int, trouble: str) -> None:
        """Log what is wrong once, and once that it is over."""
        if trouble == self._last_reported.get(servo, ""):
            return
        self._last_reported[servo] = trouble
        name = "servo bus" if servo < 0 else f"servo {servo}"
        _log.log(logging.WARNING if trouble else logging.INFO, "%s: %s", name, trouble or "well again")

    # The cycle.

    async def cycle(self, goals: Sequence[int] | None) -> tuple[ServoState, ...]:
        """One `write` and one `read`."""
        await self.write(goals)
        return await self.read()

    async def read(self) -> tuple[ServoState, ...]:
        """Hear every servo, by the configuration's deadline at the latest, and return all states.

        Never raises on a servo's or the link's behalf: what went wrong is in the states.
        """
        await self._reader.read()
        lost = [r for r in self._records if r.goal_lost and r.movable]
        if lost:
            await self._send_goals(lost)
        now = asyncio.get_running_loop().time()
        return tuple(record.state(now, self._config.silent_after) for record in self._records)

    async def write(self, goals: Sequence[int | None] | None, *, torque: bool = False) -> None:
        """Send a goal to every servo that may move, in one frame.

        Args:
            goals: ticks, in the servos' order; None, of all or of one, repeats the last ones.
            torque: switch the torque on first where it is off; the servo then starts from where it is.

        Raises:
            ValueError: a goal is no position of the extended-position mode, or their number is wrong.
        """
        if goals is not None:
            if len(goals) != len(self._records):
                raise ValueError(f"{len(goals)} goals for {len(self._records)} servos")
            if any(goal is not None and abs(goal) > ct.EXTENDED_POSITION_LIMIT_TICKS for goal in goals):
                raise ValueError(f"goals {list(goals)} exceed +-{ct.EXTENDED_POSITION_LIMIT_TICKS} ticks")
        if torque:
            await self._torque_where_off()
        movable = [r for r in self._records if r.movable]
        if goals is not None:
            for record, goal in zip(self._records, goals, strict=True):
                if record.movable and goal is not None:
                    record.goal = goal
        await self._send_goals(movable)

    async def _send_goals(self, records: Sequence[ServoRecord]) -> None:
        data = {r.id: ct.GOAL_POSITION.encode(r.goal) for r in records if r.goal is not None}
        if data:
            await self._link.tell(dxl.sync_write(ct.GOAL_POSITION.address, data))
            for record in records:
                record.goal_lost = False

    # Torque.

    async def torque(self, on: bool) -> None:
        """Switch the torque of every servo; one that comes on stays where it is.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that did not obey, after all were tried.
        """
        if not on:
            await self.limp()
            return
        for _ in range(_TRIES):
            await self._reader.read()
            await self._switch_on([r for r in self._records if not r.torque])
        raise_together("torque on", [fault_of(r, "its torque does not come on") for r in self._records if not r.torque])

    async def limp(self) -> None:
        """Let every servo go: one frame to all of them at once, then each one until it confirms.

        Does nothing once all have confirmed.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that did not confirm, after all were tried.
        """
        holding = [r for r in self._records if r.torque or r.missed]
        if holding:
            off = ct.TORQUE_ENABLE.encode(0)
            await self._link.tell(dxl.sync_write(ct.TORQUE_ENABLE.address, {r.id: off for r in self._records}))
            await self._for_each("torque off", holding, self._switch_off)

    async def _switch_off(self, record: ServoRecord) -> None:
        await self._link.write(record.id, ct.TORQUE_ENABLE, 0, tries=1 if record.missed else _TRIES)
        record.torque = False
        record.goal = None

    async def _torque_where_off(self) -> None:
        off = [r for r in self._records if r.movable and not (r.torque or r.error_bits or r.missed)]
        now = asyncio.get_running_loop().time()
        if off and now >= self._next_torque_at:
            self._next_torque_at = now + _TORQUE_RETRY_S
            await self._switch_on(off)

    async def _switch_on(self, records: Sequence[ServoRecord]) -> None:
        """Switch on those servos that are seen to have their present position as goal."""
        fresh = [r for r in records if r.set_up and r.feedback is not None and not r.missed]
        for record in fresh:
            record.hold()
        await self._send_goals(fresh)
        deadline = asyncio.get_running_loop().time() + self._config.reply_timeout_s
        await self._reader.check_goals(fresh, deadline)
        holding = [r for r in fresh if r.goal_confirmed]
        if holding:
            on = ct.TORQUE_ENABLE.encode(1)
            await self._link.tell(dxl.sync_write(ct.TORQUE_ENABLE.address, {r.id: on for r in holding}))
            await self._reader.check_torque(holding, deadline)

    async def reboot(self, servo: int) -> None:
        """Restart a servo, the way out of a shutdown. Its torque goes, and with it its turns.

        Raises:
            DeviceFault: it does not answer.
            KeyError: no servo of the arm has this id.
        """
        record = self._by_id[servo]
        await self._link.command(servo, dxl.reboot(servo))
        record.lose_power()
        record.error_bits = 0

    async def accept_position(self, servo: int, near: int | None = None) -> None:
        """Trust a servo's position again: somebody knows that its tendon is where it should be.

        Args:
            servo: its torque must be off.
            near: ticks, within half a turn of which its horn is; None: its configured zero, with the arm
                hanging straight.

        Raises:
            DeviceFault: it is silent, refuses, or its torque is on.
            KeyError: no servo of the arm has this id.
        """
        async with self._setting_up:
            await home(self._link, self._by_id[servo], self._zeros[servo] if near is None else near)

    def renew_zeros(self, zero_ticks: Sequence[int]) -> None:
        """Expect servos that hang straight at other zeros from now on, ticks in the servos' order."""
        self._zeros |= zip(self._config.ids, zero_ticks, strict=False)  # a gripper's servo, the last, has its own

    async def recover(self) -> None:
        """Bring back what can be brought back, at the word of somebody who sees the arm hang straight.

        Servos with a hardware error are rebooted, watchdog trips cleared, and servos that lost their turns
        accepted near their zeros, or where they stood without torque before the reboot, or where their tendon had been
        let out when the power went. One that is well, or still too hot, is not touched. All are tried whatever
        happens to one.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that could not be brought back.
        """
        await self._for_each("recover", self._records, self._recover)

    async def _recover(self, record: ServoRecord) -> None:
        near: int | None = None
        if record.error_bits:
            hot = await self._link.read(record.id, ct.PRESENT_TEMPERATURE)
            if record.error_bits & ct.HardwareError.OVERHEATING and hot > self._config.temperature_limit_c:
                raise DeviceFault(record.id, record.error_bits, f"still at {hot} degC")  # it would shut down again
            if record.feedback is not None and not (record.turns_lost or record.torque):
                near = record.feedback.position  # its tendon may be slack, more than a turn from its zero
            await self.reboot(record.id)
            await self._await_boot(record)
        if record.tripped or not record.set_up:
            await self._set_up(record)
        if record.turns_lost:
            if near is None:
                direction = self._config.directions[self._config.ids.index(record.id)]
                near = let_out(record, self._zeros[record.id], direction, self._parked_window)
            await self.accept_position(record.id, near)

    async def _await_boot(self, record: ServoRecord) -> None:
        """Return once a servo answers again, or after as long as that may take."""
        for _ in range(_BOOT_TRIES):
            await asyncio.sleep(_CHECK_S)
            if record.set_up:
                return
            try:
                await self._set_up(record)
            except DeviceFault as fault:
                if fault.bits:
                    raise

    def counters(self) -> BusCounters:
        """History of the bus, for telemetry."""
        return BusCounters.of(self._link, self._records, self.reconnects)
