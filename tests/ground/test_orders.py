"""The command protocol's sending side against a scripted component: losses, liars, silence."""

import argparse
import asyncio
import itertools
from collections.abc import Callable
from typing import Any

import pytest

from arm_companion.cli import ground_orders
from arm_companion.ground.channel import ArmSilent
from arm_companion.ground.commands import TRIES, CommandFailed, CommandUnfinished
from arm_companion.ground.reports import Status
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

PERCH, READY = mav.MAV_CMD_ARM_PERCH, mav.MAV_CMD_ARM_READY
ACCEPTED, REJECTED, DENIED, IN_PROGRESS = 0, 1, 2, 5


def test_nothing_is_sent_before_the_first_heartbeat(scripted: Any) -> None:
    scripted.beating = False

    async def main() -> None:
        scripted.beat((1, 1))  # the autopilot's says nothing of the arm
        scripted.say(mav.MAVLink_command_ack_message(PERCH, ACCEPTED, 0, 0, 245, 190))
        for order in (scripted.arm.ready(), scripted.arm.abort(), scripted.arm.send_set_point(0.1, 0.0)):
            with pytest.raises(ArmSilent, match="has not been heard"):
                await order
        with pytest.raises(ArmSilent):
            await scripted.arm.parameters.read_all()

    scripted.run(main)
    assert scripted.received == []


def test_an_order_reaches_the_component_with_its_parameters(scripted: Any) -> None:
    scripted.script = lambda m: scripted.ack(m.command, ACCEPTED)
    scripted.run(lambda: scripted.arm.jog_bend(0.5, 0.25))
    (sent,) = scripted.received
    assert (sent.get_type(), sent.target_system, sent.target_component) == ("COMMAND_LONG", 1, 192)
    assert (sent.command, sent.confirmation) == (mav.MAV_CMD_ARM_JOG, 0)
    assert (sent.param1, sent.param2, sent.param3, sent.param4) == (1.0, 0.5, 0.25, 0.0)


def test_a_reach_says_its_point_and_whether_the_vehicle_stays(scripted: Any) -> None:
    scripted.script = lambda m: scripted.ack(m.command, ACCEPTED)

    async def main() -> None:
        await scripted.arm.reach(3.0, -2.0, -1.5)
        await scripted.arm.reach(3.0, -2.0, -1.5, arm_only=True)

    scripted.run(main)
    assert [(m.command, m.param1, m.param2, m.param3, m.param4) for m in scripted.received] == [
        (mav.MAV_CMD_ARM_REACH, kind, 3.0, -2.0, -1.5) for kind in (0.0, 1.0)
    ]


def test_a_reach_whose_answer_is_lost_ends_when_the_tip_is_held(scripted: Any, make_status: Any) -> None:
    def script(message: Message) -> None:
        if message.confirmation == 0:
            scripted.ack(message.command, IN_PROGRESS)

    scripted.script = script

    async def main() -> None:
        reaching = asyncio.create_task(scripted.arm.reach(3.0, -2.0, -1.5))
        for state in ("TIP_MOVE", *["TIP_HOLD"] * 8):
            await asyncio.sleep(0.5)
            scripted.say(make_status(state))
        await reaching

    scripted.run(main)


def test_a_lost_command_is_repeated_and_counts_its_confirmations(scripted: Any) -> None:
    scripted.script = lambda m: scripted.ack(m.command, ACCEPTED) if m.confirmation == 2 else None
    scripted.run(scripted.arm.ready)
    assert [m.confirmation for m in scripted.received] == [0, 1, 2]


def test_no_answer_at_all_is_told_after_a_few_tries(scripted: Any) -> None:
    async def main() -> float:
        start = asyncio.get_running_loop().time()
        with pytest.raises(ArmSilent, match=f"does not answer READY: sent {TRIES} times"):
            await scripted.arm.ready()
        return asyncio.get_running_loop().time() - start

    assert 3.0 < scripted.run(main) < 4.0
    assert len(scripted.received) == TRIES


@pytest.mark.parametrize(
    "lie",
    [
        {"source": (1, 1)},  # the autopilot answers in our place
        {"source": (2, 192)},  # the arm of another vehicle
        {"target": (255, 190)},  # an answer to another station
        {"target": (245, 1)},
    ],
)
def test_an_answer_of_the_wrong_source_or_for_another_is_not_believed(scripted: Any, lie: dict[str, Any]) -> None:
    def script(message: Message) -> None:
        scripted.ack(message.command, ACCEPTED, **lie)
        scripted.ack(mav.MAV_CMD_ARM_STOW, ACCEPTED)  # and one to another command
        if message.confirmation == 1:
            scripted.ack(message.command, REJECTED)

    scripted.script = script

    async def main() -> None:
        with pytest.raises(CommandFailed, match="READY temporarily rejected"):
            await scripted.arm.ready()

    scripted.run(main)
    assert len(scripted.received) == 2


