"""A stock pymavlink ground station calibrates the tendons of the daemon, in real time, and thinks better of it."""

import asyncio
import socket
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import precise_loop
from arm_companion.protocol.dialect import mav
from arm_companion.sim.servo_emulator import keep_time
from arm_companion.transport.urls import open_url
from tests.sim.on_the_ground import OnTheGround

pytestmark = pytest.mark.realtime

CALIBRATE, ABORT = mav.MAV_CMD_ARM_CALIBRATE, mav.MAV_CMD_ARM_ABORT


class Station:
    """What a script with pymavlink does, step by step."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self.texts = ""

    def send(self, command: int, *parameters: float) -> None:
        filled = (*parameters, *[0.0] * (7 - len(parameters)))
        self._connection.mav.command_long_send(1, 192, command, 0, *filled)

    def beat(self) -> Any:
        return self._connection.recv_match(type="HEARTBEAT", blocking=True, timeout=5.0)

    def ack(self, command: int) -> Any:
        """The next answer to a command."""
        while message := self._connection.recv_match(type=["COMMAND_ACK", "STATUSTEXT"], blocking=True, timeout=20.0):
            if message.get_type() == "STATUSTEXT":
                self.texts += message.text
            elif message.command == command:
                return message
        raise AssertionError(f"no answer; it said {self.texts}")


def operate(connection: Any) -> str:
    station = Station(connection)
    while (beat := station.beat()).get_srcComponent() != 192:
        pass
    assert beat.system_status != mav.MAV_STATE_CALIBRATING
    station.send(CALIBRATE, 1.0)
    assert station.ack(CALIBRATE).result == mav.MAV_RESULT_DENIED
    station.send(CALIBRATE, 1.0, 1.0)
    while (ack := station.ack(CALIBRATE)).progress < 3:
        assert ack.result == mav.MAV_RESULT_IN_PROGRESS
    while station.beat().system_status != mav.MAV_STATE_CALIBRATING:
        pass
    station.send(ABORT)
    while (result := station.ack(CALIBRATE).result) == mav.MAV_RESULT_IN_PROGRESS:
        pass
    assert result == mav.MAV_RESULT_CANCELLED
    while station.beat().system_status == mav.MAV_STATE_CALIBRATING:
        pass
    return station.texts


def test_a_stock_ground_station_is_denied_followed_and_obeyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    from pymavlink import mavutil

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    arm = OnTheGround(tmp_path, "calibration.take_up_m_per_s=0.02", "rates.cycle_hz=50")
    # in real time the servos' clocks must go with the machine's, also when it stalls; what they pull at does not matter
    monkeypatch.setattr(arm.arm, "run", lambda: keep_time(arm.arm.servos, 0.004))
    texts: list[str] = []

    async def script() -> None:
        connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{port}", source_system=255, source_component=190, dialect="common"
        )
        try:
            texts.append(await asyncio.to_thread(operate, connection))
        finally:
            connection.close()

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        daemon = runner.run(arm.alive(script, open_url(f"udpout:127.0.0.1:{port}")))
    assert "param2 = 0: 1 confirms that nothing touches the arm" in texts[0]
    assert daemon.failures == 0
    assert not list(tmp_path.glob("tendons*"))
