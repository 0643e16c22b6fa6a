"""The commands and programs of the documentation, run as they stand there: each in a process, where a reader would be.

`tests/unit/test_documentation.py` runs what only computes, and sees to it that every command is in one of the groups.
"""

import asyncio
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from arm_companion.config import load
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from tests.documentation import ALONE, BEGIN, COMMANDS, IN_A_WORLD, ON_A_BUS, ROOT, group, words_of

LONG_S = 900.0
EXTENDS_SIM = f'extends = "{ROOT}/configs/sim.toml"\n'
# Each command with ports: in a network of its own where the system allows it, as someone may use the same ports
_OWN_NETWORK = """
import sys
from arm_companion.sim.isolation import NotIsolated, isolate
try:
    isolate()
except NotIsolated as reason:
    print(reason, file=sys.stderr)
import subprocess
sys.exit(subprocess.call(sys.argv[1:]))
"""


def lines(wanted: str) -> list[str]:
    return sorted({line for _, line in COMMANDS if group(line) == wanted})


def program(page: str, says: str) -> str:
    """The Python program on a page with these words in it."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    (found,) = (
        block for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL) if says in block
    )
    return found


def run(words: list[str], folder: Path, within_s: float = LONG_S) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, timeout=within_s, check=False
    )


def command(line: str) -> list[str]:
    return [sys.executable, "-m", "arm_companion", *words_of(line)]


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with the files that the pages speak of."""
    for name in ("flight.mcap", "build/demo/record.mcap"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "tests/golden/perch.mcap", tmp_path / name)
    for name in ("config.toml", "other.toml", "arm.toml"):
        (tmp_path / name).write_text(EXTENDS_SIM)
    return tmp_path


# --- without a world ---


@pytest.mark.scenario
@pytest.mark.parametrize("line", lines(ALONE), ids=lambda line: line[:60])
def test_it_runs(line: str, place: Path) -> None:
    if line.startswith("calibrate stiffness"):
        run(command("model stiffness-test --csv DATA.csv"), place)
        (place / "arm.toml").unlink()
    words = command(line)
    if "--trials" in words:
        words[words.index("--trials") + 1] = "1"
    done = run(words, place)
    allowed = {0}
    if line.startswith("replay"):
        allowed = {0, 3}  # 3: other commands than recorded, which is what some of them are for
    if "sim.bar.position_m" in line:
        allowed = {1}  # the bar is not where it should be
    assert done.returncode in allowed, done.stdout + done.stderr
    assert "Traceback" not in done.stderr


# --- against the simulated world, in real time ---


@contextlib.contextmanager
def world(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """`arm-companion sim world`, as the pages start it."""
    started = subprocess.Popen(
        [sys.executable, "-m", "arm_companion", "sim", "world"],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    try:
        yield started
    finally:
        started.send_signal(signal.SIGINT)
        started.wait(20.0)


def _visit(place: str) -> None:
    """Everything that a reader types while the world runs; called in a network of its own."""
    folder = Path(place)
    (folder / "order.py").write_text(program("flying.md", "COMMANDS"))
    (folder / "arm.py").write_text(program("ground.md", "Arm.connect"))
    with world(folder):
        for line in lines(IN_A_WORLD):
            watching = line.startswith("ground watch")
            words = ["timeout", "--preserve-status", "-s", "INT", "12", *command(line)] if watching else command(line)
            done = run(words, folder, 120.0)
            expected = 1 if "perch" in line or "release" in line else 0  # the vehicle is on the ground
            sys.stdout.write(f"{line}: {done.returncode}\n{done.stdout}{done.stderr}\n")
            assert done.returncode == expected, line
            assert "Traceback" not in done.stderr
        for words in (["order.py", "STOW", "udpin:127.0.0.1:14560"], ["arm.py"]):
            done = run([sys.executable, *words], folder, 120.0)
            sys.stdout.write(f"{words}: {done.returncode}\n{done.stdout}{done.stderr}\n")
            assert done.returncode == 0, words


@pytest.mark.realtime
def test_a_reader_with_a_world_on_the_desk(place: Path) -> None:
    here = "from tests.sim.test_documented_commands import _visit; import sys; _visit(sys.argv[1])"
    done = run([sys.executable, "-c", _OWN_NETWORK, sys.executable, "-c", here, str(place)], ROOT, 300.0)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    assert "result 0" in done.stdout
    assert "N on the airframe" in done.stdout


@pytest.mark.realtime
@pytest.mark.parametrize("line", lines(BEGIN), ids=lambda line: line[:60])
def test_it_begins_and_ends_when_told(line: str, place: Path) -> None:
    words = command(line)
    if words_of(line)[0] == "run":
        words += ["--config", "config.toml", "--set", "servos.port=/dev/none"]
    if words_of(line)[0] == "doctor":
        words += ["--config", "config.toml", "--patience", "1"]
    until = ["timeout", "--preserve-status", "-s", "INT", "12", *words]
    done = run([sys.executable, "-c", _OWN_NETWORK, *until], place, 60.0)
    said = done.stdout + done.stderr
    assert "Traceback" not in said, said
    assert "arm_companion" in said or "arm" in said
    assert done.returncode in ({0, 1, 2} if words_of(line)[0] == "doctor" else {0, 130}), said


# --- with a servo bus ---


@pytest.mark.realtime
@pytest.mark.parametrize("line", lines(ON_A_BUS), ids=lambda line: line[:60])
def test_it_runs_with_servos(line: str, place: Path) -> None:
    port = place / "bus"
    (place / "config.toml").write_text(f'{EXTENDS_SIM}[servos]\nport = "{port}"\n')
    config = load(place / "config.toml")

    async def main() -> tuple[int, str]:
        emulator = ServoEmulator(config.servos, seed=1)
        bus = EmulatedBus(emulator, config.servos)
        tasks = [asyncio.create_task(bus.serve_pty(port)), asyncio.create_task(keep_time(emulator))]
        await bus.wait_ready()
        words = command(line)
        if "--once" not in words:
            words = ["timeout", "--preserve-status", "-s", "INT", "6", *words]
        process = await asyncio.create_subprocess_exec(
            *words, cwd=place, env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        )  # fmt: skip
        out, _ = await process.communicate()
        for task in tasks:
            task.cancel()
        return process.returncode or 0, out.decode()

    code, said = asyncio.run(main())
    assert code in {0, 130}, said
    assert "Traceback" not in said
    assert "12.0" in said or "voltage" in said.lower(), said
