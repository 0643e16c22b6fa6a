"""The bus driver against emulated servos in simulated time: each failure, alone and with its neighbours well."""

import asyncio
import dataclasses
import itertools
import math
import random
import socket
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, cast

import pytest

from arm_companion.clock import precise_loop, run_simulated, ticks
from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.servo_link import DRAIN_S, ServoLink
from arm_companion.errors import DeviceFault, LinkError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.control_table import HardwareError, OperatingMode
from arm_companion.sim.byte_noise import ByteNoise
from arm_companion.sim.servo_device import BOOT_S
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.transport.base import Receiver, Transport
from arm_companion.transport.memory import MemoryPipe
from arm_companion.transport.tcp import tcp_in
from arm_companion.transport.urls import open_bus

CONFIG = ServosConfig()
PERIOD_S = 0.01
WATCHDOG = round(CONFIG.watchdog_s / ct.WATCHDOG_UNIT_S)


class Rig:
    """Servos, their bus, and the driver, on a simulated loop."""

    def __init__(self, config: ServosConfig = CONFIG) -> None:
        self.config = config
        self.emulator = ServoEmulator(config, seed=2)
        self.wire = EmulatedBus(self.emulator, config)
        self.pipe = MemoryPipe(latency_s=0.0001)
        self.bus = ServoBus(self.pipe.opener(1), config, rng=random.Random(1))
        self.sent: list[dxl.Packet] = []
        self._sniffer = dxl.Parser()
        self.wire.to_servos = self.sniff

    def sniff(self, data: bytes) -> bytes:
        """Note what the driver sends."""
        self.sent += self._sniffer.feed(data)
        return data

    async def cycles(self, n: int, goals: Sequence[int] | None = None, **options: bool) -> tuple[ServoState, ...]:
        """Run n cycles; states of the last."""
        states: tuple[ServoState, ...] = ()
        for _ in range(n):
            states = await self.bus.read()
            await self.bus.write(goals, **options)
            now = asyncio.get_running_loop().time()
            await asyncio.sleep((math.floor(now / PERIOD_S + 1e-6) + 1) * PERIOD_S - now)
        return states

    def registers(self, register: ct.Register) -> list[int]:
        return [servo.peek(register) for servo in self.emulator.servos]


def scenario(
    story: Callable[[Rig], Awaitable[Any]],
    config: ServosConfig = CONFIG,
    *,
    prepare: Callable[[Rig], None] | None = None,
) -> None:
    """Play a story with the bus served and time passing."""

    async def main() -> None:
        rig = Rig(config)
        if prepare is not None:
            prepare(rig)
        serving = asyncio.create_task(rig.wire.serve_memory(rig.pipe.opener(0)))
        passing = asyncio.create_task(keep_time(rig.emulator))
        await rig.wire.wait_ready()
        try:
            await story(rig)
        finally:
            await rig.bus.stop(limp=False)
            for task in (serving, passing):
                task.cancel()

    run_simulated(main())


def faults(error: ExceptionGroup) -> dict[int, int]:
    """Servo -> bits of a group of device faults."""
    assert all(isinstance(e, DeviceFault) for e in error.exceptions)
    return {e.servo: e.bits for e in error.exceptions if isinstance(e, DeviceFault)}


# Start.


def test_start_arms_the_watchdog_and_leaves_the_torque_off() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        assert rig.registers(ct.BUS_WATCHDOG) == [WATCHDOG] * 4
        assert rig.registers(ct.TORQUE_ENABLE) == [0] * 4
        assert all(velocity > 0 for velocity in rig.registers(ct.PROFILE_VELOCITY))
        assert {i.model for i in rig.bus.info.values()} == {1060}
        assert all(i.fresh for i in rig.bus.info.values())

    scenario(story)


