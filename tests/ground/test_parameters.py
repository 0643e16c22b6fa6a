"""The parameter protocol's client against a scripted service that loses and refuses."""

import asyncio
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.ground.channel import ArmSilent
from arm_companion.ground.parameters import Parameter, ParameterRefused, _decode, _encode
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

REAL32, INT32, UINT8 = mav.MAV_PARAM_TYPE_REAL32, mav.MAV_PARAM_TYPE_INT32, mav.MAV_PARAM_TYPE_UINT8
LAYOUTS = {REAL32: "<f", INT32: "<i", UINT8: "<Bxxx"}


class Service:
    """Parameters of a component."""

    def __init__(self, scripted: Any, lose: set[int] | None = None) -> None:
        self.scripted = scripted
        self.lose = lose or set()  # numbers of the PARAM_VALUEs that get lost
        self.spoken = 0
        self.values: dict[str, tuple[int, float]] = {f"P{i}": (REAL32, i / 2) for i in range(30)}
        self.values |= {"MODE": (UINT8, 7), "COUNT": (INT32, 12345), "LOCKED": (INT32, 1)}
        scripted.script = self.take

    def speak(self, name: str) -> None:
        type_, value = self.values[name]
        self.spoken += 1
        if self.spoken in self.lose:
            return
        (raw,) = struct.unpack("<f", struct.pack(LAYOUTS[type_], value))
        index = list(self.values).index(name)
        self.scripted.say(mav.MAVLink_param_value_message(name.encode(), raw, type_, len(self.values), index))

    def take(self, message: Message) -> None:
        match message.get_type():
            case "PARAM_REQUEST_LIST":
                for name in self.values:
                    self.speak(name)
            case "PARAM_REQUEST_READ":
                name = message.param_id if message.param_index < 0 else list(self.values)[message.param_index]
                if name in self.values:
                    self.speak(name)
            case "PARAM_SET":
                (value,) = struct.unpack(LAYOUTS[message.param_type], struct.pack("<f", message.param_value))
                if message.param_id != "LOCKED":
                    self.values[message.param_id] = (message.param_type, value)
                self.speak(message.param_id)


def test_a_whole_list_comes_in_order_with_types(scripted: Any) -> None:
    Service(scripted)
    found = scripted.run(scripted.arm.parameters.read_all)
    assert [p.name for p in found] == [f"P{i}" for i in range(30)] + ["MODE", "COUNT", "LOCKED"]
    assert [p.value for p in found[-3:]] == [7, 12345, 1]
    assert found[5] == Parameter("P5", 2.5, "real32", 5, 33)
    assert len(scripted.received) == 1  # no loss, no repeats


def test_what_got_lost_is_asked_for_by_number(scripted: Any) -> None:
    Service(scripted, lose={1, 2, 17, 33, 34})  # the 34th is a repeat that is lost again
    found = scripted.run(scripted.arm.parameters.read_all)
    assert len(found) == 33
    assert len(scripted.sent("PARAM_REQUEST_LIST")) == 1
    asked = [m.param_index for m in scripted.sent("PARAM_REQUEST_READ")]
    assert sorted(set(asked)) == [0, 1, 16, 32]
    assert len(asked) == 5


def test_an_arm_without_the_service_is_told(scripted: Any) -> None:
    async def main() -> None:
        with pytest.raises(ArmSilent, match="does not list"):
            await scripted.arm.parameters.read_all()

    scripted.run(main)


def test_reading_and_writing_by_name(scripted: Any) -> None:
    service = Service(scripted, lose={1, 4})

    async def main() -> None:
        assert (await scripted.arm.parameters.read("COUNT")).value == 12345
        assert (await scripted.arm.parameters.write("COUNT", 99)).value == 99
        assert (await scripted.arm.parameters.write("P3", 0.1)).value == pytest.approx(0.1)

    scripted.run(main)
    assert (service.values["COUNT"], service.values["P3"][0]) == ((INT32, 99), REAL32)
    assert service.values["P3"][1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("COUNT", 1.5, "takes whole numbers"),
        ("COUNT", 1e12, "out of range"),
        ("COUNT", -1.0, "bytes are those of a NaN"),
        ("MODE", 300.0, "out of range"),
        ("MODE", -1.0, "out of range"),
        ("P1", float("nan"), "cannot be set to nan"),
        ("P1", float("inf"), "cannot be set to inf"),
        ("LOCKED", 5.0, "stays 1"),
        ("NOTHING", 1.0, "no such parameter"),
        ("A_NAME_THAT_IS_LONG", 1.0, "no parameter name"),
        ("", 1.0, "no parameter name"),
    ],
)
def test_what_does_not_fit_is_refused_in_words(scripted: Any, name: str, value: float, words: str) -> None:
    service = Service(scripted)
    before = dict(service.values)

    async def main() -> None:
        with pytest.raises(ParameterRefused, match=words):
            await scripted.arm.parameters.write(name, value)

    scripted.run(main)
    assert service.values == before


def test_a_refusal_comes_with_the_arms_reason(scripted: Any) -> None:
    service = Service(scripted)

    def take(message: Message) -> None:
        if message.get_type() == "PARAM_SET":
            scripted.text("parameter refused: LOCKED can change only while the arm is stowed: it is PERCHED")
        service.take(message)

    scripted.script = take

    async def main() -> None:
        with pytest.raises(ParameterRefused, match=r"LOCKED stays 1: LOCKED can change only .*: it is PERCHED"):
            await scripted.arm.parameters.write("LOCKED", 5)

    scripted.run(main)


def test_a_late_answer_to_an_earlier_question_is_no_refusal(scripted: Any) -> None:
    """A radio with 0.9 s to and fro: reading is asked twice, and the second answer comes after the value was set."""
    service = Service(scripted)
    answer = service.take
    scripted.script = lambda message: asyncio.get_running_loop().call_later(0.9, answer, message)

    async def main() -> None:
        assert (await scripted.arm.parameters.write("P3", 7.0)).value == 7.0

    scripted.run(main)


KINDS = {"uint8": (0, 255), "int8": (-128, 127), "uint16": (0, 65535), "int16": (-32768, 32767)}


@given(st.sampled_from(sorted(KINDS)).flatmap(lambda kind: st.tuples(st.just(kind), st.integers(*KINDS[kind]))))
def test_small_whole_numbers_survive_the_bytes_of_a_float(given_: tuple[str, int]) -> None:
    kind, value = given_
    type_, raw = _encode(Parameter("X", 0, kind, 0, 1), value)
    back = _decode(mav.MAVLink_param_value_message(b"X", raw, type_, 1, 0))
    assert back == Parameter("X", value, kind, 0, 1)
