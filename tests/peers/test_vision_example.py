"""The vision example: geometry of its targets, and what it sends to somebody who stands where the arm would."""

import math
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from arm_companion.drivers.targets import read_bar
from arm_companion.protocol.dialect import mav
from tests.documentation import program

SCRIPT = Path(__file__).parents[2] / "docs" / "examples" / "vision" / "target_source.py"


@pytest.fixture(scope="module")
def vision() -> ModuleType:
    return program(SCRIPT)


def test_what_is_seen_ahead_of_a_vehicle_that_faces_east_is_in_the_east(vision: ModuleType) -> None:
    half = math.sqrt(0.5)
    pose = vision.VehiclePose(np.array([10.0, 20.0, -5.0]), vision.matrix(half, 0.0, 0.0, half), 0.0)
    seen = vision.Sighting(np.array([0.5, -0.3, 2.0]), np.array([1.0, 0.0, 0.0]), 0.03, 0.02, 1000.0)
    message = vision.target(seen, pose, (0.1, 0.0, 0.03), 7)
    codec = mav.MAVLink(None)
    (heard,) = codec.parse_buffer(message.pack(codec))
    assert (heard.target_system, heard.target_component, heard.time_usec) == (7, 192, 1_000_000_000)
    bar = read_bar(heard)
    # ahead 2.1 m is east, 0.5 m to the right is south, 0.27 m up
    assert bar.point_w == pytest.approx((9.5, 22.1, -5.27), abs=1e-5)
    assert bar.axis_w == pytest.approx((-1.0, 0.0, 0.0), abs=1e-6)
    assert bar.radius == pytest.approx(0.03)
    assert bar.covariance_w == pytest.approx((4e-4, 0.0, 0.0, 4e-4, 0.0, 4e-4))


@pytest.mark.realtime
def test_it_sends_nothing_before_it_knows_the_pose_and_then_what_the_arm_can_read() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as arm:
        arm.bind(("127.0.0.1", 0))
        arm.settimeout(0.2)
        port = arm.getsockname()[1]
        process = subprocess.Popen([sys.executable, str(SCRIPT), "--arm", f"udpout:127.0.0.1:{port}"])
        parser, autopilot = mav.MAVLink(None), mav.MAVLink(None, srcSystem=3, srcComponent=1)
        heard: list[mav.MAVLink_message] = []

        def listen(seconds: float, *tell: mav.MAVLink_message) -> list[str]:
            heard.clear()
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                try:
                    data, address = arm.recvfrom(65_535)
                except TimeoutError:
                    continue
                heard.extend(parser.parse_buffer(data) or [])
                for message in tell:
                    arm.sendto(message.pack(autopilot), address)
            return [message.get_type() for message in heard]

        try:
            deadline = time.monotonic() + 20.0
            while not listen(0.3):
                assert time.monotonic() < deadline, "it does not begin"
            assert set(listen(1.0)) == {"HEARTBEAT"}
            told = listen(
                2.0,
                mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, 0, 0, 4, 3),
                mav.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0),
                mav.MAVLink_attitude_quaternion_message(0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            )
            assert told.count("ARM_TARGET") >= 5
            newest = [message for message in heard if message.get_type() == "ARM_TARGET"][-1]
            assert (newest.get_srcSystem(), newest.get_srcComponent(), newest.target_system) == (3, 191, 3)
            assert read_bar(newest).point_w == pytest.approx((3.6, 2.0, -3.27), abs=1e-5)
            assert time.time() - newest.time_usec / 1e6 < 3.0
            assert "ARM_TARGET" in listen(0.3)
            listen(1.5)  # the autopilot is silent
            assert set(listen(0.5)) == {"HEARTBEAT"}
        finally:
            process.terminate()
            process.wait(10.0)
