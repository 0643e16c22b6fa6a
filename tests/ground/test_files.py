"""Records, pictures, the buttons for QGroundControl, and the keys of jogging."""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.__main__ import main
from arm_companion.cli.ground_orders import _line
from arm_companion.errors import ArmError, ProtocolError
from arm_companion.ground.figure import draw
from arm_companion.ground.jog import LARGEST_THETA, Jog, split_keys
from arm_companion.ground.parameters import Parameter
from arm_companion.ground.qgc import actions, as_text
from arm_companion.ground.recording import Entry, Recording, format_of, read_jsonl
from arm_companion.ground.reports import Status, Tendon, Tendons, Wrench, as_json
from arm_companion.ground.texts import Text
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

QGC_FILE = Path(__file__).parents[2] / "configs" / "qgroundcontrol-actions.json"
NAN = math.nan
WRENCH = Wrench(3.0, (1.0, 2.0, -3.0), (0.1, NAN, 0.3), (0.5,) * 3, (0.05,) * 3, NAN, 1e-9, "anchored", ("force",))
TENDON = Tendon(0, 0.001, NAN, 12.5, 0.5, NAN, 31.0, 11.9, 0x20, silent=False, torque_on=True)
TENDONS = Tendons(3.5, (TENDON, dataclasses.replace(TENDON, index=1, tension=4.0)))
TEXT = Text("warning", "target refused: axis has no direction, as ever")


def entries(make_status: Callable[..., Message]) -> list[tuple[float, Entry]]:
    status = Status.of(make_status("WRAP", goal_theta=NAN, flags=1 << 9, errors=(1 << 31) | 1, control_system=255))
    return [(10.0, status), (10.1, WRENCH), (10.2, TENDONS), (10.3, TEXT)]


def test_a_record_reads_back_as_it_was(make_status: Callable[..., Message]) -> None:
    stream = io.StringIO()
    recording = Recording(stream, "jsonl")
    for received, entry in entries(make_status):
        recording.put(received, entry)
    assert recording.written == 4
    stream.seek(0)
    back = list(read_jsonl(stream))
    assert repr(back) == repr(entries(make_status))  # repr: NaN is not equal to itself
    stream.seek(0)
    for line in stream:  # strict JSON: no NaN in it
        json.loads(line, parse_constant=pytest.fail)


def test_a_bit_without_a_name_is_shown_as_a_number(make_status: Callable[..., Message]) -> None:
    status = entries(make_status)[0][1]
    assert isinstance(status, Status)
    assert status.errors == ("vehicle_lost", "0x80000000")
    assert status.control[0] == 255


def test_a_record_cut_short_by_a_power_cut_is_read_to_there(make_status: Callable[..., Message]) -> None:
    stream = io.StringIO()
    recording = Recording(stream, "jsonl")
    for received, entry in entries(make_status):
        recording.put(received, entry)
    assert len(list(read_jsonl(io.StringIO(stream.getvalue()[:-5])))) == 3


@pytest.mark.parametrize(
    "line", ["nonsense\n", "[1]\n", '{"received": 1}\n', '{"received": 1, "message": "ARM_STATUS", "x": 1}\n']
)
def test_a_line_that_is_none_of_ours_is_named(line: str) -> None:
    good = '{"received": 1.0, "message": "STATUSTEXT", "severity": "info", "text": "x"}\n'
    with pytest.raises(ProtocolError, match="line 2 is not"):
        list(read_jsonl(io.StringIO(good + line)))


def test_csv_has_a_row_for_each_tendon_and_columns_for_axes(make_status: Callable[..., Message]) -> None:
    stream = io.StringIO(newline="")
    recording = Recording(stream, format_of(Path("x.CSV")))
    for received, entry in entries(make_status):
        recording.put(received, entry)
    stream.seek(0)
    rows = list(csv.DictReader(stream))
    assert [row["message"] for row in rows] == [
        "ARM_STATUS",
        "ARM_REACTION_WRENCH",
        "ARM_TENDONS",
        "ARM_TENDONS",
        "STATUSTEXT",
    ]
    status, wrench, _, tendon, text = rows
    assert (status["state"], status["goal_theta"], status["flags"]) == ("WRAP", "", "contact")
    assert (wrench["force_z"], wrench["torque_y"], wrench["state"]) == ("-3.0", "", "")
    assert (tendon["index"], tendon["tension"], tendon["torque_on"], tendon["goal"]) == ("1", "4.0", "1", "")
    assert text["text"] == TEXT.text


def test_reports_are_plain_json(make_status: Callable[..., Message]) -> None:
    for _, entry in entries(make_status)[:3]:
        assert not isinstance(entry, Text)
        assert json.loads(json.dumps(as_json(entry), allow_nan=False))["message"] == entry.MESSAGE


def test_of_nothing_there_is_no_picture(tmp_path: Path) -> None:
    with pytest.raises(ArmError, match="nothing to draw"):
        draw([(1.0, TEXT)], tmp_path / "y.png")


def test_a_record_that_is_not_there_is_told_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = tmp_path / "none.jsonl"
    assert main(["ground", "plot", str(record), "--output", str(tmp_path / "y.png")]) == 1
    assert capsys.readouterr().err == f"arm-companion ground: {record}: No such file or directory\n"


