"""Replay of the golden flight, what-if, and the page for people."""

import dataclasses
import itertools
import json
import re
from collections.abc import Callable, Collection
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest

from arm_companion.__main__ import main
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.cli import sim
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table
from arm_companion.mission import mission
from arm_companion.mission.facts import ArmFault
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import State
from arm_companion.record import replay as replay_module
from arm_companion.record import shares
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.reader import Reader, truth_beside
from arm_companion.record.replay import differences, replay
from arm_companion.record.starts import starts_text
from arm_companion.record.topics import (
    COMMANDS,
    CONFIGURATION,
    FACTS,
    FORMAT,
    LOG,
    STARTS,
    STATE,
    TRUTH,
)
from arm_companion.record.versions import versions
from arm_companion.record_codec import plain
from arm_companion.report.flight import Span, read
from arm_companion.report.words import judge
from tests.golden.thin import thin

GOLDEN = Path(__file__).parents[1] / "golden" / "perch.mcap"


@pytest.fixture(scope="module")
def of_here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden flight as this machine's linear algebra rounds it: another processor's last bits are other ones."""
    target = tmp_path_factory.mktemp("golden") / "perch.mcap"
    thin(GOLDEN, target, 1)
    return target


def copy(target: Path, *, source: Path = GOLDEN, skip: range = range(0), upto: int = 10**9, **about: str) -> None:
    """The golden flight without some cycles, or only its beginning, or with other metadata."""
    reader = Reader(source)
    file = McapFile(target, {**reader.versions, **about})
    for item in reader:
        if item.sequence not in skip and item.sequence < upto:
            file.text(item.topic, item.unix_ns, item.data, item.sequence)
    file.close()


def test_the_golden_flight_commands_what_it_did() -> None:
    """Bit for bit where it was made; elsewhere linear algebra may round otherwise, and no decision may differ."""
    reader = Reader(GOLDEN)
    here = versions(Config())
    outcome = replay(reader)
    assert outcome.cycles == 1284
    assert not outcome.failures
    assert [m.after for m in outcome.now] == [m.after for m in outcome.recorded]
    assert "PERCHED" in [m.after for m in outcome.now]
    if all(here.get(name) == reader.versions[name] for name in ("python", "numpy", "machine", "processor")):
        assert outcome.identical, outcome.first
    for name, greatest in outcome.greatest.items():
        assert greatest.value < 5e-3, name


def test_a_replay_is_bit_for_bit_on_the_machine_of_its_record(of_here: Path) -> None:
    outcome = replay(Reader(of_here))
    assert outcome.identical, outcome.first
    assert not outcome.why


def test_other_code_is_found_in_its_first_cycle(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, of_here: Path) -> None:
    path = tmp_path / "r.mcap"
    copy(path, source=of_here, upto=60)
    count = 0

    def changed(*arguments: Any) -> Any:
        nonlocal count
        state, commands = mission.step(*arguments)
        count += 1
        if count == 41:
            wrench = dataclasses.replace(commands.wrench, residual=-1.0)
            commands = dataclasses.replace(commands, wrench=wrench)
        if count == 51:
            raise ZeroDivisionError("today only")
        return state, commands

    monkeypatch.setattr(replay_module, "step", changed)
    outcome = replay(Reader(path))
    assert outcome.first is not None
    assert (outcome.first.cycle, outcome.first.field, outcome.first.now) == (40, "wrench.residual", -1.0)
    assert outcome.failures == [(50, "ZeroDivisionError: today only")]
    assert outcome.cycles == 60


def test_a_gap_is_told_and_replay_goes_on_behind_it(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    copy(path, skip=range(20, 25), upto=40)
    outcome = replay(Reader(path))
    assert outcome.gaps == [(20, 5)]
    assert outcome.cycles == 35


def remembered(
    target: Path,
    cycles: int,
    *,
    spoilt: int | None = None,
    other_start: int | None = None,
    missing: Collection[int] = (),
) -> None:
    """The golden flight's beginning with the memory before every cycle, and the solver's start with every twentieth.

    Args:
        target: written.
        cycles: how many.
        spoilt: the cycle whose commands are not those that follow.
        other_start: the cycle with which an earlier solution stands.
        missing: cycles that are left out.
    """
    reader = Reader(GOLDEN)
    file = McapFile(target, reader.versions)
    state, first, parameters = State(), State(), None
    for found in itertools.islice(replay_module.cycles(reader), cycles + 1):
        if isinstance(found, Config):
            parameters = Parameters(found, RodModel(ArmParameters.of(found.arm)))
            file.json(CONFIGURATION, 0, {"t": 0.0, "config": as_table(found)})
            continue
        assert parameters is not None
        before, first = state, state if first.prediction is None else first
        state, commands = mission.step(state, found.facts, found.t, parameters)
        if found.number == spoilt:
            commands = dataclasses.replace(commands, recover=True)
        if found.number in missing:
            continue
        if before.prediction is not None and not found.number % 20:
            start = first if found.number == other_start else before
            file.text(STARTS, 0, starts_text(start, found.t), found.number)
        file.json(STATE, 0, plain(before), found.number)
        file.json(FACTS, 0, {"t": found.t} | plain(found.facts), found.number)
        file.json(COMMANDS, 0, {"t": found.t} | plain(commands), found.number)
    file.close()


def test_shares_are_together_the_whole_replay(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    remembered(path, 150)
    whole = replay(Reader(path))
    assert whole.identical
    count = Reader(path).count(FACTS)
    assert count == 150
    parts = [shares.share(path, "", stretch) for stretch in shares.stretches(count, 3)]
    assert [part and part.cycles for part in parts] == [60, 40, 50], "from where a start is recorded"
    moves = [move for part in parts if part is not None for move in part.recorded]
    assert sorted(moves, key=lambda move: move.seconds) == whole.recorded
    assert {move.after for move in moves} >= {"STOWED", "READYING", "READY"}


def test_a_start_that_is_not_what_comes_out_is_found(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    remembered(path, 90, other_start=60)
    assert shares.share(path, "", (0, 40)) is not None
    assert shares.share(path, "", (0, 60)) is None, "the next one would start from elsewhere"
    assert replay(Reader(path)).identical, "and one go does not need it"


def test_behind_a_gap_it_goes_on_from_a_recorded_start_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    remembered(path, 90, missing=range(45, 60))
    outcome = replay(Reader(path))
    assert outcome.gaps == [(45, 15)]
    assert outcome.identical
    assert outcome.cycles == 75
    remembered(path, 90, missing=range(45, 59))
    told = replay_module.Outcome()
    runner = replay_module.Runner(told, None, fast=False)
    for found in replay_module.cycles(Reader(path)):
        if isinstance(found, Config):
            runner.configure(found)
        else:
            runner.take(found)
    assert "last bits may differ" in " ".join(told.why), "no start stands with the next one"


@pytest.mark.parametrize("spoilt", [10, 60])
def test_a_share_that_finds_a_difference_says_nothing(tmp_path: Path, spoilt: int) -> None:
    path = tmp_path / "r.mcap"
    remembered(path, 90, spoilt=spoilt)
    whose = (0, 40) if spoilt < 40 else (40, 90)
    assert shares.share(path, "", whose) is None


def test_where_no_start_is_recorded_one_share_is_all_of_it(tmp_path: Path, of_here: Path) -> None:
    path = tmp_path / "r.mcap"
    copy(path, source=of_here, upto=90)
    parts = [shares.share(path, "", stretch) for stretch in ((0, 40), (40, 90))]
    assert [part and part.cycles for part in parts] == [90, 0]


def test_what_another_configuration_would_have_done(capsys: pytest.CaptureFixture[str], of_here: Path) -> None:
    code = main(["replay", str(of_here), "--set", "perch.grip_tension_n=32", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert code == 3
    assert found["why"][0] == "the configuration is another one"
    assert "PERCHED" in [move["after"] for move in found["recorded"]]
    assert "PERCHED" not in [move["after"] for move in found["now"]]
    assert ("WRAP", "UNLOAD") in [(move["before"], move["after"]) for move in found["now"]]
    assert found["greatest"]["predicted force"]["value"] > 0.1
    assert found["first"]["seconds"] == pytest.approx(43.7, abs=0.5)


def test_exit_codes_and_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.mcap"
    copy(path, upto=30)
    code = main(["replay", str(path)])
    said = capsys.readouterr().out
    assert code in {0, 3}
    assert "30 cycles" in said
    assert ("bit for bit" in said) == (code == 0)
    assert main(["replay", str(path), "--set", "perch.nonsense=1"]) == 78
    assert "nonsense" in capsys.readouterr().err
    assert main(["replay", __file__]) == 1
    assert "not an MCAP file" in capsys.readouterr().err
    copy(path, upto=0)
    assert main(["replay", str(path)]) == 1
    assert "no whole cycle" in capsys.readouterr().err


def test_other_versions_are_named_as_reasons(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    copy(path, upto=5, numpy="1.0", mechanics="numba")
    outcome = replay(Reader(path), mechanics="numpy")
    if not outcome.identical:
        assert any("numpy: recorded with 1.0" in reason for reason in outcome.why)
        assert any("mechanics" in reason for reason in outcome.why)


def test_a_cycle_that_this_version_does_not_know_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.mcap"
    reader = Reader(GOLDEN)
    file = McapFile(path, {**reader.versions, "version": "9.9"})
    for item in reader:
        if item.sequence > 2:
            break
        data = item.data.replace(b'"vehicle"', b'"airframe"') if item.topic == "/facts" else item.data
        file.text(item.topic, item.unix_ns, data, item.sequence)
    file.close()
    assert main(["replay", str(path)]) == 1
    assert "version 9.9" in capsys.readouterr().err
    assert main(["report", str(path)]) == 1
    assert "version 9.9" in capsys.readouterr().err


def test_differences_name_the_field() -> None:
    found = list(
        differences({"a": [1.0, 0.0], "b": {"c": "x"}}, {"a": [1.0, -0.0], "b": {"c": "y"}, "d": 1, "e": None})
    )
    assert [path for path, _, _ in found] == ["a[1]", "b.c", "d"]


class Page(HTMLParser):
    """What a browser would load, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in {"src", "href"}]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_report_is_one_page_that_needs_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    reader = Reader(GOLDEN)
    file = McapFile(path, reader.versions)
    start = 0
    for item in reader:
        if item.topic == COMMANDS:
            start = start or item.unix_ns
        file.text(item.topic, item.unix_ns, item.data, item.sequence)
    warning = "tendon 3 <b>slack</b> & warm"
    file.json(LOG, start + 10**9, {"level": 3, "message": warning})
    file.close()
    truth = McapFile(truth_beside(path), {"format": FORMAT, "content": "truth"})
    for i in range(1000):
        values = {"position_w": [0.0] * 3, "force_b": [0.0] * 3, "torque_b": [0.0] * 3, "tension": [4.0] * 4}
        truth.json(TRUTH, start + i * 10**8, {"t": 0.1 * i, **values, "contact_force_n": 0.0, "wrap_angle": 0.0})
    truth.close()

    assert main(["report", str(path)]) == 0
    assert "Perched once" in capsys.readouterr().out
    text = (tmp_path / "flight" / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert "script" not in page.tags
    assert "link" not in page.tags
    assert page.loads
    assert all(value.startswith("data:image/png;base64,") for value in page.loads)
    assert not re.search(r"url\(|@import", text)
    assert 'name="viewport"' in text
    assert warning in page.text
    for word in ("PERCHED", "pull test passed", "against the simulator's truth", "against"):
        assert word in page.text
    for name in ("force", "torque", "tensions", "position", "error", "temperature", "links", "servos"):
        assert (tmp_path / "flight" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_a_record_that_was_cut_off_still_makes_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(GOLDEN.read_bytes()[:400_000])
    assert main(["report", str(path), "--json", "--output", str(tmp_path / "page")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["grade"] == "bad"
    assert "the record ends in state PERCHED" in found["points"]
    assert any("cut off" in point for point in found["points"])


@pytest.mark.parametrize(
    ("name", "folder"),
    [("flight", "flight-report"), ("flight.v2", "flight.v2-report"), ("a.b.mcap", "a.b"), (".mcap", ".mcap-report")],
)
def test_a_page_has_a_folder_of_its_own_whatever_the_record_is_called(tmp_path: Path, name: str, folder: str) -> None:
    path = tmp_path / name
    copy(path, upto=30)
    before = path.read_bytes()
    assert main(["report", str(path)]) == 0
    assert (tmp_path / folder / "report.html").is_file()
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", ["report.html", "force.png"])
def test_a_record_is_never_overwritten_by_its_page(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    copy(path, upto=30)
    before = path.read_bytes()
    assert main(["report", str(path), "--output", str(tmp_path)]) == 1
    assert "would be overwritten" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def altered(target: Path, change: Callable[[int, dict[str, Any], dict[str, Any]], None], cycles: int) -> None:
    """The golden flight's beginning, at 100 Hz and changed."""
    reader = Reader(GOLDEN)
    file = McapFile(target, reader.versions)
    facts: dict[str, Any] = {}
    for item in reader:
        if item.sequence >= cycles:
            break
        if item.topic == FACTS:
            facts = orjson.loads(item.data)
        elif item.topic == COMMANDS:
            commands = orjson.loads(item.data)
            change(item.sequence, facts, commands)
            for topic, table in ((FACTS, facts), (COMMANDS, commands)):
                file.json(topic, 10**18 + item.sequence * 10**7, table | {"t": 0.01 * item.sequence}, item.sequence)
        elif item.topic == CONFIGURATION:
            file.text(item.topic, 10**18, item.data)
    file.close()


def test_the_greatest_values_are_those_of_every_cycle(tmp_path: Path) -> None:
    def one_cycle(number: int, facts: dict[str, Any], commands: dict[str, Any]) -> None:
        commands["status"]["state"] = "PERCHED"
        if number == 13:
            facts["tendons"][1] |= {"tension": 44.0, "tension_sigma": 2.0, "temperature": 71.0, "voltage": 9.5}
            commands["wrench"] |= {"valid": True, "force_b": [3.0, 0.0, 4.0], "force_sigma": [0.5, "inf", 0.5]}
            commands["wrench"] |= {"torque_b": [0.0, 0.0, 0.7], "torque_sigma": [0.1] * 3}
            commands["status"]["error_bits"] = int(ArmFault.TENDON_OVER_TENSION)

    path = tmp_path / "r.mcap"
    altered(path, one_cycle, 40)
    flight = read(Reader(path))
    assert len(flight.t) < 10, "the cycle is not among those that are drawn"
    text = "; ".join(judge(flight).points)
    for words in (
        "a tendon reached 44.0 ± 2.0 N",
        "greatest predicted force on the airframe 5.0 N",
        "torque 0.70 ± 0.10 N m",
        "71 °C, lowest voltage 9.5 V",
        "tendon over tension",
    ):
        assert words in text


def test_where_nothing_was_heard_nothing_is_claimed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def deaf(_: int, facts: dict[str, Any], commands: dict[str, Any]) -> None:
        facts["tendons"] = [tendon | {"age_s": "inf"} for tendon in facts["tendons"]]
        facts["vehicle"]["position_age_s"] = "inf"
        commands["wrench"]["valid"] = False

    path = tmp_path / "r.mcap"
    altered(path, deaf, 40)
    assert main(["report", str(path)]) == 0
    said = capsys.readouterr().out
    assert "tension not known," in said
    assert "nan" not in said
    flight = read(Reader(path))
    assert not np.isfinite(flight.position_w).any()
    assert not np.isfinite(flight.tension).any()


def test_states_are_right_behind_a_gap(tmp_path: Path) -> None:
    whole = {span.name: span for span in read(Reader(GOLDEN)).spans}
    end = whole["PERCHED"].end
    reader = Reader(GOLDEN)
    times = [c.t for c in replay_module.cycles(reader) if isinstance(c, replay_module.Cycle)]
    last = next(i for i, t in enumerate(times) if t - times[0] >= end)
    path = tmp_path / "r.mcap"
    copy(path, skip=range(last - 5, last + 5))
    flight = read(Reader(path))
    (span,) = (span for span in flight.spans if span.name == "PERCHED")
    assert abs(span.end - end) < 1.0
    after = flight.spans[flight.spans.index(span) + 1]
    assert (after.name, after.cause) == ("UNLOAD", "not in the record")
    assert judge(flight).headline == "Perched once, 38 s in all, and let go."
    copy(path, skip=range(7))
    assert any("7 of" in point and "missing" in point for point in judge(read(Reader(path))).points)


@pytest.mark.parametrize(
    ("states", "headline"),
    [
        ("PERCHED HOLDING RELEASE STOWING STOWED", "Perched once, 10 s in all, and let go."),
        ("PERCHED HOLDING", "Perched once, 10 s in all, and did not let go in this record."),
        ("CARRY PLACE RELEASE DEPART", "Carried an object once, 10 s in all, and let go."),
        ("CARRY HOLDING:load_lost RELEASE STOWING", "Carried an object once, 10 s in all, and lost it."),
    ],
)
def test_how_it_ended(states: str, headline: str) -> None:
    spans = []
    for i, word in enumerate(states.split()):
        name, _, cause = word.partition(":")
        spans.append(Span(name, 10.0 * i, 10.0 * (i + 1), cause.replace("_", " ") + ": it is so"))
    assert judge(dataclasses.replace(read(Reader(GOLDEN)), spans=spans)).headline == headline


def test_a_truth_that_does_not_belong_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, other = tmp_path / "r.mcap", tmp_path / "other.mcap"
    copy(path, upto=30)
    truth_beside(path).write_bytes(b"")
    assert main(["report", str(path)]) == 0
    assert "r.truth.mcap: cut off" in capsys.readouterr().out
    file = McapFile(other, {"format": FORMAT, "content": "truth"})
    for i in range(1000):
        values = {"position_w": [0.0] * 3, "force_b": [0.0] * 3, "torque_b": [0.0] * 3, "tension": [4.0] * 4}
        file.json(TRUTH, 10**18 + i * 10**8, {"t": 0.1 * i, **values, "contact_force_n": 0.0, "wrap_angle": 0.0})
    file.close()
    for wrong in (other, GOLDEN):
        assert main(["report", str(path), "--truth", str(wrong)]) == 0
        said = capsys.readouterr().out
        assert f"{wrong.name} has no truth of this flight" in said
        assert "against the simulator's truth" not in said


def test_a_later_part_has_its_part_of_the_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The simulator writes one file for all parts, and calls it after the first."""
    part, whole = tmp_path / "r-002.mcap", truth_beside(tmp_path / "r.mcap")
    copy(part, upto=200)
    flight = read(Reader(part))
    file = McapFile(whole, {"format": FORMAT, "content": "truth"})
    for i in range(2000):
        values = {"position_w": [0.0] * 3, "force_b": [0.0] * 3, "torque_b": [0.0] * 3, "tension": [4.0] * 4}
        at = flight.began_ns + i * 10**8
        file.json(TRUTH, at, {"t": 0.1 * i, **values, "contact_force_n": 0.0, "wrap_angle": 0.0})
    file.close()
    t = read(Reader(part), Reader(whole)).truth["t"]
    assert 0.0 <= t[0] < 0.5
    assert flight.seconds - 0.5 < t[-1] <= flight.seconds
    assert main(["report", str(part)]) == 0
    assert "no truth" not in capsys.readouterr().out
    assert "thin: the simulator" in (tmp_path / "r-002" / "report.html").read_text(encoding="utf-8")


def test_an_earlier_runs_truth_is_gone_before_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim, "_fly", lambda *_: 0)
    (tmp_path / "record.truth.mcap").write_bytes(b"of an earlier run")
    assert main(["sim", "perch", "--simulated", "--output", str(tmp_path)]) == 0
    assert not (tmp_path / "record.truth.mcap").exists()