@pytest.mark.parametrize("early", [True, False])
def test_the_reason_of_a_refusal_is_told_whichever_comes_first(scripted: Any, early: bool) -> None:
    reason = "the bar is 61.2 m away; at most 50 m are allowed, and this sentence has more than one chunk"

    def script(message: Message) -> None:
        if early:
            scripted.text(f"PERCH denied: {reason}")
        scripted.ack(message.command, DENIED)
        if not early:
            asyncio.get_running_loop().call_later(0.2, scripted.text, f"PERCH denied: {reason}")

    scripted.script = script

    async def main() -> None:
        with pytest.raises(CommandFailed) as failed:
            await scripted.arm.perch()
        assert (failed.value.command, failed.value.result, failed.value.reason) == ("PERCH", "denied", reason)

    scripted.run(main)


def test_a_refusal_without_a_reason_is_told_without_one(scripted: Any) -> None:
    scripted.script = lambda m: scripted.ack(m.command, mav.MAV_RESULT_UNSUPPORTED)

    async def main() -> None:
        with pytest.raises(CommandFailed, match=r"^GRASP unsupported$"):
            await scripted.arm.grasp()

    scripted.run(main)


def test_progress_is_passed_on_and_a_running_order_is_not_repeated(scripted: Any) -> None:
    async def work(message: Message) -> None:
        for progress in (0, 40, 255):
            scripted.ack(message.command, IN_PROGRESS, progress)
            await asyncio.sleep(2.0)
        scripted.ack(message.command, ACCEPTED)

    tasks = []
    scripted.script = lambda m: tasks.append(asyncio.create_task(work(m)))
    seen: list[int | None] = []
    scripted.run(lambda: scripted.arm.perch(progress=seen.append))
    assert seen == [0, 40, None]
    assert len(scripted.received) == 1


def test_an_arm_that_vanishes_under_way_is_noticed(scripted: Any) -> None:
    def script(message: Message) -> None:
        scripted.ack(message.command, IN_PROGRESS)
        scripted.beating = False

    scripted.script = script

    async def main() -> float:
        with pytest.raises(ArmSilent, match="PERCH may be going on"):
            await scripted.arm.perch()
        return asyncio.get_running_loop().time()

    assert 5.0 < scripted.run(main) < 6.5


@pytest.mark.parametrize(("ends_in", "fails"), [("PERCHED", False), ("STOWED", True)])
def test_a_lost_final_answer_is_made_up_for_by_the_state(
    scripted: Any, make_status: Callable[..., Message], ends_in: str, fails: bool
) -> None:
    states = itertools.chain(["READY", "APPROACH", "REACH", "WRAP"], itertools.repeat(ends_in))

    async def tell() -> None:
        for state in states:
            scripted.say(make_status(state))
            await asyncio.sleep(1.0)

    async def main() -> None:
        scripted.script = lambda m: scripted.ack(m.command, IN_PROGRESS)
        telling = asyncio.create_task(tell())
        try:
            await scripted.arm.perch(timeout=30.0)
        finally:
            telling.cancel()

    if fails:
        with pytest.raises(CommandFailed, match="the final answer was lost; the arm is in STOWED") as failed:
            scripted.run(main)
        assert failed.value.result == "unknown"
    else:
        scripted.run(main)
    assert len(scripted.received) == 1


def test_a_time_out_is_told_apart_from_silence_and_stops_nothing(scripted: Any) -> None:
    scripted.script = lambda m: scripted.ack(m.command, IN_PROGRESS)

    async def main() -> None:
        with pytest.raises(CommandUnfinished, match="carrying on"):
            await scripted.arm.perch(timeout=12.0)

    scripted.run(main)
    assert len(scripted.received) == 1


def test_giving_up_the_wait_sends_nothing(scripted: Any) -> None:
    scripted.script = lambda m: scripted.ack(m.command, IN_PROGRESS)

    async def main() -> None:
        task = asyncio.create_task(scripted.arm.perch())
        await asyncio.sleep(2.0)
        task.cancel()
        await asyncio.wait({task})
        await asyncio.sleep(2.0)

    scripted.run(main)
    assert [m.command for m in scripted.received] == [PERCH]


