"""Jogging from the keyboard: what is streamed, and when it ends."""

import argparse
import asyncio
import contextlib
import math
import os
import pty
import termios
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from arm_companion.cli import ground_orders
from arm_companion.ground.jog import PERIOD_S, WATCHDOG_S, Jog, keyboard
from arm_companion.ground.reports import Status
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

Make = Callable[..., Message]
ARGUMENTS = argparse.Namespace(action="jog", json=False, timeout=None, vehicle=None, theta_deg=None, delta_deg=0.0)


def jog(
    scripted: Any,
    make_status: Make,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[float, str],
    *,
    follows: bool = True,
    interrupt: float = 60.0,
    leaves: float = 90.0,
) -> int:
    """Jog with keys at given times; the arm tells its state at 10 Hz and follows at once."""
    where = [0.0, 0.0]

    @contextlib.asynccontextmanager
    async def typed() -> AsyncIterator["asyncio.Queue[str]"]:
        queue: asyncio.Queue[str] = asyncio.Queue()
        for at, key in keys.items():
            asyncio.get_running_loop().call_later(at, queue.put_nowait, key)
        yield queue

    @contextlib.asynccontextmanager
    async def interrupts() -> AsyncIterator["asyncio.Queue[int]"]:
        queue: asyncio.Queue[int] = asyncio.Queue()
        asyncio.get_running_loop().call_later(interrupt, queue.put_nowait, 2)
        yield queue

    def take(message: Message) -> None:
        if follows and message.get_type() == "ARM_SETPOINT":
            where[:] = [message.theta, message.delta]

    async def tell() -> None:
        while True:
            state = "READY" if asyncio.get_running_loop().time() < leaves else "STOWING"
            theta, delta = where
            behaviour = mav.ARM_BEHAVIOUR_READY
            fields = {"theta": theta, "delta": delta, "goal_theta": theta, "goal_delta": delta}
            scripted.say(make_status(state, behaviour=behaviour, **fields))
            await asyncio.sleep(0.1)

    async def main() -> int:
        scripted.script = take
        telling = asyncio.create_task(tell())
        try:
            return await ground_orders.ACTIONS["jog"](ARGUMENTS, scripted.arm)
        finally:
            telling.cancel()

    monkeypatch.setattr(ground_orders, "keyboard", typed)
    monkeypatch.setattr(ground_orders, "interrupts", interrupts)
    code: int = scripted.run(main)
    return code


def test_keys_become_a_stream_with_a_watchdog(
    scripted: Any, make_status: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert jog(scripted, make_status, monkeypatch, {1.01: "up", 2.01: "up", 3.01: "left", 4.01: "q"}) == 0
    sent = scripted.sent("ARM_SETPOINT")
    assert len(sent) == pytest.approx(4.0 / PERIOD_S, abs=2)
    assert {m.timeout for m in sent} == {WATCHDOG_S}
    two = math.radians(2.0)
    assert [round(m.theta / two) for m in sent[::10]] == [0, 0, 1, 2, 2][: len(sent[::10])]
    assert (sent[-1].theta, sent[-1].delta) == (pytest.approx(2 * two), pytest.approx(two))


@pytest.mark.parametrize(("end", "state"), [({"interrupt": 1.05}, "READY"), ({"leaves": 1.05}, "STOWING")])
def test_it_ends_with_ctrl_c_and_when_the_arm_goes_another_way(
    scripted: Any,
    make_status: Make,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    end: dict[str, Any],
    state: str,
) -> None:
    assert jog(scripted, make_status, monkeypatch, {}, **end) == 0
    assert 8 <= len(scripted.received) <= 13
    assert f"state {state}" in capsys.readouterr().out


@pytest.mark.parametrize("follows", [True, False])
def test_an_arm_that_does_not_follow_is_told(
    scripted: Any,
    make_status: Make,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    follows: bool,
) -> None:
    assert jog(scripted, make_status, monkeypatch, {1.0: "up", 5.0: "q"}, follows=follows) == 0
    assert capsys.readouterr().out.count("does not follow") == (0 if follows else 1)


def test_an_arm_that_is_not_ready_is_not_jogged(scripted: Any, make_status: Make) -> None:
    async def main() -> int:
        asyncio.get_running_loop().call_later(0.5, scripted.say, make_status("PERCHED"))
        return await ground_orders.ACTIONS["jog"](ARGUMENTS, scripted.arm)

    assert scripted.run(main) == 1
    assert scripted.received == []


def test_the_keyboard_gives_keys_without_echo_and_puts_the_terminal_back(monkeypatch: pytest.MonkeyPatch) -> None:
    master, terminal = pty.openpty()
    try:
        with os.fdopen(terminal, "rb", buffering=0, closefd=False) as stdin:
            monkeypatch.setattr("sys.stdin", stdin)
            before = termios.tcgetattr(terminal)

            async def main() -> list[str]:
                async with keyboard() as keys:
                    assert not termios.tcgetattr(terminal)[3] & (termios.ECHO | termios.ICANON)
                    assert termios.tcgetattr(terminal)[3] & termios.ISIG  # Ctrl-C stays a signal
                    os.write(master, b"\x1b[A q")
                    async with asyncio.timeout(5.0):
                        return [await keys.get() for _ in range(3)]

            assert asyncio.run(main()) == ["up", " ", "q"]
            assert termios.tcgetattr(terminal) == before
    finally:
        os.close(terminal)
        os.close(master)


def test_an_arm_that_does_not_know_its_bend_is_held_and_told_as_json(
    make_status: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = Jog(0.5, 0.25)
    assert asked.press(" ", math.nan, math.nan) == asked
    arguments = argparse.Namespace(json=True)
    ground_orders._show_jog(arguments, asked, Status.of(make_status("READY", theta=math.nan)))
    assert '"arm_theta": null' in capsys.readouterr().out