@pytest.mark.parametrize(
    ("value", "kind", "shown"),
    [(0.8999999761581421, "real32", "0.9"), (2147483647.0, "int32", "2147483647"), (math.nan, "real32", "?")],
)
def test_a_parameter_is_shown_with_the_digits_that_it_has(value: float, kind: str, shown: str) -> None:
    assert _line(Parameter("PERCH_BEND_SPD", value, kind, 0, 1)).split() == ["PERCH_BEND_SPD", shown, kind]


def test_an_address_of_no_kind_is_told_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ground", "status", "--connect", "nonsense://"]) == 1
    assert "udpin://HOST:PORT" in capsys.readouterr().err


def test_plot_draws_a_record_without_an_arm(
    make_status: Callable[..., Message], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, picture = tmp_path / "r.jsonl", tmp_path / "r.png"
    with record.open("w", encoding="utf-8") as stream:
        recording = Recording(stream, "jsonl")
        for received, entry in entries(make_status):
            recording.put(received, entry)
    assert main(["ground", "plot", str(record), "--output", str(picture), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["result"], told["reports"]) == ("accepted", 4)
    assert picture.read_bytes().startswith(b"\x89PNG")
    for wrong in (tmp_path / "missing.jsonl", tmp_path / "x.csv", Path(__file__)):
        assert main(["ground", "plot", str(wrong), "--output", str(tmp_path / "no.png")]) == 1
        assert str(wrong.name) in (said := capsys.readouterr().err) or "CSV" in said
    assert not (tmp_path / "no.png").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["params", "get"], "params get NAME"),
        (["params", "set", "X"], "params set NAME VALUE"),
        (["params", "list", "X"], "params list"),
        (["perch", "--bar", "1", "2", "-3"], "belong together"),
        (["jog", "--theta-deg", "10", "--vehicle", "0", "0", "0.01"], "give one of them"),
        (["jog"], "needs a terminal"),
        (["calibrate"], "--yes"),
    ],
)
def test_wrong_usage_ends_with_2_before_anything_is_opened(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main(["ground", *words, "--connect", "nonsense://"]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--timeout", "0"], ["--component", "0"], ["--system", "256"], ["--seconds", "nan"]])
def test_options_out_of_range_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["ground", "watch", *words])
    assert ended.value.code == 2
    assert words[0] in capsys.readouterr().err


# QGroundControl --------------------


def test_the_shipped_buttons_are_those_that_the_dialect_gives() -> None:
    assert QGC_FILE.read_text(encoding="utf-8") == as_text(), "run: arm-companion ground qgc-actions"


def test_buttons_have_only_the_fields_that_are_documented(capsys: pytest.CaptureFixture[str]) -> None:
    # With a key that it does not know, QGroundControl drops the whole file.
    assert main(["ground", "qgc-actions", "--component", "193"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content == actions(193)
    assert set(content) == {"version", "fileType", "actions"}
    assert (content["version"], content["fileType"]) == (1, "MavlinkActions")
    known = {"label", "description", "mavCmd", "compId"} | {f"param{i}" for i in range(1, 8)}
    labels = [action["label"] for action in content["actions"]]
    assert len(set(labels)) == len(labels)
    for action in content["actions"]:
        assert set(action) == known
        assert action["compId"] == 193
        assert mav.enums["MAV_CMD"][action["mavCmd"]].name.startswith("MAV_CMD_ARM_")
        assert action["description"]


# Jogging --------------------


def test_keys_come_out_of_what_a_terminal_delivers() -> None:
    assert split_keys("\x1b[A\x1b[Bq\x1b[C\x1b[D +") == ["up", "down", "q", "right", "left", " ", "+"]


KEYS = st.sampled_from(["up", "down", "left", "right", "0", " ", "+", "-", "x", "\x1b"])


@given(st.lists(KEYS, max_size=60), st.floats(0.0, LARGEST_THETA), st.floats(-math.pi, math.pi))
def test_whatever_is_pressed_the_set_point_stays_allowed_and_moves_in_small_steps(
    keys: list[str], theta: float, delta: float
) -> None:
    jog = Jog(theta, delta)
    for key in keys:
        after = jog.press(key, theta, delta)
        assert 0.0 <= after.theta <= LARGEST_THETA
        assert -math.pi <= after.delta <= math.pi
        if key in ("up", "down", "left", "right"):
            assert abs(after.theta - jog.theta) <= jog.step_rad + 1e-12
            assert abs(math.remainder(after.delta - jog.delta, math.tau)) <= jog.step_rad + 1e-12
        jog = after


def test_zero_is_straight_and_space_holds_where_the_arm_is() -> None:
    jog = Jog(1.0, 0.5)
    assert jog.press("0", 0.9, 0.4).theta == 0.0
    assert (jog.press(" ", 0.9, 0.4).theta, jog.press(" ", 0.9, 0.4).delta) == (0.9, 0.4)
    assert jog.press("+", 0, 0).step_rad > jog.step_rad > jog.press("-", 0, 0).step_rad


def test_nothing_of_it_needs_numbers_that_are_not_known() -> None:
    nothing: Any = dataclasses.replace(TENDON, tension=NAN, displacement=NAN)
    assert as_json(Tendons(0.0, (nothing,)))["tendons"][0]["tension"] is None
