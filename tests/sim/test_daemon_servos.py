"""The whole daemon on emulated servos and a ground station, without a vehicle: servo faults and their way out."""

import asyncio
import dataclasses
import itertools
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from arm_companion import app
from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import load
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase
from arm_companion.protocol import control_table as ct
from arm_companion.protocol.control_table import HardwareError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message
from arm_companion.record.recorder import MemoryRecorder
from arm_companion.record_codec import dumps
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.memory import MemoryPipe


class Field:
    """A daemon that runs, its servos, and whoever commands it."""

    def __init__(self, ground: Any) -> None:
        config = load("sim.toml")
        self.config = dataclasses.replace(
            config,
            vehicle=dataclasses.replace(config.vehicle, system_id=1),
            servos=dataclasses.replace(config.servos, reply_timeout_s=0.008, silent_after=10, watchdog_s=0.2),
        )
        self.emulator = ServoEmulator(self.config.servos, seed=2)
        self.wire = EmulatedBus(self.emulator, self.config.servos)
        self.pipe = MemoryPipe(latency_s=0.0001)
        self.ground = ground
        self.recorder = MemoryRecorder()
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        links = {"autopilot": MemoryPipe().opener(0), "ground": ground.pipe.opener(0)}
        self.daemon = Daemon(self.config, Openers(links, self.pipe.opener(1)), clock, ServiceManager(""), self.recorder)

    def phase(self) -> Phase:
        return self.recorder.records[-1].state.phase

    def clear_errors(self) -> None:
        self.ground.received.clear()
        self.ground.command(mav.MAV_CMD_ARM_CLEAR_ERRORS)

    def results(self) -> list[int]:
        return [m.result for m in self.ground.all("COMMAND_ACK") if m.command == mav.MAV_CMD_ARM_CLEAR_ERRORS]

    def words(self) -> str:
        return "".join(m.text for m in self.ground.all("STATUSTEXT"))

    def status(self) -> Message:
        return self.ground.all("ARM_STATUS")[-1]

    async def heartbeat(self) -> int:
        """What the next one says of the system."""
        self.ground.received.clear()
        await asyncio.sleep(1.1)
        return int(self.ground.all("HEARTBEAT")[-1].system_status)


def play(ground: Any, story: Callable[[Field], Coroutine[Any, Any, None]]) -> None:
    async def main() -> None:
        field = Field(ground)
        await ground.open()
        stop = asyncio.Event()
        tasks = [
            asyncio.create_task(field.wire.serve_memory(field.pipe.opener(0))),
            asyncio.create_task(keep_time(field.emulator)),
        ]
        await field.wire.wait_ready()
        running = asyncio.create_task(field.daemon.run(stop))
        await asyncio.sleep(1.0)
        assert field.phase() is Phase.STOWED
        try:
            await story(field)
        finally:
            stop.set()
            await running
            for task in tasks:
                task.cancel()
            ground.transport.close()
        assert field.daemon.failures == 0

    run_simulated(main())


def test_a_loss_of_power_ends_with_clear_errors_and_without_a_restart(ground_peer: Any) -> None:
    async def story(field: Field) -> None:
        field.emulator.set_power(on=False)
        await asyncio.sleep(0.5)
        field.emulator.set_power(on=True)
        await asyncio.sleep(2.0)
        assert field.status().errors & mav.ARM_ERROR_SERVO_FAULT
        health = field.ground.all("ARM_SERVOS")[-1]
        assert (health.turns_lost, health.ready, list(health.power_losses)) == (0b1111, 0, [1] * 4)
        field.ground.command(mav.MAV_CMD_ARM_READY)
        await asyncio.sleep(0.3)
        assert field.phase() is Phase.STOWED
        assert "lost its turns" in field.words()
        field.clear_errors()
        await asyncio.sleep(2.0)
        assert field.results() == [mav.MAV_RESULT_IN_PROGRESS, mav.MAV_RESULT_ACCEPTED]
        assert not field.status().errors & mav.ARM_ERROR_SERVO_FAULT
        assert [s.peek(ct.LED) for s in field.emulator.servos] == [1] * 4
        field.ground.command(mav.MAV_CMD_ARM_READY)
        await asyncio.sleep(3.0)
        assert field.phase() in {Phase.READYING, Phase.READY}
        assert [s.peek(ct.TORQUE_ENABLE) for s in field.emulator.servos] == [1] * 4
        field.clear_errors()
        await asyncio.sleep(0.2)
        assert field.results() == [mav.MAV_RESULT_TEMPORARILY_REJECTED], "not while the arm is in use"

    play(ground_peer, story)


