"""A real flight stack in place of the stand-in: ArduPilot copter or PX4 SITL, started, watched and ended.

The program is the user's own. It is started in an empty directory with the parameters that ship in `configs/sitl`,
its physics is the plant (`sitl_ardupilot`, `sitl_px4`), and its MAVLink goes out by UDP on loopback: to the companion
where `sim.autopilot_url` says, and to the ground where `sim.operator_autopilot_url` says. In real time the daemon and
the ground listen there themselves. In simulated time a relay does, which reads when the flight stack has had its turn.
"""

import contextlib
import os
import select
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Protocol

from arm_companion.clock import ticks
from arm_companion.config.schema import Config
from arm_companion.errors import ArmError, ConfigError
from arm_companion.sim import sitl_ardupilot, sitl_px4
from arm_companion.sim.capture import Capture, CaptureLine
from arm_companion.sim.orphans import end_with_parent
from arm_companion.sim.ports import RigidState, RotorCommand
from arm_companion.sim.sitl_relay import Relay
from arm_companion.supervisor import ending_on_terminate
from arm_companion.transport.base import Opener

STACKS = ("ardupilot", "px4")
BINARY_VARIABLES = {"ardupilot": "ARM_COMPANION_ARDUPILOT_SITL", "px4": "ARM_COMPANION_PX4_SITL"}

_LOOPBACK = "127.0.0.1"
_BRIEF_S = 0.002  # in real time the event loop stands still for so long at most
_ASK_AGAIN_S = 1.0
_BOOTING_S = 3.0  # in real time: silent for longer, and the motors stop
_LOST_S = 30.0  # in simulated time
_STOP_WITHIN_S = 3.0
_FASTEST = 100  # times real time, which simulated time never reaches: the flight stack is not to wait
_WATCH_S = 0.5
_LAST_LINES = 5


class SitlFailed(ArmError):
    """The flight stack does not start, has ended or is silent."""


class Bridge(Protocol):
    """The physics' side of one flight stack's own interface, in turns."""

    period_s: float

    def answered(self, within_s: float) -> bool:
        """Whether it has had its turn; waits so long of the machine's time at most."""

    def ask_again(self) -> None:
        """It has not answered for a while."""

    def control(self, state: RigidState, dt: float) -> RotorCommand:
        """Give it the state, take the motors."""

    def coast(self, dt: float) -> RotorCommand:
        """Motors that nobody drives."""

    def close(self) -> None:
        """Leave its port."""


@dataclass(frozen=True)
class Launch:
    """How a flight stack is started.

    Attributes:
        command: program and arguments.
        environment: in addition to ours.
    """

    command: tuple[str, ...]
    environment: dict[str, str]


def binary(stack: str, given: Path | None) -> Path:
    """The user's program.

    Args:
        stack: one of STACKS.
        given: on the command line; None takes the environment's.

    Raises:
        ConfigError: none is named, or what is named is no program.
    """
    variable = BINARY_VARIABLES[stack]
    named = given or (Path(os.environ[variable]) if os.environ.get(variable) else None)
    if named is None:
        raise ConfigError(f"no {stack} SITL: name it with --sitl-binary PATH or {variable}")
    path = named.expanduser().resolve()
    if not path.is_file() or not os.access(path, os.X_OK):
        raise ConfigError(f"{path} is no program that can be started")
    return path


def parameters(stack: str, position: str = "satellites") -> list[Path]:
    """The shipped parameter files of a flight stack; what a later one says counts.

    Args:
        stack: one of STACKS.
        position: where it knows its position from, as `sim.sitl_position`.

    Raises:
        ConfigError: the package is incomplete.
    """
    places = (Path(str(resources.files("arm_companion"))) / "configs", Path(__file__).resolve().parents[2] / "configs")
    names = [f"{stack}.parm", f"{stack}_capture.parm"] if position == "capture" else [f"{stack}.parm"]
    for place in places:
        if all((place / "sitl" / name).is_file() for name in names):
            return [place / "sitl" / name for name in names]
    raise ConfigError(f"the parameters for {stack} are missing from this installation")


