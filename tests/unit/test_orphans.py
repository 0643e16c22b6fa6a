"""A process that was killed leaves nothing behind that it started to end with it."""

import os
import select
import subprocess
import sys

import pytest

_PARENT = """
import subprocess, sys, time
from arm_companion.sim.orphans import end_with_parent
words = [sys.executable, "-c", "import time; print('child', flush=True); time.sleep(60.0)"]
child = subprocess.Popen(words, preexec_fn=end_with_parent)
time.sleep(60.0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of its parent's end")
def test_a_child_ends_when_its_parent_is_killed() -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as end, subprocess.Popen([sys.executable, "-c", _PARENT], stdout=writing) as parent:
        os.close(writing)
        try:
            assert end.readline() == b"child\n"
        finally:
            parent.kill()
        assert select.select([end], [], [], 10.0)[0], "the child still holds its end of the pipe"
        assert end.read() == b""


def test_who_asked_for_it_goes_on_while_its_parent_does() -> None:
    words = "from arm_companion.sim.orphans import end_with_parent; end_with_parent(9); print('on')"
    assert subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True).stdout == "on\n"