def test_start_corrects_a_new_servo() -> None:
    def prepare(rig: Rig) -> None:
        rig.emulator[2].poke(ct.OPERATING_MODE, OperatingMode.POSITION)
        rig.emulator[3].poke(ct.RETURN_DELAY, 250)
        rig.emulator[4].poke(ct.STATUS_RETURN_LEVEL, 1)

    async def story(rig: Rig) -> None:
        await rig.bus.start()
        assert rig.registers(ct.OPERATING_MODE) == [OperatingMode.EXTENDED_POSITION] * 4
        assert rig.registers(ct.RETURN_DELAY) == [0] * 4
        assert rig.registers(ct.STATUS_RETURN_LEVEL) == [2] * 4

    scenario(story, prepare=prepare)


def test_start_never_lets_go_of_what_a_servo_holds() -> None:
    def prepare(rig: Rig) -> None:
        for servo in rig.emulator.servos:
            servo.poke(ct.TORQUE_ENABLE, 1)
            servo.poke(ct.GOAL_POSITION, 2048)
        rig.emulator[2].poke(ct.OPERATING_MODE, OperatingMode.POSITION)

    async def story(rig: Rig) -> None:
        with pytest.raises(ExceptionGroup) as caught:
            await rig.bus.start()
        assert faults(caught.value) == {2: 0}
        assert "torque is on" in str(caught.value.exceptions[0])
        assert rig.registers(ct.TORQUE_ENABLE) == [1] * 4
        assert rig.registers(ct.BUS_WATCHDOG) == [WATCHDOG, 0, WATCHDOG, WATCHDOG]
        offs = [p for p in rig.sent if p.instruction == dxl.Instruction.WRITE and p.parameters[0] == 64]
        assert offs == []

    scenario(story, prepare=prepare)


def test_start_takes_over_a_servo_that_its_watchdog_stopped_without_moving_it() -> None:
    def prepare(rig: Rig) -> None:
        rig.emulator[1].poke(ct.TORQUE_ENABLE, 1)
        rig.emulator[1].poke(ct.BUS_WATCHDOG, ct.WATCHDOG_TRIPPED)
        rig.emulator[1].poke(ct.GOAL_POSITION, 9000)

    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(50)
        assert rig.registers(ct.BUS_WATCHDOG)[0] == WATCHDOG
        assert rig.registers(ct.TORQUE_ENABLE)[0] == 1
        assert rig.emulator.positions()[0] == pytest.approx(2048, abs=20)

    scenario(story, prepare=prepare)


@pytest.mark.parametrize(
    ("register", "value", "words"),
    [(ct.MODEL_NUMBER, 1190, "model"), (ct.FIRMWARE_VERSION, 30, "firmware"), (ct.DRIVE_MODE, 1, None)],
)
def test_start_refuses_or_corrects_what_is_not_right(register: ct.Register, value: int, words: str | None) -> None:
    def prepare(rig: Rig) -> None:
        rig.emulator[3].poke(register, value)

    async def story(rig: Rig) -> None:
        if words is None:
            await rig.bus.start()
            assert rig.registers(register)[2] == 0
            return
        with pytest.raises(ExceptionGroup) as caught:
            await rig.bus.start()
        assert words in str(caught.value.exceptions[0])
        assert rig.registers(ct.BUS_WATCHDOG) == [WATCHDOG, WATCHDOG, 0, WATCHDOG]

    scenario(story, prepare=prepare)


def test_start_names_every_servo_that_failed_and_prepares_the_others() -> None:
    def prepare(rig: Rig) -> None:
        rig.emulator[1].silenced = True
        rig.emulator[4].trip(HardwareError.OVERLOAD)

    async def story(rig: Rig) -> None:
        with pytest.raises(ExceptionGroup) as caught:
            await rig.bus.start()
        assert faults(caught.value) == {1: 0, 4: HardwareError.OVERLOAD}
        assert rig.registers(ct.BUS_WATCHDOG)[1:3] == [WATCHDOG, WATCHDOG]

    scenario(story, prepare=prepare)


