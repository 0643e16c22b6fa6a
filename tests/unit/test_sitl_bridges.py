"""The bridges to real flight stacks, against small peers that speak ArduPilot's JSON and PX4's HIL interface."""

import itertools
import json
import math
import select
import socket
import statistics
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.capture import Capture, CaptureLine
from arm_companion.sim.flight_control import Airframe, Estimate, FlightController, MotionSetpoint
from arm_companion.sim.ports import RigidState
from arm_companion.sim.rotors import ARM_M, LAG_S, LAYOUT, THRUST_TO_WEIGHT, TORQUE_PER_THRUST_M, Rotors
from arm_companion.sim.sitl_ardupilot import ArdupilotBridge, ServoFrame, state_line
from arm_companion.sim.sitl_px4 import HOME, Px4Bridge, atmosphere, geodetic, to_body
from tests.sim.rigid_body import RigidBody

MASS = 1.8
WEIGHT = MASS * 9.81
HOVER = math.sqrt(1.0 / THRUST_TO_WEIGHT)
STILL = RigidState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -9.81))
WAIT_S = 2.0
DT = 0.002


# --- rotors ---


def settled(throttles: list[float]) -> Any:
    rotors = Rotors(MASS)
    return rotors.turn(throttles, 20 * LAG_S)


def test_rotors_hover_at_half_thrust_and_lift_twice_the_weight() -> None:
    assert settled([HOVER] * 4).thrust_n == pytest.approx(WEIGHT, rel=1e-6)
    full = settled([1.0] * 4)
    assert full.thrust_n == pytest.approx(THRUST_TO_WEIGHT * WEIGHT, rel=1e-6)
    assert full.torque_b == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("throttles", "axis", "sign"),
    [
        ([0.5, 0.6, 0.6, 0.5], 0, 1),  # more on the left: rolls right
        ([0.6, 0.5, 0.6, 0.5], 1, 1),  # more in front: pitches up
        ([0.6, 0.6, 0.5, 0.5], 2, 1),  # more on those that turn counter-clockwise: yaws clockwise
    ],
)
def test_rotors_turn_the_body_about_one_axis(throttles: list[float], axis: int, sign: int) -> None:
    torque = settled(throttles).torque_b
    assert torque[axis] * sign > 0.01
    assert all(abs(torque[i]) < 1e-9 for i in range(3) if i != axis)


def test_one_rotor_makes_the_torque_of_its_place() -> None:
    rotors = settled([0.0, 0.0, 0.0, 1.0])  # rear right
    assert rotors.torque_b[0] == pytest.approx(-ARM_M * rotors.thrust_n)
    assert rotors.torque_b[1] == pytest.approx(-ARM_M * rotors.thrust_n)


def test_thrust_lags_a_step_by_the_time_constant() -> None:
    assert Rotors(MASS).turn([1.0] * 4, LAG_S).thrust_n == pytest.approx(
        THRUST_TO_WEIGHT * WEIGHT * (1.0 - math.exp(-1.0))
    )


@given(st.lists(st.floats(), min_size=4, max_size=4))
def test_rotors_take_any_number_for_a_throttle(throttles: list[float]) -> None:
    command = settled(throttles)
    assert 0.0 <= command.thrust_n <= THRUST_TO_WEIGHT * WEIGHT * (1.0 + 1e-9)
    assert all(math.isfinite(part) for part in command.torque_b)


def test_rotors_refuse_another_number_of_motors() -> None:
    with pytest.raises(ValueError, match="argument"):
        Rotors(MASS).turn([0.5] * 3, DT)


# --- ArduPilot ---


