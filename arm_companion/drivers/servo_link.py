"""One transaction at a time on a Dynamixel bus: a request out, the answers of one or more servos in.

This layer knows bytes, frames and time. Which servos there are and what their registers mean is the business
of `servo_bus`.
"""

import asyncio
import math
from collections.abc import Sequence

from arm_companion.errors import DeviceFault, ProtocolError
from arm_companion.protocol import dynamixel as dxl
from arm_companion.protocol.control_table import RETURN_DELAY_UNIT_S, Register
from arm_companion.protocol.dynamixel import Packet
from arm_companion.transport.base import Transport

_BITS_PER_BYTE = 10
_TURNAROUND_S = 50e-6  # a servo's own time to begin an answer
_TRIES = 4
DRAIN_S = 0.02  # longer than the latency timer of an adapter as it comes from the factory
_LATE_S = 0.005
_LATEST_S = 0.1  # what comes later answers nothing any more


class Latency:
    """How much longer than its time on the wire a transaction takes: smoothed mean and deviation.

    The smoothing and the margin are those of TCP's retransmission timer (RFC 6298).
    """

    LEAST_S = 0.001
    """No margin is shorter: timers and a busy machine take that much."""

    def __init__(self) -> None:
        self.mean_s = 0.0
        self.deviation_s = 0.0
        self._known = False

    def learn(self, extra_s: float) -> None:
        """Take in one measurement."""
        if not self._known:
            self.mean_s, self.deviation_s, self._known = extra_s, extra_s / 2, True
            return
        self.deviation_s += (abs(extra_s - self.mean_s) - self.deviation_s) / 4
        self.mean_s += (extra_s - self.mean_s) / 8

    @property
    def margin_s(self) -> float:
        """How long to wait beyond the time on the wire before an answer counts as lost."""
        return max(self.mean_s + 4 * self.deviation_s, self.LEAST_S)


