"""The daemon and its tendons' calibration: reported, flown on, and READY refused when it no longer fits."""

import asyncio
import dataclasses
from pathlib import Path
from typing import Any

import pytest

from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import Config, load
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibration import VERSION, ServoIdentity, TendonCalibration, TendonZero
from arm_companion.mission.facts import CalibrationState
from arm_companion.protocol.dialect import mav
from arm_companion.record.recorder import MemoryRecorder
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.memory import MemoryPipe
from tests.conftest import MavlinkPeer


def write(directory: Path, config: Config, **changes: Any) -> None:
    zeros = tuple(
        TendonZero(ServoIdentity(i, 1060, 46), 1, zero + 30 * i, 0.0004, 5.0, 30.0)
        for i, zero in zip(config.servos.ids, config.servos.zero_ticks, strict=True)
    )
    made = TendonCalibration(
        VERSION, SIMULATED_EPOCH_S, "2026-01-01", "0.1.0", 0.01, 4.0, config.arm.tendons.angles_deg, (), zeros
    )
    files.save(directory / files.TENDONS, dataclasses.replace(made, **changes))


class Aloft:
    """A daemon, its servos, and a ground station; no vehicle."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.servos = ServoEmulator(config.servos, seed=2)
        self.recorder = MemoryRecorder()
        self.ground = MavlinkPeer(255, 190)
        self.texts: list[str] = []

    async def fly(self, *orders: int) -> list[int]:
        """Results of orders, one after the other, 2 s apart."""
        nobody, bus_pipe = MemoryPipe(), MemoryPipe()
        bus = EmulatedBus(self.servos, self.config.servos)
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        pipes = {"autopilot": nobody.opener(0), "ground": self.ground.pipe.opener(0)}
        daemon = Daemon(self.config, Openers(pipes, bus_pipe.opener(1)), clock, ServiceManager(""), self.recorder)
        await self.ground.open()
        stop = asyncio.Event()
        async with asyncio.TaskGroup() as group:
            world = [
                group.create_task(keep_time(self.servos, 0.004)),
                group.create_task(bus.serve_memory(bus_pipe.opener(0))),
            ]
            running = group.create_task(daemon.run(stop))
            await asyncio.sleep(1.0)
            for order in orders:
                self.ground.heartbeat(mav.MAV_AUTOPILOT_INVALID, 0)
                self.ground.command(order)
                await asyncio.sleep(2.0)
            stop.set()
            await running
            for task in world:
                task.cancel()
        return [ack.result for ack in self.ground.all("COMMAND_ACK") if ack.result != mav.MAV_RESULT_IN_PROGRESS]

    @property
    def seen(self) -> list[CalibrationState]:
        """States of the calibration, one after the other."""
        states = [record.facts.calibration.state for record in self.recorder.records]
        return [s for i, s in enumerate(states) if i == 0 or states[i - 1] is not s]

    def text(self) -> str:
        return "".join(message.text for message in self.ground.all("STATUSTEXT"))


def daemon(directory: Path | str, *settings: str) -> Aloft:
    where = f"calibration.directory={directory}"
    # half the cycles are enough here, and cost half
    return Aloft(load("sim.toml", (where, "vehicle.system_id=1", "rates.cycle_hz=50", *settings)))


READY, CLEAR = mav.MAV_CMD_ARM_READY, mav.MAV_CMD_ARM_CLEAR_ERRORS


def test_without_a_calibration_the_shipped_configuration_flies_and_says_so() -> None:
    arm = daemon("")
    assert run_simulated(arm.fly(READY)) == [mav.MAV_RESULT_ACCEPTED]
    assert arm.ground.all("ARM_STATUS")[-1].calibration == mav.ARM_CALIBRATION_MISSING


def test_where_one_is_required_ready_is_refused_without() -> None:
    arm = daemon("", "calibration.tendons=required")
    assert run_simulated(arm.fly(READY)) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert "no calibration of the tendons" in arm.text()


def test_a_calibration_that_fits_is_flown_on_and_where_the_servos_stand_is_kept(tmp_path: Path) -> None:
    arm = daemon(tmp_path, "calibration.tendons=required")
    write(tmp_path, arm.config)
    assert run_simulated(arm.fly(READY)) == [mav.MAV_RESULT_ACCEPTED]
    assert arm.seen == [CalibrationState.UNKNOWN, CalibrationState.VALID]
    status = arm.ground.all("ARM_STATUS")[-1]
    assert status.calibration == mav.ARM_CALIBRATION_VALID
    assert status.flags & mav.ARM_FLAG_CALIBRATED
    stand = [servo.motor.position for servo in arm.servos.servos]
    assert stand == pytest.approx([2048 + 30 * i for i in (1, 2, 3, 4)], abs=12), "ready is at the calibrated zeros"
    assert files.parked(str(tmp_path)) == pytest.approx({i: 2048 + 30 * i for i in (1, 2, 3, 4)}, abs=12)


def test_a_servo_that_was_turned_without_power_is_refused_until_somebody_has_looked(tmp_path: Path) -> None:
    first = daemon(tmp_path)
    write(tmp_path, first.config)
    assert run_simulated(first.fly(READY)) == [mav.MAV_RESULT_ACCEPTED]
    second = daemon(tmp_path)
    for new, old in zip(second.servos.servos, first.servos.servos, strict=True):
        new.motor.position = old.motor.position
    second.servos[3].motor.position += 300
    for servo in second.servos.servos:  # they start afresh from there
        servo.reboot()
    refused, cleared, accepted = run_simulated(second.fly(READY, CLEAR, READY))
    assert refused == mav.MAV_RESULT_TEMPORARILY_REJECTED
    assert "servo 3 (tendon 3) was turned by" in second.text()
    assert (cleared, accepted) == (mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_ACCEPTED)
    assert second.seen[-1] is CalibrationState.VALID
    assert CalibrationState.STALE in second.seen


def test_servos_that_come_back_where_they_were_are_known_again(tmp_path: Path) -> None:
    first = daemon(tmp_path)
    write(tmp_path, first.config)
    run_simulated(first.fly(READY))
    second = daemon(tmp_path)
    for new, old in zip(second.servos.servos, first.servos.servos, strict=True):
        new.motor.position = old.motor.position + 4096 * 2  # two turns on, as far as the servo itself can tell
        new.reboot()
    assert run_simulated(second.fly(READY)) == [mav.MAV_RESULT_ACCEPTED]
    assert second.seen == [CalibrationState.UNKNOWN, CalibrationState.VALID]


def test_another_firmware_and_a_damaged_file_keep_the_arm_on_the_ground(tmp_path: Path) -> None:
    arm = daemon(tmp_path)
    write(tmp_path, arm.config)
    arm.servos[2].values[6] = 47
    assert run_simulated(arm.fly(READY)) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert "firmware 47" in arm.text()
    assert arm.ground.all("ARM_STATUS")[-1].errors & mav.ARM_ERROR_NOT_CALIBRATED
    (tmp_path / files.TENDONS).write_text("{", encoding="utf-8")
    arm = daemon(tmp_path)
    assert run_simulated(arm.fly(READY)) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert "damaged" in arm.text()
