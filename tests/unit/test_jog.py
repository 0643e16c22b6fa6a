"""Jogging: keys in any pieces, a bend within its limits, a screen that tells; and the command on a real terminal."""

import asyncio
import math
import os
import pty
import signal
import sys
import termios
import tty
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.clock import precise_loop
from arm_companion.config import load
from arm_companion.protocol import control_table as ct
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.workshop.jog import STEPS_RAD, Jog, Key, advance, decode, press, screen
from tests.unit.test_tension import TENDON

JOG = Jog((0.0, 0.0), (0.0, 0.0), 1.0)
KNOWN = [b"w", b"A", b"+", b"-", b" ", b"r", b"q", b"\x1b[A", b"\x1b[B", b"\x1bOC", b"\x1bOD", b"\x1b[1;5C", b"\x1b[3~"]


def test_every_key_is_known_in_both_ways_that_terminals_send_arrows() -> None:
    assert decode(b"wasd+-= rqQ")[0] == [
        Key.AHEAD,
        Key.LEFT,
        Key.BACK,
        Key.RIGHT,
        Key.COARSER,
        Key.FINER,
        Key.COARSER,
        Key.STOP,
        Key.RELAX,
        Key.QUIT,
        Key.QUIT,
    ]
    arrows = [Key.AHEAD, Key.BACK, Key.RIGHT, Key.LEFT]
    assert decode(b"\x1b[A\x1b[B\x1b[C\x1b[D") == (arrows, b"")
    assert decode(b"\x1bOA\x1bOB\x1bOC\x1bOD") == (arrows, b"")


@given(st.lists(st.sampled_from(KNOWN), max_size=12), st.data())
def test_keys_do_not_depend_on_how_the_bytes_are_cut(words: list[bytes], data: st.DataObject) -> None:
    typed = b"".join(words)
    whole, rest = decode(typed)
    assert rest == b""
    cuts = sorted(data.draw(st.lists(st.integers(0, len(typed)), max_size=5)))
    pieces = [typed[a:b] for a, b in zip([0, *cuts], [*cuts, len(typed)], strict=True)]
    keys: list[Key] = []
    waiting = b""
    for piece in pieces:
        found, waiting = decode(waiting + piece)
        keys += found
    assert (keys, waiting) == (whole, b"")


@given(st.binary(max_size=40))
def test_no_bytes_are_too_strange(typed: bytes) -> None:
    _, waiting = decode(typed)
    assert typed.endswith(waiting)


@given(st.lists(st.sampled_from(list(Key)), max_size=60), st.floats(0.0, 0.1))
def test_no_keys_bend_the_arm_too_far_or_too_fast(keys: list[Key], dt: float) -> None:
    jog = JOG
    for key in keys:
        jog = press(jog, key)
        before = jog.bend
        jog = advance(jog, 0.3, dt)
        assert math.dist(before, jog.bend) <= 0.3 * dt + 1e-12
        assert math.hypot(*jog.goal) <= jog.limit + 1e-9
        assert math.hypot(*jog.bend) <= jog.limit + 1e-9
        assert jog.step_rad in STEPS_RAD


def test_stop_stops_where_it_is_and_relax_goes_straight() -> None:
    jog = advance(press(press(JOG, Key.AHEAD), Key.RIGHT), 0.1, 0.1)
    assert press(jog, Key.STOP).goal == jog.bend != (0.0, 0.0)
    assert press(jog, Key.RELAX).goal == (0.0, 0.0)


def test_the_screen_shows_what_a_person_needs() -> None:
    text = screen(JOG, [TENDON] * 4, [False, True, False, False], (0.1, 0.1), (0.01, 0.0, 0.24), "a note")
    for word in ("4.0 +- 4.0 N", "30 C", "theta", "delta", "z +240 mm", "LIMITED", "a note", "q quit"):
        assert word in text
    assert "not known" in screen(JOG, [TENDON], [False], (math.nan, math.nan), None, "")


# The command.

SETTINGS = ("limits.pull_speed_m_per_s=0.05", "servos.watchdog_s=0.5")


class Session:
    """`arm-companion jog` on a terminal of its own."""

    def __init__(self, process: asyncio.subprocess.Process, master: int, slave: int) -> None:
        self.process = process
        self.master = master
        self.slave = slave
        self.seen = ""
        self.news = asyncio.Event()
        asyncio.get_running_loop().add_reader(master, self._read)

    def _read(self) -> None:
        with suppress(OSError):
            self.seen += os.read(self.master, 65536).decode(errors="replace")
            self.news.set()
            return
        asyncio.get_running_loop().remove_reader(self.master)

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)

    async def see(self, text: str) -> None:
        async with asyncio.timeout(20.0):
            while text not in self.seen:
                self.news.clear()
                await self.news.wait()

    async def end(self) -> int:
        async with asyncio.timeout(10.0):
            return await self.process.wait()


