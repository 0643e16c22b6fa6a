"""The person at the terminal of a guided calibration, and what is looked at before anything moves."""

import asyncio
import os
import pty
from contextlib import suppress
from pathlib import Path

import pytest

from arm_companion.__main__ import main
from arm_companion.cli import calibrate_tendons
from arm_companion.cli.guide import Terminal
from arm_companion.clock import precise_loop, run_simulated
from arm_companion.config import load
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibration import identity
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.procedures.tendon_zeros import Found
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.transport.memory import MemoryPipe
from arm_companion.workshop.rig import Rig

CONFIG = load("sim.toml")


def refused(capsys: pytest.CaptureFixture[str], *words: str, code: int = 2) -> str:
    assert main(["calibrate", *words, "--config", "sim.toml"]) == code
    return capsys.readouterr().err


def test_an_enter_from_before_the_question_does_not_answer_it(monkeypatch: pytest.MonkeyPatch) -> None:
    keys, end = pty.openpty()

    async def answer() -> tuple[str | None, str | None]:
        terminal, early = Terminal(), None
        os.write(keys, b"\n\n")  # while the servo still moved
        await asyncio.sleep(0.05)
        with suppress(TimeoutError):
            async with asyncio.timeout(0.2):
                early = await terminal.ask("Take the weight off: the torque goes off now.", sure=False)
        asking = asyncio.create_task(terminal.ask("And now?", sure=False))
        await asyncio.sleep(0.05)
        os.write(keys, b"no\n")
        return early, await asking

    with os.fdopen(end, encoding="utf-8") as stdin, asyncio.Runner(loop_factory=precise_loop) as runner:
        monkeypatch.setattr("sys.stdin", stdin)
        early, late = runner.run(answer())
    os.close(keys)
    assert early is None
    assert late == "no"


@pytest.mark.parametrize("what", ["tendons", "tension"])
def test_a_place_where_nothing_can_be_kept_is_told_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    (tmp_path / "file").write_text("not a directory", encoding="utf-8")
    here = ("--yes", "--set", f"servos.port={tmp_path / 'none'}", "--directory")
    assert "cannot be written" in refused(capsys, what, *here, str(tmp_path / "file" / "state"))
    (tmp_path / files.TENSION).write_text("{", encoding="utf-8")
    expected = "remove it first" if what == "tension" else "cannot open"
    assert expected in refused(capsys, what, *here, str(tmp_path))


def test_an_arm_whose_servos_do_not_suit_its_tendons_is_refused_before_it_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    three = ("--set", "arm.tendons.angles_deg=[0.0, 120.0, 240.0]")
    text = refused(capsys, "tendons", "--yes", "--directory", str(tmp_path), *three, code=78)
    assert "4 entries for 3 tendons" in text


def test_a_run_is_not_resumed_in_another_turn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A daemon met the servos first after a loss of power: they are set up, and count from within one turn again."""
    emulator = ServoEmulator(CONFIG.servos, seed=7)
    for servo in emulator.servos:
        servo.motor.position += 2100  # past the end of its turn
    knee = Found(4200.0, 0.001, 0.02, -0.02, 0.01, 4.0, 30.0)

    async def main() -> tuple[list[tuple[Found, ...]], list[bool]]:
        pipe, wire = MemoryPipe(), EmulatedBus(emulator, CONFIG.servos)
        tasks = [asyncio.create_task(keep_time(emulator)), asyncio.create_task(wire.serve_memory(pipe.opener(0)))]
        await wire.wait_ready()

        async def start() -> ServoBus:
            bus = ServoBus(pipe.opener(1), CONFIG.servos)
            await Rig(bus, CONFIG.servos, CONFIG.limits, CONFIG.arm.pulley_radius_m).start()
            return bus

        async def resumed() -> tuple[Found, ...]:
            bus = await start()
            known = tuple(identity(bus.info[servo]) for servo in CONFIG.servos.ids)
            stand = tuple(state.position for state in await bus.read())
            if not (tmp_path / "tendons.progress.json").exists():
                calibrate_tendons._keep(tmp_path, known, stand, CONFIG, (knee,))
            fresh.append(any(info.fresh for info in bus.info.values()))
            found = await calibrate_tendons._resumed(tmp_path, known, stand, bus, CONFIG, Terminal(yes=True))
            await bus.stop(limp=False)
            return found

        fresh: list[bool] = []
        found = [await resumed(), await resumed()]
        for on in (False, True):
            emulator.set_power(on=on)
            await asyncio.sleep(1.0)
        await (await start()).stop(limp=False)
        found.append(await resumed())
        for task in tasks:
            task.cancel()
        return found, fresh

    (_, second, third), fresh = run_simulated(main())
    assert second == (knee,)
    assert third == ()
    assert not fresh[-1], "the servos themselves do not tell it"
    assert "stand elsewhere" in capsys.readouterr().out
