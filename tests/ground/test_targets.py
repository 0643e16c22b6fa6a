"""Where bar or object is, told from the ground: nothing is ordered there before the arm shows that it has just that."""

import argparse
import math
from collections.abc import Callable
from typing import Any

import pytest

from arm_companion.cli import ground_orders
from arm_companion.errors import ArmError
from arm_companion.ground.channel import ArmSilent
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import unwrap

PERCH, REQUEST = mav.MAV_CMD_ARM_PERCH, mav.MAV_CMD_REQUEST_MESSAGE
BAR = {"bar": (3.0, 0.0, -2.0), "bar_axis_deg": 60.0, "bar_radius": 0.035, "hang": False}
OBJECT = {"object": (1.0, 0.2, -0.4), "object_axis_deg": 30.0, "object_radius": 0.03}


class Listener:
    """An arm that has been told of another bar and object before; the first `lost` targets do not reach it."""

    def __init__(self, scripted: Any, lost: int = 0) -> None:
        self.scripted = scripted
        self.lost = lost
        self.refusal = ""
        self.held: dict[int, Message] = {}
        nan = math.nan
        for kind in (mav.ARM_TARGET_KIND_BAR, mav.ARM_TARGET_KIND_OBJECT):
            place = (0, kind, 1, [9.0, 9.0, -9.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], 0.02, [nan] * 6, nan)
            self.held[kind] = mav.MAVLink_arm_target_message(0, 0, *place)

    def take(self, message: Message) -> None:
        if message.get_type() == "ARM_TARGET":
            self.lost -= 1
            if self.refusal:
                self.scripted.text(f"target refused: {self.refusal}")
            elif self.lost < 0:
                fields = [getattr(message, name) for name in message.fieldnames[2:]]
                self.held[message.kind] = mav.MAVLink_arm_target_message(0, 0, *fields)
        elif message.command == REQUEST and message.param1 == mav.MAVLINK_MSG_ID_ARM_TARGET:
            self.scripted.say(self.held[message.param2])
            self.scripted.ack(REQUEST, mav.MAV_RESULT_ACCEPTED)
        else:
            self.scripted.ack(message.command, mav.MAV_RESULT_ACCEPTED)


def order(listener: Listener, make_status: Callable[..., Message], action: str, **words: Any) -> Any:
    scripted = listener.scripted
    scripted.script = listener.take

    async def main() -> None:
        scripted.say(make_status("READY", flags=mav.ARM_FLAG_TARGET_KNOWN))
        arguments = argparse.Namespace(action=action, json=True, timeout=None, **words)
        await ground_orders.ACTIONS[action](arguments, scripted.arm)

    return scripted.run(main)


def orders(scripted: Any) -> list[int]:
    return [m.command for m in scripted.sent("COMMAND_LONG") if m.command != REQUEST]


@pytest.mark.parametrize("tunnelled", [False, True])
@pytest.mark.parametrize(("action", "words"), [("perch", BAR), ("grasp", OBJECT)])
def test_a_target_that_got_lost_is_told_again(
    scripted: Any, make_status: Callable[..., Message], action: str, words: dict[str, Any], *, tunnelled: bool
) -> None:
    listener = Listener(scripted, lost=0 if tunnelled else 1)
    scripted.through_autopilot = tunnelled
    if tunnelled:  # ours come as TUNNEL; this arm takes them out
        take = listener.take
        listener.take = lambda m: [take(inner) for inner in unwrapped(m)]  # type: ignore[assignment, method-assign]
    order(listener, make_status, action, **words)
    kind = mav.ARM_TARGET_KIND_BAR if action == "perch" else mav.ARM_TARGET_KIND_OBJECT
    assert listener.held[kind].position == pytest.approx(words.get("bar", words.get("object")))
    assert len(orders(scripted)) == 1


def unwrapped(message: Message) -> list[Message]:
    if message.get_type() != "TUNNEL":
        return [message]
    frame = unwrap(message.payload_type, bytes(message.payload[: message.payload_length]))
    assert frame is not None
    return list(MavlinkCodec(0, 0).feed(frame))


@pytest.mark.parametrize(("action", "words"), [("perch", BAR), ("grasp", OBJECT)])
def test_no_order_follows_a_target_that_the_arm_does_not_have(
    scripted: Any, make_status: Callable[..., Message], action: str, words: dict[str, Any]
) -> None:
    """Its flag says that it knows a target, which is an older one: it would go there."""
    with pytest.raises(ArmError, match=r"does not show that it has taken the .* at 9\.00 9\.00 -9\.00"):
        order(Listener(scripted, lost=99), make_status, action, **words)
    assert orders(scripted) == []


def test_a_refusal_comes_with_its_reason(scripted: Any, make_status: Callable[..., Message]) -> None:
    listener = Listener(scripted)
    listener.refusal = "radius 9 m is outside 0.002 to 0.5 m"
    with pytest.raises(ArmError, match="target refused: radius 9 m"):
        order(listener, make_status, "perch", **BAR)
    assert orders(scripted) == []


def test_an_arm_that_answers_nothing_is_not_ordered(scripted: Any, make_status: Callable[..., Message]) -> None:
    listener = Listener(scripted)
    listener.take = lambda _: None  # type: ignore[assignment, method-assign]
    with pytest.raises(ArmSilent, match="does not answer REQUEST_MESSAGE"):
        order(listener, make_status, "perch", **BAR)
    assert orders(scripted) == []