def test_start_without_a_port_is_a_link_error() -> None:
    async def refuse(_: Receiver) -> Transport:
        raise LinkError("no such device")

    async def main() -> None:
        with pytest.raises(LinkError, match="no such device"):
            await ServoBus(refuse, CONFIG).start()

    run_simulated(main())


# The cycle.


@pytest.mark.parametrize(
    ("firmware", "instruction"),
    [(44, dxl.Instruction.SYNC_READ), (45, dxl.Instruction.FAST_SYNC_READ)],
)
def test_a_cycle_is_one_sync_read_and_one_sync_write(firmware: int, instruction: dxl.Instruction) -> None:
    def prepare(rig: Rig) -> None:
        rig.emulator[3].poke(ct.FIRMWARE_VERSION, firmware)  # the oldest firmware decides

    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(6)
        rig.sent.clear()
        states = await rig.cycles(1, (2048, 2050, 2052, 2054))
        assert [(p.id, p.instruction) for p in rig.sent] == [
            (dxl.BROADCAST_ID, instruction),
            (dxl.BROADCAST_ID, dxl.Instruction.SYNC_WRITE),
        ]
        assert rig.sent[0].parameters == bytes((124, 0, 23, 0, 1, 2, 3, 4))
        assert [s.position for s in states] == [2048] * 4
        assert all(s.age_s < 0.001 and not s.silent and s.ready for s in states)
        assert all(s.voltage == pytest.approx(12.0) and s.temperature == 30.0 for s in states)

    scenario(story, prepare=prepare)


def test_a_cycle_takes_little_more_than_its_time_on_the_wire() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(20)
        loop = asyncio.get_running_loop()
        begin = loop.time()
        await rig.bus.read()
        assert loop.time() - begin < 1.3 * (18 + 4 * 34) * 1e-5

    scenario(story)


def test_goals_are_followed_and_torque_comes_on_without_a_jerk() -> None:
    def prepare(rig: Rig) -> None:
        for servo in rig.emulator.servos:
            servo.poke(ct.GOAL_POSITION, 50_000)  # left over; torque alone would drive to it

    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(12)
        for servo in rig.emulator.servos:
            servo.motor.position += 150.0  # turned by hand since
        await rig.cycles(1)
        await rig.bus.torque(True)
        assert rig.registers(ct.TORQUE_ENABLE) == [1] * 4
        await rig.cycles(30)
        assert rig.emulator.positions() == pytest.approx([2198.0] * 4, abs=10)
        goals = (2298, 2098, 2198, 2248)
        states = await rig.cycles(100, goals)
        assert [s.position for s in states] == pytest.approx(goals, abs=10)
        assert all(s.torque for s in states)

    scenario(story, prepare=prepare)


def test_writing_with_torque_switches_it_on_where_it_is_off() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        states = await rig.cycles(100, (2100,) * 4, torque=True)
        assert all(s.torque for s in states)
        assert [s.position for s in states] == pytest.approx([2100] * 4, abs=10)

    scenario(story)


@pytest.mark.parametrize("goals", [(1, 2, 3), (0, 0, 0, 2_000_000)])
def test_goals_that_are_no_goals_are_refused(goals: tuple[int, ...]) -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        rig.sent.clear()
        with pytest.raises(ValueError, match="goals"):
            await rig.bus.write(goals)
        assert rig.sent == []

    scenario(story)


@pytest.mark.parametrize("dead", [1, 2, 3, 4])
def test_a_dead_servo_is_seen_and_the_others_go_on(dead: int) -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        rig.emulator[dead].set_power(on=False)
        rig.emulator[dead].silenced = True  # the chain of answers breaks at it
        others = [i for i in range(4) if i != dead - 1]
        states = await rig.cycles(1, (2100,) * 4)
        assert [i for i, s in enumerate(states) if s.age_s > 0.005] == [dead - 1]
        states = await rig.cycles(60, (2100,) * 4)
        assert [s.silent for s in states] == [i == dead - 1 for i in range(4)]
        assert all(states[i].position == pytest.approx(2100, abs=10) for i in others)
        missed = [c.missed_cycles for c in rig.bus.counters().servos.values()]
        assert all(missed[i] == 0 for i in others)

    scenario(story)


