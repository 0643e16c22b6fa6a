"""A process beside the daemon: what it says and how it ends, whatever it is."""

import asyncio
import json
import logging
import signal
import subprocess
import sys

import pytest

from arm_companion.drivers.side_process import SideProcess

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


def test_lines_that_are_no_messages_are_counted_told_once_and_passed_over(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    heard: list[tuple[str, str]] = []
    strange = ("7", "null", '"ab"', "[]", '["one"]', '["a", "b", "c"]', '["a", 1]', "{}", "a word", "\xff", "[" * 9000)
    process = SideProcess("page", "none", {}, 1, lambda kind, text: heard.append((kind, text)))

    async def main() -> None:
        pipe = asyncio.StreamReader()
        for line in (*strange, json.dumps(["log", "a sentence"]), json.dumps(["command", "{}"])):
            pipe.feed_data(line.encode("latin-1") + b"\n")
        pipe.feed_eof()
        await process._listen(pipe)

    asyncio.run(main())
    assert heard == [("command", "{}")]
    assert process.malformed == len(strange)
    assert [record.message for record in caplog.records if record.name == "arm_companion.drivers.side_process"] == [
        "page: its process says what is no message: b'7\\n'",
        "page: a sentence",
    ]
