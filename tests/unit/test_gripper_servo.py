"""The gripper's servo, the fifth on the bus: set up with its own limits, never lost, and telling what it closed on."""

import asyncio
import dataclasses
import random
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.config.schema import Config
from arm_companion.drivers.gripper_servo import GripperServo, own_settings
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_health import ServoState
from arm_companion.mission.gripper_facts import GripperAction, GripperOrder, JawState
from arm_companion.protocol import control_table as ct
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.sim.servo_faults import seize, set_free
from arm_companion.transport.memory import MemoryPipe

CONFIG = load("sim_gripper.toml")
OPEN, CLOSE = GripperOrder(GripperAction.OPEN, 1.0), GripperOrder(GripperAction.CLOSE, 2.0)
STAY = (None,) * 4
PERIOD_S = 0.01


class Rig:
    """Five servos, their bus, and the gripper's driver."""

    def __init__(self, config: Config) -> None:
        self.emulator = ServoEmulator(config.bus_servos, seed=2)
        self.wire = EmulatedBus(self.emulator, config.bus_servos)
        self.pipe = MemoryPipe(latency_s=0.0001)
        self.bus = ServoBus(
            self.pipe.opener(1), config.bus_servos, rng=random.Random(1), own_settings=own_settings(config)
        )
        self.gripper = GripperServo(config.gripper)
        self.states: tuple[ServoState, ...] = ()

    @property
    def fifth(self) -> Any:
        return self.emulator[CONFIG.gripper.servo_id]

    async def cycles(self, seconds: float, order: GripperOrder | None, *, torque: bool = True) -> JawState:
        """The daemon's cycle for a while; the jaws after it."""
        for _ in range(round(seconds / PERIOD_S)):
            self.states = await self.bus.read()
            await self.bus.write((*STAY, *self.gripper.goals(order, 0.0)), torque=torque)
            await asyncio.sleep(PERIOD_S)
        jaws = self.gripper.state(self.states, 0.0).jaws
        assert jaws is not None
        return jaws


def play(
    story: Callable[[Rig], Awaitable[None]], config: Config = CONFIG, prepare: Callable[[Rig], None] = lambda _: None
) -> None:
    async def main() -> None:
        rig = Rig(config)
        prepare(rig)
        tasks = [
            asyncio.create_task(rig.wire.serve_memory(rig.pipe.opener(0))),
            asyncio.create_task(keep_time(rig.emulator)),
        ]
        await rig.wire.wait_ready()
        tasks.append(asyncio.create_task(rig.bus.run()))
        await asyncio.sleep(0.5)
        try:
            await story(rig)
        finally:
            for task in tasks[::-1]:
                task.cancel()
            await rig.bus.stop(limp=False)

    run_simulated(main())


def test_it_is_set_up_with_its_own_speed_and_force_and_the_others_with_theirs() -> None:
    async def story(rig: Rig) -> None:
        speeds = [servo.peek(ct.PROFILE_VELOCITY) for servo in rig.emulator.servos]
        assert len(set(speeds[:4])) == 1
        assert speeds[4] == round(CONFIG.gripper.speed_rad_per_s / ct.VELOCITY_UNIT_RAD_PER_S)
        forces = [servo.peek(ct.GOAL_PWM) for servo in rig.emulator.servos]
        assert forces == [ct.PWM_FULL] * 4 + [round(CONFIG.gripper.pwm * ct.PWM_FULL)]

    play(story)


def test_a_force_over_the_servos_own_limit_is_that_limit() -> None:
    async def story(rig: Rig) -> None:
        assert rig.fifth.peek(ct.GOAL_PWM) == 200
        assert not (await rig.cycles(0.1, None)).error_bits

    play(story, prepare=lambda rig: rig.fifth.poke(ct.PWM_LIMIT, 200))


@pytest.mark.parametrize("ticks", [0, 900, 3900])
def test_wherever_it_stands_after_power_up_its_turn_is_known(ticks: int) -> None:
    def prepare(rig: Rig) -> None:
        rig.fifth.motor.position = float(ticks)
        rig.emulator[1].poke(ct.TORQUE_ENABLE, 1)  # the arm holds something already

    async def story(rig: Rig) -> None:
        jaws = await rig.cycles(0.1, None)
        assert jaws.homed
        assert jaws.closed == pytest.approx((ticks - 1024) / 2048, abs=0.01)
        assert (await rig.cycles(2.5, CLOSE)).closed > 0.96

    play(story, prepare=prepare)