def test_a_servo_that_only_cannot_talk_still_gets_its_goals() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        rig.emulator[2].silenced = True
        states = await rig.cycles(100, (2200,) * 4)
        assert states[1].silent
        assert rig.emulator.positions()[1] == pytest.approx(2200, abs=10)
        rig.emulator[2].silenced = False
        states = await rig.cycles(20, (2200,) * 4)
        assert not states[1].silent
        assert not states[1].turns_lost
        assert states[1].ready

    scenario(story)


def test_a_hardware_error_shows_its_bits_in_the_same_cycle() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        rig.emulator[3].trip(HardwareError.OVERHEATING)
        states = await rig.cycles(1, (2100,) * 4)
        assert [s.error_bits for s in states] == [0, 0, HardwareError.OVERHEATING, 0]
        assert [s.torque for s in states] == [True, True, False, True]
        states = await rig.cycles(60, (2100,) * 4, torque=True)
        assert states[0].position == pytest.approx(2100, abs=10)
        assert states[2].position == pytest.approx(2048, abs=10)

    scenario(story)


def test_a_reboot_ends_a_shutdown_and_the_turns_are_not_assumed() -> None:
    async def story(rig: Rig) -> None:
        running = asyncio.create_task(rig.bus.run())
        await asyncio.sleep(0.2)
        await rig.cycles(20)
        rig.emulator[3].trip(HardwareError.OVERLOAD)
        await rig.cycles(2)
        await rig.bus.reboot(3)
        states = await rig.cycles(round((BOOT_S + 0.8) / PERIOD_S), (2100,) * 4, torque=True)
        assert states[2].error_bits == 0
        assert states[2].turns_lost
        assert not states[2].ready
        assert not states[2].torque
        assert rig.emulator.positions()[2] == pytest.approx(2048, abs=10)
        await rig.bus.accept_position(3)
        states = await rig.cycles(100, (2100,) * 4, torque=True)
        assert states[2].position == pytest.approx(2100, abs=10)
        running.cancel()

    scenario(story)


def test_lost_power_is_noticed_even_when_the_position_looks_the_same() -> None:
    async def story(rig: Rig) -> None:
        running = asyncio.create_task(rig.bus.run())
        await asyncio.sleep(0.2)
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        rig.emulator.set_power(on=False)
        await rig.cycles(3, (2100,) * 4)
        rig.emulator.set_power(on=True)
        states = await rig.cycles(100, (2100,) * 4, torque=True)
        assert all(s.turns_lost and not s.torque and not s.ready and not s.silent for s in states)
        assert rig.emulator.positions() == pytest.approx([2048.0] * 4, abs=10)
        assert all(c.power_losses == 1 for c in rig.bus.counters().servos.values())
        assert rig.registers(ct.BUS_WATCHDOG) == [WATCHDOG] * 4  # set up again all the same
        running.cancel()

    scenario(story)


def test_a_position_that_jumps_is_not_believed() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        rig.emulator[1].motor.position += 4096.0
        states = await rig.cycles(2)
        assert [s.turns_lost for s in states] == [True, False, False, False]

    scenario(story)


def test_a_watchdog_trip_stays_until_start() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        await asyncio.sleep(0.5)  # the daemon is stopped
        states = await rig.cycles(40, (2300,) * 4, torque=True)
        assert all(s.tripped and s.torque and not s.ready for s in states)
        assert rig.emulator.positions() == pytest.approx([2048.0] * 4, abs=10)
        await rig.bus.start()
        states = await rig.cycles(1)
        assert not any(s.tripped for s in states)
        states = await rig.cycles(100, (2300,) * 4)
        assert [s.position for s in states] == pytest.approx([2300] * 4, abs=10)

    scenario(story)