@asynccontextmanager
async def jogging(port: Path, emulator: ServoEmulator, *options: str) -> AsyncIterator[Session]:
    config = load("sim.toml", (f"servos.port={port}", *SETTINGS))
    bus = EmulatedBus(emulator, config.servos)
    master, slave = pty.openpty()
    os.set_blocking(master, False)
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(keep_time(emulator)), group.create_task(bus.serve_pty(port))]
        await bus.wait_ready()
        words = [word for setting in (f"servos.port={port}", *SETTINGS) for word in ("--set", setting)]
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "arm_companion", "jog", "--config", "sim.toml", "--speed-deg-s", "40", *words, *options),
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
        )
        session = Session(process, master, slave)
        try:
            yield session
        finally:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            for task in tasks:
                task.cancel()
            asyncio.get_running_loop().remove_reader(master)
            for descriptor in (master, slave):
                with suppress(OSError):
                    os.close(descriptor)


def emulator() -> ServoEmulator:
    return ServoEmulator(load("sim.toml").servos, seed=4)


@pytest.mark.realtime
def test_keys_move_the_servos_and_q_leaves_them_holding_and_the_terminal_as_it_was(tmp_path: Path) -> None:
    servos = emulator()

    async def main() -> None:
        async with jogging(tmp_path / "bus", servos) as session:
            before = termios.tcgetattr(session.slave)
            await session.see("q quit")
            assert termios.tcgetattr(session.slave)[3] != before[3], "keys come one by one"
            session.type(b"+++\x1b[A\x1b[A")  # 2 x 0.5 rad towards tendon 1
            await asyncio.sleep(2.2)
            front, back = servos[1].motor.position, servos[3].motor.position
            assert front - back > 0.8 * 2 * 0.02 / 0.01 * ct.TICKS_PER_TURN / (2 * math.pi)
            session.type(b"r")
            await asyncio.sleep(2.2)
            assert abs(servos[1].motor.position - servos[3].motor.position) < 100
            session.type(b"q")
            assert await session.end() == 0
            await session.see("the servos hold")
            assert termios.tcgetattr(session.slave)[3] == before[3]
            assert all(servo.peek(ct.TORQUE_ENABLE) == 1 for servo in servos.servos)

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
def test_losing_the_terminal_in_the_middle_of_a_move_holds_the_arm(tmp_path: Path, number: int) -> None:
    servos = emulator()

    async def main() -> None:
        async with jogging(tmp_path / "bus", servos) as session:
            await session.see("q quit")
            session.type(b"+++wwww")
            await asyncio.sleep(0.7)
            session.process.send_signal(number)
            assert await session.end() == 0
            held = servos.positions()
            await asyncio.sleep(0.7)
            assert servos.positions() == pytest.approx(held, abs=30), "nothing moves on"
            assert held[0] - held[2] > 100
            assert all(servo.peek(ct.TORQUE_ENABLE) == 1 for servo in servos.servos)

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())


@pytest.mark.realtime
@pytest.mark.parametrize("stopped", [True, False])
def test_an_interrupt_stops_the_way_to_straight_and_the_arm_is_not_let_go(tmp_path: Path, stopped: bool) -> None:
    servos = emulator()

    async def main() -> None:
        async with jogging(tmp_path / "bus", servos, "--torque-off") as session:
            await session.see("q quit")
            session.type(b"+++ww")
            await asyncio.sleep(1.8)
            session.type(b"q")
            await asyncio.sleep(0.3)
            if stopped:
                session.process.send_signal(signal.SIGINT)
            assert await session.end() == 0
            await session.see("the servos hold" if stopped else "the arm is limp")
            assert [servo.peek(ct.TORQUE_ENABLE) for servo in servos.servos] == [int(stopped)] * 4
            assert (abs(servos.positions()[0] - servos.positions()[2]) > 500) is stopped

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())


@pytest.mark.realtime
@pytest.mark.parametrize("stall", ["Ctrl-S", "link"])
def test_a_terminal_that_takes_no_more_does_not_stop_the_cycles(tmp_path: Path, stall: str) -> None:
    """Then the servos' watchdogs would stop them in the middle of a move."""
    servos = emulator()

    async def main() -> None:
        async with jogging(tmp_path / "bus", servos) as session:
            await session.see("q quit")
            if stall == "Ctrl-S":
                session.type(b"\x13")
            else:
                asyncio.get_running_loop().remove_reader(session.master)
                tty.setraw(session.slave, termios.TCSANOW)
                os.set_blocking(session.slave, False)
                with suppress(BlockingIOError):
                    while True:
                        os.write(session.slave, b"." * 256)
                os.set_blocking(session.slave, True)
            session.type(b"+++w")
            await asyncio.sleep(1.8)  # longer than the watchdogs wait
            assert all(servo.peek(ct.BUS_WATCHDOG) == 25 for servo in servos.servos)
            assert servos.positions()[0] - servos.positions()[2] > 500
            session.type(b"q")
            if stall == "link":
                asyncio.get_running_loop().add_reader(session.master, session._read)
            assert await session.end() == 0

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())


@pytest.mark.realtime
def test_without_a_terminal_or_with_a_taken_port_it_says_so(tmp_path: Path) -> None:
    async def main() -> None:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "arm_companion", "jog", "--config", "sim.toml", "--set", f"servos.port={tmp_path / 'none'}"),
            stdin=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        _, text = await process.communicate()
        assert process.returncode == 2
        assert b"needs a terminal" in text

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())
