"""`calibrate tendons` and `calibrate tension` whole: against the plant in simulated time, and as commands on a pty."""

import asyncio
import contextlib
import dataclasses
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from signal import SIGINT
from typing import Any

import numpy as np
import pytest

from arm_companion.arm.parameters import ArmParameters
from arm_companion.clock import precise_loop, run_simulated
from arm_companion.config import Config, load
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibration import TendonCalibration, TensionCalibration
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.tendons import nominal_curve
from arm_companion.procedures.tendon_zeros import Options, Setup, Zero, procedure
from arm_companion.protocol import control_table as ct
from arm_companion.sim import servo_device
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator
from arm_companion.workshop.rig import Rig, m_per_tick
from tests.sim.bench_arm import BenchArm
from tests.unit.test_procedures import hanging

CONFIG = load("sim.toml")
M_PER_TICK = m_per_tick(CONFIG.arm.pulley_radius_m)


class Nodding:
    """A person who says yes to everything."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def say(self, text: str) -> None:
        self.heard.append(text)

    async def ask(self, text: str, *, sure: bool) -> str:
        self.heard.append(text)
        await asyncio.sleep(0.3)
        return ""


def test_shifted_zeros_of_the_plant_are_found() -> None:
    """To 2 mm of tendon each, four sigma; tightness of opposite tendons to 0.25 mm, which is 0.8 N."""
    arm = BenchArm(CONFIG, (0.004, -0.003, 0.006, 0.001))

    async def main() -> tuple[Zero, ...]:
        async with arm.served() as pipe:
            bus = ServoBus(pipe.opener(1), CONFIG.servos)
            rig = Rig(bus, CONFIG.servos, CONFIG.limits, CONFIG.arm.pulley_radius_m)
            await rig.start()
            curves = (nominal_curve(CONFIG.servos, CONFIG.arm.pulley_radius_m),) * 4
            servos, options = CONFIG.servos, Options(speed=0.014)
            parameters = ArmParameters.of(CONFIG.arm)
            setup = Setup(parameters, curves, servos.directions, servos.ids, M_PER_TICK, 45.0, options)
            found = await rig.run(procedure(setup), Nodding(), lambda _: None)
            await bus.stop(limp=False)
            return found

    found = run_simulated(main())
    error = np.array([(zero.ticks - true) * M_PER_TICK for zero, true in zip(found, arm.zeros, strict=True)])
    assert np.all(np.abs(error) < 4.0 * np.array([zero.sigma for zero in found]))
    assert max(zero.sigma for zero in found) < 0.0015
    assert np.all(np.abs(error[:2] + error[2:]) / 2 < 0.00025)
    assert all(servo.peek(ct.TORQUE_ENABLE) == 0 for servo in arm.servos.servos)
    assert max(arm.plant.tensions()) < 6.0


# The commands.

ZEROS = np.array((0.002, -0.002, 0.001, 0.0))
GENTLE = ("--speed-mm-s", "20", "--threshold-n", "3", "--slack-mm", "20", "--travel-mm", "50")
SETTINGS = ("servos.directions=[1,-1,1,1]", "servos.watchdog_s=0.5")
STROKES = ("--speed-mm-s", "15", "--travel-mm", "20")
Loads = Callable[[np.ndarray], np.ndarray]


class Bench:
    """Emulated servos behind a pty, with tendons on them, and commands that are run on it."""

    def __init__(self, folder: Path, loads: Loads) -> None:
        self.port = folder / "bus"
        self.state = folder / "state"
        self.settings = (f"servos.port={self.port}", f"calibration.directory={self.state}", *SETTINGS)
        self.config: Config = load("sim.toml", self.settings)
        self.servos = ServoEmulator(self.config.servos, seed=11)
        self.loads = loads

    async def live(self) -> None:
        loop = asyncio.get_running_loop()
        zeros, signs = self.config.servos.zero_ticks, self.config.servos.directions
        last = loop.time()
        while True:
            await asyncio.sleep(0.004)
            now = loop.time()
            while last < now:  # in small steps even where the machine was late: tendons are stiff
                dt = min(now - last, 0.001)
                horns = zip(signs, self.servos.positions(), zeros, strict=True)
                wound = [d * (p - z) * M_PER_TICK for d, p, z in horns]
                self.servos.advance(dt, (self.loads(np.array(wound)) * 0.01).tolist())
                last += dt

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator["Bench"]:
        bus = EmulatedBus(self.servos, self.config.servos)
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(self.live()), group.create_task(bus.serve_pty(self.port))]
            await bus.wait_ready()
            try:
                yield self
            finally:
                for task in tasks:
                    task.cancel()

    @contextlib.asynccontextmanager
    async def command(self, *words: str) -> AsyncIterator["Command"]:
        settings = [word for setting in self.settings for word in ("--set", setting)]
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "arm_companion", "calibrate", *words, "--config", "sim.toml", *settings),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        try:
            yield Command(process)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.communicate()

    @property
    def torque(self) -> list[int]:
        return [servo.peek(ct.TORQUE_ENABLE) for servo in self.servos.servos]


class Command:
    """A running command and what it has said."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.text = ""

    async def see(self, words: str) -> None:
        assert self.process.stdout is not None
        async with asyncio.timeout(40.0):
            while words not in self.text:
                data = await self.process.stdout.read(4096)
                assert data, self.text
                self.text += data.decode()

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())

    async def end(self) -> int:
        assert self.process.stdout is not None
        async with asyncio.timeout(60.0):
            self.text += (await self.process.stdout.read()).decode()
            return await self.process.wait()


