"""The codecs beside the libraries that everybody uses: pymavlink and the servo maker's SDK."""

import itertools
from collections.abc import Iterator

import dynamixel_sdk as sdk

from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from tests.bench.measure import Result, medians

SERVOS = (1, 2, 3, 4)


def protocols(rounds: int) -> Iterator[Result]:
    yield from _mavlink(rounds)
    yield from _dynamixel(rounds)


def _messages() -> list[Message]:
    """Half a second of what an autopilot streams to a companion."""
    messages: list[Message] = []
    for k in range(50):
        messages.append(mav.MAVLink_attitude_quaternion_message(10 * k, 1.0, 0.01, 0.02, 0.03, 0.1, 0.2, 0.3))
        messages.append(mav.MAVLink_local_position_ned_message(10 * k, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3))
        messages.append(mav.MAVLink_highres_imu_message(10_000 * k, *[0.1 * i for i in range(13)], 63))
        if k % 10 == 0:
            messages.append(mav.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3))
            messages.append(mav.MAVLink_sys_status_message(*[0] * 13))
    return messages


def _mavlink(rounds: int) -> Iterator[Result]:
    messages = _messages()
    count = len(messages)
    sender = MavlinkCodec(1, 1)
    frames = [sender.encode(message) for message in messages]
    stream = [bytes((byte,)) for byte in b"".join(frames)]
    ours, theirs = MavlinkCodec(1, 192), mav.MAVLink(None, 1, 192)
    theirs.robust_parsing = True

    def decode() -> None:
        _complete(sum(len(ours.feed(frame)) for frame in frames), count)

    def parse_buffer() -> None:
        _complete(sum(len(theirs.parse_buffer(frame) or ()) for frame in frames), count)

    def parse_char() -> None:
        _complete(sum(theirs.parse_char(byte) is not None for byte in stream), count)

    times = medians(rounds, (decode, 5, 1), (parse_buffer, 5, 1), (parse_char, 1, 1))
    mine, buffer, char = (1e6 * t / count for t in times)
    yield Result("MAVLink, decode one message", mine, "us", "pymavlink parse_buffer", buffer)
    yield Result("MAVLink, decode one message", mine, "us", "pymavlink parse_char", char)
    encode, pack = (lambda: [sender.encode(m) for m in messages]), (lambda: [m.pack(theirs) for m in messages])
    mine, packed = (1e6 * t / count for t in medians(rounds, (encode, 5, 1), (pack, 5, 1)))
    yield Result("MAVLink, encode one message", mine, "us", "pymavlink pack", packed)


def _complete(found: int, count: int) -> None:
    if found != count:
        raise RuntimeError(f"{found} of {count} messages came through")


class _MemoryPort:
    """A port for the SDK whose far end has already answered."""

    is_using = False
    is_open = True

    def __init__(self) -> None:
        self.answer = b""
        self.left = b""

    def clearPort(self) -> None:  # the SDK's own names
        self.left = self.answer

    def writePort(self, packet: list[int]) -> int:
        self.left = self.answer
        return len(packet)

    def readPort(self, length: int) -> bytes:
        taken, self.left = self.left[:length], self.left[length:]
        return taken

    def setPacketTimeout(self, length: int) -> None: ...

    def isPacketTimeout(self) -> bool:
        return False

    def getBaudRate(self) -> int:
        return 1_000_000


def _dynamixel(rounds: int) -> Iterator[Result]:
    """One cycle: ask four servos for their feedback, understand the answers, send four goals."""
    address, size = ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE
    goal = ct.GOAL_POSITION
    data = bytes(range(1, size + 1))
    answer = b"".join(dxl.status(servo, 0, data) for servo in SERVOS)
    parser = dxl.Parser()
    ticks = itertools.cycle(range(2000, 2100))

    def ours() -> None:
        dxl.sync_read(SERVOS, address, size)
        packets = parser.feed(answer)
        if len(packets) != len(SERVOS):
            raise RuntimeError("answers were lost")
        for packet in packets:
            ct.decode_feedback(packet.parameters)
        value = goal.encode(next(ticks))
        dxl.sync_write(goal.address, dict.fromkeys(SERVOS, value))

    port, handler = _MemoryPort(), sdk.PacketHandler(2.0)
    port.answer = answer
    reader = sdk.GroupSyncRead(port, handler, address, size)
    writer = sdk.GroupSyncWrite(port, handler, goal.address, goal.size)
    for servo in SERVOS:
        reader.addParam(servo)
        writer.addParam(servo, list(goal.encode(2000)))

    def theirs() -> None:
        if reader.txRxPacket() != sdk.COMM_SUCCESS:
            raise RuntimeError("answers were lost")
        for servo in SERVOS:
            for offset, length in ((0, 2), (2, 4), (6, 4)):
                reader.getData(servo, address + offset, length)
        value = list(goal.encode(next(ticks)))
        for servo in SERVOS:
            writer.changeParam(servo, value)
        port.is_using = False
        writer.txPacket()

    mine, maker = (1e6 * t for t in medians(rounds, (ours, 5, 60), (theirs, 5, 30)))
    yield Result("Dynamixel, codec work of one cycle", mine, "us", "the maker's SDK", maker)
