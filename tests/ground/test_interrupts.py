"""What Ctrl-C does to an order under way: nothing, then ABORT, then the arm is left to it."""

import argparse
import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import pytest

from arm_companion.cli import ground_orders
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

PERCH, ABORT = mav.MAV_CMD_ARM_PERCH, mav.MAV_CMD_ARM_ABORT


class Keys:
    """Ctrl-C at given times after the start."""

    def __init__(self, *at: float) -> None:
        self.at = at

    @contextlib.asynccontextmanager
    async def interrupts(self) -> AsyncIterator["asyncio.Queue[int]"]:
        queue: asyncio.Queue[int] = asyncio.Queue()
        for at in self.at:
            asyncio.get_running_loop().call_later(at, queue.put_nowait, 2)
        yield queue


def perch(scripted: Any, monkeypatch: pytest.MonkeyPatch, *presses: float, abortable: bool = True) -> int:
    """A perch of ten seconds; ABORT cancels it."""
    monkeypatch.setattr(ground_orders, "interrupts", Keys(*presses).interrupts)
    tasks: list[asyncio.Task[None]] = []

    async def work() -> None:
        scripted.ack(PERCH, mav.MAV_RESULT_IN_PROGRESS, 10)
        await asyncio.sleep(10.0)
        scripted.ack(PERCH, mav.MAV_RESULT_ACCEPTED)

    def script(message: Message) -> None:
        if message.command == PERCH:
            tasks.append(asyncio.create_task(work()))
        elif abortable:
            tasks[0].cancel()
            scripted.ack(ABORT, mav.MAV_RESULT_ACCEPTED)
            scripted.text("PERCH cancelled: ABORT ordered")
            scripted.ack(PERCH, mav.MAV_RESULT_CANCELLED)

    async def main() -> int:
        scripted.script = script
        arguments = argparse.Namespace(action="perch", json=True, timeout=None, bar=None, hang=False)
        code = await ground_orders.ACTIONS["perch"](arguments, scripted.arm)
        for task in tasks:
            task.cancel()
        return code

    code: int = scripted.run(main)
    return code


def commands(scripted: Any) -> list[int]:
    return [m.command for m in scripted.sent("COMMAND_LONG")]


def result(capsys: pytest.CaptureFixture[str]) -> tuple[str, str, str]:
    """Result and reason as JSON, and what was said."""
    captured = capsys.readouterr()
    told = json.loads(captured.out.splitlines()[-1])
    return told["result"], told["reason"], captured.err


def test_undisturbed_it_ends_with_0(
    scripted: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert perch(scripted, monkeypatch) == 0
    assert result(capsys)[0] == "accepted"


def test_once_only_tells_how_to_stop_the_arm(
    scripted: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert perch(scripted, monkeypatch, 3.0) == 0
    assert commands(scripted) == [PERCH]
    kind, _, said = result(capsys)
    assert kind == "accepted"
    assert "PERCH goes on. Ctrl-C again: abort" in said


def test_an_order_that_fails_by_itself_after_one_press_has_failed(
    scripted: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ground_orders, "interrupts", Keys(0.2).interrupts)

    def fail() -> None:
        scripted.text("PERCH failed: no contact")
        scripted.ack(PERCH, mav.MAV_RESULT_FAILED)

    async def main() -> int:
        scripted.script = lambda _: asyncio.get_running_loop().call_later(0.5, fail)
        arguments = argparse.Namespace(action="perch", json=True, timeout=None, bar=None, hang=False)
        return await ground_orders.ACTIONS["perch"](arguments, scripted.arm)

    assert scripted.run(main) == 1
    assert result(capsys)[:2] == ("failed", "no contact")


def test_twice_aborts_and_waits_for_the_arms_word(
    scripted: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert perch(scripted, monkeypatch, 3.0, 4.0) == 130
    assert commands(scripted) == [PERCH, ABORT]
    assert result(capsys)[:2] == ("cancelled", "ABORT ordered")


def test_three_times_leaves_even_when_the_arm_does_not_answer(
    scripted: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert perch(scripted, monkeypatch, 3.0, 4.0, 4.1, abortable=False) == 130
    assert commands(scripted)[:2] == [PERCH, ABORT]
    kind, _, said = result(capsys)
    assert kind == "left"
    assert "the arm carries on" in said