def test_cycles_alone_keep_the_watchdog_quiet() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.cycles(1, (2048,) * 4, torque=True)
        for _ in range(200):  # a mission that holds reads and writes nothing
            await rig.bus.read()
            await asyncio.sleep(PERIOD_S)
        assert rig.registers(ct.BUS_WATCHDOG) == [WATCHDOG] * 4

    scenario(story)


def test_noise_of_one_per_cent_loses_no_goal() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.bus.torque(True)
        noise_out, noise_in = ByteNoise(0.005, 0.005, seed=1), ByteNoise(0.005, 0.005, seed=2)
        rig.wire.to_servos, rig.wire.to_master = noise_out, noise_in
        silent = 0
        for k in range(20):
            goal = 2048 + 20 * (k % 5)
            for _ in range(20):
                states = await rig.cycles(1, (goal,) * 4)
                silent += sum(s.silent for s in states)
            assert rig.registers(ct.GOAL_POSITION) == [goal] * 4
        assert silent == 0
        counters = rig.bus.counters()
        assert counters.crc_errors > 20
        assert all(c.lost > 20 and c.power_losses == 0 for c in counters.servos.values())
        assert not any(s.turns_lost or s.error_bits for s in states)

    scenario(story)


def test_a_goal_that_was_lost_is_sent_again_even_if_the_mission_says_nothing_more() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.bus.torque(True)
        rig.wire.to_servos = lambda data: b"" if dxl.Instruction.SYNC_WRITE in data[7:8] else data
        await rig.bus.write((2100,) * 4)
        await asyncio.sleep(PERIOD_S)
        rig.wire.to_servos = rig.sniff
        for _ in range(30):
            await rig.bus.read()
            await asyncio.sleep(PERIOD_S)
        assert rig.registers(ct.GOAL_POSITION) == [2100] * 4
        assert all(c.goals_lost == 1 for c in rig.bus.counters().servos.values())

    scenario(story)


def test_an_adapters_latency_is_learnt_and_costs_no_answers() -> None:
    async def story(rig: Rig) -> None:
        rig.wire.latency_s = 0.001
        await rig.bus.start()
        states = await rig.cycles(100)
        assert not any(s.silent for s in states)
        assert rig.bus.counters().latency_s == pytest.approx(0.001, rel=0.3)
        assert sum(c.lost for c in rig.bus.counters().servos.values()) < 4

    scenario(story)


def test_a_slow_adapter_still_finds_servos_again_after_a_gap() -> None:
    async def story(rig: Rig) -> None:
        rig.wire.latency_s = 0.003
        await rig.bus.start()
        await rig.cycles(20)
        rig.emulator[2].silenced = True
        await rig.cycles(20)
        rig.emulator[2].silenced = False
        states = await rig.cycles(60)
        assert all(s.ready and not s.silent for s in states)

    scenario(story)


class LateServo:
    """A servo whose answers take a while: of its watchdog longer than anybody waits. Registers hold their address."""

    def __init__(self, link: ServoLink) -> None:
        self.link = link

    def write(self, data: bytes) -> None:
        (request,) = dxl.Parser().feed(data)
        address = request.parameters[0]
        late = 0.0016 if address == ct.BUS_WATCHDOG.address else 0.0003
        asyncio.get_running_loop().call_later(late, self.link.receive, dxl.status(2, 0, bytes((address,))))


def test_the_late_answer_to_another_question_is_not_believed() -> None:
    """The cycle looks at a watchdog while a servo is set up, whose next question is whether its turns are known."""

    async def main() -> None:
        link = ServoLink(1_000_000, 0.008)
        link.attach(cast("Transport", LateServo(link)))
        audit = dxl.sync_read((2,), ct.BUS_WATCHDOG.address, 1)
        for _ in range(3):
            asking = asyncio.create_task(link.ask(audit, (2,), 1, asyncio.get_running_loop().time() + 0.001))
            await asyncio.sleep(0)
            assert await link.read(2, ct.LED) == ct.LED.address
            assert not await asking
            assert await link.read(2, ct.TORQUE_ENABLE) == ct.TORQUE_ENABLE.address

    run_simulated(main())