def launch(
    stack: str,
    program: Path,
    config: Config,
    physics_port: int,
    *,
    simulated: bool,
    capture_port: int | None = None,
    more: Sequence[Path] = (),
) -> Launch:
    """The command line of a flight stack.

    Args:
        stack: one of STACKS.
        program: the user's.
        config: its links say where MAVLink goes.
        physics_port: of the bridge.
        simulated: as fast as it goes.
        capture_port: where ArduPilot hears motion capture.
        more: parameter files besides.

    Raises:
        ConfigError: PX4 without its `etc` beside it, or ports that PX4 cannot have.
    """
    companion, ground = _ports(config)
    files = [*parameters(stack, config.sim.sitl_position), *more]
    if stack == "ardupilot":
        latitude, longitude, height = sitl_px4.HOME
        words = [
            str(program),
            *("--model", f"JSON:{_LOOPBACK}", "--sim-port-out", str(physics_port)),
            *("--speedup", str(_FASTEST if simulated else 1), "--home", f"{latitude},{longitude},{height},0"),
            *("--defaults", ",".join(map(str, files)), "--wipe"),
            *("--serial0", f"udpclient:{_LOOPBACK}:{ground}", "--serial1", f"udpclient:{_LOOPBACK}:{companion}"),
        ]
        if capture_port is not None:
            words += ["--serial2", f"udpclient:{_LOOPBACK}:{capture_port}"]
        return Launch(tuple(words), {})
    if (physics_port, companion, ground) != (sitl_px4.PORT, 14540, 14550):
        raise ConfigError("PX4 SITL has its own ports: 14540 to the companion, 14550 to the ground")
    etc = program.parent.parent / "etc"
    if not etc.is_dir():
        raise ConfigError(f"PX4 SITL needs its build's etc directory: {etc} is missing")
    lines = (line.split() for file in files for line in file.read_text(encoding="utf-8").splitlines())
    values = {f"PX4_PARAM_{words[0]}": words[1] for words in lines if len(words) == 2}
    values["PX4_PARAM_MIS_TAKEOFF_ALT"] = str(config.sim.takeoff_height_m)
    return Launch((str(program), "-d", "-i", "0", str(etc)), {"PX4_SIM_MODEL": "none_iris", **values})


def _ports(config: Config) -> tuple[int, int]:
    """UDP ports of companion and ground."""
    urls = (config.sim.autopilot_url, config.sim.operator_autopilot_url)
    companion, ground = (int(url.rpartition(":")[2]) for url in urls)
    return companion, ground


class Sitl:
    """A running flight stack, as the world's.

    Attributes:
        bridge: to its physics.
        log: what it writes.
        silent: nobody drives the motors, because it has not answered for a while.
    """

    def __init__(self, bridge: Bridge, process: subprocess.Popen[bytes], log: Path, relay: Relay | None) -> None:
        self.bridge = bridge
        self.log = log
        self.silent = False
        self.period_s = bridge.period_s
        self._process = process
        self._relay = relay
        self._asked = self._heard = time.perf_counter()

    def due(self) -> bool:
        """Whether the flight stack has had its turn.

        In simulated time this waits for it: that is the lock-step. In real time the world stands still instead, and
        after three seconds goes on with motors that nobody drives, as with an autopilot that boots.

        Raises:
            SitlFailed: it has ended, or is silent in simulated time.
        """
        if self._relay is None:
            answered = self.bridge.answered(_BRIEF_S)
            self.silent = not answered and self._silence() > _BOOTING_S
            return answered or self.silent
        while not self.bridge.answered(_ASK_AGAIN_S):
            if self._silence() > _LOST_S:
                raise SitlFailed(f"the flight stack has been silent for {_LOST_S:.0f} s; see {self.log}")
        self._heard = time.perf_counter()
        self._relay.poll()
        return True

    def control(self, state: RigidState, dt: float) -> RotorCommand:
        """One turn of physics and flight stack."""
        if self.silent:
            return self.bridge.coast(dt)
        self._heard = time.perf_counter()
        return self.bridge.control(state, dt)

    async def run(self, companion: Opener, ground: Opener) -> None:
        """Relay, in simulated time, and watch the program, until cancelled.

        Raises:
            SitlFailed: it has ended.
        """
        if self._relay is not None:
            await self._relay.connect((companion, ground))
        async for _ in ticks(_WATCH_S):
            self._check()

    def _silence(self) -> float:
        """Seconds of the machine's time without an answer; once a second it is asked again."""
        self._check()
        now = time.perf_counter()
        if min(now - self._asked, now - self._heard) >= _ASK_AGAIN_S:
            self._asked = now
            self.bridge.ask_again()
        return now - self._heard

    def _check(self) -> None:
        code = self._process.poll()
        if code is not None:
            raise SitlFailed(f"the flight stack has ended with code {code}{_last_words(self.log)}")


