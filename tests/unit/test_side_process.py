"""A process beside the daemon: what it says and how it ends, whatever it is."""

import signal
import subprocess
import sys

import pytest

_STUBBORN = """
import asyncio, time
from arm_companion.drivers import side_child

async def deaf():
    while True:
        try:
            await asyncio.sleep(3600.0)
        except asyncio.CancelledError:
            pass

async def in_a_thread():
    await asyncio.to_thread(time.sleep, 3600.0)

side_child._END_WITHIN_S = 0.1
side_child.run(lambda _: (print, {work}()), 1 << 30)
"""


@pytest.mark.parametrize("work", ["deaf", "in_a_thread"])
def test_a_process_ends_with_its_input_even_if_its_work_does_not(work: str) -> None:
    code = _STUBBORN.replace("{work}", work)
    ended = subprocess.run([sys.executable, "-c", code], input=b"{}\n", check=False, timeout=60.0)
    assert ended.returncode == -signal.SIGALRM