class FakeArdupilot:
    """A SITL that sends frames and reads answers when told to."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(WAIT_S)
        self._to = ("127.0.0.1", port)

    def send(self, count: int, pwm: tuple[int, ...] = (1500,) * 16) -> None:
        magic = 18458 if len(pwm) == 16 else 29569
        self.raw(struct.pack(f"<HHI{len(pwm)}H", magic, 1200, count, *pwm))

    def raw(self, data: bytes) -> None:
        self._socket.sendto(data, self._to)

    def answer(self) -> dict[str, Any]:
        data = self._socket.recv(65_000)
        assert data.startswith(b"\n")
        assert data.endswith(b"\n")
        assert b": " not in data, "SITL's parser takes no space after a colon"
        value: dict[str, Any] = json.loads(data)
        return value

    def silent(self) -> bool:
        self._socket.settimeout(0.05)
        try:
            self._socket.recv(65_000)
        except TimeoutError:
            return True
        finally:
            self._socket.settimeout(WAIT_S)
        return False

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def ardupilot() -> Iterator[tuple[ArdupilotBridge, FakeArdupilot]]:
    bridge = ArdupilotBridge(MASS, ("127.0.0.1", 0))
    peer = FakeArdupilot(bridge.address[1])
    yield bridge, peer
    peer.close()
    bridge.close()


def test_nothing_is_due_before_the_first_frame(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, _ = ardupilot
    assert not bridge.answered(0.0)


def test_state_goes_out_and_the_motors_of_the_frame_come_in(
    ardupilot: tuple[ArdupilotBridge, FakeArdupilot],
) -> None:
    bridge, peer = ardupilot
    peer.send(0)
    assert bridge.answered(WAIT_S)
    state = RigidState((1.0, 2.0, -3.0), (0.1, 0.2, 0.3), (0.6, 0.8, 0.0, 0.0), (0.4, 0.5, 0.6), (0.7, 0.8, -9.0))
    bridge.control(state, DT)
    answer = peer.answer()
    assert answer["timestamp"] == pytest.approx(DT)
    assert answer["imu"] == {"gyro": [0.4, 0.5, 0.6], "accel_body": [0.7, 0.8, -9.0]}
    assert answer["position"] == [1.0, 2.0, -3.0]
    assert answer["velocity"] == [0.1, 0.2, 0.3]
    assert answer["quaternion"] == [0.6, 0.8, 0.0, 0.0]
    assert not bridge.answered(0.0), "the next turn is SITL's"
    peer.send(1, (2000,) * 16)
    assert bridge.answered(WAIT_S)
    assert bridge.control(STILL, 20 * LAG_S).thrust_n == pytest.approx(THRUST_TO_WEIGHT * WEIGHT, rel=1e-6)


def test_a_repeated_frame_makes_no_second_step(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, peer = ardupilot
    peer.send(7)
    assert bridge.answered(WAIT_S)
    bridge.control(STILL, DT)
    peer.answer()
    peer.send(7)
    assert not bridge.answered(0.05)
    assert (bridge.frames, bridge.repeated) == (1, 1)
    assert peer.silent()
    peer.send(8)
    assert bridge.answered(WAIT_S)


def test_a_lost_answer_is_sent_again(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, peer = ardupilot
    peer.send(0)
    assert bridge.answered(WAIT_S)
    bridge.control(STILL, DT)
    first = peer.answer()
    bridge.ask_again()
    assert peer.answer() == first


def test_a_sitl_that_boots_again_is_taken_up(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, peer = ardupilot
    peer.send(500)
    assert bridge.answered(WAIT_S)
    bridge.control(STILL, DT)
    peer.send(0)
    assert bridge.answered(WAIT_S)
    bridge.control(STILL, DT)
    assert bridge.boots == 2
    again = FakeArdupilot(bridge.address[1])  # from another port
    again.send(0)
    assert bridge.answered(WAIT_S)
    bridge.control(STILL, DT)
    assert again.answer()["timestamp"] == pytest.approx(3 * DT), "the world's time goes on"
    again.close()


def test_motors_stop_while_nobody_drives_them(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, peer = ardupilot
    peer.send(0, (1800,) * 16)
    assert bridge.answered(WAIT_S)
    assert bridge.control(STILL, 1.0).thrust_n > WEIGHT
    assert bridge.coast(1.0).thrust_n < 1e-3


@given(st.binary(max_size=80))
def test_what_is_no_servo_packet_is_refused(data: bytes) -> None:
    if len(data) in {40, 72} and data[:2] in {b"\x1a\x48", b"\x81\x73"}:
        return
    with pytest.raises(ValueError, match="no servo packet"):
        ServoFrame(data)


def test_malformed_packets_are_counted_and_stop_nothing(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, peer = ardupilot
    for data in (b"", b"\x00", b"hello", struct.pack("<HHI15H", 18458, 1200, 0, *(1500,) * 15), b"\xff" * 40):
        peer.raw(data)
    peer.send(0)
    assert bridge.answered(WAIT_S)
    assert (bridge.frames, bridge.malformed) == (1, 5)


def test_thirty_two_channels_are_read_and_absent_pulses_are_no_throttle() -> None:
    frame = ServoFrame(struct.pack("<HHI32H", 29569, 400, 9, 1000, 2000, 0, 1250, *(0,) * 28))
    assert frame.count == 9
    assert frame.throttles() == [0.0, 1.0, 0.0, 0.25]


def test_no_answer_has_what_is_no_number() -> None:
    broken = RigidState((math.nan, 0.0, 0.0), (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3)
    with pytest.raises(ValueError, match="JSON compliant"):
        state_line(0.0, broken)


def test_a_taken_port_is_said(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, _ = ardupilot
    with pytest.raises(LinkError, match=str(bridge.address[1])):
        ArdupilotBridge(MASS, bridge.address)


# --- PX4 ---


class FakePx4:
    """A PX4 that connects, reads sensors and answers when told to."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), WAIT_S)
        self._codec = mav.MAVLink(None, 1, 1)
        self._heard: list[Any] = []

    def controls(self, values: tuple[float, ...], *, armed: bool = True, lockstep: bool = True) -> None:
        mode = mav.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        padded = (*values, *(0.0,) * (16 - len(values)))
        message = mav.MAVLink_hil_actuator_controls_message(0, padded, mode, int(lockstep))
        self._socket.sendall(message.pack(self._codec))

    def raw(self, data: bytes) -> None:
        self._socket.sendall(data)

    def hear(self, name: str) -> Any:
        while True:
            for i, message in enumerate(self._heard):
                if message.get_type() == name:
                    return self._heard.pop(i)
            self._heard += self._codec.parse_buffer(self._socket.recv(4096)) or ()

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def px4() -> Iterator[tuple[Px4Bridge, FakePx4]]:
    bridge = Px4Bridge(MASS, 1, ("127.0.0.1", 0))
    peer = FakePx4(bridge.address[1])
    yield bridge, peer
    peer.close()
    bridge.close()