@contextlib.contextmanager
def running(
    stack: str, program: Path, config: Config, log: Path, *, simulated: bool, scripts: Sequence[Path] = ()
) -> Iterator[Sitl]:
    """A flight stack for the time of a block. However the block ends, the program and its children end with it.

    Args:
        stack: one of STACKS.
        program: the user's.
        config: of the world.
        log: takes what the program writes.
        simulated: time.
        scripts: in Lua, that ArduPilot runs.

    Raises:
        ConfigError: it cannot be started like this.
        LinkError: a port is taken.
        SitlFailed: the system does not start it.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as undo:
        line = _capture_line(stack, config)
        if line is not None:
            undo.callback(line.close)
        bridge = _bridge(stack, config, line)
        undo.callback(bridge.close)
        if config.sim.step_s > bridge.period_s:
            raise ConfigError(f"sim.step_s = {config.sim.step_s:g} is longer than the {bridge.period_s:g} s of {stack}")
        relay = Relay(_ports(config)) if simulated else None
        if relay is not None:
            undo.callback(relay.close)
        directory = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="arm-companion-sitl-")))
        how = launch(
            stack,
            program,
            config,
            bridge.address[1],
            simulated=simulated,
            capture_port=None if line is None else line.port,
            more=_with_scripts(directory, scripts),
        )
        undo.enter_context(ending_on_terminate())
        process = undo.enter_context(_started(how, directory, log))
        yield Sitl(bridge, process, log, relay)


def _with_scripts(directory: Path, scripts: Sequence[Path]) -> list[Path]:
    """Put Lua scripts where ArduPilot looks for them; the parameter files that let it."""
    if not scripts:
        return []
    (directory / "scripts").mkdir()
    for script in scripts:
        shutil.copy(script, directory / "scripts")
    enable = directory / "scripts.parm"
    enable.write_text("SCR_ENABLE 1\n", encoding="ascii")
    return [enable]


def _capture(config: Config) -> Capture:
    return Capture(config.sim.seed, config.sim.position_noise_m)


def _capture_line(stack: str, config: Config) -> CaptureLine | None:
    """ArduPilot's line to motion capture; PX4 hears it beside its sensors."""
    if stack != "ardupilot" or config.sim.sitl_position != "capture":
        return None
    return CaptureLine(_capture(config))


def _bridge(
    stack: str, config: Config, line: CaptureLine | None
) -> sitl_ardupilot.ArdupilotBridge | sitl_px4.Px4Bridge:
    if stack == "ardupilot":
        return sitl_ardupilot.ArdupilotBridge(config.vehicle.mass_kg, capture=line)
    capture = _capture(config) if config.sim.sitl_position == "capture" else None
    return sitl_px4.Px4Bridge(config.vehicle.mass_kg, config.sim.seed, capture=capture)


@contextlib.contextmanager
def _started(how: Launch, directory: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The program in a process group of its own, which ends as one."""
    with log.open("wb") as stream:
        try:
            process = subprocess.Popen(  # noqa: S603 - the user's own program is what is asked for
                how.command,
                cwd=directory,
                env={**os.environ, **how.environment},
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                start_new_session=True,
                preexec_fn=partial(end_with_parent, signal.SIGKILL),  # noqa: PLW1509 - one system call
            )
        except OSError as error:
            raise SitlFailed(f"{how.command[0]} does not start: {error.strerror}") from error
        try:
            yield process
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask the group to end, and kill what does not."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    until = time.perf_counter() + _STOP_WITHIN_S
    while _runs(process) and time.perf_counter() < until:
        select.select([], [], [], 0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _runs(process: subprocess.Popen[bytes]) -> bool:
    """Whether it has not ended; one that has is not collected here, so that its group's number stays its own."""
    if process.returncode is not None:
        return False
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


def _last_words(log: Path) -> str:
    """The end of what a program wrote, for people."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return ":\n  " + "\n  ".join(lines[-_LAST_LINES:]) if lines else ""
