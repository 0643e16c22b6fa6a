"""The whole daemon in real time: what a cycle takes of one core, when it begins, and how old a goal's knowledge is.

The daemon runs with its arm ready and driven, on four servos emulated behind a pseudo-terminal with the timing of
every byte, and listens to 500 messages a second by UDP. Servos and autopilot are processes of their own. The peer is
a bare event loop that wakes up as often: nothing on this machine can take less.
"""

import asyncio
import dataclasses
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arm_companion.app import Daemon, Openers
from arm_companion.clock import Clock, precise_loop, ticks, unix_now
from arm_companion.config import load
from arm_companion.mission.facts import Order, Request
from arm_companion.mission.state import Phase
from arm_companion.record import configured_recorder, raw
from arm_companion.record.recorder import Recorder
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.serial import open_serial
from arm_companion.transport.trace import observed
from arm_companion.transport.udp import udp_in
from tests.bench.listening import free_port, stream
from tests.bench.measure import Result
from tests.bench.servo_cycle import port, wire_of_goals_s

SECONDS = 15.0
READY_S = 20.0
LATEST = 0.99


class NotReady(Exception):
    """Nothing could be measured."""


@dataclasses.dataclass
class Taken:
    """Of one flight on the bench: seconds of each cycle, and shares."""

    cpu: float
    late: list[float]
    known_to_goal: list[float]
    missed: int
    recording: float = 0.0


def p99(samples: list[float]) -> float:
    """What all but a hundredth of them stay under."""
    return sorted(samples)[int(LATEST * len(samples))]


def daemon(_: int) -> Iterator[Result]:
    """The budgets of the design, at its two rates, and what a record costs."""
    bare = {rate: _bare(rate) for rate in (100.0, 200.0)}
    for rate, recorded in ((100.0, False), (200.0, False), (200.0, True)):
        what = f"daemon, {rate:.0f} Hz, 500 messages/s{', recorded' if recorded else ''}"
        try:
            taken = _measure(rate, recorded=recorded)
        except NotReady as reason:  # the machine stalled, and the emulated servos fell behind
            sys.stderr.write(f"{what}: not measured, {reason}\n")
            continue
        yield Result(f"{what}: of a core", 100.0 * taken.cpu, "%", "a bare event loop", 100.0 * bare[rate].cpu)
        late = 1e3 * p99(bare[rate].late)
        yield Result(f"{what}: start late, p99", 1e3 * p99(taken.late), "ms", "a bare event loop", late)
        goal = 1e3 * p99(taken.known_to_goal)
        yield Result(f"{what}: state to goal, p99", goal, "ms")
        yield Result(f"{what}: cycles missed", taken.missed, f"/{len(taken.late)}")
        if recorded:
            yield Result(f"{what}: for the record", 100.0 * taken.recording, "%")


def _measure(rate: float, *, recorded: bool) -> Taken:
    with tempfile.TemporaryDirectory() as folder, port() as servos:
        udp = free_port()
        command = [sys.executable, "-m", "tests.bench.daemon", str(udp)]
        with (
            subprocess.Popen(command, stdin=subprocess.PIPE) as autopilot,
            asyncio.Runner(loop_factory=precise_loop) as runner,
        ):
            try:
                return runner.run(_fly(rate, servos, udp, Path(folder) if recorded else None))
            finally:
                autopilot.kill()


async def _fly(rate: float, servos: Path, udp: int, folder: Path | None) -> Taken:
    settings = [f"rates.cycle_hz={rate}", "vehicle.system_id=1", "calibration.directory=''"]
    if folder is not None:
        settings += [f"record.directory='{folder}'", "record.raw=true"]
    config = load("sim.toml", settings)
    (name,) = (name for name, link in config.links.items() if link.role == "autopilot")
    config = dataclasses.replace(config, links={name: config.links[name]})
    clock = Clock(asyncio.get_running_loop(), unix_now())
    openers = Openers({name: udp_in("127.0.0.1", udp)}, open_serial(str(servos), config.servos.baud))
    recorder = Recorder() if folder is None else configured_recorder(config, clock)
    meter = Meter(recorder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raw, "observed", lambda opener, note: observed(opener, meter.of(note)))
        flown = Daemon(config, openers, clock, ServiceManager(""), recorder, compiled_model=True)
    recorder.put, flown._taps.hand_over = meter.of(recorder.put), meter.of(flown._taps.hand_over)  # type: ignore[method-assign]
    stop = asyncio.Event()
    running = asyncio.create_task(flown.run(stop))
    probe = Probe(flown)
    try:
        await probe.ready()
        begun, before = time.perf_counter(), meter.seconds()
        taken = await probe.watch(rate)
        return dataclasses.replace(taken, recording=(meter.seconds() - before) / (time.perf_counter() - begun))
    finally:
        stop.set()
        await running


