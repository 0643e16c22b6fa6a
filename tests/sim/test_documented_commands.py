"""The commands and programs of the documentation, run as they stand there: each in a process, where a reader would be.

`tests/unit/test_documentation.py` runs what only computes, and sees to it that every command is in one of the groups.
"""

import asyncio
import contextlib
import math
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import load
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from tests.documentation import ALONE, BEGIN, COMMANDS, IN_A_WORLD, ON_A_BUS, ROOT, group, words_of

LONG_S = 900.0
NOT_HEARD = 3
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


def loading_test() -> str:
    """What a person would measure at the default arm: the tip under loads, in three bends."""
    rows = ["run,theta_deg,force_x_n,x_m,y_m,z_m"]
    model = RodModel(ArmParameters.of(load("zhao2022.toml").arm))
    for degrees in (0.0, 20.0, 40.0):
        pull = model.pull_for_bend([math.radians(degrees), 0.0])
        for force in (0.0, 0.2, 0.4, 0.6):
            found = model.free(pull, [0.0, 0.0, 9.81], tip_wrench=[force, 0.0, 0.0, 0.0, 0.0, 0.0])
            x, y, z = found.tip_position
            rows.append(f"bend {degrees:g},{degrees},{force},{x:.5f},{y:.5f},{z:.5f}")
    return "\n".join(rows) + "\n"


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
        (place / "arm.toml").unlink()
        (place / "DATA.csv").write_text(loading_test())
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
def world(folder: Path, line: str = "sim world") -> Iterator[None]:
    """`arm-companion sim world`, as the pages start it, and heard."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    started = subprocess.Popen(command(line), cwd=folder, env=environment, stdout=subprocess.DEVNULL)
    try:
        for _ in range(5):  # each waits until it hears the arm, or gives up
            if run(command("ground status"), folder, 60.0).returncode == 0:
                break
        yield
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
            if done.returncode == NOT_HEARD:  # a busy machine
                done = run(words, folder, 120.0)
            expected = 1 if words_of(line)[1] in {"perch", "reach", "release"} else 0  # the vehicle is on the ground
            sys.stdout.write(f"{line}: {done.returncode}\n{done.stdout}{done.stderr}\n")
            assert done.returncode == expected, line
            assert "Traceback" not in done.stderr
        for words in (["order.py", "STOW", "udpin:127.0.0.1:14560"], ["arm.py"]):
            done = run([sys.executable, *words], folder, 120.0)
            sys.stdout.write(f"{words}: {done.returncode}\n{done.stdout}{done.stderr}\n")
            assert done.returncode == 0, words


@pytest.mark.scenario
@pytest.mark.realtime
def test_a_reader_with_a_world_on_the_desk(place: Path) -> None:
    here = "from tests.sim.test_documented_commands import _visit; import sys; _visit(sys.argv[1])"
    done = run([sys.executable, "-c", _OWN_NETWORK, sys.executable, "-c", here, str(place)], ROOT, 300.0)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    assert "result 0" in done.stdout
    assert "N on the airframe" in done.stdout


def _look(place: str) -> None:
    """The world of vision.md, and the program beside it; called in a network of its own."""
    folder = Path(place)
    (line,) = (line for page, line in COMMANDS if page == "vision.md" and line.startswith("sim world"))
    page = (ROOT / "docs/vision.md").read_text(encoding="utf-8")
    (words,) = re.findall(r"^python (docs/examples/vision/.*)$", page, re.MULTILINE)
    script, *options = words.split()
    with world(folder, line):
        before = run(command("ground status --json"), folder, 60.0)
        seeing = ["timeout", "--preserve-status", "-s", "INT", "8", sys.executable, str(ROOT / script), *options]
        assert run(seeing, folder, 60.0).returncode == 0
        after = run(command("ground status --json"), folder, 60.0)
    log = (folder / "build/sim/daemon.log").read_text()
    sys.stdout.write(f"{before.stdout}{before.stderr}\n{after.stdout}{after.stderr}\n{log}")
    assert "target_known" not in before.stdout
    assert "target_known" in after.stdout
    assert "refused" not in log


@pytest.mark.scenario
@pytest.mark.realtime
def test_a_reader_with_a_vision_process(place: Path) -> None:
    here = "from tests.sim.test_documented_commands import _look; import sys; _look(sys.argv[1])"
    done = run([sys.executable, "-c", _OWN_NETWORK, sys.executable, "-c", here, str(place)], ROOT, 300.0)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]


@pytest.mark.scenario
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
