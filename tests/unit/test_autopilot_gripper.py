"""DO_GRIPPER to the autopilot: sent until it is answered, to nobody else, and never an order to ourselves."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import load
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.autopilot_gripper import RESEND_S, TRIES, AutopilotGripper
from arm_companion.drivers.component import Component
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.mission.facts import Order
from arm_companion.mission.gripper_facts import GripperAction, GripperAnswer, GripperFate, GripperOrder
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.transport.memory import MemoryPipe

CONFIG = load("sim_gripper.toml", ("gripper.by=autopilot", "gripper.instance=3", "mavlink.grab=grasp"))
GRAB, RELEASE = mav.GRIPPER_ACTION_GRAB, mav.GRIPPER_ACTION_RELEASE
US = (1, CONFIG.vehicle.component_id)
TICK_S = 0.01


class Rig:
    """The driver on a link whose other end is an autopilot of the test's own."""

    def __init__(self) -> None:
        pipe = MemoryPipe()
        self.codec = MavlinkCodec(1, 1, wanted=(mav.MAVLINK_MSG_ID_COMMAND_LONG,))
        self.heard: list[Message] = []
        self.link = MavlinkLink("autopilot", "autopilot", pipe.opener(0), CONFIG.vehicle)
        self.autopilot = Autopilot(self.link, CONFIG.vehicle)
        self.gripper = AutopilotGripper(CONFIG.gripper, self.link, self.autopilot)
        self.component = Component(
            [self.link],
            CONFIG.vehicle,
            Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S),
            mavlink=CONFIG.mavlink,
        )
        self._other = pipe.opener(1)
        self.answers: Callable[[Message], int | None] = lambda _: None

    async def open(self) -> None:
        self.transport = await self._other(self._receive)

    def _receive(self, data: bytes) -> None:
        for message in self.codec.feed(data):
            if message.get_type() == "COMMAND_LONG" and message.command == mav.MAV_CMD_DO_GRIPPER:
                self.heard.append(message)
                result = self.answers(message)
                if result is not None:
                    self.say(mav.MAVLink_command_ack_message(message.command, result, 0, 0, *US))

    def say(self, message: Message) -> None:
        self.transport.write(self.codec.encode(message))

    async def pass_time(self, seconds: float, order: GripperOrder | None) -> GripperAnswer | None:
        """The daemon's cycle: what is known, and the order that stands."""
        loop = asyncio.get_running_loop()
        for _ in range(round(seconds / TICK_S)):
            assert self.gripper.goals(order, loop.time()) == ()
            await asyncio.sleep(TICK_S)
        return self.gripper.state((), loop.time()).answer


def play(story: Callable[[Rig], Coroutine[Any, Any, None]], *, heard: bool = True) -> None:
    async def main() -> None:
        rig = Rig()
        await rig.open()
        tasks = [asyncio.create_task(run()) for run in (rig.link.run, rig.component.run)]
        await asyncio.sleep(0.1)
        if heard:
            rig.say(mav.MAVLink_heartbeat_message(2, mav.MAV_AUTOPILOT_PX4, 0, 0, 4, 3))
            await asyncio.sleep(0.1)
        try:
            await story(rig)
        finally:
            for task in tasks:
                task.cancel()

    run_simulated(main())


def close(at: float = 1.0) -> GripperOrder:
    return GripperOrder(GripperAction.CLOSE, at)


def test_the_autopilot_itself_is_told_once_and_its_word_is_kept() -> None:
    async def story(rig: Rig) -> None:
        rig.answers = lambda _: int(mav.MAV_RESULT_ACCEPTED)
        assert await rig.pass_time(0.5, None) is None
        assert not rig.heard, "nobody has asked for anything"
        known = await rig.pass_time(2.0, close())
        assert known is not None
        assert (known.at, known.fate, known.reason) == (1.0, GripperFate.TAKEN, "")
        assert known.since_s == pytest.approx(2.0, abs=0.05)
        (message,) = rig.heard
        assert (message.target_system, message.target_component) == (1, 1)
        assert (message.param1, message.param2, message.confirmation) == (3.0, GRAB, 0)
        known = await rig.pass_time(1.0, GripperOrder(GripperAction.OPEN, 9.0))
        assert known is not None
        assert (known.at, rig.heard[-1].param2, len(rig.heard)) == (9.0, RELEASE, 2)

    play(story)


