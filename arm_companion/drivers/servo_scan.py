"""Finding servos on a bus, at any speed and any id, without writing to any of them."""

import asyncio
import contextlib
import errno
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass

from arm_companion.drivers.servo_link import ServoLink
from arm_companion.errors import DeviceFault, LinkError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.transport.base import Opener

OpenAt = Callable[[int], Opener]
"""The opener of the bus at a speed in bits per second."""

ALL_IDS = range(dxl.MAX_ID + 1)
_PING_SIZE = 3
_PATIENCE_S = 0.04  # beyond the time on the wire: more than twice an adapter's worst latency timer
_SAMPLE = (ct.REALTIME_TICK.address, ct.TABLE_SIZE - ct.REALTIME_TICK.address)
_SAMPLES = 4


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered."""

    baud: int  # bit/s
    id: int
    model: int
    firmware: int
    crowded: bool = False  # its answers are damaged: there are two servos with this id, or the line is bad

    @property
    def kind(self) -> str:
        """Model and firmware for people."""
        name = "XL430-W250" if self.model == ct.MODEL_NUMBER_XL430_W250 else f"model {self.model}"
        return f"{name}, firmware {self.firmware}"


_NO_PORT = (errno.ENOENT, errno.EACCES, errno.ECONNREFUSED)  # whatever the speed


@contextlib.asynccontextmanager
async def link_at(open_at: OpenAt, baud: int, byte_count: int = 256) -> AsyncIterator[ServoLink]:
    """A link at `baud`, patient enough for answers of `byte_count` bytes; the port is closed at the end.

    Raises:
        LinkError: the port cannot be opened at this speed.
    """
    link = ServoLink(baud, byte_count * 10 / baud + 2 * _PATIENCE_S)
    link.latency.learn(_PATIENCE_S / 3)
    transport = await open_at(baud)(link.receive)
    link.attach(transport)
    try:
        yield link
    finally:
        link.detach()
        transport.close()
        await transport.wait_closed()


async def scan(
    open_at: OpenAt,
    bauds: Iterable[int],
    ids: Iterable[int] = (),
    report: Callable[[str], None] = lambda _: None,
) -> list[FoundServo]:
    """All servos that answer at one of the speeds.

    A broadcast ping finds those that are alone at their id; `ids` are asked one by one as well, since a damaged
    answer may hide a servo from the broadcast.

    Args:
        open_at: the bus.
        bauds: bit/s.
        ids: to ask one by one.
        report: told what is being done and what is odd.

    Raises:
        LinkError: the port cannot be opened at any of the speeds, or is not there.
    """
    found: list[FoundServo] = []
    refused: list[LinkError] = []
    asked = list(bauds)
    for baud in asked:
        report(f"asking at {baud} bit/s")
        try:
            async with link_at(open_at, baud) as link:
                found += await _at_one_speed(link, baud, sorted(set(ids)), report)
        except LinkError as error:
            if isinstance(error.__cause__, OSError) and error.__cause__.errno in _NO_PORT:
                raise
            refused.append(error)
            report(str(error))
    if len(refused) == len(asked) and refused:
        raise refused[0]
    return found


async def ping(link: ServoLink, servo: int, tries: int = 2) -> tuple[int, int] | None:
    """Model and firmware of one servo, None when it does not answer."""
    try:
        data = await link.command(servo, dxl.ping(servo), _PING_SIZE, tries)
    except DeviceFault:
        return None
    return int.from_bytes(data[:2], "little"), data[2]


async def _at_one_speed(
    link: ServoLink, baud: int, ids: Iterable[int], report: Callable[[str], None]
) -> list[FoundServo]:
    wire = len(ALL_IDS) * (_PING_SIZE + dxl.STATUS_OVERHEAD) * 10 / baud
    deadline = asyncio.get_running_loop().time() + wire + len(ALL_IDS) * 1e-3 + 2 * _PATIENCE_S
    answers = await link.ask(dxl.ping(dxl.BROADCAST_ID), ALL_IDS, _PING_SIZE, deadline)
    known = {servo: (int.from_bytes(p.parameters[:2], "little"), p.parameters[2]) for servo, p in answers.items()}
    for servo in ids:
        if servo not in known and (answer := await ping(link, servo)) is not None:
            known[servo] = answer
    if not known and link.parser.garbage:
        report(f"something answers at {baud} bit/s and cannot be understood: two servos with one id, or a bad line")
    return [FoundServo(baud, servo, *known[servo], crowded=await is_crowded(link, servo)) for servo in sorted(known)]


async def is_crowded(link: ServoLink, servo: int) -> bool:
    """Whether two servos have this id: what both send at once, about themselves, comes damaged.

    Two new servos answer a ping with the same bytes at the same time, which passes for one answer; their loads
    and clocks are not the same.
    """
    request = dxl.read(servo, *_SAMPLE)
    damaged = 0
    for _ in range(_SAMPLES):
        before = link.parser.crc_errors + link.parser.garbage
        deadline = asyncio.get_running_loop().time() + link.timeout_s
        answers = await link.ask(request, (servo,), _SAMPLE[1], deadline)
        link.parser.reset()
        damaged += servo not in answers and link.parser.crc_errors + link.parser.garbage > before
    return damaged > _SAMPLES // 2
