"""`python -m tests.bench.servo_port PATH`: four emulated servos at a pseudo-terminal, in a process of their own.

With `--spin` it never sleeps, and takes a core for it: servos and wire are hardware, which no scheduler wakes late.
Whoever started it closes its standard input to end it.
"""

import asyncio
import selectors
import sys
import time

from arm_companion.clock import precise_loop
from arm_companion.config.schema import ServosConfig
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time


class Spinning(selectors.SelectSelector):
    """A selector that looks again and again instead of waiting."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        until = time.perf_counter() + (timeout or 0.0)
        while not (ready := super().select(0)) and (timeout is None or time.perf_counter() < until):
            pass
        return ready


def spinning_loop() -> asyncio.SelectorEventLoop:
    return asyncio.SelectorEventLoop(Spinning())


async def serve(path: str) -> None:
    config = ServosConfig()
    emulator = ServoEmulator(config)
    bus = EmulatedBus(emulator, config)
    tasks = [asyncio.create_task(bus.serve_pty(path)), asyncio.create_task(keep_time(emulator, 0.02))]
    await bus.wait_ready()
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    for task in tasks:
        task.cancel()


if __name__ == "__main__":
    path, *options = sys.argv[1:]
    spinning = options == ["--spin"]
    with asyncio.Runner(loop_factory=spinning_loop if spinning else precise_loop) as runner:
        runner.run(serve(path))