def test_a_shut_down_servo_is_rebooted_and_a_dead_one_named(ground_peer: Any) -> None:
    async def story(field: Field) -> None:
        assert await field.heartbeat() == mav.MAV_STATE_STANDBY
        field.emulator[2].trip(HardwareError.OVERLOAD)
        await asyncio.sleep(0.3)
        assert field.status().errors & mav.ARM_ERROR_OVERLOAD
        assert await field.heartbeat() == mav.MAV_STATE_CRITICAL
        field.clear_errors()
        await asyncio.sleep(3.0)
        assert field.results() == [mav.MAV_RESULT_IN_PROGRESS, mav.MAV_RESULT_ACCEPTED]
        assert field.emulator[2].peek(ct.HARDWARE_ERROR_STATUS) == 0
        assert await field.heartbeat() == mav.MAV_STATE_STANDBY
        assert not field.ground.all("SYS_STATUS"), "the vehicle's battery is taken from it"
        field.emulator[4].silenced = True
        await asyncio.sleep(1.0)
        field.clear_errors()
        await asyncio.sleep(8.0)
        assert field.results() == [mav.MAV_RESULT_IN_PROGRESS, mav.MAV_RESULT_FAILED]
        assert "does not answer" in field.words()

    play(ground_peer, story)


def test_clear_errors_without_errors_is_done_at_once(ground_peer: Any) -> None:
    async def story(field: Field) -> None:
        field.clear_errors()
        await asyncio.sleep(0.2)
        assert field.results()[-1] == mav.MAV_RESULT_ACCEPTED
        assert not any(record.commands.recover for record in field.recorder.records)

    play(ground_peer, story)


def test_a_fault_is_in_the_facts_of_the_very_cycle_in_which_the_bus_tells_it(ground_peer: Any) -> None:
    async def story(field: Field) -> None:
        field.emulator[3].trip(HardwareError.OVERHEATING)
        before = len(field.recorder.records)
        await asyncio.sleep(0.05)
        after = [record.facts.tendons[2].error_bits for record in field.recorder.records[before:]]
        assert after == [HardwareError.OVERHEATING] * len(after)
        assert len(after) >= 4

    play(ground_peer, story)


def test_a_cycle_that_fails_as_it_acts_is_recorded(ground_peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a bug")

    async def story(field: Field) -> None:
        config, records = field.config, field.recorder.records
        begin = len(records) - 3
        with monkeypatch.context() as broken:
            broken.setattr(field.daemon._telemetry, "publish", fail)
            await asyncio.sleep(0.05)
        await asyncio.sleep(0.05)
        assert field.daemon.failures > 2
        field.daemon.failures = 0  # they were meant
        parameters = Parameters(config, field.daemon._parameters.model)
        for record, following in itertools.pairwise(records[begin:]):
            state, commands = app.step(record.state, record.facts, record.t, parameters)
            assert commands == record.commands
            assert dumps(state) == dumps(following.state)

    play(ground_peer, story)


def test_cycles_that_fail_are_seen_in_the_heartbeat(ground_peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a bug")

    async def story(field: Field) -> None:
        with monkeypatch.context() as broken:
            broken.setattr(app, "step", fail)
            assert await field.heartbeat() == mav.MAV_STATE_CRITICAL
        assert await field.heartbeat() == mav.MAV_STATE_STANDBY
        assert field.daemon.failures > 50
        field.daemon.failures = 0  # they were meant

    play(ground_peer, story)
