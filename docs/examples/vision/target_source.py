"""A vision process that tells the arm where the bar is: from what a camera sees to ARM_TARGET.

    python target_source.py --arm udpout:127.0.0.1:14570 --camera-position 0.10 0 0.03

The detector here is a stand-in that sees a bar at a fixed place; put yours in `detect`. Everything else can stay.
"""

import argparse
import math
import select
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arm_companion.protocol.dialect import mav

PERIOD_S = 0.1
OLD_S = 0.5  # a pose of the vehicle that is older says nothing of this frame
ME = 191  # MAV_COMP_ID_ONBOARD_COMPUTER, of the vehicle's system
ARM = 192
# camera axes (x right, y down, z forward) in body axes (x forward, y right, z down), for a camera that looks ahead
BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass
class Sighting:
    """One bar in one frame, in camera axes."""

    point: np.ndarray  # m, of the bar's axis
    axis: np.ndarray  # direction of the bar's axis
    radius: float  # m
    sigma: float  # m, one sigma of point
    exposed: float  # Unix time of the exposure, s


@dataclass
class VehiclePose:
    """Where the vehicle is, from the autopilot's own stream."""

    position: np.ndarray | None = None  # m, NED
    attitude: np.ndarray | None = None  # body to NED, 3x3
    heard: float = -math.inf  # Unix time of the newest part, s

    def hear(self, message: mav.MAVLink_message) -> None:
        """Take in one message of the autopilot."""
        if message.get_srcComponent() != 1:
            return
        if message.get_type() == "LOCAL_POSITION_NED":
            self.position, self.heard = np.array([message.x, message.y, message.z]), time.time()
        elif message.get_type() == "ATTITUDE_QUATERNION":
            self.attitude = matrix(message.q1, message.q2, message.q3, message.q4)


def matrix(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Rotation of a unit quaternion."""
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def detect() -> Sighting | None:
    """What the newest frame shows: replace this by your detector. None: no bar."""
    return Sighting(np.array([0.0, -0.3, 2.5]), np.array([1.0, 0.0, 0.0]), 0.035, 0.02, time.time())


def target(seen: Sighting, pose: VehiclePose, camera_position: Sequence[float], system: int) -> mav.MAVLink_message:
    """ARM_TARGET of a bar, in the autopilot's local frame.

    Args:
        seen: in camera axes.
        pose: of the vehicle when the frame was exposed, complete.
        camera_position: of the camera in body axes, m.
        system: the vehicle's MAVLink system id.
    """
    world_from_camera = pose.attitude @ BODY_FROM_CAMERA
    point = pose.position + pose.attitude @ np.asarray(camera_position) + world_from_camera @ seen.point
    axis = world_from_camera @ seen.axis
    nan, variance = math.nan, seen.sigma**2
    return mav.MAVLink_arm_target_message(
        system,
        ARM,
        round(seen.exposed * 1e6),
        mav.ARM_TARGET_KIND_BAR,
        mav.MAV_FRAME_LOCAL_NED,
        point.tolist(),
        axis.tolist(),
        [nan] * 4,
        seen.radius,
        [variance, 0.0, 0.0, variance, 0.0, variance],
        nan,
    )


def address(text: str) -> tuple[str, int]:
    """Host and port of a URL."""
    host, _, port = text.removeprefix("udpout:").rpartition(":")
    if not host or not port.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not udpout:HOST:PORT")
    return host, int(port)


def main() -> int:
    """Send what is seen, until Ctrl-C."""
    parser = argparse.ArgumentParser(description="Tell the arm where the bar is.")
    parser.add_argument("--arm", type=address, default="udpout:127.0.0.1:14570", help="the arm's link of role peer")
    place: dict[str, Any] = {"type": float, "nargs": 3, "metavar": ("X", "Y", "Z"), "default": (0.10, 0.0, 0.03)}
    parser.add_argument("--camera-position", help="m, body axes", **place)
    arguments = parser.parse_args()
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.connect(arguments.arm)
    codec = mav.MAVLink(None, srcComponent=ME)
    codec.robust_parsing = True
    pose, system, told, said = VehiclePose(), 0, 0.0, ""
    while True:
        if select.select([link], [], [], PERIOD_S)[0]:
            try:
                data = link.recv(65_535)
            except ConnectionRefusedError:  # the arm's daemon does not run yet
                time.sleep(PERIOD_S)
                continue
            for message in codec.parse_buffer(data) or []:
                pose.hear(message)
                system = message.get_srcSystem() if message.get_type() == "HEARTBEAT" else system
        if time.time() - told < PERIOD_S:
            continue
        told = time.time()
        codec.srcSystem = system or 1
        messages = [
            mav.MAVLink_heartbeat_message(mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
        ]
        fresh = pose.position is not None and pose.attitude is not None and told - pose.heard < OLD_S
        doing = "waiting for the vehicle's pose" if system else "waiting for the arm's link"
        doing = "telling what is seen" if system and fresh else doing
        if doing != said:
            said = doing
            print(doing, flush=True)
        if system and fresh and (seen := detect()) is not None:
            messages.append(target(seen, pose, arguments.camera_position, system))
        for message in messages:
            try:
                link.send(message.pack(codec))
            except ConnectionRefusedError:
                break


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(0)
