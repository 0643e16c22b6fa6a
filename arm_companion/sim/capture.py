"""Motion capture: tells a real flight stack where the vehicle is, as in a laboratory, by VISION_POSITION_ESTIMATE.

Its position has an error of the size that the stand-in's estimate has (`estimator`), and jumps about with it.
Satellites and a barometer are not good enough for a perch: their estimate wanders by centimetres within seconds
(docs/results.md).
"""

import math
import random
import socket
from typing import Any

from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.estimator import Estimator
from arm_companion.sim.ports import RigidState

_PERIOD_S = 0.02
_SYSTEM, _COMPONENT = 1, int(mav.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)


class Capture:
    """Poses at 50 Hz.

    Args:
        seed: of the error.
        noise_m: of the position, one sigma.
    """

    def __init__(self, seed: int, noise_m: float) -> None:
        rng = random.Random(seed)  # noqa: S311 - a simulation, repeatable by design
        self._estimator = Estimator(rng, noise_m, inertial=False)
        self._since = 0.0

    def message(self, state: RigidState, t: float, dt: float) -> Any | None:
        """The pose that is due now; None: none is.

        Args:
            state: true motion.
            t: s, of the capture's own clock.
            dt: s since the last call.
        """
        estimate = self._estimator.update(state, dt)
        self._since += dt
        if self._since < _PERIOD_S - 1e-9:
            return None
        self._since -= _PERIOD_S
        return mav.MAVLink_vision_position_estimate_message(
            round(t * 1e6), *estimate.position_w, *estimate.euler, [math.nan] * 21
        )


class CaptureLine:
    """The same by UDP, to a flight stack that has spoken on this line first.

    Args:
        capture: the poses.

    Raises:
        LinkError: there is no port.
    """

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._codec = mav.MAVLink(None, _SYSTEM, _COMPONENT)
        self._peer: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", 0))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"UDP for motion capture: {error.strerror}") from error
        self._socket.setblocking(False)

    @property
    def port(self) -> int:
        """Where the flight stack speaks to."""
        return int(self._socket.getsockname()[1])

    def tell(self, state: RigidState, t: float, dt: float) -> None:
        """Send the pose that is due; see `Capture.message`."""
        message = self._capture.message(state, t, dt)
        if message is None:
            return
        try:
            while True:
                _, self._peer = self._socket.recvfrom(65_536)
        except (BlockingIOError, ConnectionRefusedError):  # all is read, or the flight stack boots
            pass
        if self._peer is not None:
            frame = message.pack(self._codec)
            self._codec.seq = (self._codec.seq + 1) % 256
            try:
                self._socket.sendto(frame, self._peer)
            except (BlockingIOError, ConnectionRefusedError):
                return

    def close(self) -> None:
        """Leave the port."""
        self._socket.close()
