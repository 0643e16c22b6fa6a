"""Starting, watching and ending a flight stack, with small programs that behave as good and bad ones do."""

import argparse
import asyncio
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from arm_companion.cli import sim as command
from arm_companion.cli import sitl as options
from arm_companion.clock import run_simulated
from arm_companion.config import Config, load
from arm_companion.errors import ConfigError, LinkError
from arm_companion.sim import sitl, sitl_ardupilot
from arm_companion.sim.ports import RigidState
from arm_companion.sim.runner import fly_simulated
from arm_companion.sim.sitl import Sitl, SitlFailed
from arm_companion.sim.sitl_relay import Relay
from arm_companion.sim.world import World
from arm_companion.transport.memory import MemoryPipe

STILL = RigidState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -9.81))

# Speaks ArduPilot's JSON interface in lock-step, and sends one datagram on each MAVLink port for every frame.
GOOD = """
    import socket, struct, sys
    words = sys.argv[1:]
    def after(name):
        return words[words.index(name) + 1]
    physics = ("127.0.0.1", int(after("--sim-port-out")))
    ports = [("127.0.0.1", int(after(name).rpartition(":")[2])) for name in ("--serial0", "--serial1")]
    plain = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    plain.settimeout(0.5)
    mavlink = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in ports]
    count = 0
    while True:
        plain.sendto(struct.pack("<HHI16H", 18458, 400, count, *[1500] * 16), physics)
        try:
            answer = plain.recv(65000)
        except TimeoutError:
            continue
        if not answer.startswith(b"\\n{"):
            raise SystemExit("not JSON")
        count += 1
        for one, port in zip(mavlink, ports):
            one.sendto(b"frame %d." % count, port)
"""
ENDS = """
    print("cannot find my parameters", flush=True)
    raise SystemExit(3)
"""
SILENT = """
    import os, time
    print(os.getpid(), flush=True)
    time.sleep(60)
"""
STUBBORN = """
    import signal, subprocess, sys, time
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    print(child.pid, flush=True)
    time.sleep(60)
"""


def program(directory: Path, text: str) -> Path:
    path = directory / "arducopter"
    path.write_text(f"#!{sys.executable}\n{textwrap.dedent(text)}", encoding="utf-8")
    path.chmod(0o755)
    return path


@pytest.fixture
def config() -> Config:
    """With ports that nobody else has."""
    plain = load("sim.toml")
    held = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for one in held:
        one.bind(("127.0.0.1", 0))
    companion, ground = (one.getsockname()[1] for one in held)
    for one in held:
        one.close()
    sim = replace(
        plain.sim,
        autopilot_url=f"udpout:127.0.0.1:{companion}",
        operator_autopilot_url=f"udpin:127.0.0.1:{ground}",
    )
    return replace(plain, sim=sim)


@pytest.fixture(autouse=True)
def _own_physics_port(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = sitl_ardupilot.ArdupilotBridge
    monkeypatch.setattr(
        sitl_ardupilot, "ArdupilotBridge", lambda mass, **others: bridge(mass, ("127.0.0.1", 0), **others)
    )


@contextmanager
def started(directory: Path, text: str, config: Config, *, simulated: bool = True) -> Iterator[Sitl]:
    with sitl.running("ardupilot", program(directory, text), config, directory / "log", simulated=simulated) as stack:
        yield stack


def gone(pid: int) -> bool:
    """Whether a process has ended, or does within the few seconds that a busy machine takes to end it."""
    until = time.monotonic() + 5.0
    while time.monotonic() < until:
        try:
            if "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text(encoding="ascii"):
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.02)
    return False


