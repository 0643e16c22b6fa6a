"""MAV_CMD_ARM_CALIBRATE whole: the daemon, emulated servos and the plant's arm in simulated time."""

import asyncio
import errno
from pathlib import Path

import numpy as np
import pytest

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers import recalibration
from arm_companion.drivers.calibration import TendonCalibration
from arm_companion.mission.facts import Facts
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.protocol.control_table import TICK_RAD
from arm_companion.protocol.dialect import mav
from arm_companion.record_codec import dumps, loads
from tests.conftest import MavlinkPeer
from tests.sim.on_the_ground import CALIBRATE, IN_PROGRESS, OnTheGround

ACCEPTED, DENIED, FAILED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED, mav.MAV_RESULT_FAILED
REJECTED = mav.MAV_RESULT_TEMPORARILY_REJECTED
CANCELLED = mav.MAV_RESULT_CANCELLED


@pytest.mark.scenario
def test_the_ground_station_calibrates_and_the_arm_is_ready_with_the_zeros_that_it_found(tmp_path: Path) -> None:
    """Zeros to 2 mm, tightness of opposite tendons to 0.25 mm: what the command on the bench must reach, too."""
    arm = OnTheGround(tmp_path, "calibration.tendons=required")

    async def script() -> None:
        assert await arm.order(command=mav.MAV_CMD_ARM_READY) == REJECTED, "it has no calibration"
        assert await arm.order(1, 0) == DENIED
        assert "param2 = 0: 1 confirms" in arm.text
        assert await arm.order(0, 1) == DENIED
        assert await arm.order(1, 1) == ACCEPTED
        await asyncio.sleep(1.2)
        assert await arm.order(command=mav.MAV_CMD_ARM_READY) == ACCEPTED

    daemon = arm.run(script)
    assert (daemon.failures, daemon.missed) == (0, 0)
    found = files.tendons(str(tmp_path))
    assert isinstance(found, TendonCalibration)
    m_per_tick = TICK_RAD * arm.config.arm.pulley_radius_m
    ticks = [tendon.zero_ticks for tendon in found.tendons]
    error = (np.array(ticks) - np.array(arm.arm.zeros)) * m_per_tick
    assert np.all(np.abs(error) < 4.0 * np.array([tendon.sigma for tendon in found.tendons]))
    assert max(tendon.sigma for tendon in found.tendons) < 0.0015
    assert np.all(np.abs(error[:2] + error[2:]) / 2 < 0.00025)
    assert {tendon.servo.firmware for tendon in found.tendons} == {46}
    assert [servo.motor.position for servo in arm.arm.servos.servos] == pytest.approx(ticks, abs=12), "ready is there"
    assert max(arm.pulled[4:]) < 8.0
    told = [ack.progress for ack in arm.acks(CALIBRATE) if ack.result == IN_PROGRESS]
    assert told == sorted(told)
    assert told[-1] == 99
    _flags_and_heartbeats_follow(arm)
    _replays(arm)


def _flags_and_heartbeats_follow(arm: OnTheGround) -> None:
    statuses = arm.ground.all("ARM_STATUS")
    running = [s for s in statuses if s.state == mav.ARM_STATE_CALIBRATING]
    assert {s.calibration for s in running} == {mav.ARM_CALIBRATION_RUNNING}
    assert {s.behaviour for s in running} == {mav.ARM_BEHAVIOUR_CALIBRATE}
    assert statuses[0].errors & mav.ARM_ERROR_NOT_CALIBRATED
    assert not any(s.errors & mav.ARM_ERROR_NOT_CALIBRATED for s in running)
    last = statuses[-1]
    assert last.calibration == mav.ARM_CALIBRATION_VALID
    assert last.flags & mav.ARM_FLAG_CALIBRATED
    assert not last.errors & mav.ARM_ERROR_NOT_CALIBRATED
    beats = [beat.system_status for beat in arm.ground.all("HEARTBEAT") if beat.get_srcComponent() == 192]
    order = [b for i, b in enumerate(beats) if i == 0 or beats[i - 1] != b]
    wanted = [mav.MAV_STATE_CRITICAL, mav.MAV_STATE_CALIBRATING, mav.MAV_STATE_STANDBY]
    assert [state for state in order if state != mav.MAV_STATE_BOOT] == wanted


def _replays(arm: OnTheGround) -> None:
    """From the facts as they are recorded, every command the same, bit for bit."""
    records = arm.recorder.records
    parameters = Parameters(arm.config, RodModel(ArmParameters.of(arm.config.arm)))
    state = records[0].state
    for record in records:
        state, commands = step(state, loads(Facts, dumps(record.facts)), record.t, parameters)
        assert dumps(commands) == dumps(record.commands)
        assert commands.zeros == record.commands.zeros


