"""A stock pymavlink client over UDP flies the stand-in: arm, take off, OFFBOARD, move, land. In real time."""

import asyncio
import math
import socket
import threading
import time
from typing import Any

import pytest

from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.transport.udp import udp_out
from tests.sim.flight_rig import config, fly
from tests.sim.rigid_body import RigidBody

HEIGHT_M = 0.9


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Client:
    """pymavlink's own connection, used the way its users write scripts."""

    def __init__(self, port: int) -> None:
        from pymavlink import mavutil

        self.util = mavutil
        self.link = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{port}", source_system=254, source_component=191, dialect="common"
        )

    def expect(self, kind: str, condition: str | None = None, timeout: float = 5.0) -> Any:
        message = self.link.recv_match(type=kind, condition=condition, blocking=True, timeout=timeout)
        assert message is not None, f"no {kind} with {condition} within {timeout} s"
        return message

    def command(self, number: int, *parameters: float) -> int:
        numbers = [*parameters, *[0.0] * (7 - len(parameters))]
        self.link.mav.command_long_send(1, 1, number, 0, *numbers)
        return int(self.expect("COMMAND_ACK", f"COMMAND_ACK.command=={number}").result)

    def setpoint(self, x: float, y: float, z: float) -> None:
        mavlink = self.util.mavlink
        mask = mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
        self.link.mav.set_position_target_local_ned_send(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, mask, x, y, z, 0, 0, 0, 0, 0, 0, 0, 0
        )

    def stream(self, seconds: float, *goal: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.setpoint(*goal)
            time.sleep(0.05)
            while self.link.recv_match(blocking=False) is not None:
                pass

    def fly(self) -> dict[str, Any]:
        """The whole flight; what was seen on the way is judged by the test."""
        mavlink = self.util.mavlink
        seen: dict[str, Any] = {}
        heartbeat = self.link.wait_heartbeat(timeout=5)
        seen["autopilot"], seen["version"] = heartbeat.autopilot, self.link.WIRE_PROTOCOL_VERSION
        self.expect("SYS_STATUS", f"SYS_STATUS.onboard_control_sensors_health&{mavlink.MAV_SYS_STATUS_PREARM_CHECK}")
        self.link.param_fetch_one("COM_OF_LOSS_T")
        seen["parameter"] = self.expect("PARAM_VALUE", "PARAM_VALUE.param_id=='COM_OF_LOSS_T'").param_value
        asked = (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20_000)
        seen["interval"] = self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *asked)
        seen["takeoff"] = self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, 0, 0, math.nan)
        self.link.arducopter_arm()
        self.link.motors_armed_wait()
        self.expect("LOCAL_POSITION_NED", f"LOCAL_POSITION_NED.z<{0.15 - HEIGHT_M}", timeout=10)
        goal = (0.6, 0.0, -HEIGHT_M)
        self.stream(1.3, *goal)
        self.link.set_mode("OFFBOARD")  # by name, through pymavlink's own table of PX4 modes
        for _ in range(12):  # a busy machine takes longer
            self.stream(1.0, *goal)
            where = self.link.messages["LOCAL_POSITION_NED"]
            if math.dist((where.x, where.y, where.z), goal) < 0.1:
                break
        seen["mode"] = self.expect("HEARTBEAT", "HEARTBEAT.get_srcComponent()==1").custom_mode
        seen["flightmode"] = self.link.flightmode
        where = self.link.messages["LOCAL_POSITION_NED"]
        seen["position"] = (where.x, where.y, where.z)
        seen["land"] = self.command(mavlink.MAV_CMD_NAV_LAND)
        self.link.motors_disarmed_wait()
        return seen

    def close(self) -> None:
        self.link.close()


@pytest.mark.realtime
def test_a_pymavlink_script_flies_offboard_and_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    port = free_port()
    body = RigidBody()

    async def main() -> dict[str, Any]:
        autopilot = AutopilotStandIn(config(takeoff_height_m=HEIGHT_M), ready_s=1.0)
        client = Client(port)
        async with asyncio.TaskGroup() as group:
            tasks = [
                group.create_task(autopilot.run(udp_out("127.0.0.1", free_port()), udp_out("127.0.0.1", port))),
                group.create_task(fly(autopilot, body)),
            ]
            try:
                async with asyncio.timeout(40):
                    return await asyncio.to_thread(client.fly)
            finally:
                client.close()
                for task in tasks:
                    task.cancel()

    seen = asyncio.run(main())
    assert seen["autopilot"] == 12
    assert seen["version"] == "2.0"
    assert seen["parameter"] == 1.0
    assert seen["interval"] == seen["takeoff"] == seen["land"] == 0
    assert seen["mode"] == 6 << 16
    assert seen["flightmode"] == "OFFBOARD"
    assert seen["position"] == pytest.approx((0.6, 0.0, -HEIGHT_M), abs=0.12)
    assert abs(body.position[2]) < 0.02
    assert threading.active_count() <= 2
