"""PX4's hardware-in-the-loop interface: the plant as the simulator behind a PX4 SITL built with lock-step.

PX4 connects by TCP, takes HIL_SENSOR and HIL_GPS, and answers every HIL_SENSOR of its first IMU with
HIL_ACTUATOR_CONTROLS once its outputs run; its clock is the sensors' (PX4's documentation, "Simulation", "Lockstep").
The sensors have a little noise, without which PX4 takes them for stuck.
"""

import math
import random
import select
import socket
import time
from collections.abc import Sequence
from typing import Any

from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.capture import Capture
from arm_companion.sim.mjcf import GRAVITY
from arm_companion.sim.ports import RigidState, RotorCommand, Vec3
from arm_companion.sim.rotors import LAYOUT, Rotors

PORT = 4560
HOME = (47.397742, 8.545594, 488.0)
"""Latitude and longitude, deg, and height over the sea, m, of the world's origin."""
_FIELD_NED = (0.21523, 0.00771, 0.42741)  # gauss, the earth's at HOME by the World Magnetic Model
_EARTH_RADIUS_M = 6_371_000.0  # the sphere that PX4 projects with

_IMU, _MAG, _BARO = 0b111111, 0b111000000, 0b1101000000000  # bits of HIL_SENSOR's fields_updated
_MAG_EVERY, _BARO_EVERY, _GPS_EVERY = 4, 5, 25  # turns: 62, 50 and 10 Hz
_GYRO_NOISE, _ACCEL_NOISE, _MAG_NOISE, _BARO_NOISE_PA = 0.001, 0.02, 0.0005, 0.5  # one sigma: rad/s, m/s^2, gauss, Pa
_LOCKSTEP = 1  # bit of HIL_ACTUATOR_CONTROLS' flags
_START_S = 1.0  # PX4 takes time 0 for none
_BOOTING_PERIOD_S = 0.004  # of the machine's time, in which a PX4 that does not answer yet gets its sensors


