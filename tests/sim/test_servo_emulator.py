"""The emulated servos: the maker's rules for registers, motion that obeys physics, faults that stay."""

import asyncio
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from arm_companion.clock import precise_loop, run_simulated
from arm_companion.config.schema import ServosConfig
from arm_companion.errors import LinkError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.control_table import HardwareError, MovingStatus, OperatingMode, Register
from arm_companion.protocol.dynamixel import StatusError
from arm_companion.sim.byte_noise import ByteNoise
from arm_companion.sim.servo_device import BOOT_S
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator
from arm_companion.sim.servo_faults import ByteDelay, seize, set_free
from arm_companion.sim.servo_motion import FRICTION, Trajectory
from arm_companion.transport.base import Transport
from arm_companion.transport.memory import MemoryPipe
from arm_companion.transport.serial import open_serial

CONFIG = ServosConfig()
FREE = (0.0, 0.0, 0.0, 0.0)


class Master:
    """Talks to an emulator without a wire between."""

    def __init__(self, config: ServosConfig = CONFIG) -> None:
        self.emulator = ServoEmulator(config, seed=3)
        self._parser = dxl.Parser()

    def send(self, request: bytes) -> list[dxl.Packet]:
        return self._parser.feed(self.emulator.feed(request))

    def read(self, servo: int, register: Register) -> int:
        (answer,) = self.send(dxl.read(servo, register.address, register.size))
        assert answer.error & ~dxl.ALERT == 0
        return register.decode(answer.parameters)

    def write(self, servo: int, register: Register, value: int) -> int:
        """Error number of the answer."""
        (answer,) = self.send(dxl.write(servo, register.address, register.encode(value)))
        return answer.error & ~dxl.ALERT

    def set(self, servo: int, register: Register, value: int) -> None:
        assert self.write(servo, register, value) == StatusError.NONE

    def wait(self, seconds: float, loads: tuple[float, ...] = FREE, *, talking: bool = False) -> None:
        """Let time pass, with pings in between if `talking`."""
        for _ in range(round(seconds / 0.01)):
            self.emulator.advance(0.01, loads)
            if talking:
                self.send(dxl.ping(dxl.BROADCAST_ID))


@pytest.fixture
def master() -> Master:
    return Master()


def test_ping_tells_model_and_firmware_and_a_broadcast_reaches_all_in_order(master: Master) -> None:
    (answer,) = master.send(dxl.ping(2))
    assert (answer.id, answer.error, answer.parameters) == (2, 0, b"\x24\x04\x2e")
    assert [a.id for a in master.send(dxl.ping(dxl.BROADCAST_ID))] == [1, 2, 3, 4]
    assert master.send(dxl.ping(9)) == []


@pytest.mark.parametrize(
    ("register", "value", "error"),
    [
        (ct.PRESENT_POSITION, 5, StatusError.ACCESS),
        (ct.MODEL_NUMBER, 5, StatusError.ACCESS),
        (ct.TORQUE_ENABLE, 2, StatusError.DATA_RANGE),
        (ct.BAUD_RATE, 8, StatusError.DATA_RANGE),
        (ct.GOAL_POSITION, 1_048_576, StatusError.DATA_RANGE),
        (ct.GOAL_PWM, 886, StatusError.DATA_RANGE),
        (ct.OPERATING_MODE, 2, StatusError.DATA_RANGE),
        (ct.GOAL_VELOCITY, 300, StatusError.DATA_LIMIT),
        (ct.GOAL_POSITION, -1_048_575, StatusError.NONE),
    ],
)
def test_writes_are_refused_with_the_makers_error_and_change_nothing(
    master: Master, register: Register, value: int, error: StatusError
) -> None:
    before = master.read(1, register)
    assert master.write(1, register, value) == error
    assert (master.read(1, register) == before) == (error != StatusError.NONE)


