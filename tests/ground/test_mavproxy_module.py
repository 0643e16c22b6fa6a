"""The MAVProxy module's own rules, on MAVProxy's base class with time and links in our hands.

tests/peers/test_ground_station.py runs it in a real MAVProxy.
"""

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as stock

from arm_companion.ground.commands import TRIES
from arm_companion.ground.mavproxy_arm_companion import ArmModule, init
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import tunnel


class Link:
    """One of MAVProxy's links: keeps what is sent."""

    def __init__(self) -> None:
        self.mav = self
        self.sent: list[tuple[Any, ...]] = []

    def command_long_send(self, *fields: Any) -> None:
        self.sent.append(fields)


class State:
    """What the module uses of MAVProxy's state."""

    def __init__(self) -> None:
        self.command_map: dict[str, Any] = {}
        self.completions: dict[str, Any] = {}
        self.mav_master = [Link(), Link()]
        self.vehicle_link_map: dict[int, set[tuple[int, int]]] = {0: {(1, 1)}, 1: {(1, 192), (1, 1)}}
        self.settings = self
        self.source_system, self.source_component = 255, 230
        self.console = self
        self.shown: list[str] = []

    def set_status(self, _name: str, text: str) -> None:
        self.shown.append(text)


class Rig:
    """The module with a clock that stands where it is put."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(ArmModule, "get_time", lambda _: self.now)
        self.state = State()
        self.module = init(self.state)
        self._stock = stock.MAVLink(None)
        self._codecs: dict[tuple[int, int], MavlinkCodec] = {}

    def hear(self, message: Message, source: tuple[int, int] = (1, 192)) -> None:
        """As MAVProxy reads it: with a dialect that does not have our messages."""
        frame = self._codecs.setdefault(source, MavlinkCodec(*source)).encode(message)
        for packet in self._stock.parse_buffer(frame):
            self.module.mavlink_packet(packet)

    def beat(self) -> None:
        self.hear(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3))

    def type(self, words: str) -> None:
        function, _ = self.state.command_map["armc"]
        function(words.split())

    def wait(self, seconds: float, step: float = 0.1) -> None:
        for _ in range(round(seconds / step)):
            self.now += step
            self.module.idle_task()

    def ack(self, command: int, result: int, target: tuple[int, int] = (255, 230), **more: Any) -> None:
        self.hear(mav.MAVLink_command_ack_message(command, result, 0, 0, *target), **more)

    @property
    def sent(self) -> list[tuple[Any, ...]]:
        assert not self.state.mav_master[0].sent  # the arm has never been heard there
        return self.state.mav_master[1].sent


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(monkeypatch)


def test_before_its_heartbeat_nothing_goes_to_the_arm(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.hear(mav.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3), (1, 1))
    for order in ("abort", "ready", "perch"):
        rig.type(order)
    rig.wait(5.0)
    assert rig.sent == []
    assert "nothing is sent" in capsys.readouterr().out
    rig.beat()
    rig.type("perch")
    assert rig.sent == [(1, 192, mav.MAV_CMD_ARM_PERCH, 0, *[0.0] * 7)]


def test_hang_is_a_perch_of_that_kind(rig: Rig) -> None:
    rig.beat()
    rig.type("hang")
    assert rig.sent == [(1, 192, mav.MAV_CMD_ARM_PERCH, 0, 1.0, *[0.0] * 6)]


def test_reach_sends_its_point(rig: Rig) -> None:
    rig.beat()
    rig.type("reach 3 -2 -1.5")
    assert rig.sent == [(1, 192, mav.MAV_CMD_ARM_REACH, 0, 0.0, 3.0, -2.0, -1.5, *[0.0] * 3)]


def test_a_calibration_wants_a_yes(rig: Rig) -> None:
    rig.beat()
    for words in ("calibrate", "calibrate no"):
        rig.type(words)
    assert rig.sent == []
    rig.type("calibrate yes")
    assert rig.sent == [(1, 192, mav.MAV_CMD_ARM_CALIBRATE, 0, 1.0, 1.0, *[0.0] * 5)]


def test_what_gets_no_answer_is_repeated_and_then_told(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.beat()
    rig.type("jog 90 45")
    rig.wait(10.0)
    assert [fields[3] for fields in rig.sent] == list(range(TRIES))
    assert rig.sent[0][4:8] == (1, pytest.approx(1.570796), pytest.approx(0.785398), 0.0)
    assert f"no answer to JOG, sent {TRIES} times" in capsys.readouterr().out


@pytest.mark.parametrize("lie", [{"source": (1, 1)}, {"source": (2, 192)}, {"target": (245, 190)}])
def test_an_answer_of_another_or_for_another_does_not_count(
    rig: Rig, lie: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    rig.beat()
    rig.type("ready")
    rig.ack(mav.MAV_CMD_ARM_READY, 0, **lie)
    rig.wait(1.0)
    assert len(rig.sent) == 2
    rig.ack(mav.MAV_CMD_ARM_READY, 0)
    rig.wait(5.0)
    assert len(rig.sent) == 2
    assert capsys.readouterr().out.count("READY accepted") == 1


def test_an_order_under_way_is_not_repeated_and_silence_is_told(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.beat()
    rig.type("perch")
    rig.ack(mav.MAV_CMD_ARM_PERCH, mav.MAV_RESULT_IN_PROGRESS)
    rig.wait(10.0)
    assert len(rig.sent) == 1
    assert "PERCH may be going on" in capsys.readouterr().out


@pytest.mark.parametrize("through_autopilot", [False, True])
def test_state_is_read_from_messages_that_mavproxy_does_not_know(
    rig: Rig,
    make_status: Callable[..., Message],
    through_autopilot: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def tell(message: Message) -> None:
        rig.hear(tunnel(MavlinkCodec(1, 192).encode(message), 0, 0) if through_autopilot else message)

    tell(make_status("READY"))  # before the heartbeat it could be anybody's
    assert "state" not in capsys.readouterr().out
    rig.beat()
    tell(make_status("READY"))
    tell(make_status("READY"))
    tell(make_status("PERCHED", errors=1 << 9))
    assert capsys.readouterr().out.splitlines()[-2:] == ["arm: state READY", "arm: state PERCHED"]
    assert rig.state.shown == ["Arm READY", "Arm PERCHED"]
    rig.type("status")
    assert "errors: servo_silent" in capsys.readouterr().out
    rig.now += 60.0
    rig.type("status")
    assert "SILENT for 60 s" in capsys.readouterr().out


def test_wrong_words_show_the_usage_and_send_nothing(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.beat()
    for words in (
        "",
        "fly",
        "ready now",
        "jog",
        "jog x",
        "vehicle 1 2",
        "reach 1 2",
        "component 300",
        "component x",
        "control",
    ):
        rig.type(words)
        assert "usage: armc" in capsys.readouterr().out, words
    assert rig.sent == []
    rig.type("component 193")
    rig.type("ready")
    assert "no heartbeat of component 193" in capsys.readouterr().out


def test_unloading_takes_the_command_away(rig: Rig) -> None:
    rig.module.unload()
    assert rig.state.command_map == {}