def take(bridge: Px4Bridge) -> None:
    """Until what the peer sent has been read."""
    for _ in range(40):
        if bridge.frames:
            return
        bridge.answered(0.05)
    raise AssertionError("no HIL_ACTUATOR_CONTROLS taken")


def test_px4_gets_sensors_before_it_answers_and_one_turn_for_each_answer_after(
    px4: tuple[Px4Bridge, FakePx4],
) -> None:
    bridge, peer = px4
    for _ in range(3):
        assert bridge.answered(WAIT_S), "a PX4 that boots waits for sensors"
        bridge.control(STILL, bridge.period_s)
        peer.hear("HIL_SENSOR")
    peer.controls((0.0,) * 4)
    take(bridge)
    bridge.control(STILL, bridge.period_s)
    assert not bridge.answered(0.05)
    peer.controls((1.0,) * 4)
    assert bridge.answered(WAIT_S)
    assert bridge.control(STILL, 20 * LAG_S).thrust_n == pytest.approx(THRUST_TO_WEIGHT * WEIGHT, rel=1e-6)


def test_px4_sensors_feel_the_vehicle(px4: tuple[Px4Bridge, FakePx4]) -> None:
    bridge, peer = px4
    quarter = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # nose to the east
    state = RigidState((3.0, 4.0, -10.0), (1.0, 0.0, -0.5), quarter, (0.1, 0.2, 0.3), (0.4, 0.5, -9.0))
    assert bridge.answered(WAIT_S)
    times, magnetic, pressures = [], [], []
    for i in range(100):
        t = i * bridge.period_s  # body x points east, and body y south
        moving = replace(state, velocity_w=(1.0 - 0.5 * t, 0.4 * t, -0.5 + 0.81 * t))
        bridge.control(moving, bridge.period_s)
        message = peer.hear("HIL_SENSOR")
        times.append(message.time_usec)
        assert (message.xacc, message.yacc, message.zacc) == pytest.approx((0.4, 0.5, -9.0), abs=0.15)
        assert (message.xgyro, message.ygyro, message.zgyro) == pytest.approx((0.1, 0.2, 0.3), abs=0.01)
        if message.fields_updated & 0b111000000:
            magnetic.append((message.xmag, message.ymag, message.zmag))
        if message.fields_updated & 0b1101000000000:
            pressures.append(message.abs_pressure)
    gps = [peer.hear("HIL_GPS") for _ in range(4)]
    assert {b - a for a, b in itertools.pairwise(times)} == {4000}
    assert (len(magnetic), len(pressures)) == (25, 20)
    assert sum(m[0] for m in magnetic) / 25 == pytest.approx(0.00771, abs=1e-3), "the nose is in the east"
    assert sum(m[1] for m in magnetic) / 25 == pytest.approx(-0.21523, abs=1e-3), "north is on the left"
    assert sum(pressures) / 20 == pytest.approx(atmosphere(HOME[2] + 10.0)[0] / 100.0, abs=0.02)
    assert (gps[-1].vn, gps[-1].ve, gps[-1].vd, gps[-1].fix_type) == (80, 16, -18, 3)
    assert gps[-1].alt == round((HOME[2] + 10.0) * 1e3)
    assert (gps[-1].lat - round(HOME[0] * 1e7)) * 1e-7 * 111_194.9 == pytest.approx(3.0, abs=0.02)