def test_world_and_flight_stack_take_turns_and_its_mavlink_is_relayed(tmp_path: Path, config: Config) -> None:
    heard: dict[str, list[bytes]] = {"companion": [], "ground": []}

    async def fly(stack: Sitl) -> float:
        world = World(config, stack)
        pipes = {name: MemoryPipe() for name in heard}
        for name, pipe in pipes.items():
            await pipe.opener(1)(heard[name].append)
        links = pipes["companion"].opener(0), pipes["ground"].opener(0)
        tasks = [asyncio.create_task(stack.run(*links)), asyncio.create_task(world.run())]
        await asyncio.sleep(0.2)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return world.plant.time

    with started(tmp_path, GOOD, config) as stack:
        flown = run_simulated(fly(stack))
        frames = getattr(stack.bridge, "frames", 0)
    assert flown == pytest.approx(0.2, abs=0.005)
    assert frames == pytest.approx(100, abs=3), "one frame for each turn of 2 ms"
    for chunks in heard.values():
        assert b"".join(chunks).startswith(b"frame 1.frame 2.frame 3.")


def test_a_world_without_stand_in_says_so(tmp_path: Path, config: Config) -> None:
    with started(tmp_path, SILENT, config) as stack, pytest.raises(TypeError, match="no stand-in"):
        _ = World(config, stack).autopilot


def test_one_that_ends_is_told_with_its_last_words(tmp_path: Path, config: Config) -> None:
    with (
        started(tmp_path, ENDS, config) as stack,
        pytest.raises(SitlFailed, match=r"code 3(.|\n)*cannot find my parameters"),
    ):
        stack.due()


def test_one_that_ends_in_flight_ends_the_flight_with_its_last_words_alone(tmp_path: Path, config: Config) -> None:
    with (
        started(tmp_path, ENDS, config) as stack,
        pytest.raises(SitlFailed, match=r"code 3(.|\n)*cannot find my parameters"),
    ):
        run_simulated(fly_simulated(config, print, flown_by=stack))


def test_one_that_ends_ends_the_watch(tmp_path: Path, config: Config) -> None:
    nobody = MemoryPipe()
    with started(tmp_path, ENDS, config, simulated=False) as stack, pytest.raises(SitlFailed, match="code 3"):
        asyncio.run(stack.run(nobody.opener(0), nobody.opener(1)))


def test_a_silent_one_is_given_up_in_simulated_time(
    tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sitl, "_LOST_S", 0.3)
    monkeypatch.setattr(sitl, "_ASK_AGAIN_S", 0.1)
    with started(tmp_path, SILENT, config) as stack, pytest.raises(SitlFailed, match="silent"):
        stack.due()


def test_in_real_time_the_world_waits_and_then_the_motors_stop(
    tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sitl, "_BOOTING_S", 0.2)
    with started(tmp_path, SILENT, config, simulated=False) as stack:
        assert not stack.due(), "it has not had its turn"
        time.sleep(0.25)
        assert stack.due()
        assert stack.silent
        assert stack.control(STILL, 0.002).thrust_n == 0.0


def test_whatever_happens_the_program_and_its_children_end(
    tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sitl, "_STOP_WITHIN_S", 0.3)
    children = []

    def fly() -> None:
        with started(tmp_path, STUBBORN, config, simulated=False) as stack:
            until = time.monotonic() + 10.0
            while not (text := stack.log.read_text(encoding="ascii")) and time.monotonic() < until:
                time.sleep(0.02)
            children.append(int(text))
            raise RuntimeError("in flight")

    with pytest.raises(RuntimeError, match="in flight"):
        fly()
    assert children
    assert gone(children[0])


def test_sigterm_ends_what_was_started(tmp_path: Path) -> None:
    path = program(tmp_path, SILENT)
    words = ["sim", "perch", "--simulated", "--sitl", "ardupilot", "--sitl-binary", str(path)]
    process = subprocess.Popen(
        [sys.executable, "-m", "arm_companion", *words, "--output", str(tmp_path)], stderr=subprocess.PIPE, text=True
    )
    log = tmp_path / "ardupilot.log"
    until = time.monotonic() + 30.0
    while not (log.exists() and (text := log.read_text(encoding="ascii"))) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20.0)
    assert process.returncode == 128 + signal.SIGTERM
    assert gone(int(text))


