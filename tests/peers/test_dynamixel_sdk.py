"""The maker's own SDK as bus master of the emulated servos, over a pty at 1 Mbit/s.

The SDK busy-waits, so it works in a thread while the emulator runs on the event loop.
"""

import asyncio
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import dynamixel_sdk as sdk
import pytest

from arm_companion.clock import precise_loop
from arm_companion.config.schema import ServosConfig
from arm_companion.protocol import control_table as ct
from arm_companion.protocol.control_table import HardwareError, Register
from arm_companion.protocol.dynamixel import StatusError
from arm_companion.sim.byte_noise import ByteNoise
from arm_companion.sim.servo_device import BOOT_S
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.sim.servo_faults import ByteDelay, seize

pytestmark = pytest.mark.realtime
CONFIG = ServosConfig()
IDS = CONFIG.ids


class Client:
    """The SDK on an open port, with its results checked."""

    def __init__(self, path: Path, bus: EmulatedBus) -> None:
        self.bus = bus
        self.emulator = bus.emulator
        self.port = sdk.PortHandler(str(path))
        self.handler = sdk.PacketHandler(2.0)
        assert self.port.setBaudRate(CONFIG.baud)

    def read(self, servo: int, register: Register) -> int:
        call = getattr(self.handler, f"read{register.size}ByteTxRx")
        value, result, error = call(self.port, servo, register.address)
        assert (result, error & 0x7F) == (sdk.COMM_SUCCESS, 0)
        return register.decode(value.to_bytes(register.size, "little"))

    def write(self, servo: int, register: Register, value: int) -> int:
        call = getattr(self.handler, f"write{register.size}ByteTxRx")
        result, error = call(self.port, servo, register.address, value)
        assert result == sdk.COMM_SUCCESS
        return int(error)

    def wait_for(self, condition: Callable[[], bool], seconds: float = 5.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "it did not happen in time"
            time.sleep(0.01)


def feedback_group(client: Client) -> "sdk.GroupSyncRead":
    group = sdk.GroupSyncRead(client.port, client.handler, ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE)
    for servo in IDS:
        assert group.addParam(servo)
    return group


Play = Callable[[Callable[[Client], None]], None]


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK waits for two of its 16 ms beyond the wire, which is too short where others compute as well."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 100)


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Play]:
    """Lets a client talk to four servos from a thread of its own."""
    path = tmp_path / "servo-bus"

    async def serve(talk: Callable[[Client], None]) -> None:
        emulator = ServoEmulator(CONFIG, seed=4)
        bus = EmulatedBus(emulator, CONFIG)
        tasks = [asyncio.create_task(bus.serve_pty(path)), asyncio.create_task(keep_time(emulator))]
        await bus.wait_ready()

        def run() -> None:
            client = Client(path, bus)
            try:
                talk(client)
            finally:
                client.port.closePort()

        try:
            await asyncio.to_thread(run)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        yield lambda talk: runner.run(serve(talk))