def test_px4_disarmed_drives_no_motor(px4: tuple[Px4Bridge, FakePx4]) -> None:
    bridge, peer = px4
    peer.controls((1.0,) * 4, armed=False)
    take(bridge)
    assert bridge.control(STILL, 1.0).thrust_n == 0.0


def test_px4_that_stops_answering_is_not_waited_for_for_ever(px4: tuple[Px4Bridge, FakePx4]) -> None:
    bridge, peer = px4
    peer.controls((0.5,) * 4)
    take(bridge)
    bridge.control(STILL, bridge.period_s)
    assert not bridge.answered(0.0)
    bridge.ask_again()
    assert bridge.answered(0.1)


def test_px4_that_boots_again_comes_on_a_new_connection(px4: tuple[Px4Bridge, FakePx4]) -> None:
    bridge, peer = px4
    assert bridge.answered(WAIT_S)
    peer.close()
    bridge.control(STILL, bridge.period_s)
    while bridge.answered(0.01):
        bridge.control(STILL, bridge.period_s)
    again = FakePx4(bridge.address[1])
    assert bridge.answered(WAIT_S)
    bridge.control(STILL, bridge.period_s)
    assert again.hear("HIL_SENSOR").time_usec > 1_000_000
    assert bridge.boots == 2
    again.close()


def test_px4_garbage_is_counted_and_stops_nothing(px4: tuple[Px4Bridge, FakePx4]) -> None:
    bridge, peer = px4
    peer.raw(b"\xfd\x05garbage, and more of it" * 3)
    for _ in range(6):  # a frame's length in the garbage may swallow the first ones
        peer.controls((1.0,) * 4)
    take(bridge)
    assert bridge.malformed > 0


@given(st.tuples(*(st.floats(-1.0, 1.0),) * 4), st.tuples(*(st.floats(-10.0, 10.0),) * 3))
def test_a_vector_in_body_axes_keeps_its_length(
    q: tuple[float, float, float, float], v: tuple[float, float, float]
) -> None:
    norm = math.sqrt(sum(part * part for part in q))
    if norm < 0.1:
        return
    w, x, y, z = (part / norm for part in q)
    assert math.hypot(*to_body((w, x, y, z), v)) == pytest.approx(math.hypot(*v), abs=1e-9)


def test_geodetic_is_the_home_at_the_origin_and_metres_around_it() -> None:
    assert geodetic((0.0, 0.0, 0.0)) == pytest.approx(HOME)
    latitude, longitude, height = geodetic((100.0, 100.0, -20.0))
    assert (latitude - HOME[0]) * 111_194.9 == pytest.approx(100.0, rel=1e-3)
    assert (longitude - HOME[1]) * 111_194.9 * math.cos(math.radians(HOME[0])) == pytest.approx(100.0, rel=1e-3)
    assert height == HOME[2] + 20.0


def test_atmosphere_is_the_standard_one() -> None:
    assert atmosphere(0.0) == pytest.approx((101_325.0, 15.0))
    assert atmosphere(1000.0) == pytest.approx((89_875.0, 8.5), rel=1e-3)


# --- closed loops: a controller of known good manners flies a body through each interface ---


class SmallStack:
    """A small flight stack: a cascade in the peer's place, from the state that the bridge tells to motor commands."""

    def __init__(self) -> None:
        self._controller = FlightController(Airframe(MASS, motor_lag=1e-6))
        self.place = (1.0, -1.0, -2.0)

    def motors(self, estimate: Estimate, dt: float) -> list[float]:
        wanted = self._controller.update(estimate, MotionSetpoint(self.place, yaw=0.7), dt)
        roll, pitch, yaw = wanted.torque_b
        most = THRUST_TO_WEIGHT * WEIGHT / 4.0
        throttles = []
        for x, y, drag in LAYOUT:
            thrust = (wanted.thrust_n + (x * pitch - y * roll) / ARM_M + drag * yaw / TORQUE_PER_THRUST_M) / 4.0
            throttles.append(math.sqrt(min(max(thrust / most, 0.0), 1.0)))
        return throttles