def test_a_program_must_be_named_and_be_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ARM_COMPANION_PX4_SITL", raising=False)
    with pytest.raises(ConfigError, match="ARM_COMPANION_PX4_SITL"):
        sitl.binary("px4", None)
    text = tmp_path / "text"
    text.write_text("no program", encoding="ascii")
    with pytest.raises(ConfigError, match="no program"):
        sitl.binary("px4", text)
    monkeypatch.setenv("ARM_COMPANION_PX4_SITL", sys.executable)
    assert sitl.binary("px4", None) == Path(sys.executable).resolve()


def test_px4_needs_its_etc_and_its_ports(tmp_path: Path, config: Config) -> None:
    (tmp_path / "bin").mkdir()
    path = tmp_path / "bin" / "px4"
    with pytest.raises(ConfigError, match="14540"):
        sitl.launch("px4", path, config, 4560, simulated=True)
    plain = load("sim.toml")
    with pytest.raises(ConfigError, match="etc"):
        sitl.launch("px4", path, plain, 4560, simulated=True)
    (tmp_path / "etc").mkdir()
    how = sitl.launch("px4", path, plain, 4560, simulated=True)
    assert how.command[-1] == str(tmp_path / "etc")
    assert how.environment["PX4_SIM_MODEL"] == "none_iris"
    assert how.environment["PX4_PARAM_THR_MDL_FAC"] == "1.0"
    assert how.environment["PX4_PARAM_MIS_TAKEOFF_ALT"] == str(plain.sim.takeoff_height_m)
    assert how.environment["PX4_PARAM_EKF2_HGT_REF"] == "3", "motion capture tells the height"


def test_motion_capture_is_a_choice(tmp_path: Path, config: Config) -> None:
    """Satellites alone: no parameters for it, and no line."""
    how = sitl.launch("ardupilot", tmp_path, config, 9002, simulated=True, capture_port=1234)
    assert [Path(name).name for name in how.command[how.command.index("--defaults") + 1].split(",")] == [
        "ardupilot.parm",
        "ardupilot_capture.parm",
    ]
    assert how.command[-2:] == ("--serial2", "udpclient:127.0.0.1:1234")
    outdoors = replace(config, sim=replace(config.sim, sitl_position="satellites"))
    how = sitl.launch("ardupilot", tmp_path, outdoors, 9002, simulated=True)
    assert how.command[how.command.index("--defaults") + 1].endswith("ardupilot.parm")
    assert "--serial2" not in how.command


def test_a_step_longer_than_a_turn_is_refused(tmp_path: Path, config: Config) -> None:
    slow = replace(config, sim=replace(config.sim, step_s=0.004))
    with pytest.raises(ConfigError, match="step_s"), started(tmp_path, SILENT, slow):
        pass


def test_a_relay_says_which_port_is_taken() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=str(port)):
            Relay([port])


def arguments(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(["perch", *words])


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--sitl-binary", "x"], "need --sitl"),
        (["--sitl-fly"], "need --sitl"),
        (["--sitl", "px4", "--trials", "3"], "one flight"),
        (["--sitl", "px4", "--sitl-binary", "x", "--sitl-connect", "udpin:127.0.0.1:1"], "not both"),
        (["--sitl", "px4", "--sitl-fly"], "--sitl-connect"),
    ],
)
def test_options_that_do_not_go_together_are_refused(words: list[str], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        options.check(arguments(words))


def test_the_daemon_is_told_of_the_flight_stack() -> None:
    given = arguments(["--sitl", "ardupilot"])
    options.check(given)
    assert load("sim.toml", given.settings).vehicle.autopilot == "ardupilot"


def test_isolation_leaves_nothing_but_a_loopback() -> None:
    code = textwrap.dedent("""
        import socket
        from pathlib import Path
        from arm_companion.sim.isolation import NotIsolated, isolate
        try:
            isolate()
        except NotIsolated as reason:
            print("not permitted:", reason)
            raise SystemExit(77)
        print(len(Path("/proc/net/route").read_text().splitlines()) - 1, "routes")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.bind(("127.0.0.1", 0))
            one.sendto(b"x", one.getsockname())
            print(one.recv(1))
    """)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ), check=False
    )
    if done.returncode == 77:
        pytest.skip(done.stdout)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["0 routes", "b'x'"]
