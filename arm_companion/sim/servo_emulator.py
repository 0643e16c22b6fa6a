"""Four XL430s on one bus, and the bus itself with the timing of real bytes.

`ServoEmulator` is a state machine: bytes in, bytes out, time and load from outside. `EmulatedBus` serves it
behind a pty or a memory pipe.
"""

import asyncio
import random
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from arm_companion.config.schema import ServosConfig
from arm_companion.protocol import dynamixel as dxl
from arm_companion.sim.pty_port import PtyTransport, pty_opener
from arm_companion.sim.servo_device import EmulatedServo
from arm_companion.sim.servo_instructions import Reply, respond
from arm_companion.sim.servo_motion import substeps
from arm_companion.transport.base import Opener, Transport
from arm_companion.transport.memory import Fault

SUPPLY_V = 12.0
SUPPLY_OHM = 0.15
_BITS_PER_BYTE = 10


class ServoEmulator:
    """All servos of a bus.

    Attributes:
        servos: in the tendons' order.
        supply_v: of the battery; change it at will. What the servos draw makes it sag.
        chained: whether, as in real Sync Reads, a servo answers only after the one named before it has.
    """

    def __init__(self, config: ServosConfig, seed: int = 0) -> None:
        rng = random.Random(seed)  # noqa: S311 - reproducible noise, not a secret
        self.servos = tuple(
            EmulatedServo(servo, config.baud, float(zero), rng)
            for servo, zero in zip(config.ids, config.zero_ticks, strict=True)
        )
        self._directions = config.directions
        self.supply_v = SUPPLY_V
        self.chained = True
        self._parser = dxl.Parser()

    def __getitem__(self, servo_id: int) -> EmulatedServo:
        """The servo that answers to this id.

        Raises:
            KeyError: when there is none.
        """
        for servo in self.servos:
            if servo.id == servo_id:
                return servo
        raise KeyError(servo_id)

    def positions(self) -> tuple[float, ...]:
        """True horn positions in ticks; at a servo's `zero_ticks` its tendon holds the straight arm."""
        return tuple(servo.motor.position for servo in self.servos)

    def speeds(self) -> tuple[float, ...]:
        """True horn speeds in ticks/s."""
        return tuple(servo.motor.speed for servo in self.servos)

    def advance(self, dt: float, load_torques: Sequence[float]) -> None:
        """Let `dt` seconds pass.

        Args:
            dt: s.
            load_torques: of each tendon on its pulley, N m: tension times pulley radius. A positive one
                lets tendon out, whichever direction that is for the servo.
        """
        n = substeps(dt)
        for _ in range(n):
            drawn = 0.0
            for servo in self.servos:
                drawn += servo.current
            voltage = max(self.supply_v - SUPPLY_OHM * drawn, 0.0)
            for servo, direction, torque in zip(self.servos, self._directions, load_torques, strict=True):
                servo.advance(dt / n, -direction * torque, voltage)

    def set_power(self, *, on: bool) -> None:
        """Cut or restore the supply of all servos."""
        self.supply_v = SUPPLY_V if on else 0.0
        for servo in self.servos:
            servo.set_power(on=on)

    def feed(self, data: bytes) -> bytes:
        """Bytes that the servos put on the wire in answer to `data`."""
        return b"".join(reply.data for reply in self.respond(data))

    def respond(self, data: bytes, baud: int | None = None) -> list[Reply]:
        """Frames that the servos send in answer to `data`, with their delays.

        Args:
            data: what the master sends, in any pieces.
            baud: speed at which it sends; servos at another hear nothing. None: every servo listens.
        """
        listening = [s for s in self.servos if s.awake and (baud is None or s.baud == baud)]
        replies: list[Reply] = []
        for packet in self._parser.feed(data):
            replies += respond(packet, listening, chained=self.chained)
        return replies


def _unchanged(data: bytes) -> bytes:
    return data


def _whole(data: bytes) -> list[tuple[float, bytes]]:
    return [(0.0, data)]


class EmulatedBus:
    """The wire between an emulator and one end of a byte pipe.

    Every byte takes ten bit times; a servo answers after its return delay, and a frame reaches the master when
    its last byte has. On a loop of `clock.precise_loop`, or in simulated time, the timing is good to some
    0.1 ms; on the default loop every answer waits for the next whole millisecond.

    Attributes:
        emulator: the servos; whoever owns the physics advances them.
        to_servos: fault on what the master sends.
        to_master: fault on what the servos send.
        latency_s: added to every answer, as a USB adapter's latency timer does.
        delays: fault on the times of what the servos send: the pieces in which an answer comes, each with the
            pause before it.
    """

    def __init__(self, emulator: ServoEmulator, config: ServosConfig) -> None:
        self.emulator = emulator
        self.to_servos: Fault = _unchanged
        self.to_master: Fault = _unchanged
        self.latency_s = 0.0
        self.delays: Callable[[bytes], list[tuple[float, bytes]]] = _whole
        self._baud = config.baud
        self._transport: Transport | None = None
        self._ready = asyncio.Event()
        self._queue: deque[tuple[float, bytes]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._line_free_at = 0.0

    async def serve_pty(self, path: str | Path) -> None:
        """Serve on a pseudo-terminal that stands at `path`, until it is lost, unplugged or cancelled.

        Raises:
            LinkError: when the path is taken by something else, or by a simulation that runs.
        """
        await self.serve(pty_opener(path))

    async def serve_memory(self, opener: Opener) -> None:
        """Serve on one end of a `MemoryPipe`, until it is cut, unplugged or cancelled."""
        await self.serve(opener)

    async def serve(self, opener: Opener) -> None:
        """Serve on the pipe that `opener` opens, until it is lost, unplugged or cancelled.

        Raises:
            LinkError: when it cannot be opened.
        """
        self._transport = transport = await opener(self._receive)
        self._ready.set()
        try:
            await transport.wait_closed()
        finally:
            self.unplug()

    async def wait_ready(self) -> None:
        """Return once programs can open the port."""
        await self._ready.wait()

    def unplug(self) -> None:
        """Take the adapter's cable out; the servos keep their power."""
        self._ready.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._queue.clear()
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _receive(self, data: bytes) -> None:
        now = asyncio.get_running_loop().time()
        baud = self._transport.baud if isinstance(self._transport, PtyTransport) else self._baud
        byte_s = _BITS_PER_BYTE / baud
        end = max(now, self._line_free_at) + len(data) * byte_s
        for delay, answer in self.emulator.respond(self.to_servos(data), baud):
            end += delay + len(answer) * byte_s
            for pause, piece in self.delays(answer):
                end += pause
                self._queue.append((end + self.latency_s, piece))
        self._line_free_at = end
        self._arm()

    def _arm(self) -> None:
        if self._timer is None and self._queue:
            self._timer = asyncio.get_running_loop().call_at(self._queue[0][0], self._send)

    def _send(self) -> None:
        self._timer = None
        now = asyncio.get_running_loop().time()
        due = b""
        while self._queue and self._queue[0][0] <= now:
            due += self._queue.popleft()[1]
        data = self.to_master(due)
        if data and self._transport is not None:
            self._transport.write(data)
        self._arm()


async def keep_time(emulator: ServoEmulator, period_s: float = 0.002) -> None:
    """Advance an emulator without load as the loop's time goes by, where no plant does, until cancelled."""
    loop = asyncio.get_running_loop()
    free = (0.0,) * len(emulator.servos)
    last = loop.time()
    while True:
        await asyncio.sleep(period_s)
        now = loop.time()
        emulator.advance(now - last, free)
        last = now