class ServoLink:
    """The open bus.

    Attributes:
        latency: beyond the time on the wire, learnt from complete transactions.
        strays: status frames that nobody waited for.
        timeout_s: longest wait for the answer to one request.
    """

    def __init__(self, baud: int, timeout_s: float) -> None:
        """Speak at `baud` bits per second and wait at most `timeout_s` for the answers to one request."""
        self.latency = Latency()
        self.parser = dxl.Parser()
        self.strays = 0
        self._byte_s = _BITS_PER_BYTE / baud
        self.timeout_s = timeout_s
        self._return_delays: dict[int, float] = {}
        self._transport: Transport | None = None
        self._lock = asyncio.Lock()
        self._line_free_at = 0.0
        self._waiting: asyncio.Future[None] | None = None
        self._wanted: Sequence[int] = ()
        self._size = 0
        self._fast = False
        self._answers: dict[int, Packet] = {}
        self._owed: dict[int, float] = {}  # when an answer that has not come should have ended
        self._late_until: dict[int, float] = {}  # until when answers to earlier requests may come
        self._possible: dict[int, float] = {}  # before which no answer to the present request can have come
        self._forestalled: set[int] = set()  # whose late answer was dropped since the present request

    @property
    def connected(self) -> bool:
        """There is a transport to write to."""
        return self._transport is not None

    def attach(self, transport: Transport) -> None:
        """Use this transport from now on; its receiver must be `receive`."""
        self._transport = transport
        self.parser.reset()

    def detach(self) -> None:
        """The transport is gone; whoever waits for answers stops waiting."""
        self._transport = None
        self._finish()

    def expect_return_delay(self, servo: int, raw: int) -> None:
        """Take a servo's return-delay register into account when waiting for it."""
        self._return_delays[servo] = raw * RETURN_DELAY_UNIT_S

    def receive(self, data: bytes) -> None:
        """Receiver of the transport."""
        for packet in self.parser.feed(data):
            if packet.instruction != dxl.Instruction.STATUS:
                continue  # our own request, which some adapters echo
            if packet.id == dxl.BROADCAST_ID:
                self._take_fast(packet)
                continue
            fits = len(packet.parameters) == self._size or packet.error & ~dxl.ALERT
            if self._waiting is None or packet.id not in self._wanted or not fits or self._forestalls(packet.id):
                self.strays += 1
                self._learn_from_late(packet.id)
                continue
            self._answers[packet.id] = packet
            # Servos answer in the order of the request: after the last one nobody will.
            if packet.id == self._wanted[-1]:
                self._finish()

    def _take_fast(self, packet: Packet) -> None:
        """The one answer of all servos to a Fast Sync Read."""
        try:
            answers = dxl.split_fast_sync_answer(packet, self._size) if self._fast and self._waiting else []
        except ProtocolError:
            answers = []
        late = [answer.id for answer in answers if self._forestalls(answer.id)]
        if late or [answer.id for answer in answers] != list(self._wanted):
            self.strays += 1
            for servo in late:
                self._learn_from_late(servo)
            return
        self._answers = {answer.id: answer for answer in answers}
        self._finish()

    async def ask(
        self,
        request: bytes,
        servos: Sequence[int],
        size: int,
        deadline: float,
        *,
        fast: bool = False,
        sure: bool = False,
    ) -> dict[int, Packet]:
        """Send `request`; answers by servo id, without those that did not come in time.

        Args:
            request: one frame.
            servos: who has to answer, in the order in which they will.
            size: bytes of data in each answer.
            deadline: loop time at which to stop waiting whatever the wire would still allow.
            fast: the request is a Fast Sync Read, which all servos answer in one frame.
            sure: ask nothing while the answer to an earlier request may still come, which would pass for this one's.
        """
        async with self._lock:
            loop = asyncio.get_running_loop()
            begin = loop.time()
            each = size + dxl.STATUS_OVERHEAD
            ends = [dxl.fast_sync_size(len(servos), size) if fast else (i + 1) * each for i in range(len(servos))]
            wire = self._end_of_line(begin, len(request) + max(ends, default=0))
            for servo in servos:
                wire += self._return_delays.get(servo, 0.0) + _TURNAROUND_S
            if self._transport is None or not servos or wire > deadline:
                return {}
            if sure and any(self._owes(servo) for servo in servos):
                return {}
            self.parser.reset()
            self._wanted, self._size, self._fast, self._answers = servos, size, fast, {}
            self._forestalled.clear()
            if self._late_until:
                line = self._end_of_line(begin, len(request))
                self._possible = {s: line + end * self._byte_s for s, end in zip(servos, ends, strict=True)}
            self._waiting = loop.create_future()
            self._transport.write(request)
            timer = loop.call_at(min(wire + self.latency.margin_s, deadline), self._finish)
            try:
                await self._waiting
            finally:
                timer.cancel()
                self._waiting = None
            end = loop.time()
            self._line_free_at = min(wire, end)
            if len(self._answers) == len(servos):
                if self._owed.keys().isdisjoint(servos):
                    self.latency.learn(max(end - wire, 0.0))
                for servo in servos:
                    self._owed.pop(servo, None)
            else:
                silent = [s for s in servos if s not in self._answers and s not in self._forestalled]
                self._owed |= dict.fromkeys(silent, wire)
                self._late_until |= dict.fromkeys(silent, wire + DRAIN_S)
            return self._answers

    async def tell(self, request: bytes) -> None:
        """Send a request that nobody answers."""
        async with self._lock:
            if self._transport is not None:
                self._transport.write(request)
                self._line_free_at = self._end_of_line(asyncio.get_running_loop().time(), len(request))

    async def command(self, servo: int, request: bytes, size: int = 0, tries: int = _TRIES) -> bytes:
        """Data of one servo's answer; asks again when none comes.

        Answers carry neither number nor address: before it asks for data, or asks again, a late one is given time to
        come and be dropped.

        Raises:
            DeviceFault: when it stays silent, or refuses.
        """
        for attempt in range(tries):
            if attempt or (size and self._owes(servo)):
                await asyncio.sleep(DRAIN_S)
            deadline = asyncio.get_running_loop().time() + self.timeout_s
            answers = await self.ask(request, (servo,), size, deadline, sure=size > 0)
            if servo in answers:
                refusal = answers[servo].error & ~dxl.ALERT
                if refusal:
                    raise DeviceFault(servo, 0, f"refused a request: {_reason(refusal)}")
                return answers[servo].parameters
            if not self.connected:
                raise DeviceFault(servo, 0, "the bus is not connected")
        late = self.latency.mean_s
        hint = f"; answers come {late * 1e3:.0f} ms late: see the adapter's latency timer" if late > _LATE_S else ""
        raise DeviceFault(servo, 0, "does not answer" + hint)

    async def read(self, servo: int, register: Register) -> int:
        """Value of a register.

        Raises:
            DeviceFault: when the servo stays silent, or refuses.
        """
        data = await self.command(servo, dxl.read(servo, register.address, register.size), register.size)
        return register.decode(data)

    async def write(self, servo: int, register: Register, value: int, tries: int = _TRIES) -> None:
        """Set a register, and have it acknowledged.

        Raises:
            DeviceFault: when the servo stays silent, or refuses.
        """
        try:
            await self.command(servo, dxl.write(servo, register.address, register.encode(value)), tries=tries)
        except DeviceFault as fault:
            raise DeviceFault(servo, 0, f"{register.name} = {value}: {fault}") from fault

    def _owes(self, servo: int) -> bool:
        """Whether the answer to an earlier request may still come."""
        return asyncio.get_running_loop().time() - self._owed.get(servo, -math.inf) < DRAIN_S

    def _forestalls(self, servo: int) -> bool:
        """Whether an answer is to an earlier request: one may still come, and the present one's cannot be here yet.

        Taken for the present one's, that of the last servo would end a Sync Read while the others are talking. Requests
        that nothing but such answers come to are no reason to go on so: where the wire is faster than it is said to
        be, each answer looks like that.
        """
        until = self._late_until.get(servo)
        if until is None or not asyncio.get_running_loop().time() < min(until, self._possible.get(servo, -math.inf)):
            return False
        self._forestalled.add(servo)
        return True

    def _learn_from_late(self, servo: int) -> None:
        due = self._owed.pop(servo, None)
        if due is not None:
            late = asyncio.get_running_loop().time() - due
            if late < _LATEST_S:
                self.latency.learn(late)

    def _end_of_line(self, begin: float, n_bytes: int) -> float:
        """When `n_bytes` that are sent at `begin` at the earliest have passed the wire."""
        return max(begin, self._line_free_at) + n_bytes * self._byte_s

    def _finish(self) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(None)


def _reason(code: int) -> str:
    try:
        return dxl.StatusError(code).name.lower().replace("_", " ") + " error"
    except ValueError:
        return f"error {code}"