def in_real_time(main: Any) -> None:
    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main)


@pytest.mark.soak  # a machine that stalls distorts what is measured against its clock: run it alone
@pytest.mark.realtime
def test_interrupted_resumed_and_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servo_device, "LOAD_NOISE", 0.002)  # it goes fast here: accuracy is another test's matter
    bench = Bench(tmp_path, hanging(ZEROS))

    async def main() -> None:
        async with bench.open():
            async with bench.command("tendons", *GENTLE) as first:
                await first.see("Torque comes on now")
                assert bench.torque == [0, 0, 0, 0], "nothing happens before Enter"
                first.type("")
                for step in ("let out by 20 mm", "(servo 1) is taken up", "towards tendon 1 now"):
                    await first.see(step)
                    first.type("")
                await first.see("tendon 1 (servo 1) is taut from")
                async with bench.command("tendons", "--yes", *GENTLE) as other:
                    assert await other.end() == 2
                    assert "cannot open" in other.text, "the port is one program's alone"
                first.type("")
                await first.see("(servo 2) is taken up")
                await asyncio.sleep(0.4)
                first.process.send_signal(SIGINT)
                assert await first.end() == 130
                assert "interrupted" in first.text
                assert bench.torque == [0, 0, 0, 0]
            assert not (bench.state / files.TENDONS).exists()
            async with bench.command("tendons", "--yes", *GENTLE) as second:
                assert await second.end() == 0, second.text
                assert "has found 1 of 4 tendons" in second.text
                assert "(servo 1) is taken up" not in second.text
                assert bench.torque == [0, 0, 0, 0]

    in_real_time(main())
    found = files.tendons(str(bench.state))
    assert isinstance(found, TendonCalibration)
    signs = bench.config.servos.directions
    error = [
        d * (t.zero_ticks - z) * M_PER_TICK - true
        for t, z, d, true in zip(found.tendons, bench.config.servos.zero_ticks, signs, ZEROS, strict=True)
    ]
    assert np.all(np.abs(error) < 4.5 * np.array([t.sigma for t in found.tendons])), error
    assert {t.servo.firmware for t in found.tendons} == {46}
    assert set(files.parked(str(bench.state))) == {1, 2, 3, 4}
    assert not list(bench.state.glob("*progress*"))


@pytest.mark.soak
@pytest.mark.realtime
def test_tension_with_weights(tmp_path: Path) -> None:
    masses = [0.0]
    bench = Bench(tmp_path, lambda _: np.array((0.0, 9.81 * masses[0], 0.0, 0.0)))

    async def main() -> None:
        async with bench.open(), bench.command("tension", "--tendon", "2", *STROKES) as run:
            await run.see("take its far end off")
            run.type("")
            for mass, before in (("0.3", "Hang a weight"), ("1", "1 tensions so far"), ("x", "2 tensions so far")):
                await run.see(before)
                masses[0] = float(mass) if mass != "x" else 2.0
                await asyncio.sleep(0.3)
                run.type(mass)
            await run.see("A number, an empty line")
            run.type("2")
            await run.see("3 tensions so far")
            run.type("")
            await run.see("the torque goes off")
            run.type("")
            assert await run.end() == 0, run.text
            assert "gain" in run.text

    in_real_time(main())
    fits = files.read(TensionCalibration, bench.state / files.TENSION)
    assert fits is not None
    (fit,) = fits.fits
    assert fit.servo.id == 2
    # 1.5 N m at 12 V on a pulley of 10 mm, where 1.4 are configured
    assert abs(fit.curve.gain * 12.0 / fit.curve.volts - 150.0) < 4.0 * 150.0 * fit.curve.gain_sigma
    assert fit.curve.gain_sigma < 0.06
    assert fit.curve.friction == pytest.approx(5.0, abs=0.8)
    assert bench.torque == [0, 0, 0, 0]


def test_what_cannot_begin_is_refused_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from arm_companion.__main__ import main

    def refused(*words: str) -> str:
        assert main(["calibrate", *words, "--config", "sim.toml"]) == 2
        text = capsys.readouterr().err
        assert text.count("\n") == 1
        return text

    here: Sequence[str] = ("--directory", str(tmp_path), "--set", f"servos.port={tmp_path / 'none'}")
    assert "nowhere to keep" in refused("tendons")
    assert "cannot open" in refused("tendons", "--yes", *here)
    assert "--speed" in refused("tendons", *here, "--speed-mm-s", "500")
    assert "--slack" in refused("tendons", *here, "--slack-mm", "6")
    assert "tendons 1 to 4" in refused("tension", *here, "--tendon", "5")
    assert "--travel-mm" in refused("tension", *here, "--travel-mm", "1")
    coupled = dataclasses.asdict(CONFIG.servos)["ids"]
    rows = str([[1.0 if i == j else 0.1 for j in range(len(coupled))] for i in range(len(coupled))])
    assert "coupled" in refused("tendons", *here, "--set", f"servos.coupling={rows}")
