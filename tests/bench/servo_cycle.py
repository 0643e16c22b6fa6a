"""A whole servo cycle over a port at 1 Mbit/s, beside the maker's SDK doing the same on the same port.

One Sync Read of 23 bytes from each of four servos (a fast one, as both can) and one Sync Write of goals. The servos
are emulated in a process of their own, with the timing of every byte. A cycle ends when its goals have left the
program; the time on the wire counts request, answers and goals.
"""

import asyncio
import contextlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import dynamixel_sdk as sdk

from arm_companion.clock import precise_loop, ticks
from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.protocol import control_table as ct
from arm_companion.protocol import dynamixel as dxl
from arm_companion.transport.serial import open_serial
from tests.bench.measure import Result

CONFIG = ServosConfig()
GOAL = 2048
RATE_HZ = 200.0
CYCLES = 200  # in one round


def servo_cycle(rounds: int) -> Iterator[Result]:
    """Time and processor time of a cycle, ours and the SDK's in turns."""
    ours: list[tuple[float, float]] = []
    theirs: list[tuple[float, float]] = []
    bare: list[float] = []
    with port(spin=True) as path:
        for _ in range(rounds):
            ours.append(_ours(path))
            theirs.append(_theirs(path))
            bare.append(_bare_loop())
    mine, peer = (1e3 * statistics.median(time_ for time_, _ in side) for side in (ours, theirs))
    my_cpu, peer_cpu = (1e3 * statistics.median(cpu for _, cpu in side) for side in (ours, theirs))
    yield Result("servo bus, one cycle", mine, "ms", "the maker's SDK", peer)
    yield Result("servo bus, cycle beside its time on the wire", mine, "ms", "wire", 1e3 * wire_s())
    yield Result("servo bus, processor time a cycle", my_cpu, "ms", "the maker's SDK", peer_cpu)
    idle = 1e3 * statistics.median(bare)
    yield Result("servo bus, processor time a cycle", my_cpu, "ms", "two waits of a bare event loop", idle)


def wire_s() -> float:
    """Time on the wire of request, answers and goals, s."""
    request = len(dxl.sync_read(CONFIG.ids, ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE, fast=True))
    answer = dxl.fast_sync_size(len(CONFIG.ids), ct.FEEDBACK_SIZE)
    goals = len(dxl.sync_write(ct.GOAL_POSITION.address, dict.fromkeys(CONFIG.ids, ct.GOAL_POSITION.encode(GOAL))))
    return (request + answer + goals) * 10 / CONFIG.baud


@contextlib.contextmanager
def port(*, spin: bool = False) -> Iterator[Path]:
    """Where four emulated servos are; with `spin` they take a core, and answer when real ones would."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "servos"
        command = [sys.executable, "-m", "tests.bench.servo_port", str(path), *(["--spin"] if spin else [])]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as servos:
            if servos.stdout is None or servos.stdout.readline() != b"ready\n":
                raise RuntimeError("the emulated servos do not start")
            try:
                yield path
            finally:
                servos.communicate()


def _ours(path: Path) -> tuple[float, float]:
    """Median time and mean processor time of a cycle, s."""

    async def main() -> tuple[float, float]:
        bus = ServoBus(open_serial(str(path), CONFIG.baud), CONFIG)
        await bus.start()
        taken: list[float] = []
        cpu = time.process_time()
        async for _ in ticks(1.0 / RATE_HZ):
            begun = time.perf_counter()
            await bus.read()
            await bus.write((GOAL,) * len(CONFIG.ids))
            taken.append(time.perf_counter() - begun)
            if len(taken) == CYCLES:
                break
        cpu = (time.process_time() - cpu) / CYCLES
        await bus.stop(limp=False)
        # the write returns at once; its bytes are still to pass
        return statistics.median(taken) + wire_of_goals_s(), cpu

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        return runner.run(main())


def wire_of_goals_s() -> float:
    """Time on the wire of the goals alone, s."""
    data = dict.fromkeys(CONFIG.ids, ct.GOAL_POSITION.encode(GOAL))
    return len(dxl.sync_write(ct.GOAL_POSITION.address, data)) * 10 / CONFIG.baud


def _theirs(path: Path) -> tuple[float, float]:
    """The same with the SDK."""
    port, handler = sdk.PortHandler(str(path)), sdk.PacketHandler(2.0)
    if not port.setBaudRate(CONFIG.baud):
        raise RuntimeError("the SDK does not open the port")
    reader = sdk.GroupSyncRead(port, handler, ct.FEEDBACK_ADDRESS, ct.FEEDBACK_SIZE)
    writer = sdk.GroupSyncWrite(port, handler, ct.GOAL_POSITION.address, ct.GOAL_POSITION.size)
    for servo in CONFIG.ids:
        reader.addParam(servo)
        writer.addParam(servo, list(ct.GOAL_POSITION.encode(GOAL)))
    taken: list[float] = []
    cpu = time.process_time()
    due = time.perf_counter()
    for _ in range(CYCLES):
        begun = time.perf_counter()
        reader.fastSyncRead()
        for servo in CONFIG.ids:
            for address, size in ((126, 2), (128, 4), (132, 4), (144, 2), (146, 1)):
                reader.getData(servo, address, size)
            writer.changeParam(servo, list(ct.GOAL_POSITION.encode(GOAL)))
        writer.txPacket()
        taken.append(time.perf_counter() - begun)
        due += 1.0 / RATE_HZ
        time.sleep(max(due - time.perf_counter(), 0.0))
    cpu = (time.process_time() - cpu) / CYCLES
    port.closePort()
    return statistics.median(taken) + wire_of_goals_s(), cpu


def _bare_loop() -> float:
    """Processor time that an event loop takes for two waits that together last one cycle, s: nothing can take less."""

    async def main() -> float:
        cpu = time.process_time()
        for _ in range(CYCLES):
            await asyncio.sleep(0.0015)
            await asyncio.sleep(1.0 / RATE_HZ - 0.0015)
        return (time.process_time() - cpu) / CYCLES

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        return runner.run(main())