def test_a_stream_ends_with_silence_unless_it_is_patient(scripted: Any, make_status: Callable[..., Message]) -> None:
    async def main() -> None:
        async def collect(*, patient: bool) -> int:
            count = 0
            async for _ in scripted.arm.stream(Status, patient=patient):
                count += 1
            return count

        waiting = asyncio.create_task(collect(patient=True))
        short = asyncio.create_task(collect(patient=False))
        await asyncio.sleep(0.1)
        scripted.say(make_status())
        scripted.beating = False
        with pytest.raises(ArmSilent, match="not been heard for"):
            await short
        assert not waiting.done()
        waiting.cancel()

    scripted.run(main)


def test_a_slow_reader_loses_the_oldest(scripted: Any, make_status: Callable[..., Message]) -> None:
    async def main() -> list[str]:
        stream = scripted.arm.stream(Status, depth=3)
        first = asyncio.create_task(anext(stream))
        await asyncio.sleep(0.0)
        for i in range(10):
            scripted.say(make_status(f"S{i}"))
        seen = [(await first).state]
        seen += [(await anext(stream)).state for _ in range(2)]
        await stream.aclose()
        return seen

    assert scripted.run(main) == ["S7", "S8", "S9"]


def test_clearing_errors_may_take_its_time_in_a_state_of_rest(scripted: Any, make_status: Any) -> None:
    """Servos are rebooted and homed for up to six seconds, while the state stays STOWED."""
    command = mav.MAV_CMD_ARM_CLEAR_ERRORS
    scripted.script = lambda m: scripted.ack(m.command, IN_PROGRESS)

    async def main() -> None:
        arguments = argparse.Namespace(action="clear", json=True, timeout=None)
        clearing = asyncio.create_task(ground_orders.ACTIONS["clear"](arguments, scripted.arm))
        for _ in range(12):
            await asyncio.sleep(0.5)
            scripted.say(make_status("STOWED"))
        scripted.ack(command, ACCEPTED)
        assert await clearing == 0

    scripted.run(main)
    assert [m.command for m in scripted.received] == [command]


@pytest.mark.parametrize("early", [True, False])
def test_a_refused_order_is_shown_once(scripted: Any, capsys: pytest.CaptureFixture[str], early: bool) -> None:
    def script(message: Message) -> None:
        if early:
            scripted.text("PERCH denied: no bar is known")
        scripted.ack(message.command, DENIED)
        if not early:
            asyncio.get_running_loop().call_later(0.2, scripted.text, "PERCH denied: no bar is known")

    scripted.script = script
    arguments = argparse.Namespace(action="perch", json=False, timeout=None, bar=None, hang=False)
    assert scripted.run(lambda: ground_orders.ACTIONS["perch"](arguments, scripted.arm)) == 1
    out, err = capsys.readouterr()
    assert err == "arm-companion ground: PERCH denied: no bar is known\n"
    assert out == ""


def test_a_refusal_of_another_stations_order_is_shown_while_ours_goes_on(
    scripted: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    scripted.script = lambda m: scripted.ack(m.command, IN_PROGRESS)

    async def main() -> None:
        arguments = argparse.Namespace(action="perch", json=False, timeout=None, bar=None, hang=False)
        perching = asyncio.create_task(ground_orders.ACTIONS["perch"](arguments, scripted.arm))
        await asyncio.sleep(1.0)
        scripted.text("STOW denied: 255/190 has control")
        scripted.text("tendon 1 is warm")
        await asyncio.sleep(3.0)
        scripted.ack(PERCH, ACCEPTED)
        assert await perching == 0

    scripted.run(main)
    out, _ = capsys.readouterr()
    assert out.index("warning: STOW denied: 255/190") < out.index("warning: tendon 1 is warm") < out.index("PERCH done")


@pytest.mark.parametrize(("verb", "told"), [("take", True), ("take-over", True), ("release", False)])
def test_who_takes_control_is_told_that_it_ends_with_the_program(
    scripted: Any, capsys: pytest.CaptureFixture[str], verb: str, *, told: bool
) -> None:
    scripted.script = lambda m: scripted.ack(m.command, ACCEPTED)
    arguments = argparse.Namespace(action="control", verb=verb, json=False, timeout=None)
    assert scripted.run(lambda: ground_orders.ACTIONS["control"](arguments, scripted.arm)) == 0
    assert ("control_timeout_s" in capsys.readouterr().out) is told
