"""One story for every fault of a servo or its bus: what the mission sees at once, who goes on, and how it ends.

All in simulated time, with the real driver on one side of a pipe and emulated servos on the other.
"""

import asyncio
import dataclasses
import random
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from arm_companion.clock import run_simulated
from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_health import ServoRecord, ServoState
from arm_companion.errors import DeviceFault, LinkError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol.control_table import Feedback, HardwareError
from arm_companion.sim import servo_faults
from arm_companion.sim.byte_noise import ByteNoise
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.sim.servo_faults import ByteDelay
from arm_companion.transport.base import Receiver, Transport
from arm_companion.transport.memory import MemoryPipe

CONFIG = ServosConfig()
PERIOD_S = 0.01
HOME = 2048


class Arm:
    """A driver that runs, four servos under torque, and a cycle that never stops."""

    def __init__(self, config: ServosConfig) -> None:
        self.config = config
        self.emulator = ServoEmulator(config, seed=5)
        self.wire = EmulatedBus(self.emulator, config)
        self.pipe = MemoryPipe(latency_s=0.0001)
        self.bus = ServoBus(self.pipe.opener(1), config, rng=random.Random(3), parked_window=128)
        self.states: tuple[ServoState, ...] = ()
        self.serving: asyncio.Task[None] | None = None

    def plug_in(self) -> None:
        self.serving = asyncio.create_task(self.wire.serve_memory(self.pipe.opener(0)))

    def unplug(self) -> None:
        self.pipe.cut()

    async def run(self, seconds: float, goal: int | None = None, *, until: Callable[[], bool] | None = None) -> int:
        """Cycle for some time, or until something holds; the number of cycles done."""
        n = round(seconds / PERIOD_S)
        for k in range(n):
            began = asyncio.get_running_loop().time()
            self.states = await self.bus.read()
            await self.bus.write(None if goal is None else (goal,) * len(self.states), torque=goal is not None)
            if until is not None and until():
                return k + 1
            await asyncio.sleep(max(began + PERIOD_S - asyncio.get_running_loop().time(), 0.0))
        assert until is None, "it did not happen in time"
        return n

    async def meanwhile(self, action: Coroutine[Any, Any, None], goal: int) -> None:
        """Cycle while something else is done, as the daemon does."""
        task = asyncio.create_task(action)
        while not task.done():
            await self.run(PERIOD_S, goal)
        await task
        await self.run(PERIOD_S, goal)

    def faults(self) -> dict[int, int]:
        """Servo -> bits of what the mission would be told now."""
        found = [state.fault for state in self.states]
        assert all(fault is None or isinstance(fault, DeviceFault) for fault in found)
        return {fault.servo: fault.bits for fault in found if fault is not None}

    def at(self, goal: float, servos: set[int], tolerance: float = 12.0) -> bool:
        return all(abs(self.emulator[i].motor.position - goal) < tolerance for i in servos)


def story(play: Callable[[Arm], Coroutine[Any, Any, None]], config: ServosConfig = CONFIG) -> None:
    async def main() -> None:
        arm = Arm(config)
        arm.plug_in()
        passing = asyncio.create_task(keep_time(arm.emulator))
        await arm.wire.wait_ready()
        running = asyncio.create_task(arm.bus.run())
        await arm.run(2.0, until=lambda: all(state.ready for state in arm.states))
        await arm.run(0.5, HOME)
        assert all(state.torque for state in arm.states)
        assert arm.faults() == {}
        await play(arm)
        running.cancel()
        await arm.bus.stop(limp=False)
        passing.cancel()

    run_simulated(main())


ALL = {1, 2, 3, 4}


# The bytes.


@pytest.mark.parametrize("noise", [{"drop": 0.01}, {"corrupt": 0.01}], ids=["dropped", "corrupted"])
def test_one_byte_in_a_hundred_lost_or_wrong_loses_no_goal(noise: dict[str, float]) -> None:
    async def play(arm: Arm) -> None:
        arm.wire.to_servos, arm.wire.to_master = ByteNoise(**noise, seed=1), ByteNoise(**noise, seed=2)
        for k in range(10):
            goal = HOME + 30 * (k % 4)
            await arm.run(0.25, goal)
            assert [s.peek(ct.GOAL_POSITION) for s in arm.emulator.servos] == [goal] * 4
            assert arm.faults() == {}, "noise is no fault of a servo"
        counters = arm.bus.counters()
        assert sum(c.lost for c in counters.servos.values()) > 50
        assert counters.garbage_bytes > 100

    story(play)


