"""ArduPilot's JSON interface: the plant as the physics behind a copter SITL started with `--model JSON`.

SITL sends a packet of motor commands by UDP and stands still until the physics has answered with where the vehicle
is; its clock is the physics' (ArduPilot's documentation, "SITL with JSON"). Motor commands are taken up one frame
after the state that they belong to: so SITL and plant compute at the same time, on two processors.
"""

import json
import select
import socket
import struct
import time
from collections.abc import Sequence

from arm_companion.errors import LinkError
from arm_companion.sim.capture import CaptureLine
from arm_companion.sim.ports import RigidState, RotorCommand
from arm_companion.sim.rotors import LAYOUT, Rotors

PORT = 9002
_SERVOS = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}  # by the magic number: 16 or 32 channels
_MAGIC = struct.Struct("<H")
_LARGEST = 2048
_PWM_LOW, _PWM_RANGE = 1000.0, 1000.0  # us; MOT_PWM_MIN and MOT_PWM_MAX of the shipped parameters


class ServoFrame:
    """One packet of SITL: the number of the frame and the pulse widths of its motors."""

    __slots__ = ("count", "pwm")

    def __init__(self, data: bytes) -> None:
        """Read a packet.

        Raises:
            ValueError: it is none.
        """
        if len(data) < _MAGIC.size:
            raise ValueError(f"{len(data)} bytes are no servo packet")
        form = _SERVOS.get(_MAGIC.unpack_from(data)[0])
        if form is None or len(data) != form.size:
            raise ValueError(f"{len(data)} bytes that begin with {data[:2].hex()} are no servo packet")
        _, _, self.count, *self.pwm = form.unpack(data)

    def throttles(self) -> list[float]:
        """Share of the range for each motor; a pulse of 0 means that there is none."""
        return [(pulse - _PWM_LOW) / _PWM_RANGE if pulse else 0.0 for pulse in self.pwm[: len(LAYOUT)]]


def state_line(t: float, state: RigidState) -> bytes:
    """The physics' answer. SITL's own parser takes no space after a colon.

    Args:
        t: s since the physics began.
        state: of the airframe.

    Raises:
        ValueError: the state has what is no finite number, which SITL would fly with.
    """
    value = {
        "timestamp": t,
        "imu": {"gyro": state.rate_b, "accel_body": state.specific_force_b},
        "position": state.position_w,
        "quaternion": state.attitude_wb,
        "velocity": state.velocity_w,
    }
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return f"\n{text}\n".encode()


class ArdupilotBridge:
    """Turns of SITL and plant.

    A frame count that comes again is the same frame: SITL repeats itself after a second without an answer. A lower
    one is a SITL that has booted again.

    Args:
        mass: of the whole vehicle, kg.
        address: where SITL sends its packets.
        capture: tells it where it is; None: satellites alone do.

    Attributes:
        frames, repeated, malformed, boots: counted.

    Raises:
        LinkError: the address is taken.
    """

    period_s = 0.002
    """Of the turns: 500 Hz, which ArduPilot's own loop of 400 Hz follows."""

    def __init__(
        self, mass: float, address: tuple[str, int] = ("127.0.0.1", PORT), capture: CaptureLine | None = None
    ) -> None:
        self.frames = self.repeated = self.malformed = self.boots = 0
        self._rotors = Rotors(mass)
        self._capture = capture
        self._throttles: Sequence[float] = (0.0,) * len(LAYOUT)
        self._peer: tuple[str, int] | None = None
        self._sender: tuple[str, int] | None = None  # of the packet that was read last
        self._count = -1
        self._t = 0.0
        self._answer = b""
        self._waiting = False  # for a frame that answers what was sent last
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise LinkError(f"UDP port {address[1]} for ArduPilot's physics: {error.strerror}") from error
        self._socket.setblocking(False)

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def close(self) -> None:
        """Leave the port."""
        self._socket.close()

    def answered(self, within_s: float) -> bool:
        """Whether SITL has had its turn; waits for it for so long, at most.

        Args:
            within_s: s on the machine's clock, 0 to look only.
        """
        until = time.perf_counter() + within_s
        while True:
            while (data := self._receive()) is not None:
                if self._take(data):
                    self._waiting = False
            if self._peer is not None and not self._waiting:
                return True
            left = until - time.perf_counter()
            if left <= 0.0 or not select.select([self._socket], [], [], left)[0]:
                return False

    def ask_again(self) -> None:
        """Send the last answer once more: it may not have arrived."""
        if self._answer:
            self._send(self._answer)

    def control(self, state: RigidState, dt: float) -> RotorCommand:
        """Tell SITL where the vehicle is, and take what its motors were last told.

        Args:
            state: true motion now.
            dt: s since the last call.
        """
        self._t += dt
        if self._capture is not None:
            self._capture.tell(state, self._t, dt)  # before the answer, which gives SITL its turn
        self._answer = state_line(self._t, state)
        self._send(self._answer)
        self._waiting = self._peer is not None
        return self._rotors.turn(self._throttles, dt)

    def coast(self, dt: float) -> RotorCommand:
        """SITL is silent, as an autopilot that boots: nobody drives the motors."""
        self._throttles = (0.0,) * len(LAYOUT)
        return self._rotors.turn(self._throttles, dt)

    def _receive(self) -> bytes | None:
        try:
            data, self._sender = self._socket.recvfrom(_LARGEST)
        except (BlockingIOError, ConnectionRefusedError):
            return None
        return data

    def _take(self, data: bytes) -> bool:
        """Whether this is a frame that has not been seen."""
        try:
            frame = ServoFrame(data)
        except ValueError:
            self.malformed += 1
            return False
        if frame.count == self._count and self._sender == self._peer:
            self.repeated += 1
            return False
        if frame.count < self._count or self._sender != self._peer:
            self.boots += 1
        self._count, self._peer = frame.count, self._sender
        self._throttles = frame.throttles()
        self.frames += 1
        return True

    def _send(self, data: bytes) -> None:
        try:
            if self._peer is not None:
                self._socket.sendto(data, self._peer)
        except (BlockingIOError, ConnectionRefusedError):  # SITL's socket is gone for a while: it boots
            return