def test_a_lost_answer_is_asked_for_again_with_a_growing_confirmation() -> None:
    async def story(rig: Rig) -> None:
        rig.answers = lambda message: int(mav.MAV_RESULT_ACCEPTED) if message.confirmation == 2 else None
        known = await rig.pass_time(2.0, close())
        assert known is not None
        assert known.fate is GripperFate.TAKEN
        assert [message.confirmation for message in rig.heard] == [0, 1, 2]

    play(story)


@pytest.mark.parametrize("heard", [True, False], ids=["it is silent", "it was never heard"])
def test_nobody_is_asked_for_ever(heard: bool) -> None:
    async def story(rig: Rig) -> None:
        known = await rig.pass_time((TRIES - 0.5) * RESEND_S, close())
        assert known is not None
        assert known.fate is GripperFate.PENDING
        known = await rig.pass_time(10.0, close())
        assert known is not None
        assert (known.fate, known.reason) == (GripperFate.REFUSED, "the autopilot does not answer DO_GRIPPER")
        assert len(rig.heard) == (TRIES if heard else 0)

    play(story, heard=heard)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (mav.MAV_RESULT_DENIED, "denied"),
        (mav.MAV_RESULT_UNSUPPORTED, "unsupported: has it a gripper that is switched on?"),
        (mav.MAV_RESULT_FAILED, "failed"),
    ],
)
def test_a_refusal_is_told_in_words_and_a_new_order_begins_anew(result: int, words: str) -> None:
    async def story(rig: Rig) -> None:
        rig.answers = lambda _: int(result)
        known = await rig.pass_time(3.0, close())
        assert known is not None
        assert (known.fate, known.reason) == (GripperFate.REFUSED, f"the autopilot answers DO_GRIPPER: {words}")
        assert len(rig.heard) == 1
        rig.answers = lambda _: int(mav.MAV_RESULT_ACCEPTED)
        known = await rig.pass_time(1.0, close(at=2.0))
        assert known is not None
        assert (known.at, known.fate) == (2.0, GripperFate.TAKEN)

    play(story)


def test_an_answer_that_is_in_progress_or_somebody_elses_decides_nothing() -> None:
    async def story(rig: Rig) -> None:
        def say(result: int, system: int, component: int) -> None:
            rig.say(mav.MAVLink_command_ack_message(mav.MAV_CMD_DO_GRIPPER, result, 0, 0, system, component))

        rig.gripper.goals(close(), asyncio.get_running_loop().time())
        for result, target in ((mav.MAV_RESULT_IN_PROGRESS, US), (mav.MAV_RESULT_ACCEPTED, (255, 190))):
            say(result, *target)
            known = await rig.pass_time(0.2, close())
            assert known is not None
            assert known.fate is GripperFate.PENDING
        say(mav.MAV_RESULT_ACCEPTED, *US)
        known = await rig.pass_time(0.1, close())
        assert known is not None
        assert known.fate is GripperFate.TAKEN

    play(story)


def test_our_own_command_is_no_order_to_us_whoever_sends_it_back() -> None:
    """A router that echoes, and an autopilot that passes the command on as its own: neither begins a second grasp."""

    async def story(rig: Rig) -> None:
        await rig.pass_time(0.1, close())
        (sent,) = rig.heard
        again = mav.MAVLink_command_long_message(
            1, sent.target_component, sent.command, 0, sent.param1, sent.param2, 0.0, 0.0, 0.0, 0.0, 0.0
        )
        echo = MavlinkCodec(*US)
        rig.transport.write(echo.encode(again))
        rig.say(again)
        to_all = mav.MAVLink_command_long_message(1, 0, sent.command, 0, sent.param1, sent.param2, 0, 0, 0, 0, 0)
        rig.transport.write(echo.encode(to_all))
        rig.say(to_all)
        await rig.pass_time(0.1, close())
        assert rig.component.take()[0] == []
        ours = mav.MAVLink_command_long_message(1, 0, sent.command, 0, float(US[1]), GRAB, 0, 0, 0, 0, 0)
        rig.say(ours)  # of the autopilot's mission
        await rig.pass_time(0.1, close())
        assert [request.order for request in rig.component.take()[0]] == [Order.GRASP]

    play(story)
