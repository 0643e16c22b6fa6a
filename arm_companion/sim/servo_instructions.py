"""What emulated servos do on each instruction of Protocol 2.0, and what they answer.

Not emulated, and answered as real servos answer what they do not know: Bulk Read and Write, Factory Reset,
Control Table Backup. A damaged instruction is met with silence.
"""

from collections.abc import Sequence
from typing import NamedTuple

from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.dynamixel import Instruction, Packet, StatusError
from arm_companion.sim.servo_device import EmulatedServo

TURNAROUND_S = 20e-6
"""Time a servo needs to answer beyond its return delay."""

_ANSWERED_FROM_LEVEL = {int(Instruction.PING): 0, int(Instruction.READ): 1}  # status return level, else 2
_PING_RANGE = (ct.MODEL_NUMBER.address, ct.FIRMWARE_VERSION.address + 1)


class Reply(NamedTuple):
    """One frame a servo sends.

    Attributes:
        delay_s: from the end of what it answers, or of the frame before it, to its own beginning.
        data: its bytes.
    """

    delay_s: float
    data: bytes


def respond(packet: Packet, listening: Sequence[EmulatedServo], *, chained: bool) -> list[Reply]:
    """Let the servos that listen do what a frame says.

    Args:
        packet: what came.
        listening: servos that are awake and hear the master's speed.
        chained: in a Sync Read a servo answers only after the one named before it has.
    """
    if packet.instruction == Instruction.STATUS:
        return []
    broadcast = packet.id == dxl.BROADCAST_ID
    addressed = [s for s in listening if broadcast or s.id == packet.id]
    shadows = [s for s in listening if s not in addressed and s.peek(ct.SECONDARY_ID) == packet.id]
    for servo in addressed + shadows:
        servo.hear()
    for shadow in shadows:
        _execute(shadow, packet)
    if not broadcast:
        return _collided([reply for servo in addressed for reply in _answer(servo, packet)])
    by_id = {s.id: s for s in sorted(listening, key=lambda s: s.id)}
    match packet.instruction:
        case Instruction.PING:
            return [reply for servo in by_id.values() for reply in _answer(servo, packet)]
        case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
            return _sync_read(packet, by_id, chained)
        case Instruction.SYNC_WRITE:
            _sync_write(packet.parameters, by_id)
        case _:
            for servo in addressed:
                _execute(servo, packet)
    return []


def _sync_read(packet: Packet, listening: dict[int, EmulatedServo], chained: bool) -> list[Reply]:
    if len(packet.parameters) < 4:
        return []
    address, size = _two_words(packet.parameters)
    fast = packet.instruction == Instruction.FAST_SYNC_READ
    wanted = packet.parameters[4:]
    blocks: list[tuple[EmulatedServo, int, bytes]] = []
    for servo_id in wanted:
        servo = listening.get(servo_id)
        if servo is not None and fast and servo.firmware < ct.FIRST_FIRMWARE_WITH_FAST_SYNC_READ:
            servo = None
        if servo is None or servo.silenced or servo.peek(ct.STATUS_RETURN_LEVEL) == 0:
            if chained or fast:
                break
            continue
        data = servo.read(address, size)
        error = StatusError.NONE if data is not None else StatusError.ACCESS
        filler = bytes(size) if fast else b""
        blocks.append((servo, _error_byte(servo, error), data if data is not None else filler))
    if not fast:
        return [_reply(s, dxl.status(s.id, error, data)) for s, error, data in blocks]
    if not blocks:
        return []
    whole = [(s.id, error, data) for s, error, data in blocks]
    missing = len(wanted) - len(blocks)
    answer = dxl.fast_sync_answer(whole + [(0, 0, bytes(size))] * missing)
    return [_reply(blocks[0][0], answer[: len(answer) - missing * (size + 4)])]


def _collided(replies: list[Reply]) -> list[Reply]:
    """What is on the wire when several servos with one id answer at once: a low bit wins over a high one."""
    if len(replies) < 2:
        return replies
    size = max(len(reply.data) for reply in replies)
    wire = bytearray(b"\xff" * size)
    for reply in replies:
        for i, byte in enumerate(reply.data):
            wire[i] &= byte
    return [Reply(min(reply.delay_s for reply in replies), bytes(wire))]


def _answer(servo: EmulatedServo, packet: Packet) -> list[Reply]:
    """Execute an instruction; the status frame that the servo's status return level lets it send."""
    level = servo.peek(ct.STATUS_RETURN_LEVEL)
    error, data = _execute(servo, packet)
    if servo.silenced or level < _ANSWERED_FROM_LEVEL.get(packet.instruction, 2):
        return []
    return [_reply(servo, dxl.status(servo.id, _error_byte(servo, error), data))]


def _execute(servo: EmulatedServo, packet: Packet) -> tuple[StatusError, bytes]:
    """Do what one servo is told; error and data of its answer."""
    data = b""
    error = StatusError.NONE
    match packet.instruction:
        case Instruction.PING:
            data = servo.read(*_PING_RANGE) or b""
            data = data[:2] + data[-1:]
        case Instruction.READ | Instruction.WRITE | Instruction.REG_WRITE:
            return _access(servo, packet)
        case Instruction.ACTION:
            error = servo.act()
        case Instruction.REBOOT:
            servo.reboot()
        case Instruction.CLEAR if packet.parameters == dxl.CLEAR_TURNS:
            error = servo.clear_turns()
        case _:
            error = StatusError.INSTRUCTION
    return error, data


def _access(servo: EmulatedServo, packet: Packet) -> tuple[StatusError, bytes]:
    """Read or write the control table."""
    parameters = packet.parameters
    if packet.instruction == Instruction.READ:
        if len(parameters) != 4:
            return StatusError.DATA_LENGTH, b""
        data = servo.read(*_two_words(parameters))
        return (StatusError.ACCESS, b"") if data is None else (StatusError.NONE, data)
    if len(parameters) < 3:
        return StatusError.DATA_LENGTH, b""
    address = int.from_bytes(parameters[:2], "little")
    if packet.instruction == Instruction.WRITE:
        return servo.write(address, parameters[2:]), b""
    return servo.register_write(address, parameters[2:]), b""


def _sync_write(parameters: bytes, listening: dict[int, EmulatedServo]) -> None:
    if len(parameters) < 4:
        return
    address, size = _two_words(parameters)
    for at in range(4, len(parameters) - size, size + 1):
        servo = listening.get(parameters[at])
        if servo is not None:
            servo.write(address, parameters[at + 1 : at + 1 + size])


def _two_words(parameters: bytes) -> tuple[int, int]:
    return int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")


def _error_byte(servo: EmulatedServo, error: StatusError) -> int:
    return error | (dxl.ALERT if servo.alert else 0)


def _reply(servo: EmulatedServo, data: bytes) -> Reply:
    return Reply(TURNAROUND_S + servo.peek(ct.RETURN_DELAY) * ct.RETURN_DELAY_UNIT_S, data)