def test_ping_and_broadcast_ping(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.handler.ping(client.port, 1) == (1060, sdk.COMM_SUCCESS, 0)
        assert client.handler.ping(client.port, 99)[1] == sdk.COMM_RX_TIMEOUT
        found, result = client.handler.broadcastPing(client.port)
        assert result == sdk.COMM_SUCCESS
        assert found == {servo: [1060, 46] for servo in IDS}

    play(talk)


def test_read_and_write_of_every_size(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.read(2, ct.PRESENT_POSITION) == 2048
        assert client.read(2, ct.PRESENT_TEMPERATURE) == 30
        for register, value in ((ct.LED, 1), (ct.POSITION_P_GAIN, 700), (ct.PROFILE_VELOCITY, 123)):
            assert client.write(2, register, value) == 0
            assert client.read(2, register) == value
        assert client.read(1, ct.LED) == 0

    play(talk)


def test_eeprom_is_refused_with_torque_on(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.write(1, ct.TORQUE_ENABLE, 1) == 0
        assert client.write(1, ct.RETURN_DELAY, 20) == sdk.protocol2_packet_handler.ERRNUM_ACCESS
        assert client.write(1, ct.TORQUE_ENABLE, 0) == 0
        assert client.write(1, ct.RETURN_DELAY, 20) == 0

    play(talk)


def test_errors_have_the_numbers_the_sdk_knows(play: Play) -> None:
    def talk(client: Client) -> None:
        handler = client.handler
        for register, value, error in (
            (ct.TORQUE_ENABLE, 7, StatusError.DATA_RANGE),
            (ct.PRESENT_LOAD, 1, StatusError.ACCESS),
            (ct.GOAL_VELOCITY, 900, StatusError.DATA_LIMIT),
        ):
            assert client.write(1, register, value) == error
        _, short = handler.write2ByteTxRx(client.port, 1, ct.GOAL_POSITION.address, 5)
        assert short == StatusError.DATA_LENGTH
        assert handler.factoryReset(client.port, 1, 2) == (sdk.COMM_SUCCESS, StatusError.INSTRUCTION)
        assert "length" in handler.getRxPacketError(short)

    play(talk)


def sync_group(client: Client, register: Register) -> "sdk.GroupSyncRead":
    group = sdk.GroupSyncRead(client.port, client.handler, register.address, register.size)
    for servo in IDS:
        assert group.addParam(servo)
    return group


def test_sync_write_moves_all_and_sync_read_sees_it(play: Play) -> None:
    def talk(client: Client) -> None:
        goals = {servo: 2048 + 40 * servo for servo in IDS}
        for servo in IDS:
            assert client.write(servo, ct.TORQUE_ENABLE, 1) == 0
        writer = sdk.GroupSyncWrite(client.port, client.handler, ct.GOAL_POSITION.address, 4)
        for servo, goal in goals.items():
            assert writer.addParam(servo, list(ct.GOAL_POSITION.encode(goal)))
        assert writer.txPacket() == sdk.COMM_SUCCESS
        reader = sync_group(client, ct.PRESENT_POSITION)

        def arrived() -> bool:
            assert reader.txRxPacket() == sdk.COMM_SUCCESS
            return all(abs(reader.getData(s, ct.PRESENT_POSITION.address, 4) - g) < 10 for s, g in goals.items())

        client.wait_for(arrived)

    play(talk)


def test_the_daemons_own_block_can_be_read_by_sync_and_fast_sync_read(play: Play) -> None:
    def talk(client: Client) -> None:
        group = feedback_group(client)
        for call in (group.txRxPacket, group.fastSyncRead):
            assert call() == sdk.COMM_SUCCESS
            for servo in IDS:
                assert group.getData(servo, ct.PRESENT_POSITION.address, 4) == 2048
                assert group.getData(servo, ct.PRESENT_VOLTAGE.address, 2) == 120
                assert group.getData(servo, ct.PRESENT_TEMPERATURE.address, 1) == 30

    play(talk)


def test_stuffed_data_survives_the_way_there_and_back(play: Play) -> None:
    def talk(client: Client) -> None:
        goals = (-131_073, -768)  # FF FF FD FF and 00 FD FF FF: with their neighbours, headers in the data
        writer = sdk.GroupSyncWrite(client.port, client.handler, ct.GOAL_POSITION.address, 4)
        for servo, goal in zip(IDS, goals, strict=False):
            writer.addParam(servo, list(ct.GOAL_POSITION.encode(goal)))
        assert writer.txPacket() == sdk.COMM_SUCCESS
        client.wait_for(lambda: client.emulator[1].peek(ct.GOAL_POSITION) == goals[0])
        assert [client.read(servo, ct.GOAL_POSITION) for servo in IDS[:2]] == list(goals)

    play(talk)


def test_reboot_ends_a_shutdown(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.write(3, ct.TORQUE_ENABLE, 1) == 0
        client.emulator[3].trip(HardwareError.OVERLOAD)
        _, result, error = client.handler.ping(client.port, 3)
        assert (result, error) == (sdk.COMM_SUCCESS, sdk.protocol2_packet_handler.ERRBIT_ALERT)
        assert client.read(3, ct.HARDWARE_ERROR_STATUS) == HardwareError.OVERLOAD
        assert client.read(3, ct.TORQUE_ENABLE) == 0
        assert client.handler.reboot(client.port, 3)[0] == sdk.COMM_SUCCESS
        assert client.handler.ping(client.port, 3)[1] == sdk.COMM_RX_TIMEOUT
        client.wait_for(lambda: client.handler.ping(client.port, 3)[1] == sdk.COMM_SUCCESS, BOOT_S + 3.0)
        assert client.read(3, ct.HARDWARE_ERROR_STATUS) == 0

    play(talk)


def test_reg_write_action_and_clear(play: Play) -> None:
    def talk(client: Client) -> None:
        handler, port = client.handler, client.port
        for servo in IDS:
            assert handler.regWriteTxRx(port, servo, ct.LED.address, 1, [1]) == (sdk.COMM_SUCCESS, 0)
        assert [client.read(servo, ct.LED) for servo in IDS] == [0] * 4
        assert handler.action(port, sdk.BROADCAST_ID) == sdk.COMM_SUCCESS
        client.wait_for(lambda: client.emulator[4].peek(ct.LED) == 1)
        assert [client.read(servo, ct.LED) for servo in IDS] == [1] * 4
        assert handler.clearMultiTurn(port, 1) == (sdk.COMM_SUCCESS, 0)

    play(talk)


def test_the_watchdog_stops_a_servo_whose_master_fell_silent(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.write(1, ct.TORQUE_ENABLE, 1) == 0
        assert client.write(1, ct.BUS_WATCHDOG, 5) == 0
        time.sleep(0.3)
        assert client.read(1, ct.BUS_WATCHDOG) == ct.WATCHDOG_TRIPPED
        assert client.write(1, ct.GOAL_POSITION, 2100) == StatusError.DATA_RANGE
        assert client.write(1, ct.BUS_WATCHDOG, 0) == 0
        assert client.write(1, ct.GOAL_POSITION, 2100) == 0

    play(talk)


def test_old_firmware_answers_a_sync_read_and_no_fast_one(play: Play) -> None:
    def talk(client: Client) -> None:
        client.emulator[3].poke(ct.FIRMWARE_VERSION, 44)
        group = feedback_group(client)
        assert group.fastSyncRead() != sdk.COMM_SUCCESS
        assert group.txRxPacket() == sdk.COMM_SUCCESS

    play(talk)


def test_a_profile_limits_speed_and_the_trajectory_can_be_read(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.write(2, ct.PROFILE_VELOCITY, 100) == 0
        assert client.write(2, ct.PROFILE_ACCELERATION, 20) == 0
        assert client.write(2, ct.TORQUE_ENABLE, 1) == 0
        assert client.write(2, ct.GOAL_POSITION, 2048 + 4096) == 0
        client.wait_for(lambda: client.read(2, ct.VELOCITY_TRAJECTORY) == 100)
        assert client.read(2, ct.MOVING) == 1
        assert 2048 < client.read(2, ct.POSITION_TRAJECTORY) < 2048 + 4096
        assert client.read(2, ct.PRESENT_VELOCITY) < 115

    play(talk)


def test_a_brown_out_alerts_and_a_deep_one_restarts_the_servo(play: Play) -> None:
    def talk(client: Client) -> None:
        assert client.write(1, ct.LED, 1) == 0
        client.emulator.supply_v = 5.5
        alert = sdk.protocol2_packet_handler.ERRBIT_ALERT
        client.wait_for(lambda: client.handler.ping(client.port, 1)[2] == alert)
        assert client.read(1, ct.HARDWARE_ERROR_STATUS) == HardwareError.INPUT_VOLTAGE
        assert client.read(1, ct.PRESENT_VOLTAGE) == 55
        client.emulator.supply_v = 3.0
        client.wait_for(lambda: client.handler.ping(client.port, 1)[1] == sdk.COMM_RX_TIMEOUT)
        client.emulator.supply_v = 12.0
        client.wait_for(lambda: client.handler.ping(client.port, 1)[1:] == (sdk.COMM_SUCCESS, 0))
        assert client.read(1, ct.LED) == 0, "RAM is as after power-up"

    play(talk)


def test_overheating_and_a_stuck_horn_let_go_and_alert(play: Play) -> None:
    def talk(client: Client) -> None:
        for servo in (1, 2):
            assert client.write(servo, ct.TORQUE_ENABLE, 1) == 0
        client.emulator[1].warm(80.0)
        seize(client.emulator[2])
        assert client.write(2, ct.GOAL_POSITION, 4000) & 0x7F == 0
        client.wait_for(lambda: client.read(1, ct.TORQUE_ENABLE) == 0)
        assert client.read(1, ct.HARDWARE_ERROR_STATUS) == HardwareError.OVERHEATING
        assert client.read(1, ct.PRESENT_TEMPERATURE) > 72
        client.wait_for(lambda: client.read(2, ct.HARDWARE_ERROR_STATUS) == HardwareError.OVERLOAD, 8.0)
        assert client.write(2, ct.TORQUE_ENABLE, 1) & 0x7F == StatusError.RESULT_FAIL

    play(talk)


def test_silence_noise_and_late_bytes_are_errors_that_the_sdk_names(play: Play) -> None:
    def talk(client: Client) -> None:
        client.emulator[4].silenced = True
        assert client.handler.ping(client.port, 4)[1] == sdk.COMM_RX_TIMEOUT
        assert client.write(3, ct.LED, 1) == 0
        client.emulator[4].silenced = False
        client.bus.to_master = ByteNoise(corrupt=0.2, seed=1)
        results = {client.handler.ping(client.port, 4)[1] for _ in range(10)}
        assert results <= {sdk.COMM_SUCCESS, sdk.COMM_RX_TIMEOUT, sdk.COMM_RX_CORRUPT}
        assert results - {sdk.COMM_SUCCESS}
        client.bus.to_master = lambda data: data
        client.bus.delays = ByteDelay(0.1, 0.002, seed=2)
        assert client.handler.ping(client.port, 4) == (1060, sdk.COMM_SUCCESS, 0), "the SDK waits long enough"

    play(talk)


def test_a_new_id_and_speed_hold_for_the_sdk_too(play: Play) -> None:
    def talk(client: Client) -> None:
        handler, port = client.handler, client.port
        handler.write1ByteTxOnly(port, 2, ct.ID.address, 42)
        client.wait_for(lambda: handler.ping(port, 42)[1] == sdk.COMM_SUCCESS)
        assert handler.ping(port, 2)[1] == sdk.COMM_RX_TIMEOUT
        handler.write1ByteTxOnly(port, 42, ct.BAUD_RATE.address, 2)
        client.wait_for(lambda: handler.ping(port, 42)[1] == sdk.COMM_RX_TIMEOUT)
        assert port.setBaudRate(115_200)
        assert handler.ping(port, 42) == (1060, sdk.COMM_SUCCESS, 0)
        assert handler.ping(port, 1)[1] == sdk.COMM_RX_TIMEOUT

    play(talk)