def test_bytes_that_come_late_are_waited_for_or_asked_for_again() -> None:
    async def play(arm: Arm) -> None:
        arm.wire.delays = ByteDelay(0.003, 0.002, seed=4)
        await arm.run(2.0, HOME + 200)
        assert arm.faults() == {}
        assert arm.at(HOME + 200, ALL)
        counters = arm.bus.counters()
        assert sum(c.missed_cycles for c in counters.servos.values()) < 0.05 * 4 * 200

    story(play)


# One servo.


def test_a_servo_that_falls_silent_is_a_fault_in_time_and_the_others_follow() -> None:
    async def play(arm: Arm) -> None:
        arm.emulator[2].silenced = True
        cycles = await arm.run(1.0, HOME + 100, until=lambda: arm.faults() == {2: 0})
        assert cycles == arm.config.silent_after
        await arm.run(1.0, HOME + 100)
        assert arm.at(HOME + 100, ALL), "it still hears"
        arm.emulator[2].silenced = False
        await arm.run(1.0, HOME, until=lambda: arm.faults() == {})
        await arm.run(1.0, HOME)
        assert arm.at(HOME, ALL)

    story(play)


def test_a_stuck_horn_ends_in_an_overload_seen_in_the_same_cycle() -> None:
    async def play(arm: Arm) -> None:
        servo_faults.seize(arm.emulator[3])
        shut_down = arm.emulator[3].peek
        await arm.run(8.0, HOME + 800, until=lambda: bool(shut_down(ct.HARDWARE_ERROR_STATUS)))
        cycles = await arm.run(1.0, HOME + 800, until=lambda: bool(arm.faults()))
        assert cycles == 1
        assert arm.faults() == {3: HardwareError.OVERLOAD}
        assert not arm.states[2].torque, "a shutdown drops the torque, and it is known at once"
        await arm.run(3.0, HOME + 400)
        assert arm.at(HOME + 400, ALL - {3})
        servo_faults.set_free(arm.emulator[3])
        with pytest.raises(ExceptionGroup) as refused:
            await arm.bus.torque(True)
        assert [(f.servo, f.bits) for f in refused.value.exceptions if isinstance(f, DeviceFault)] == [(3, 32)]
        before = arm.emulator[3].motor.position
        await arm.meanwhile(arm.bus.recover(), HOME + 400)
        assert arm.states[2].ready
        assert abs(arm.emulator[3].motor.position - before) < 40.0, "nothing jumps when the torque comes on"
        await arm.run(2.0, HOME + 400)
        assert arm.at(HOME + 400, ALL)

    story(play)


def test_a_servo_that_overheats_shuts_down_and_comes_back_only_when_it_has_cooled() -> None:
    async def play(arm: Arm) -> None:
        arm.emulator[1].warm(75.0)
        await arm.run(0.1, HOME + 50, until=lambda: arm.faults() == {1: HardwareError.OVERHEATING})
        assert arm.states[0].temperature > 70.0
        with pytest.raises(ExceptionGroup, match="recover: 1 of the servos"):
            await arm.meanwhile(arm.bus.recover(), HOME + 50)
        await arm.run(1.0, HOME + 50)
        assert 1 in arm.faults(), "still too hot"
        assert arm.at(HOME + 50, ALL - {1})
        arm.emulator[1].warm(40.0)
        await arm.meanwhile(arm.bus.recover(), HOME + 50)
        await arm.run(2.0, HOME + 50)
        assert arm.faults() == {}
        assert arm.at(HOME + 50, ALL)

    story(play)


@pytest.mark.parametrize("away", [-5000, 5000])
def test_a_servo_that_shut_down_more_than_a_turn_from_its_zero_is_found_where_it_stood(away: int) -> None:
    async def play(arm: Arm) -> None:
        await arm.run(4.0, HOME + away)
        arm.emulator[4].trip(HardwareError.OVERLOAD)
        await arm.run(0.2, HOME + away)
        assert arm.faults() == {4: HardwareError.OVERLOAD}
        await arm.meanwhile(arm.bus.recover(), HOME + away)
        await arm.run(0.5, HOME + away)
        assert arm.faults() == {}
        assert arm.at(HOME + away, ALL), "a turn nearer to its zero, it would have wound its tendon by that turn"
        assert arm.states[3].position == pytest.approx(HOME + away, abs=20)

    story(play)