def hold_back(rig: Rig, late: float, firmware: int) -> Callable[[bool], None]:
    """Make the adapter bring the last servo's answers late, or one of all; whoever gets this switches it on and off."""
    held = [False]
    loop = asyncio.get_running_loop()

    def to_master(data: bytes) -> bytes:
        if not held[0]:
            return data
        now = b""
        for packet in dxl.Parser().feed(data):
            frame = dxl.status(packet.id, packet.error, packet.parameters)
            if packet.id == rig.config.ids[-1] or packet.id == dxl.BROADCAST_ID:
                loop.call_later(late, rig.bus._link.receive, data if firmware > 44 else frame)
            else:
                now += frame
        return now

    def switch(on: bool) -> None:
        held[0] = on

    rig.wire.to_master = to_master
    return switch


@pytest.mark.parametrize("late", [0.004, 0.0095])
@pytest.mark.parametrize("firmware", [42, 52], ids=["Sync Read", "Fast Sync Read"])
def test_late_answers_to_the_cycle_before_do_not_end_this_ones_read(firmware: int, late: float) -> None:
    """It would end while the other servos are talking, and they would be asked again, one by one, meanwhile."""

    def prepare(rig: Rig) -> None:
        for servo in rig.emulator.servos:
            servo.poke(ct.FIRMWARE_VERSION, firmware)

    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(20)
        hold = hold_back(rig, late, firmware)
        hold(True)
        await rig.cycles(1)
        hold(False)
        rig.sent.clear()
        begin = asyncio.get_running_loop().time()
        states = await rig.bus.read()
        assert asyncio.get_running_loop().time() - begin > 0.0014, "as long as four answers take"
        assert [p.instruction for p in rig.sent if p.instruction == dxl.Instruction.READ] == []
        assert rig.bus._link.strays > 0
        assert all(state.age_s < 0.002 for state in states)

    scenario(story, prepare=prepare)


def test_on_a_wire_that_is_faster_than_it_is_said_to_be_servos_are_heard_again_soon() -> None:
    """A bridge may speak to the servos at another speed: each answer comes sooner than it could here."""

    async def main() -> None:
        link = ServoLink(9600, 0.05)
        link.attach(cast("Transport", LateServo(link)))
        loop = asyncio.get_running_loop()
        link._late_until[2] = loop.time() + DRAIN_S
        read = dxl.read(2, ct.LED.address, 1)
        heard = [bool(await link.ask(read, (2,), 1, loop.time() + 0.05)) for _ in range(4)]
        assert heard == [False, True, True, True]

    run_simulated(main())


def test_an_adapter_at_its_factory_latency_is_named_as_the_trouble() -> None:
    async def story(rig: Rig) -> None:
        rig.wire.latency_s = 0.016
        with pytest.raises(ExceptionGroup) as caught:
            await rig.bus.start()
        assert "latency timer" in str(caught.value.exceptions[-1])

    scenario(story)


def test_reading_ends_by_the_deadline_whatever_is_missing() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        for servo in rig.emulator.servos:
            servo.silenced = True
        loop = asyncio.get_running_loop()
        for _ in range(15):
            begin = loop.time()
            await rig.bus.read()
            assert loop.time() - begin <= CONFIG.reply_timeout_s + 1e-6
            await asyncio.sleep(PERIOD_S)

    scenario(story)


# Torque off.


def test_limp_reaches_every_servo_and_names_those_that_did_not_confirm() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        rig.emulator[1].silenced = True
        rig.emulator[3].silenced = True
        with pytest.raises(ExceptionGroup) as caught:
            await rig.bus.limp()
        assert faults(caught.value) == {1: 0, 3: 0}
        assert rig.registers(ct.TORQUE_ENABLE) == [0] * 4

    scenario(story)


