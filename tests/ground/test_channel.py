"""What is heard of one component, direct and inside TUNNEL, and where private messages go."""

import asyncio
import io
import json
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from arm_companion.drivers.status_text import LONGEST, status_texts
from arm_companion.drivers.targets import read_object
from arm_companion.ground.reports import Payload, Status, Tendons, as_json
from arm_companion.ground.screen import Rates, screen, summary
from arm_companion.ground.texts import Sentences
from arm_companion.mission.motion import rotate
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import tunnel, unwrap

Make = Callable[..., Message]


def test_state_arrives_direct_and_private_messages_leave_direct(scripted: Any, make_status: Make) -> None:
    async def main() -> None:
        scripted.beat((1, 1))  # an autopilot on the same connection, behind a router
        scripted.say(make_status("READY", progress=40, flags=3, errors=1 << 9))
        status = await scripted.arm.first(Status)
        assert (status.state, status.progress, status.behaviour) == ("READY", 40, "ready")
        assert status.flags == ("servos_connected", "torque_on")
        assert status.errors == ("servo_silent",)
        assert scripted.arm.way == "direct"
        await scripted.arm.send_set_point(0.5, -0.25, 0.4)

    scripted.run(main)
    (sent,) = scripted.received
    assert sent.get_type() == "ARM_SETPOINT"
    assert (sent.target_system, sent.target_component) == (1, 192)
    assert (sent.theta, sent.delta, sent.timeout) == (0.5, -0.25, pytest.approx(0.4))
    assert all(math.isnan(x) for x in sent.tip_position)


def test_stamps_are_in_the_arms_own_clock(scripted: Any, make_status: Make) -> None:
    async def main() -> None:
        await asyncio.sleep(2.0)
        await scripted.arm.send_set_point(0.1, 0.0)  # nothing is known of its clock
        scripted.say(make_status(time_usec=77_000_000))
        await asyncio.sleep(0.25)
        await scripted.arm.target_bar((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.02)

    scripted.run(main)
    assert [m.time_usec for m in scripted.received] == [0, 77_250_000]


def test_behind_an_autopilot_both_ways_are_tunnels(scripted: Any, make_status: Make) -> None:
    scripted.through_autopilot = True

    async def main() -> None:
        scripted.say(make_status("PERCHED"))
        assert (await scripted.arm.first(Status)).state == "PERCHED"
        assert scripted.arm.way == "tunnel"
        await scripted.arm.target_bar((3.0, 0.5, -2.0), (0.0, 1.0, 0.0), 0.015)

    scripted.run(main)
    (sent,) = scripted.received
    assert (sent.get_type(), sent.target_system, sent.target_component) == ("TUNNEL", 1, 192)
    frame = unwrap(sent.payload_type, bytes(sent.payload[: sent.payload_length]))
    assert frame is not None
    (target,) = MavlinkCodec(0, 0).feed(frame)
    assert (target.get_type(), target.get_srcSystem(), target.get_srcComponent()) == ("ARM_TARGET", 245, 190)
    assert list(target.position) == [3.0, 0.5, -2.0]
    assert (target.target_system, target.target_component) == (1, 192)


def test_with_an_autopilot_heard_but_no_state_yet_a_tunnel_is_the_safe_guess(scripted: Any) -> None:
    async def main() -> None:
        scripted.beat((1, 1))
        await scripted.arm.send_set_point(0.1, 0.0)

    scripted.run(main)
    assert [m.get_type() for m in scripted.received] == ["TUNNEL"]


@pytest.mark.parametrize("through_autopilot", [True, False])
def test_just_connected_a_private_message_waits_until_the_way_is_known(
    scripted: Any, make_status: Make, through_autopilot: bool
) -> None:
    scripted.through_autopilot = through_autopilot

    async def main() -> None:
        asyncio.get_running_loop().call_later(0.3, scripted.say, make_status())
        await scripted.arm.send_set_point(0.1, 0.0)
        assert asyncio.get_running_loop().time() == pytest.approx(0.3, abs=0.01)
        await scripted.arm.send_set_point(0.2, 0.0)
        assert asyncio.get_running_loop().time() == pytest.approx(0.3, abs=0.01)  # and then it is known

    scripted.run(main)
    assert [m.get_type() for m in scripted.received] == ["TUNNEL" if through_autopilot else "ARM_SETPOINT"] * 2


def test_commands_never_need_a_tunnel(scripted: Any, make_status: Make) -> None:
    scripted.through_autopilot = True
    scripted.script = lambda m: scripted.ack(m.command, 0)

    async def main() -> None:
        scripted.say(make_status())
        await scripted.arm.ready()

    scripted.run(main)
    assert [m.get_type() for m in scripted.received] == ["COMMAND_LONG"]


def test_what_others_say_is_not_the_arms(scripted: Any, make_status: Make) -> None:
    async def main() -> None:
        scripted.say(make_status("PERCHED"), (1, 191))  # another component
        scripted.say(make_status("PERCHED"), (2, 192))  # the arm of another vehicle
        inner = MavlinkCodec(9, 192).encode(make_status("PERCHED"))
        scripted.say(tunnel(inner, 0, 0))  # a frame of somebody else in the arm's tunnel
        inner = MavlinkCodec(1, 192).encode(make_status("PERCHED"))
        scripted.say(tunnel(inner, 255, 190))  # for another station
        assert scripted.arm.status is None

    scripted.run(main)


def test_a_damaged_tunnel_is_dropped_and_the_next_one_is_read(scripted: Any, make_status: Make) -> None:
    def tunnelled(state: str, *, damage: bool) -> Message:
        frame = bytearray(MavlinkCodec(1, 192).encode(make_status(state)))
        if damage:
            frame[20] ^= 0xFF
        message = tunnel(MavlinkCodec(1, 192).encode(make_status(state)), 0, 0)
        message.payload = bytes(frame).ljust(128, b"\0")
        message._payload_raw = message.payload
        return message

    async def main() -> Any:
        scripted.say(tunnelled("PERCHED", damage=True))
        before = scripted.arm.status
        scripted.say(tunnelled("READY", damage=False))
        return before, scripted.arm.status.state

    assert scripted.run(main) == (None, "READY")


def test_an_arm_with_more_tendons_is_put_together(scripted: Any) -> None:
    def group(first: int, tension: float) -> Message:
        four = [float("nan")] * 4
        return mav.MAVLink_arm_tendons_message(
            5_000_000, four, four, [tension] * 4, four, [32767] * 4, [2500] * 4, [65535] * 4, [0] * 4, first, 4, 2, 1
        )

    async def main() -> Tendons:
        for message in (group(0, 1.0), group(4, 2.0), group(0, 3.0)):
            scripted.say(message)
        tendons: Tendons = scripted.arm.tendons
        return tendons

    tendons = scripted.run(main).tendons
    assert [t.index for t in tendons] == list(range(8))
    assert [t.tension for t in tendons] == [3.0] * 4 + [2.0] * 4
    assert [t.silent for t in tendons[:4]] == [False, True, False, False]
    assert [t.torque_on for t in tendons[:4]] == [True, False, False, False]
    assert tendons[0].temperature == pytest.approx(25.0)
    assert math.isnan(tendons[0].load)
    assert math.isnan(tendons[0].voltage)


@given(st.lists(st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=LONGEST), max_size=4))
def test_sentences_come_out_as_they_went_in(sentences: list[str]) -> None:
    joiner = Sentences()
    heard = [
        text
        for i, sentence in enumerate(sentences, 1)
        for chunk in status_texts(4, sentence, i)
        for text in joiner.take(chunk)
    ]
    assert [t.text for t in heard] == sentences
    assert {t.severity for t in heard} <= {"warning"}