def test_a_servo_that_is_still_hot_is_not_rebooted_so_that_it_knows_its_turns_when_it_has_cooled() -> None:
    async def play(arm: Arm) -> None:
        away = HOME + 5000
        await arm.run(4.0, away)
        arm.emulator[2].warm(90.0)
        await arm.run(0.3, away, until=lambda: arm.faults() == {2: HardwareError.OVERHEATING})
        with pytest.raises(ExceptionGroup) as refused:
            await arm.meanwhile(arm.bus.recover(), away)
        assert "still" in str(refused.value.exceptions[0])
        assert arm.bus.counters().servos[2].power_losses == 0
        arm.emulator[2].warm(40.0)
        await arm.run(0.1, away)
        await arm.meanwhile(arm.bus.recover(), away)
        await arm.run(0.5, away)
        assert arm.faults() == {}
        assert arm.at(away, ALL), "and not a turn nearer to its zero"

    story(play)


def test_a_servo_that_restarts_by_itself_is_not_believed_and_the_others_go_on() -> None:
    async def play(arm: Arm) -> None:
        arm.emulator[4].reboot()
        await arm.run(2.0, HOME + 300)
        assert arm.faults() == {4: 0}
        assert arm.states[3].turns_lost
        assert not arm.states[3].torque
        assert arm.at(HOME + 300, ALL - {4})
        assert arm.at(HOME, {4})
        await arm.bus.accept_position(4)
        await arm.run(2.0, HOME + 300)
        assert arm.faults() == {}
        assert arm.at(HOME + 300, ALL)

    story(play)


# Power.


@pytest.mark.parametrize("turned", [0.0, 3.0 * 4096 + 300.0])
def test_turns_that_were_lost_with_the_power_are_found_again_only_when_told(turned: float) -> None:
    async def play(arm: Arm) -> None:
        arm.emulator.set_power(on=False)
        await arm.run(0.5, HOME)
        assert set(arm.faults()) == ALL
        for servo in arm.emulator.servos:
            servo.motor.position += turned  # the arm let out its tendons
        arm.emulator.set_power(on=True)
        await arm.run(2.0, HOME + 100)
        assert arm.faults() == dict.fromkeys(ALL, 0)
        assert all(state.turns_lost and not state.ready for state in arm.states)
        assert arm.at(HOME + turned, ALL), "nothing moved"
        for i in arm.config.ids:
            await arm.bus.accept_position(i, round(HOME + turned))
        await arm.run(1.0, round(HOME + turned))
        assert arm.faults() == {}
        assert [state.position for state in arm.states] == pytest.approx([HOME + turned] * 4, abs=20)

    story(play)


@pytest.mark.parametrize(
    ("stood", "turned", "found"),
    [
        (-6270, 0.0, -6270),  # a tendon let out, that hangs slack since
        (-6270, 40.0, -6230),
        (-6270, 6270.0, 0),  # a person has wound it up
        (6804, -6804.0, 0),  # a tendon taken in, that the arm has drawn out as it straightened
        (4096, -4096.0, 0),  # the same: the angle alone says nothing of a turn
        (265, -265.0, 0),
    ],
)
def test_a_servo_that_had_no_power_is_found_where_its_tendon_was_let_out_or_else_near_its_zero(
    stood: int, turned: float, found: float
) -> None:
    async def play(arm: Arm) -> None:
        stands = HOME + arm.config.directions[3] * stood
        turns = arm.config.directions[3] * turned
        await arm.run(6.0, stands)
        arm.emulator[4].set_power(on=False)
        await arm.run(10.0, stands, until=lambda: arm.states[3].silent)
        arm.emulator[4].motor.position += turns
        await arm.run(1.0)
        arm.emulator[4].set_power(on=True)
        await arm.run(1.0)
        assert arm.states[3].turns_lost
        assert arm.at(stands + turns, {4}), "nothing moved"
        await arm.meanwhile(arm.bus.recover(), stands)
        assert arm.states[3].position == pytest.approx(HOME + arm.config.directions[3] * found, abs=20)

    story(play)


def test_where_a_servo_stood_is_what_it_said_while_its_turns_were_known() -> None:
    record = ServoRecord(1, 0)

    def hear(position: int) -> int | None:
        record.take(Feedback(0, 0, 0, 0, 0, 0, 0, 0)._replace(position=position), 0.01)
        return record.stood

    assert hear(100) is None, "nobody has decided yet whether it knows its turns"
    record.set_up = True
    assert hear(110) == 110
    assert hear(3000) == 110, "a jump"
    record.turns_lost = False
    assert hear(3010) == 3010
    record.lose_power()
    assert hear(1000) == 3010
    record.set_up = True
    assert hear(1001) == 3010