def test_writes_of_half_a_register_or_into_nowhere_are_refused(master: Master) -> None:
    (half,) = master.send(dxl.write(1, ct.GOAL_POSITION.address, b"\x00\x00"))
    (gap,) = master.send(dxl.write(1, 66, b"\x00"))
    (beyond,) = master.send(dxl.read(1, 140, 20))
    (short,) = master.send(dxl.frame(1, dxl.Instruction.READ, b"\x00"))
    assert [a.error for a in (half, gap, beyond, short)] == [
        StatusError.DATA_LENGTH,
        StatusError.ACCESS,
        StatusError.ACCESS,
        StatusError.DATA_LENGTH,
    ]


def test_a_write_over_several_registers_is_all_or_nothing(master: Master) -> None:
    good = ct.PROFILE_ACCELERATION.encode(10) + ct.PROFILE_VELOCITY.encode(20)
    bad = ct.PROFILE_ACCELERATION.encode(30) + ct.PROFILE_VELOCITY.encode(40_000)
    assert master.send(dxl.write(1, 108, good))[0].error == 0
    assert master.send(dxl.write(1, 108, bad))[0].error == StatusError.DATA_RANGE
    assert (master.read(1, ct.PROFILE_ACCELERATION), master.read(1, ct.PROFILE_VELOCITY)) == (10, 20)


def test_any_range_can_be_read_even_one_that_cuts_a_register(master: Master) -> None:
    (whole,) = master.send(dxl.read(1, 0, ct.TABLE_SIZE))
    (part,) = master.send(dxl.read(1, 118, 4))
    assert len(whole.parameters) == ct.TABLE_SIZE
    assert whole.parameters[:2] == b"\x24\x04"
    assert part.parameters[:2] == whole.parameters[118:120]


def test_eeprom_is_locked_while_the_torque_is_on(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    assert master.write(1, ct.RETURN_DELAY, 10) == StatusError.ACCESS
    master.set(1, ct.TORQUE_ENABLE, 0)
    assert master.write(1, ct.RETURN_DELAY, 10) == StatusError.NONE


def test_changing_the_mode_resets_gains_profile_and_goal_pwm(master: Master) -> None:
    for register, value in ((ct.POSITION_P_GAIN, 900), (ct.PROFILE_VELOCITY, 100), (ct.GOAL_PWM, 300)):
        master.set(1, register, value)
    master.set(1, ct.OPERATING_MODE, OperatingMode.POSITION)
    assert master.read(1, ct.POSITION_P_GAIN) == 640
    assert master.read(1, ct.PROFILE_VELOCITY) == 0
    assert master.read(1, ct.GOAL_PWM) == 885


@pytest.mark.parametrize(("level", "read_answers", "write_answers"), [(0, 0, 0), (1, 1, 0), (2, 1, 1)])
def test_status_return_level(master: Master, level: int, read_answers: int, write_answers: int) -> None:
    master.send(dxl.write(1, ct.STATUS_RETURN_LEVEL.address, bytes((level,))))
    assert len(master.send(dxl.read(1, 0, 2))) == read_answers
    assert len(master.send(dxl.write(1, ct.LED.address, b"\x01"))) == write_answers
    assert len(master.send(dxl.ping(1))) == 1
    assert master.emulator[1].peek(ct.LED) == 1


def test_sync_write_reaches_those_named_and_nobody_answers(master: Master) -> None:
    goals = {1: ct.GOAL_POSITION.encode(1111), 3: ct.GOAL_POSITION.encode(-3)}
    assert master.send(dxl.sync_write(ct.GOAL_POSITION.address, goals)) == []
    assert [master.read(i, ct.GOAL_POSITION) for i in (1, 2, 3, 4)] == [1111, 2048, -3, 2048]


def test_sync_read_answers_in_the_order_asked_and_stops_at_a_silent_servo(master: Master) -> None:
    request = dxl.sync_read((4, 2, 1, 3), ct.PRESENT_POSITION.address, 4)
    assert [a.id for a in master.send(request)] == [4, 2, 1, 3]
    master.emulator[2].silenced = True
    assert [a.id for a in master.send(request)] == [4]
    master.emulator.chained = False
    assert [a.id for a in master.send(request)] == [4, 1, 3]


def test_fast_sync_read_holds_the_same_data(master: Master) -> None:
    request = dxl.sync_read((1, 2, 3, 4), ct.GOAL_POSITION.address, 4, fast=True)
    (answer,) = master.send(request)
    items = dxl.split_fast_sync_answer(answer, 4)
    assert [(p.id, p.error, ct.GOAL_POSITION.decode(p.parameters)) for p in items] == [
        (i, 0, 2048) for i in (1, 2, 3, 4)
    ]
    master.emulator[3].silenced = True
    assert master.send(request) == []  # the frame breaks off where the servo is missing


def test_old_firmware_knows_no_fast_sync_read_and_older_no_watchdog(master: Master) -> None:
    request = dxl.sync_read((1, 2), ct.GOAL_POSITION.address, 4, fast=True)
    master.emulator[2].poke(ct.FIRMWARE_VERSION, 44)
    assert master.send(request) == []
    assert len(master.send(dxl.sync_read((1, 2), ct.GOAL_POSITION.address, 4))) == 2
    assert master.write(2, ct.BUS_WATCHDOG, 10) == StatusError.NONE
    master.emulator[2].poke(ct.FIRMWARE_VERSION, 37)
    assert master.write(2, ct.BUS_WATCHDOG, 10) == StatusError.ACCESS


def test_two_servos_with_one_id_answer_over_each_other(master: Master) -> None:
    master.emulator.servos[1].poke(ct.ID, 1)
    (answer,) = master.send(dxl.ping(1))
    assert answer.id == 1  # both say the same
    master.emulator.servos[1].motor.position += 1000.0
    assert master.send(dxl.read(1, ct.PRESENT_POSITION.address, 4)) == []
    master.set(1, ct.LED, 1)  # both obey
    assert [servo.peek(ct.LED) for servo in master.emulator.servos] == [1, 1, 0, 0]


def test_a_seized_horn_strains_without_turning_until_it_shuts_down(master: Master) -> None:
    seize(master.emulator[1])
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 4000)
    master.wait(1.0)
    assert master.read(1, ct.PRESENT_POSITION) == 2048
    assert master.read(1, ct.PRESENT_LOAD) > 850
    master.wait(2.0)
    assert master.emulator[1].peek(ct.HARDWARE_ERROR_STATUS) == HardwareError.OVERLOAD
    set_free(master.emulator[1])
    master.send(dxl.reboot(1))
    master.wait(BOOT_S + 0.02)
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 2500)
    master.wait(2.0)
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(2500, abs=8)