def test_a_lost_chunk_shows(scripted: Any) -> None:
    joiner = Sentences()
    chunks = list(status_texts(3, "a" * 50 + "b" * 50 + "c", 9))
    assert joiner.take(chunks[0]) == []
    (text,) = joiner.take(chunks[2])
    assert text.text == "a" * 50 + "..." + "c"
    assert joiner.take(chunks[0]) == []  # its end never comes ...
    (next_one,) = status_texts(6, "short", 10)
    assert [t.text for t in joiner.take(next_one)] == ["a" * 50, "short"]


def test_two_channels_do_not_share_state(scripted: Any) -> None:
    assert scripted.channel.system == 0

    async def main() -> None:
        await asyncio.sleep(0.1)
        assert scripted.channel.system == 1

    scripted.run(main)


def test_an_object_is_told_as_the_arm_reads_it(scripted: Any) -> None:
    scripted.run(lambda: scripted.arm.target_object((3.0, 0.5, -1.5), 0.5, 0.03))
    (sent,) = scripted.received
    thing = read_object(sent)
    assert (thing.position_w, thing.attitude_wo is not None) == ((3.0, 0.5, -1.5), True)
    assert thing.radius == pytest.approx(0.03)
    axis = rotate(thing.attitude_wo or (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert axis == pytest.approx((math.cos(0.5), math.sin(0.5), 0.0))


def test_people_count_tendons_from_one_and_nothing_is_no_negative(scripted: Any, make_status: Make) -> None:
    many = [0] * 4

    async def main() -> None:
        scripted.say(make_status("READY"))
        pulls, tensions = [-1e-6] * 4, [4.0] * 4
        scripted.say(
            mav.MAVLink_arm_tendons_message(0, pulls, pulls, tensions, tensions, many, many, many, many, 0, 4, 0, 15)
        )
        await scripted.arm.first(Tendons)
        stream = io.StringIO()
        Console(file=stream, width=120).print(screen(scripted.arm, "udpin://x", Rates()))
        lines = [line.strip("│ ").split() for line in stream.getvalue().splitlines()]
        rows = [words for words in lines if words and words[0] in {"0", "1", "2", "3", "4"}]
        assert [words[0] for words in rows] == ["1", "2", "3", "4"]
        assert not any("-0.00" in words for words in rows)

    scripted.run(main)


def test_what_is_carried_is_shown_while_it_is_told(scripted: Any, make_status: Make) -> None:
    async def main() -> None:
        scripted.say(make_status("CARRY"))
        assert scripted.arm.payload is None
        scripted.say(mav.MAVLink_arm_payload_message(5_000_000, 0.2, 0.014, [0.05, 0.0, 0.12], [0.01] * 3, 1))
        payload = await scripted.arm.first(Payload)
        assert (payload.time, payload.valid) == (5.0, True)
        assert payload.mass == pytest.approx(0.2)
        assert payload.centre_of_mass == pytest.approx((0.05, 0.0, 0.12))
        assert "carries 200 ±14 g" in summary(scripted.arm)
        assert json.loads(json.dumps(as_json(payload)))["mass"] == pytest.approx(0.2)
        for _ in range(4):  # heard of, but not of this any more
            await asyncio.sleep(1.0)
            scripted.say(make_status("STOWED"))
        assert scripted.arm.payload is None

    scripted.run(main)
