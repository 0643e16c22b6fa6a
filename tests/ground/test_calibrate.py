"""`ground calibrate`: what is sent, and that nothing is without somebody's word that nothing touches the arm."""

import asyncio
import io
import itertools
import json
from collections.abc import Callable
from typing import Any

import pytest

from arm_companion.__main__ import main
from arm_companion.cli import ground
from arm_companion.ground.commands import CommandFailed
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

CALIBRATE = mav.MAV_CMD_ARM_CALIBRATE
ACCEPTED, IN_PROGRESS = 0, 5


def test_it_sends_step_and_confirmation_and_follows_the_progress(scripted: Any) -> None:
    told: list[int | None] = []

    def script(message: Message) -> None:
        for progress in (0, 3, 50):
            scripted.ack(message.command, IN_PROGRESS, progress)
        scripted.ack(message.command, ACCEPTED)

    scripted.script = script
    scripted.run(lambda: scripted.arm.calibrate(told.append))
    (sent,) = scripted.received
    assert (sent.command, sent.param1, sent.param2) == (CALIBRATE, 1.0, 1.0)
    assert told == [0, 3, 50]


def test_a_final_answer_that_is_lost_is_no_success(scripted: Any, make_status: Callable[..., Message]) -> None:
    """A calibration that failed ends in STOWED as well as one that did not."""
    scripted.script = lambda message: scripted.ack(message.command, IN_PROGRESS, 0)

    async def tell() -> None:
        for state in itertools.chain(["CALIBRATING"] * 20, itertools.repeat("STOWED")):
            scripted.say(make_status(state))
            await asyncio.sleep(1.0)

    async def follow() -> None:
        telling = asyncio.create_task(tell())
        try:
            with pytest.raises(CommandFailed, match="the final answer was lost; the arm is in STOWED"):
                await scripted.arm.calibrate()
        finally:
            telling.cancel()

    scripted.run(follow)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("answer", ["n\n", "\n", "", "yess\n"])
def test_without_a_yes_nothing_is_sent(
    answer: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    assert main(["ground", "calibrate", "--json", "--connect", "nonsense://"]) == ground.FAILED
    out, err = capsys.readouterr()
    assert "nothing and nobody may touch it" in err
    assert json.loads(out)["result"] == "declined"


def test_where_nobody_can_answer_it_wants_the_word_beforehand(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert main(["ground", "calibrate", "--connect", "nonsense://"]) == ground.USAGE
    assert "--yes" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", Terminal("y\n"))
    for words in (["--yes"], []):
        assert main(["ground", "calibrate", *words, "--connect", "nonsense://"]) == ground.FAILED
        assert "nothing is done" not in capsys.readouterr().err, "it went on, to a connection that there is not"