def test_heat_above_the_limit_lets_go_and_goes_away_by_itself(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.emulator[1].warm(73.0)
    master.wait(0.02)
    assert master.emulator[1].peek(ct.HARDWARE_ERROR_STATUS) == HardwareError.OVERHEATING
    assert master.emulator[1].peek(ct.TORQUE_ENABLE) == 0
    master.wait(10.0)
    assert 65 < master.emulator[1].peek(ct.PRESENT_TEMPERATURE) < 72
    assert master.emulator[1].peek(ct.TORQUE_ENABLE) == 0


def test_delayed_bytes_come_whole_in_order_and_late() -> None:
    delay = ByteDelay(0.1, 0.002, seed=3)
    data = bytes(range(256))
    pieces = delay(data)
    assert b"".join(piece for _, piece in pieces) == data
    assert 10 < len(pieces) < 45
    assert all(pause == 0.002 for pause, _ in pieces[1:])
    assert ByteDelay(0.0, 0.002)(data) == [(0.0, data)]


def test_reg_write_waits_for_action(master: Master) -> None:
    assert master.send(dxl.action(1))[0].error == StatusError.INSTRUCTION
    master.send(dxl.reg_write(1, ct.LED.address, b"\x01"))
    assert (master.read(1, ct.LED), master.read(1, ct.REGISTERED_INSTRUCTION)) == (0, 1)
    master.send(dxl.action(dxl.BROADCAST_ID))
    assert (master.read(1, ct.LED), master.read(1, ct.REGISTERED_INSTRUCTION)) == (1, 0)


def test_unknown_instructions_are_refused(master: Master) -> None:
    (answer,) = master.send(dxl.frame(1, 0x77))
    assert answer.error == StatusError.INSTRUCTION
    assert master.send(dxl.frame(dxl.BROADCAST_ID, 0x77)) == []


def test_a_new_id_and_baud_hold_at_once(master: Master) -> None:
    master.set(1, ct.ID, 77)
    assert master.send(dxl.ping(1)) == []
    assert master.send(dxl.ping(77))[0].id == 77
    master.set(77, ct.BAUD_RATE, 1)
    assert master.emulator.respond(dxl.ping(77), baud=1_000_000) == []
    assert len(master.emulator.respond(dxl.ping(77), baud=57_600)) == 1


def test_a_secondary_id_is_obeyed_and_not_answered(master: Master) -> None:
    for servo in (1, 2):
        master.set(servo, ct.SECONDARY_ID, 100)
    assert master.send(dxl.write(100, ct.LED.address, b"\x01")) == []
    assert [master.read(i, ct.LED) for i in (1, 2, 3)] == [1, 1, 0]


# Motion.


def test_it_goes_to_its_goal_over_several_turns_and_says_so(master: Master) -> None:
    master.set(1, ct.PROFILE_VELOCITY, 200)
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 2048 + 3 * 4096)
    master.wait(1.0)
    assert master.read(1, ct.MOVING) == 1
    assert master.read(1, ct.PRESENT_VELOCITY) == pytest.approx(200, abs=3)
    assert master.read(1, ct.MOVING_STATUS) & MovingStatus.PROFILE_ONGOING
    master.wait(6.0)
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(2048 + 3 * 4096, abs=8)
    assert master.read(1, ct.MOVING_STATUS) & MovingStatus.IN_POSITION
    assert master.read(1, ct.MOVING) == 0
    assert master.emulator.positions()[1:] == (2048.0, 2048.0, 2048.0)