def test_limp_says_nothing_more_once_all_have_confirmed() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.bus.torque(True)
        await rig.bus.limp()
        rig.sent.clear()
        await rig.bus.limp()
        assert rig.sent == []
        assert rig.registers(ct.TORQUE_ENABLE) == [0] * 4

    scenario(story)


def test_torque_on_names_the_servo_that_cannot() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        rig.emulator[2].trip(HardwareError.ELECTRICAL_SHOCK)
        with pytest.raises(ExceptionGroup) as caught:
            await rig.bus.torque(True)
        assert faults(caught.value) == {2: HardwareError.ELECTRICAL_SHOCK}
        assert rig.registers(ct.TORQUE_ENABLE) == [1, 0, 1, 1]

    scenario(story)


def test_stop_releases_the_port_and_lets_go_only_if_told() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        await rig.cycles(5)
        await rig.bus.torque(True)
        await rig.bus.stop(limp=False)
        assert rig.pipe.ends[1] is None
        assert rig.registers(ct.TORQUE_ENABLE) == [1] * 4
        await rig.bus.start()
        await rig.bus.stop(limp=True)
        assert rig.registers(ct.TORQUE_ENABLE) == [0] * 4

    scenario(story)


# The link.


def test_unplugged_and_replugged_it_goes_on_once_started() -> None:
    async def story(rig: Rig) -> None:
        running = asyncio.create_task(rig.bus.run())
        await asyncio.sleep(0.2)
        await rig.cycles(5)
        await rig.cycles(5, (2048,) * 4, torque=True)
        rig.pipe.cut()
        states = await rig.cycles(50, (2200,) * 4)
        assert all(s.silent for s in states)
        serving = asyncio.create_task(rig.wire.serve_memory(rig.pipe.opener(0)))
        states = await rig.cycles(150, (2200,) * 4)
        assert not any(s.silent or s.turns_lost for s in states)
        assert all(s.tripped for s in states)  # the bus was silent for longer than the watchdog allows
        assert rig.bus.counters().reconnects >= 1
        await rig.bus.start()
        states = await rig.cycles(100, (2200,) * 4)
        assert [s.position for s in states] == pytest.approx([2200] * 4, abs=10)
        running.cancel()
        serving.cancel()

    scenario(story)


def test_run_waits_for_a_port_that_is_not_there_yet_with_growing_delays() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        attempts: list[float] = []

        async def refuse(_: Receiver) -> Transport:
            attempts.append(loop.time())
            raise LinkError("not yet")

        bus = ServoBus(refuse, CONFIG, rng=random.Random(0))
        running = asyncio.create_task(bus.run())
        await asyncio.sleep(30.0)
        assert all(s.silent for s in await bus.read())
        running.cancel()
        return attempts

    attempts = run_simulated(main())
    gaps = [b - a for a, b in itertools.pairwise(attempts)]
    assert gaps[0] < 0.051
    assert max(gaps) <= 2.0
    assert all(gap >= 1.0 for gap in gaps[-5:])
    assert len({round(gap, 6) for gap in gaps[-5:]}) == 5  # jittered


@pytest.mark.parametrize(("stays_s", "fewest", "most"), [(0.0, 10, 30), (1.5, 19, 21)], ids=["at once", "later"])
def test_a_port_that_opens_and_is_lost_is_opened_again_with_growing_delays_unless_it_stayed_for_a_while(
    stays_s: float, fewest: int, most: int
) -> None:
    class Bridge:
        """Accepts, and hangs up after a while."""

        dropped = 0

        def write(self, data: bytes) -> None:
            """Nobody hears it."""

        def close(self) -> None:
            """It is."""

        async def wait_closed(self) -> None:
            await asyncio.sleep(stays_s)

    async def main() -> int:
        async def accept(_: Receiver) -> Transport:
            assert bus.reconnects <= most, "it hardly pauses"
            return Bridge()

        bus = ServoBus(accept, CONFIG, rng=random.Random(0))
        running = asyncio.create_task(bus.run())
        done, _ = await asyncio.wait({running}, timeout=30.0)
        for task in done:
            task.result()
        running.cancel()
        return bus.reconnects

    assert fewest <= run_simulated(main()) <= most