def test_a_brown_out_warns_and_a_deep_one_is_a_loss_of_power() -> None:
    async def play(arm: Arm) -> None:
        low = asyncio.create_task(servo_faults.brown_out(arm.emulator, 5.5, 0.2))
        await arm.run(0.3, HOME, until=lambda: arm.faults() == dict.fromkeys(ALL, int(HardwareError.INPUT_VOLTAGE)))
        assert all(state.torque for state in arm.states), "too low a voltage is no reason to let go"
        assert all(state.voltage < 6.0 for state in arm.states)
        await low
        await servo_faults.brown_out(arm.emulator, 3.0, 0.3)
        await arm.run(2.0, HOME)
        assert all(state.turns_lost and not state.torque for state in arm.states)
        await arm.meanwhile(arm.bus.recover(), HOME)
        await arm.run(1.0, HOME)
        assert arm.faults() == {}

    story(play)


# The bus.


def test_cable_out_and_in_again_goes_on_where_it_was() -> None:
    async def play(arm: Arm) -> None:
        arm.unplug()
        await arm.run(0.5, HOME + 100)
        assert set(arm.faults()) == ALL
        arm.plug_in()
        await arm.run(3.0, HOME + 100, until=lambda: not any(state.silent for state in arm.states))
        assert all(state.tripped and not state.turns_lost for state in arm.states)
        assert arm.at(HOME, ALL)
        await arm.bus.start()
        await arm.run(1.0, HOME + 100)
        assert arm.faults() == {}
        assert arm.at(HOME + 100, ALL)

    story(play)


def test_re_arming_neither_opens_the_port_nor_waits_for_a_silent_servo() -> None:
    async def play(arm: Arm) -> None:
        await asyncio.sleep(0.5)  # the daemon is stopped, and the watchdogs trip
        await arm.run(1.0, HOME, until=lambda: all(state.tripped for state in arm.states))
        arm.emulator[2].silenced = True
        await arm.run(1.0, HOME, until=lambda: arm.states[1].silent)
        await arm.bus.rearm()
        await arm.run(0.05, HOME)
        assert [state.tripped for state in arm.states] == [False, True, False, False]
        loop, opened = asyncio.get_running_loop(), []

        async def dead(_: Receiver) -> Transport:
            opened.append(loop.time())
            await asyncio.sleep(3.0)  # a bridge that does not answer
            raise LinkError("no answer")

        arm.bus._opener = dead
        arm.unplug()
        before = loop.time()
        await arm.bus.rearm()
        assert loop.time() == before
        await arm.run(0.5)
        before, n = loop.time(), len(opened)
        await arm.bus.rearm()
        assert (loop.time(), len(opened)) == (before, n)
        assert not arm.bus.connected

    story(play)


def test_a_master_that_dies_leaves_servos_that_hold_and_its_successor_takes_over() -> None:
    async def play(arm: Arm) -> None:
        await arm.run(0.1, HOME + 2000)  # on the way
        await asyncio.sleep(1.0)
        assert [s.peek(ct.BUS_WATCHDOG) for s in arm.emulator.servos] == [ct.WATCHDOG_TRIPPED] * 4
        assert [s.peek(ct.TORQUE_ENABLE) for s in arm.emulator.servos] == [1] * 4
        stopped = arm.emulator.positions()
        assert all(position < HOME + 1900 for position in stopped)
        await arm.bus.stop(limp=False)
        successor = ServoBus(arm.pipe.opener(1), CONFIG)
        arm.bus = successor
        await successor.start()
        await arm.run(0.1)
        assert arm.faults() == {}
        assert not any(state.turns_lost for state in arm.states), "torque on: their turns were never lost"
        assert arm.emulator.positions() == pytest.approx(stopped, abs=30)

    story(play)


# Homing at the start.


def start(prepare: Callable[[Arm], None], config: ServosConfig = CONFIG) -> list[tuple[ServoState, ...]]:
    """What two daemons see that start one after the other."""

    async def main() -> list[tuple[ServoState, ...]]:
        arm = Arm(config)
        prepare(arm)
        arm.plug_in()
        await arm.wire.wait_ready()
        seen = []
        for _ in range(2):
            arm.bus = ServoBus(arm.pipe.opener(1), config)
            await arm.bus.start()
            await arm.run(0.1)
            await arm.bus.stop(limp=False)
            seen.append(arm.states)
        arm.unplug()
        return seen

    return run_simulated(main())