def test_without_a_profile_it_is_as_fast_as_the_motor_and_no_faster(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 100_000)
    master.wait(1.0)
    rev_per_min = master.emulator.speeds()[0] / 4096 * 60
    assert 56.0 < rev_per_min < 61.0


def test_the_trajectory_is_a_trapezoid() -> None:
    trajectory = Trajectory(0.0)
    speeds = []
    for _ in range(3000):
        before = trajectory.speed
        trajectory.step(1000.0, 800.0, 2000.0, 0.001)
        speeds.append(trajectory.speed)
        assert abs(trajectory.speed - before) <= 2000.0 * 0.001 * 1.01 or trajectory.position == 1000.0
    assert max(speeds) == pytest.approx(800.0)
    assert trajectory.position == 1000.0
    assert trajectory.speed == 0.0
    moving = sum(speed != 0.0 for speed in speeds) * 0.001
    assert moving == pytest.approx(1000 / 800 + 800 / 2000, rel=0.02)  # length over speed, and one ramp


def test_it_sags_under_load_and_reports_it(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.wait(2.0, (0.4, 0.0, 0.0, 0.0))
    sag = 2048 - master.read(1, ct.PRESENT_POSITION)  # a tendon in direction +1 pulls towards smaller ticks
    loads = [master.read(1, ct.PRESENT_LOAD) for _ in range(200)]
    expected = 0.4 / 1.5
    friction = FRICTION / 1.5 + 0.005  # and the noise of the mean, and a supply below 12 V
    assert expected - friction < sum(loads) / 200 / 1000 < expected + friction
    assert (expected - friction) * 885 / 5 - 1 < sag < (expected + friction) * 885 / 5 + 1
    assert 5 < math.dist(loads, [sum(loads) / 200] * 200) / math.sqrt(200) < 20  # noise of about 1 %


def test_direction_decides_which_way_a_tendon_pulls() -> None:
    master = Master(dataclasses.replace(CONFIG, directions=(1, -1, 1, -1)))
    for servo in (1, 2):
        master.set(servo, ct.TORQUE_ENABLE, 1)
    master.wait(2.0, (0.4, 0.4, 0.0, 0.0))
    assert master.read(1, ct.PRESENT_POSITION) < 2048 < master.read(2, ct.PRESENT_POSITION)
    assert master.read(1, ct.PRESENT_LOAD) > 0 > master.read(2, ct.PRESENT_LOAD)


def test_more_than_the_stall_torque_pulls_it_away_and_overload_lets_go(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.wait(1.0, (1.7, 0.0, 0.0, 0.0))
    assert master.read(1, ct.PRESENT_POSITION) < 1500
    master.wait(2.0, (1.7, 0.0, 0.0, 0.0))
    assert master.emulator[1].peek(ct.HARDWARE_ERROR_STATUS) == HardwareError.OVERLOAD
    assert master.emulator[1].peek(ct.TORQUE_ENABLE) == 0


def test_a_standing_horn_holds_what_friction_holds_even_limp(master: Master) -> None:
    master.wait(1.0, (0.9 * FRICTION, 1.5 * FRICTION, 0.0, 0.0))
    assert master.emulator.positions()[0] == 2048.0
    assert master.emulator.positions()[1] < 2040.0


def test_an_integral_gain_takes_the_sag_away(master: Master) -> None:
    master.set(1, ct.POSITION_I_GAIN, 1000)
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.wait(6.0, (0.4, 0.0, 0.0, 0.0))
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(2048, abs=3)


def test_the_same_seed_gives_the_same_world() -> None:
    def story() -> list[int]:
        master = Master()
        master.set(1, ct.TORQUE_ENABLE, 1)
        master.set(1, ct.GOAL_POSITION, 2500)
        loads = []
        for _ in range(20):
            master.wait(0.02, (0.2, 0.0, 0.0, 0.0))
            loads.append(master.read(1, ct.PRESENT_LOAD))
        return loads

    assert story() == story()


# Protections and power.


def test_the_bus_watchdog_counts_only_with_torque_and_stops_the_servo(master: Master) -> None:
    master.set(1, ct.BUS_WATCHDOG, 10)  # 0.2 s
    master.wait(1.0)
    assert master.read(1, ct.BUS_WATCHDOG) == 10
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 20_000)
    master.wait(0.5, talking=True)
    assert master.read(1, ct.BUS_WATCHDOG) == 10
    master.wait(0.6)
    assert master.read(1, ct.BUS_WATCHDOG) == -1
    stopped = master.read(1, ct.PRESENT_POSITION)
    assert stopped < 19_000
    assert master.write(1, ct.GOAL_POSITION, 20_000) == StatusError.DATA_RANGE
    master.wait(0.5)
    assert abs(master.read(1, ct.PRESENT_POSITION) - stopped) < 200
    assert master.read(1, ct.TORQUE_ENABLE) == 1
    master.set(1, ct.BUS_WATCHDOG, 0)
    master.set(1, ct.GOAL_POSITION, 20_000)


def test_a_masked_error_drops_the_torque_until_a_reboot(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.emulator[1].trip(HardwareError.OVERHEATING)
    (answer,) = master.send(dxl.ping(1))
    assert answer.error == dxl.ALERT
    assert master.read(1, ct.TORQUE_ENABLE) == 0
    assert master.write(1, ct.TORQUE_ENABLE, 1) != StatusError.NONE
    assert master.send(dxl.reboot(1))[0].error == dxl.ALERT
    assert master.send(dxl.ping(1)) == []  # it boots
    master.wait(BOOT_S + 0.02)
    assert master.send(dxl.ping(1))[0].error == 0
    master.set(1, ct.TORQUE_ENABLE, 1)


def test_an_unmasked_error_only_alerts(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.emulator.supply_v = 15.0
    master.wait(0.02)
    (answer,) = master.send(dxl.ping(1))
    assert answer.error == dxl.ALERT
    assert master.read(1, ct.HARDWARE_ERROR_STATUS) == HardwareError.INPUT_VOLTAGE
    assert master.read(1, ct.TORQUE_ENABLE) == 1


def test_losing_power_loses_turns_and_ram_and_keeps_eeprom(master: Master) -> None:
    master.set(1, ct.RETURN_DELAY, 5)
    master.set(1, ct.PROFILE_VELOCITY, 250)
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 10_000)
    master.wait(4.0)
    true = master.emulator.positions()[0]
    master.wait(30.0)
    assert master.read(1, ct.REALTIME_TICK) < 2000  # wrapped at 32.768 s
    master.emulator.supply_v = 3.0  # brown-out
    master.wait(0.1)
    assert master.send(dxl.ping(1)) == []
    master.emulator.supply_v = 12.0
    master.wait(BOOT_S + 0.05)
    assert master.emulator.positions()[0] == pytest.approx(true, abs=1)
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(true % 4096, abs=1)
    assert master.read(1, ct.REALTIME_TICK) < 100
    assert (master.read(1, ct.TORQUE_ENABLE), master.read(1, ct.PROFILE_VELOCITY)) == (0, 0)
    assert master.read(1, ct.RETURN_DELAY) == 5


def test_clear_needs_a_servo_that_stands(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 9000)
    master.wait(0.5)
    assert master.send(dxl.clear_turns(1))[0].error == StatusError.RESULT_FAIL
    master.wait(3.0)
    assert master.send(dxl.clear_turns(1))[0].error == 0
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(9000 % 4096, abs=8)
    before = master.emulator.positions()[0]
    master.wait(1.0)
    assert master.emulator.positions()[0] == pytest.approx(before, abs=8)


def test_torque_in_position_mode_and_homing_offset_move_the_numbers_not_the_horn(master: Master) -> None:
    master.set(1, ct.TORQUE_ENABLE, 1)
    master.set(1, ct.GOAL_POSITION, 5000)
    master.wait(3.0)
    master.set(1, ct.TORQUE_ENABLE, 0)
    true = master.emulator.positions()[0]
    master.set(1, ct.HOMING_OFFSET, 100)
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(true + 100, abs=1)
    master.set(1, ct.OPERATING_MODE, OperatingMode.POSITION)
    assert master.read(1, ct.PRESENT_POSITION) == pytest.approx(true % 4096 + 100, abs=1)
    assert master.emulator.positions()[0] == pytest.approx(true)


def test_hard_work_heats_and_draws_the_supply_down(master: Master) -> None:
    for servo in (1, 2, 3, 4):
        master.set(servo, ct.TORQUE_ENABLE, 1)
    master.wait(1.0, (1.0, 1.0, 1.0, 1.0))
    assert 10.5 < master.read(1, ct.PRESENT_VOLTAGE) / 10 < 11.8
    master.wait(60.0, (1.0, 1.0, 1.0, 1.0))
    assert master.read(1, ct.PRESENT_TEMPERATURE) > 36


# The wire.


def test_answers_take_the_time_of_their_bytes() -> None:
    async def main() -> tuple[list[float], float]:
        pipe = MemoryPipe(latency_s=0.0)
        emulator = ServoEmulator(CONFIG)
        emulator[2].poke(ct.RETURN_DELAY, 250)
        bus = EmulatedBus(emulator, CONFIG)
        serving = asyncio.create_task(bus.serve_memory(pipe.opener(0)))
        await bus.wait_ready()
        loop = asyncio.get_running_loop()
        arrivals: list[float] = []
        end = await pipe.opener(1)(lambda _: arrivals.append(loop.time()))
        request = dxl.sync_read((1, 2, 3, 4), 124, 23)
        start = loop.time()
        end.write(request)
        await asyncio.sleep(0.01)
        serving.cancel()
        end.close()
        return [t - start for t in arrivals], len(request) * 1e-5

    arrivals, request_s = run_simulated(main())
    reply_s, turnaround_s, delay_s = 34 * 1e-5, 20e-6, 500e-6
    expected = [request_s + (i + 1) * (reply_s + turnaround_s) + (delay_s if i >= 1 else 0.0) for i in range(4)]
    assert arrivals == pytest.approx(expected, abs=2e-6)


def test_noise_drops_and_changes_the_share_it_is_told() -> None:
    noise = ByteNoise(drop=0.1, corrupt=0.2, seed=5)
    data = bytes(10_000)
    out = noise(data)
    assert 0.88 < len(out) / len(data) < 0.92
    assert 0.18 < sum(byte != 0 for byte in out) / len(data) < 0.22
    assert ByteNoise(0.1, 0.2, seed=5)(data) == out


@pytest.fixture
def runner() -> Iterator[asyncio.Runner]:
    with asyncio.Runner(loop_factory=precise_loop) as runner:
        yield runner


class PortClient:
    """One program that has the port open."""

    def __init__(self) -> None:
        self._parser = dxl.Parser()
        self.answers: asyncio.Queue[dxl.Packet] = asyncio.Queue()

    def receive(self, data: bytes) -> None:
        for packet in self._parser.feed(data):
            self.answers.put_nowait(packet)

    async def ping(self, transport: Transport) -> int:
        transport.write(dxl.ping(1))
        async with asyncio.timeout(2.0):
            return (await self.answers.get()).id


@pytest.mark.realtime
def test_a_program_may_close_and_reopen_the_port_and_sees_it_go(runner: asyncio.Runner, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "bus"

    async def main() -> None:
        bus = EmulatedBus(ServoEmulator(CONFIG), CONFIG)
        serving = asyncio.create_task(bus.serve_pty(path))
        await bus.wait_ready()
        for _ in range(3):
            client = PortClient()
            port = await open_serial(str(path), 1_000_000)(client.receive)
            assert await client.ping(port) == 1
            port.close()
            await port.wait_closed()
        client = PortClient()
        port = await open_serial(str(path), 1_000_000)(client.receive)
        with pytest.raises(LinkError, match="lock"):
            await open_serial(str(path), 1_000_000)(client.receive)
        bus.unplug()
        await asyncio.wait_for(port.wait_closed(), 2.0)
        await serving
        with pytest.raises(LinkError, match=r"bus"):
            await open_serial(str(path), 1_000_000)(client.receive)

    runner.run(main())
    assert list(path.parent.iterdir()) == []


@pytest.mark.realtime
def test_servos_do_not_hear_another_speed(runner: asyncio.Runner, tmp_path: Path) -> None:
    async def main() -> list[int]:
        emulator = ServoEmulator(CONFIG)
        emulator[1].poke(ct.BAUD_RATE, 1)
        bus = EmulatedBus(emulator, CONFIG)
        serving = asyncio.create_task(bus.serve_pty(tmp_path / "bus"))
        await bus.wait_ready()
        client = PortClient()
        heard = []
        for baud in (1_000_000, 57_600):
            port = await open_serial(str(tmp_path / "bus"), baud)(client.receive)
            port.write(dxl.sync_read((1,), 0, 2))
            port.write(dxl.ping(2))
            async with asyncio.timeout(2.0):
                heard.append((await client.answers.get()).id)
            port.close()
            await port.wait_closed()
        serving.cancel()
        return heard

    assert runner.run(main()) == [2, 1]


@pytest.mark.realtime
def test_a_stale_link_is_replaced_and_a_living_one_is_an_error(runner: asyncio.Runner, tmp_path: Path) -> None:
    path = tmp_path / "bus"
    path.symlink_to("/dev/null")

    async def main() -> None:
        first, second = (EmulatedBus(ServoEmulator(CONFIG), CONFIG) for _ in range(2))
        serving = asyncio.create_task(first.serve_pty(path))
        await first.wait_ready()
        target = path.readlink()
        assert str(target) != "/dev/null"
        with pytest.raises(LinkError, match="another simulation"):
            await second.serve_pty(path)
        assert path.readlink() == target
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    runner.run(main())
    assert not path.is_symlink()


def test_what_is_no_link_is_left_alone(runner: asyncio.Runner, tmp_path: Path) -> None:
    path = tmp_path / "bus"
    path.write_text("mine")
    with pytest.raises(LinkError, match="no simulated port"):
        runner.run(EmulatedBus(ServoEmulator(CONFIG), CONFIG).serve_pty(path))
    assert path.read_text() == "mine"


def test_one_servo_without_its_cable_stays_without_power_until_it_has_it_again() -> None:
    master = Master()
    master.emulator[2].set_power(on=False)
    master.wait(1.0)
    assert [servo.awake for servo in master.emulator.servos] == [True, False, True, True]
    master.emulator.supply_v = 0.0
    master.wait(0.1)
    master.emulator.supply_v = 12.0
    master.wait(1.0)
    assert not master.emulator[2].awake
    master.emulator[2].set_power(on=True)
    master.wait(1.0)
    assert master.emulator[2].awake