def nothing_changed(arm: OnTheGround, directory: Path) -> None:
    assert arm.state == "STOWED"
    assert files.tendons(str(directory)) == ""
    assert not list(directory.glob("tendons*"))
    assert arm.ground.all("ARM_STATUS")[-1].calibration == mav.ARM_CALIBRATION_MISSING
    assert arm.arm.servos.positions()[:3] == pytest.approx(arm.before[:3], abs=12)
    assert arm.torque[:2] == [0, 0]


@pytest.mark.parametrize("way", ["COMMAND_CANCEL", "ABORT"])
def test_it_is_cancelled_and_the_tendons_go_back(way: str, tmp_path: Path) -> None:
    arm = OnTheGround(tmp_path)

    async def script() -> None:
        await arm.begun(12)
        if way == "ABORT":
            arm.ground.command(mav.MAV_CMD_ARM_ABORT)
        else:
            arm.ground.send(mav.MAVLink_command_cancel_message(1, 192, CALIBRATE))
        await arm.until(lambda: arm.acks(CALIBRATE)[-1].result == CANCELLED, 0.5)
        await asyncio.sleep(0.3)
        assert arm.state == "EASING"
        await arm.until(lambda: arm.state == "STOWED", 10.0)

    arm.run(script)
    nothing_changed(arm, tmp_path)


def test_a_vehicle_that_arms_ends_it_at_once_and_none_is_begun_while_it_is_armed(tmp_path: Path) -> None:
    arm = OnTheGround(tmp_path)

    async def script() -> None:
        await arm.begun()
        arm.armed = True
        await arm.until(lambda: arm.acks(CALIBRATE)[-1].result == FAILED, 0.5)
        await arm.until(lambda: arm.state == "STOWED", 10.0)
        assert await arm.order(1, 1) == REJECTED
        arm.armed = False
        await asyncio.sleep(0.5)

    arm.run(script)
    assert "CALIBRATE failed: the vehicle is armed" in arm.text
    assert arm.ground.all("ARM_STATUS")[-1].errors & mav.ARM_ERROR_CALIBRATION_FAILED
    nothing_changed(arm, tmp_path)


def test_a_silent_autopilot_may_be_armed(tmp_path: Path) -> None:
    arm = OnTheGround(tmp_path)

    async def script() -> None:
        await arm.begun()
        arm.beats = False
        await arm.until(lambda: arm.acks(CALIBRATE)[-1].result == FAILED, 10.0)
        await arm.until(lambda: arm.state == "STOWED", 10.0)

    arm.run(script)
    assert "the autopilot is silent" in arm.text
    nothing_changed(arm, tmp_path)


def test_a_servo_that_is_unplugged_on_the_way_ends_it_and_the_cycle_goes_on(tmp_path: Path) -> None:
    arm = OnTheGround(tmp_path)

    async def script() -> None:
        await arm.begun(12)
        arm.arm.servos.servos[3].silenced = True
        await arm.until(lambda: arm.acks(CALIBRATE)[-1].result == FAILED, 1.0)
        await arm.until(lambda: arm.state == "STOWED", 15.0)

    daemon = arm.run(script)
    assert "tendon 4: servo does not answer" in arm.text
    assert daemon.failures == 0
    nothing_changed(arm, tmp_path)


def test_the_same_command_again_does_nothing_twice(tmp_path: Path) -> None:
    arm = OnTheGround(tmp_path)

    async def script() -> None:
        await arm.begun()
        arm.ground.command(CALIBRATE, 1, 1, confirmation=1)
        await asyncio.sleep(0.2)
        assert {ack.result for ack in arm.acks(CALIBRATE)} == {IN_PROGRESS}
        other = MavlinkPeer(254, 190)
        other.transport = arm.ground.transport
        other.command(CALIBRATE, 1, 1)
        await asyncio.sleep(0.2)
        theirs = [ack for ack in arm.acks(CALIBRATE) if ack.target_system == 254]
        assert [ack.result for ack in theirs] == [REJECTED]
        assert arm.state == "CALIBRATING"

    daemon = arm.run(script)
    assert daemon.failures == 0
    assert arm.torque == [0, 0, 0, 0], "the daemon's end lets the arm hang"
    assert sum("STOWED -> CALIBRATING" in n.text for r in arm.recorder.records for n in r.commands.notices) == 1


@pytest.mark.scenario
def test_a_read_only_disk_leaves_the_zeros_that_were_in_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, _: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(recalibration.files, "save", refuse)
    arm = OnTheGround(tmp_path)

    async def script() -> None:
        assert await arm.order(1, 1) == FAILED
        await arm.until(lambda: arm.state == "STOWED", 10.0)

    arm.run(script)
    assert "tendons.json cannot be written: Read-only file system" in arm.text
    nothing_changed(arm, tmp_path)