def arrives(body: RigidBody, stack: SmallStack) -> None:
    state = body.state()
    estimate = Estimate(attitude_wb=state.attitude_wb)
    assert state.position_w == pytest.approx(stack.place, abs=0.1)
    assert math.hypot(*state.velocity_w) < 0.1
    assert estimate.yaw == pytest.approx(0.7, abs=0.05)


def test_a_body_is_flown_through_ardupilots_interface(ardupilot: tuple[ArdupilotBridge, FakeArdupilot]) -> None:
    bridge, peer = ardupilot
    body, stack = RigidBody(), SmallStack()
    pwm = [1000] * 4
    for count in range(5000):
        peer.send(count, (*pwm, *(0,) * 12))
        assert bridge.answered(WAIT_S)
        body.step(bridge.control(body.state(), DT), DT)
        told = peer.answer()
        estimate = Estimate(
            told["position"], told["velocity"], told["quaternion"], told["imu"]["gyro"], told["imu"]["accel_body"]
        )
        pwm = [round(1000 + 1000 * throttle) for throttle in stack.motors(estimate, DT)]
    arrives(body, stack)


def test_a_body_is_flown_through_px4s_interface(px4: tuple[Px4Bridge, FakePx4]) -> None:
    """The motors by the interface; PX4's own estimator is replaced by the truth."""
    bridge, peer = px4
    body, stack = RigidBody(), SmallStack()
    assert bridge.answered(WAIT_S)
    for _ in range(2500):
        body.step(bridge.control(body.state(), bridge.period_s), bridge.period_s)
        told = peer.hear("HIL_SENSOR")
        state = body.state()
        felt = (told.xgyro, told.ygyro, told.zgyro)
        estimate = Estimate(state.position_w, state.velocity_w, state.attitude_wb, felt, state.specific_force_b)
        peer.controls(tuple(stack.motors(estimate, bridge.period_s)))
        assert bridge.answered(WAIT_S)
    arrives(body, stack)


# Motion capture --------------------


def test_motion_capture_tells_where_the_vehicle_is_50_times_a_second_within_its_noise() -> None:
    turned = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))
    state = RigidState((3.0, 4.0, -10.0), (0.0, 0.0, 0.0), turned, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81))
    capture = Capture(1, 0.004)
    told = [m for i in range(5000) if (m := capture.message(state, 0.002 * i, 0.002)) is not None]
    assert len(told) == 500
    assert {b.usec - a.usec for a, b in itertools.pairwise(told)} == {20_000}
    away = [math.dist((m.x, m.y, m.z), state.position_w) for m in told]
    assert 0.001 < statistics.median(away) < 0.02
    assert told[0].yaw == pytest.approx(0.8, abs=0.02)


def test_px4_feels_a_blow_that_falls_between_two_turns(px4: tuple[Px4Bridge, FakePx4]) -> None:
    """Its velocity has changed by 0.2 m/s: that is what its sensor has to add up to, whatever it feels now."""
    bridge, peer = px4
    assert bridge.answered(WAIT_S)
    felt = []
    for v in (0.0, 0.0, 0.2, 0.2):
        bridge.control(replace(STILL, velocity_w=(v, 0.0, 0.0)), bridge.period_s)
        felt.append(peer.hear("HIL_SENSOR").xacc)
    assert sum(felt) * bridge.period_s == pytest.approx(0.2, abs=0.001)


def test_px4_hears_motion_capture_beside_its_sensors() -> None:
    bridge = Px4Bridge(MASS, 1, ("127.0.0.1", 0), Capture(1, 0.0))
    peer = FakePx4(bridge.address[1])
    try:
        assert bridge.answered(WAIT_S)
        for _ in range(5):
            bridge.control(replace(STILL, position_w=(1.0, 2.0, -3.0)), bridge.period_s)
        message = peer.hear("VISION_POSITION_ESTIMATE")
        assert (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
    finally:
        peer.close()
        bridge.close()


def test_ardupilot_hears_motion_capture_on_a_line_of_its_own_once_it_has_spoken_there() -> None:
    line = CaptureLine(Capture(1, 0.0))
    codec = mav.MAVLink(None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as serial:
        serial.settimeout(WAIT_S)
        line.tell(STILL, 1.0, 0.02)  # to nobody
        serial.sendto(b"heartbeat", ("127.0.0.1", line.port))
        select.select([], [], [], 0.05)
        line.tell(replace(STILL, position_w=(1.0, 2.0, -3.0)), 1.02, 0.02)
        (message,) = codec.parse_buffer(serial.recv(4096))
    line.close()
    assert message.usec == 1_020_000
    assert (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