@pytest.mark.parametrize(("open_ticks", "closed_ticks"), [(1024, 3072), (3072, 1024)])
def test_jaws_open_and_close_either_way_round(open_ticks: int, closed_ticks: int) -> None:
    gripper = dataclasses.replace(CONFIG.gripper, open_ticks=open_ticks, closed_ticks=closed_ticks)
    config = dataclasses.replace(CONFIG, gripper=gripper)

    async def story(rig: Rig) -> None:
        start = await rig.cycles(0.1, None)
        assert start.closed == pytest.approx(0.5, abs=0.01)
        assert (await rig.cycles(1.5, OPEN)).closed < 0.05
        closing = await rig.cycles(0.2, CLOSE)
        assert closing.speed > 0.3
        shut = await rig.cycles(1.5, CLOSE)
        assert shut.closed > 0.96
        assert abs(shut.speed) < 0.1
        assert [servo.motor.position for servo in rig.emulator.servos[:4]] == pytest.approx([2048.0] * 4, abs=2.0)

    play(story, config)


@pytest.mark.parametrize(("open_ticks", "closed_ticks"), [(1024, 3072), (3072, 1024)])
def test_what_is_between_the_jaws_shows_as_load_within_the_limit(open_ticks: int, closed_ticks: int) -> None:
    gripper = dataclasses.replace(CONFIG.gripper, open_ticks=open_ticks, closed_ticks=closed_ticks)

    async def story(rig: Rig) -> None:
        await rig.cycles(1.0, OPEN)
        await rig.cycles(0.2, CLOSE)
        seize(rig.fifth)
        jaws = await rig.cycles(5.0, CLOSE)
        assert jaws.closed < 0.8
        assert CONFIG.gripper.load_min < jaws.load < CONFIG.gripper.pwm + 0.05
        assert not jaws.error_bits, "it may hold like this for long"

    play(story, dataclasses.replace(CONFIG, gripper=gripper))


def test_without_an_order_it_stays_as_it_is() -> None:
    async def story(rig: Rig) -> None:
        closed = await rig.cycles(1.5, CLOSE)
        before = rig.fifth.motor.position
        after = await rig.cycles(1.0, None)
        assert closed.closed == pytest.approx(after.closed, abs=0.01)
        assert rig.fifth.motor.position == pytest.approx(before, abs=2.0)

    play(story)


def test_after_a_loss_of_power_it_closes_again_by_itself() -> None:
    async def story(rig: Rig) -> None:
        await rig.cycles(1.0, OPEN)
        await rig.cycles(0.2, CLOSE)
        seize(rig.fifth)
        assert (await rig.cycles(1.0, CLOSE)).load > CONFIG.gripper.load_min
        rig.fifth.set_power(on=False)
        rig.fifth.set_power(on=True)
        jaws = await rig.cycles(2.5, CLOSE)
        assert (jaws.homed, jaws.torque, jaws.ready, jaws.silent) == (True, True, True, False)
        assert jaws.load > CONFIG.gripper.load_min
        assert rig.bus.counters().servos[rig.fifth.id].power_losses == 1
        assert rig.fifth.peek(ct.GOAL_PWM) == round(CONFIG.gripper.pwm * ct.PWM_FULL)

    play(story)


def test_a_watchdog_trip_lets_it_stand_and_the_next_start_close_on() -> None:
    async def story(rig: Rig) -> None:
        await rig.cycles(1.0, OPEN)
        await rig.cycles(0.2, CLOSE)
        seize(rig.fifth)
        await rig.cycles(1.0, CLOSE)
        await asyncio.sleep(CONFIG.servos.watchdog_s + 0.5)  # nobody speaks on the bus
        stood = await rig.cycles(0.5, CLOSE)
        assert not stood.ready
        await rig.bus.start()
        jaws = await rig.cycles(1.0, CLOSE)
        assert jaws.ready
        assert jaws.load > CONFIG.gripper.load_min
        set_free(rig.fifth)
        assert (await rig.cycles(1.5, CLOSE)).closed > 0.96, "what it held is gone"

    play(story)


def test_a_silent_gripper_keeps_no_goals_from_the_tendons() -> None:
    async def story(rig: Rig) -> None:
        await rig.cycles(0.2, CLOSE)
        rig.fifth.silenced = True
        jaws = await rig.cycles(1.0, CLOSE)
        assert jaws.silent
        for _ in range(50):
            await rig.bus.read()
            await rig.bus.write((2148, 2048, 2048, 2048, None), torque=True)
            await asyncio.sleep(PERIOD_S)
        assert rig.emulator[1].motor.position == pytest.approx(2148.0, abs=10.0)

    play(story)


def test_other_zeros_of_the_tendons_are_none_of_its_business() -> None:
    async def story(rig: Rig) -> None:
        rig.bus.renew_zeros((2000, 2001, 2002, 2003))
        rig.fifth.motor.position = 3000.0
        await rig.cycles(0.1, None, torque=False)
        await rig.bus.accept_position(rig.fifth.id)
        assert (await rig.cycles(0.1, None, torque=False)).closed == pytest.approx((3000 - 1024) / 2048, abs=0.01)

    play(story)