def test_run_sets_up_a_servo_that_comes_late() -> None:
    def prepare(rig: Rig) -> None:
        rig.emulator[4].silenced = True

    async def story(rig: Rig) -> None:
        running = asyncio.create_task(rig.bus.run())
        states = await rig.cycles(50)
        assert [s.ready for s in states] == [True, True, True, False]
        rig.emulator[4].silenced = False
        states = await rig.cycles(80)
        assert all(s.ready for s in states)
        running.cancel()

    scenario(story, prepare=prepare)


def test_an_adapter_that_echoes_what_is_sent_is_no_trouble() -> None:
    async def story(rig: Rig) -> None:
        echoed = rig.wire.to_servos

        def echo(data: bytes) -> bytes:
            end = rig.pipe.ends[0]
            assert end is not None
            end.write(data)
            return echoed(data)

        rig.wire.to_servos = echo
        await rig.bus.start()
        states = await rig.cycles(10)
        assert not any(s.silent for s in states)
        assert sum(c.lost for c in rig.bus.counters().servos.values()) == 0

    scenario(story)


def test_any_bytes_from_the_bus_are_survived() -> None:
    async def story(rig: Rig) -> None:
        await rig.bus.start()
        rng = random.Random(7)
        for _ in range(100):
            end = rig.pipe.ends[0]
            assert end is not None
            end.write(rng.randbytes(rng.randrange(1, 60)))
            end.write(dxl.status(rng.randrange(0, 253), rng.randrange(256), rng.randbytes(rng.randrange(30))))
            await rig.cycles(1)
        states = await rig.cycles(20)
        assert not any(s.silent for s in states)
        assert rig.bus.counters().garbage_bytes > 500
        assert rig.bus.counters().strays > 0

    scenario(story)


def test_the_number_of_servos_is_free() -> None:
    config = dataclasses.replace(CONFIG, ids=(7, 3, 9), directions=(1, 1, -1), zero_ticks=(0, 2048, 4000))

    async def story(rig: Rig) -> None:
        await rig.bus.start()
        states = await rig.cycles(5)
        assert [(s.id, s.position) for s in states] == [(7, 0), (3, 2048), (9, 4000)]

    scenario(story, config)


async def until(bus: ServoBus, reached: Callable[[ServoState], bool], goals: Sequence[int] | None) -> None:
    """Run cycles until every servo has reached something."""
    async for _ in ticks(PERIOD_S):
        states = await bus.read()
        await bus.write(goals, torque=goals is not None)
        if all(reached(state) for state in states):
            return


@pytest.mark.realtime
@pytest.mark.parametrize("way", ["pty", "tcp"])
def test_the_same_over_a_port_in_real_time(tmp_path: Path, way: str) -> None:
    async def main() -> None:
        emulator = ServoEmulator(CONFIG)
        wire = EmulatedBus(emulator, CONFIG)
        passing = asyncio.create_task(keep_time(emulator))
        if way == "pty":
            port = str(tmp_path / "bus")
            serving = asyncio.create_task(wire.serve_pty(port))
        else:
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                number = int(probe.getsockname()[1])
            port = f"tcp:127.0.0.1:{number}"
            serving = asyncio.create_task(wire.serve(tcp_in("127.0.0.1", number)))
        await wire.wait_ready()
        bus = ServoBus(open_bus(port, CONFIG.baud), CONFIG)
        running = asyncio.create_task(bus.run())
        await until(bus, lambda s: s.ready, None)
        await until(bus, lambda s: abs(s.position - 2148) < 10, (2148,) * 4)
        wire.unplug()
        await asyncio.gather(serving)
        await until(bus, lambda s: s.silent, None)
        assert bus.counters().reconnects == 1
        running.cancel()
        passing.cancel()
        await bus.stop(limp=False)

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(asyncio.wait_for(main(), 20.0))