class Meter:
    """Processor time of a recorder: of its thread, and of what the loop calls for its sake."""

    def __init__(self, recorder: Recorder) -> None:
        thread = getattr(recorder, "_thread", None)
        self._clock = None if thread is None else time.pthread_getcpuclockid(thread.ident)
        self._calls = 0.0

    def of(self, work: Callable[..., None]) -> Callable[..., None]:
        """The same work, with its time counted; looking at the clock is not."""

        def metered(*arguments: Any) -> None:
            begun = time.thread_time()
            work(*arguments)
            ended = time.thread_time()
            self._calls += 2.0 * ended - begun - time.thread_time()

        return metered

    def seconds(self) -> float:
        return self._calls + (0.0 if self._clock is None else time.clock_gettime(self._clock))


class Probe:
    """Looks at the daemon's clockwork from inside, and changes nothing of it."""

    def __init__(self, flown: Daemon) -> None:
        self._daemon: Any = flown
        self._known = 0.0
        self._on = False
        self._goal: list[float] = []
        self._starts: list[float] = []

    async def ready(self) -> None:
        """Have the arm driven."""
        component, begun = self._daemon._component, time.perf_counter()
        while self._daemon._state.phase is not Phase.STOWED:
            _in_time(begun)
            await asyncio.sleep(0.05)
        take = component.take

        def ask() -> Any:
            requests, bar = take()
            component.take = take
            return [*requests, Request(1, Order.READY)], bar

        component.take = ask
        while self._daemon._state.phase is not Phase.READY:
            _in_time(begun)
            await asyncio.sleep(0.05)

    async def watch(self, rate: float) -> Taken:
        """What the cycles take from now on."""
        bus, autopilot = self._daemon._bus, self._daemon._autopilot
        read, write, state = bus.read, bus.write, autopilot.state

        async def reading() -> Any:
            self._starts.append(time.perf_counter())
            return await read()

        def knowing(now: float) -> Any:
            self._known = time.perf_counter()
            return state(now)

        async def writing(*goals: Any, **named: Any) -> Any:
            answer = await write(*goals, **named)
            self._goal.append(time.perf_counter() - self._known + wire_of_goals_s())
            return answer

        bus.read, autopilot.state, bus.write = reading, knowing, writing
        missed, cpu, begun = self._daemon.missed, time.process_time(), time.perf_counter()
        await asyncio.sleep(SECONDS)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - begun
        return Taken(cpu / wall, lateness(self._starts, 1.0 / rate), self._goal, self._daemon.missed - missed)


def _in_time(begun: float) -> None:
    if time.perf_counter() - begun > READY_S:
        raise NotReady("the arm does not become ready")


def lateness(starts: list[float], period: float) -> list[float]:
    """How late each start is on the grid through the median start, s; its sign is of no matter."""
    phases = [start - starts[0] - round((start - starts[0]) / period) * period for start in starts]
    middle = statistics.median(phases)
    return [abs(phase - middle) for phase in phases]


def _bare(rate: float) -> Taken:
    """A loop that wakes up twice in a cycle and does nothing."""

    async def main() -> Taken:
        starts: list[float] = []
        cpu, begun = time.process_time(), time.perf_counter()
        async for _ in ticks(1.0 / rate):
            starts.append(time.perf_counter())
            await asyncio.sleep(0.0015)
            if starts[-1] - begun > SECONDS / 3.0:
                break
        share = (time.process_time() - cpu) / (time.perf_counter() - begun)
        return Taken(share, lateness(starts, 1.0 / rate), [], 0)

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        return runner.run(main())


if __name__ == "__main__":
    stream(int(sys.argv[1]), lambda: True)