class Px4Bridge:
    """Turns of SITL and plant.

    Args:
        mass: of the whole vehicle, kg.
        seed: of the sensors' noise.
        address: where PX4 connects.
        capture: tells it where it is; None: satellites and barometer alone do.

    Attributes:
        frames: HIL_ACTUATOR_CONTROLS taken.
        malformed: bytes or messages that were not understood.
        boots: connections.

    Raises:
        LinkError: the address is taken.
    """

    period_s = 0.004
    """Of the turns: PX4 expects the sensors at 250 Hz."""

    def __init__(
        self, mass: float, seed: int, address: tuple[str, int] = ("127.0.0.1", PORT), capture: Capture | None = None
    ) -> None:
        self.frames = self.malformed = self.boots = 0
        self._rotors = Rotors(mass)
        self._throttles: Sequence[float] = (0.0,) * len(LAYOUT)
        self._rng = random.Random(seed)  # noqa: S311 - a simulation, repeatable by design
        self._capture = capture
        self._t = _START_S
        self._turns = 0
        self._velocity: Vec3 | None = None  # at the last turn
        self._waiting = False
        self._lockstep = False  # it has answered, and so will answer every turn
        self._codec = self._fresh_codec()
        self._connection: socket.socket | None = None
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(address)
            self._listener.listen(1)
        except OSError as error:
            self._listener.close()
            raise LinkError(f"TCP port {address[1]} for PX4's sensors: {error.strerror}") from error
        self._listener.setblocking(False)

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        host, port = self._listener.getsockname()
        return str(host), int(port)

    def close(self) -> None:
        """Leave the port."""
        self._hang_up()
        self._listener.close()

    def answered(self, within_s: float) -> bool:
        """Whether PX4 has had its turn; waits for it for so long, at most.

        Args:
            within_s: s on the machine's clock, 0 to look only.
        """
        start = time.perf_counter()
        until = start + within_s
        while True:
            self._accept()
            self._read()
            if self._connection is not None and not self._lockstep:
                until = min(until, start + _BOOTING_PERIOD_S)
            if self._connection is not None and self._lockstep and not self._waiting:
                return True
            left = until - time.perf_counter()
            if left <= 0.0:
                return self._connection is not None and not self._lockstep
            select.select([self._connection or self._listener], [], [], left)

    def ask_again(self) -> None:
        """It has not answered these sensors, as when its outputs stand still: go on without."""
        self._lockstep = False

    def control(self, state: RigidState, dt: float) -> RotorCommand:
        """Tell PX4's sensors what they feel, and take what its motors were last told.

        Args:
            state: true motion now.
            dt: s since the last call.
        """
        self._t += dt
        self._turns += 1
        if self._capture is not None and (pose := self._capture.message(state, self._t, dt)) is not None:
            self._send(pose)  # before the sensors, which it belongs to: they give PX4 its turn
        for message in self._messages(state, self._felt(state, dt)):
            self._send(message)
        self._waiting = self._connection is not None
        return self._rotors.turn(self._throttles, dt)

    def coast(self, dt: float) -> RotorCommand:
        """PX4 is silent, as an autopilot that boots: nobody drives the motors."""
        self._throttles = (0.0,) * len(LAYOUT)
        return self._rotors.turn(self._throttles, dt)

    # Sensors --------------------

    def _felt(self, state: RigidState, dt: float) -> Vec3:
        """Specific force, m/s^2, body axes, mean since the last turn: sensors integrate, and so does what reads them.

        The force of one instant would be off by what a bar's blow did between two instants.
        """
        before, self._velocity = self._velocity, state.velocity_w
        if before is None or dt <= 0.0:
            return state.specific_force_b
        a, b, c = ((new - old) / dt for new, old in zip(state.velocity_w, before, strict=True))
        return to_body(state.attitude_wb, (a, b, c - GRAVITY))

    def _messages(self, state: RigidState, felt: Vec3) -> list[Any]:
        turns, time_usec = self._turns, round(self._t * 1e6)
        updated = _IMU
        updated |= _MAG if turns % _MAG_EVERY == 0 else 0
        updated |= _BARO if turns % _BARO_EVERY == 0 else 0
        height = HOME[2] - state.position_w[2]
        pressure, temperature = atmosphere(height)
        pressure += self._rng.gauss(0.0, _BARO_NOISE_PA)
        messages = [
            mav.MAVLink_hil_sensor_message(
                time_usec,
                *self._noisy(felt, _ACCEL_NOISE),
                *self._noisy(state.rate_b, _GYRO_NOISE),
                *self._noisy(to_body(state.attitude_wb, _FIELD_NED), _MAG_NOISE),
                pressure / 100.0,
                0.0,
                height,
                temperature,
                updated,
            )
        ]
        if turns % _GPS_EVERY == 0:
            messages.append(self._gps(state, time_usec))
        return messages

    def _gps(self, state: RigidState, time_usec: int) -> Any:
        latitude, longitude, height = geodetic(state.position_w)
        north, east, down = state.velocity_w
        course = math.degrees(math.atan2(east, north)) % 360.0
        return mav.MAVLink_hil_gps_message(
            time_usec,
            3,
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(height * 1e3),
            30,
            40,
            round(math.hypot(north, east) * 100),
            round(north * 100),
            round(east * 100),
            round(down * 100),
            round(course * 100) % 36_000,
            16,
        )

    def _noisy(self, values: Vec3, sigma: float) -> Vec3:
        gauss = self._rng.gauss
        return values[0] + gauss(0.0, sigma), values[1] + gauss(0.0, sigma), values[2] + gauss(0.0, sigma)

    # The line --------------------

    @staticmethod
    def _fresh_codec() -> Any:
        codec = mav.MAVLink(None, 1, 51)
        codec.robust_parsing = True
        return codec

    def _accept(self) -> None:
        """Take a PX4 that connects; one that boots again comes on a new connection."""
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        self._hang_up()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection, self._codec = connection, self._fresh_codec()
        self.boots += 1

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection, self._lockstep, self._waiting = None, False, False

    def _read(self) -> None:
        while self._connection is not None:
            try:
                data = self._connection.recv(4096)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._hang_up()
                return
            for message in self._codec.parse_buffer(data) or ():
                self._take(message)

    def _take(self, message: Any) -> None:
        name = message.get_type()
        if name == "BAD_DATA":
            self.malformed += 1
        elif name == "HIL_ACTUATOR_CONTROLS":
            self.frames += 1
            self._waiting = False
            self._lockstep = bool(message.flags & _LOCKSTEP)
            armed = bool(message.mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
            self._throttles = tuple(message.controls[: len(LAYOUT)]) if armed else (0.0,) * len(LAYOUT)

    def _send(self, message: Any) -> None:
        if self._connection is None:
            return
        frame = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        try:
            self._connection.sendall(frame)
        except OSError:  # gone, or so far behind that its buffer is full: either way it is heard of when read
            return


def to_body(attitude_wb: tuple[float, float, float, float], v: Vec3) -> Vec3:
    """A world vector in body axes: R(q)^T v."""
    w, x, y, z = attitude_wb
    a, b, c = v
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def atmosphere(height: float) -> tuple[float, float]:
    """Pressure in Pa and temperature in deg C of the International Standard Atmosphere's lowest layer.

    Args:
        height: m over the sea.
    """
    kelvin = 288.15 - 0.0065 * height
    return 101_325.0 * (kelvin / 288.15) ** 5.2559, kelvin - 273.15


def geodetic(position_w: Vec3) -> tuple[float, float, float]:
    """Latitude and longitude in deg and height in m of a place near HOME, on a sphere.

    Args:
        position_w: m, NED from HOME.
    """
    north, east, down = position_w
    latitude = HOME[0] + math.degrees(north / _EARTH_RADIUS_M)
    longitude = HOME[1] + math.degrees(east / (_EARTH_RADIUS_M * math.cos(math.radians(HOME[0]))))
    return latitude, longitude, HOME[2] - down