def test_a_zero_several_turns_up_is_found_after_every_power_up() -> None:
    config = dataclasses.replace(CONFIG, zero_ticks=(9000, -5000, 2048, 100))
    for states in start(lambda arm: None, config):
        assert [state.position for state in states] == [9000, -5000, 2048, 100]
        assert not any(state.turns_lost for state in states)


def test_a_servo_far_from_its_zero_at_power_up_is_not_believed_by_this_daemon_nor_by_the_next() -> None:
    def turn(arm: Arm) -> None:
        arm.emulator[2].motor.position += 900.0

    for states in start(turn):
        assert [state.turns_lost for state in states] == [False, True, False, False]


def test_beside_a_servo_that_holds_nothing_is_taken_for_granted() -> None:
    def hold(arm: Arm) -> None:
        arm.emulator[4].poke(ct.TORQUE_ENABLE, 1)

    for states in start(hold):
        assert [state.turns_lost for state in states] == [True, True, True, False]


def test_a_jump_seen_by_a_daemon_that_was_restarted_is_known_to_the_next_one() -> None:
    async def main() -> None:
        arm = Arm(CONFIG)
        arm.plug_in()
        passing = asyncio.create_task(keep_time(arm.emulator))
        await arm.wire.wait_ready()
        for life, jump in enumerate((0.0, 3000.0, 0.0)):
            arm.bus = ServoBus(arm.pipe.opener(1), CONFIG)
            running = asyncio.create_task(arm.bus.run())
            await arm.run(0.5)
            assert [state.turns_lost for state in arm.states] == [life == 2, False, False, False]
            arm.emulator[1].motor.position += jump
            await arm.run(0.6)
            assert [servo.peek(ct.LED) for servo in arm.emulator.servos] == [int(life == 0), 1, 1, 1]
            running.cancel()
            await arm.bus.stop(limp=False)
        passing.cancel()

    run_simulated(main())


def test_homing_needs_the_torque_off() -> None:
    async def play(arm: Arm) -> None:
        with pytest.raises(DeviceFault, match="torque is on"):
            await arm.bus.accept_position(1)
        with pytest.raises(KeyError):
            await arm.bus.accept_position(9)

    story(play)


# Any order of them.

FAULTS: dict[str, Callable[[Arm, int], None]] = {
    "silence": lambda arm, i: setattr(arm.emulator.servos[i], "silenced", True),
    "voice": lambda arm, i: setattr(arm.emulator.servos[i], "silenced", False),
    "overload": lambda arm, i: arm.emulator.servos[i].trip(HardwareError.OVERLOAD),
    "restart": lambda arm, i: arm.emulator.servos[i].reboot(),
    "noise": lambda arm, _: setattr(arm.wire, "to_master", ByteNoise(0.01, 0.01, seed=1)),
    "quiet": lambda arm, _: setattr(arm.wire, "to_master", lambda data: data),
}


@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(st.tuples(st.sampled_from(sorted(FAULTS)), st.integers(0, 3), st.floats(0.0, 0.3)), max_size=6),
    st.integers(0, 3),
)
def test_whatever_befalls_others_a_healthy_servo_is_commanded_and_limp_reaches_all(
    events: list[tuple[str, int, float]], healthy: int
) -> None:
    async def play(arm: Arm) -> None:
        goal = HOME
        for fault, i, wait in events:
            if i != healthy:
                FAULTS[fault](arm, i)
            goal += 20
            await arm.run(wait + PERIOD_S, goal)
        goal += 20
        await arm.run(0.6, goal)
        well = arm.states[healthy]
        assert well.fault is None
        assert arm.emulator.servos[healthy].peek(ct.GOAL_POSITION) == goal
        assert arm.at(goal, {healthy + 1})
        for state, servo in zip(arm.states, arm.emulator.servos, strict=True):
            if servo.alert and not servo.silenced and servo.awake:
                assert state.fault is not None, "a fault is told"
        arm.wire.to_master = lambda data: data
        silent = {s.id for s in arm.emulator.servos if s.silenced}
        unconfirmed: set[int] = set()
        try:
            await arm.bus.limp()
        except* DeviceFault as faults:
            unconfirmed = {f.servo for f in faults.exceptions if isinstance(f, DeviceFault)}
        assert unconfirmed <= silent
        assert [s.peek(ct.TORQUE_ENABLE) for s in arm.emulator.servos] == [0] * 4

    story(play)
