"""`python -m tests.bench.servo_port PATH`: four emulated servos at a pseudo-terminal, in a process of their own.

Whoever started it closes its standard input to end it.
"""

import asyncio
import sys

from arm_companion.clock import precise_loop
from arm_companion.config.schema import ServosConfig
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time


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
    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(serve(sys.argv[1]))
