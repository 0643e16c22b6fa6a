"""Files, drop-ins, environment and settings: who wins, who is blamed, and what is told of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.__main__ import main
from arm_companion.app import open_configured
from arm_companion.arm.reaction import mount
from arm_companion.config import document, load
from arm_companion.config.describe import every, json_schema
from arm_companion.config.flyable import check_flyable
from arm_companion.config.layers import PREFIX, collect, files_of, shipped
from arm_companion.config.options import spelling
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table
from arm_companion.errors import ConfigError
from arm_companion.ground.arm import OUR_ADDRESS

ROOT = Path(__file__).parents[2]


def test_a_folder_is_no_configuration_and_is_called_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="a folder"):
        load(tmp_path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A configuration with a base and two drop-ins."""
    (tmp_path / "base.toml").write_text("[arm]\nlength_m = 0.2\ndisks = 8\n[vehicle]\nmass_kg = 1.0\n")
    path = tmp_path / "config.toml"
    path.write_text('extends = "base.toml"\n[arm]\nlength_m = 0.3\n[links.ground]\nurl = "udpout:127.0.0.1:1"\n')
    (tmp_path / "config.d").mkdir()
    (tmp_path / "config.d" / "20-late.toml").write_text("[vehicle]\nmass_kg = 2.5\n")
    (tmp_path / "config.d" / "10-early.toml").write_text("[vehicle]\nmass_kg = 2.0\n[limits]\ntension_max_n = 40.0\n")
    (tmp_path / "config.d" / "notes.txt").write_text("no configuration")
    return path


def test_each_layer_wins_over_the_one_before(file: Path) -> None:
    config = load(file)
    assert (config.arm.disks, config.arm.length_m) == (8, 0.3)
    assert (config.vehicle.mass_kg, config.limits.tension_max_n) == (2.5, 40.0)
    environment = {f"{PREFIX}VEHICLE__MASS_KG": "3", f"{PREFIX}LINKS__GROUND__URL": "udpout:10.0.0.2:5", "PATH": "/bin"}
    config = load(file, environment=environment)
    assert (config.vehicle.mass_kg, config.links["ground"].url) == (3.0, "udpout:10.0.0.2:5")
    assert load(file, ["vehicle.mass_kg=4"], environment).vehicle.mass_kg == 4.0


def test_the_origin_of_every_value_is_known(file: Path) -> None:
    layers = collect(file, ["rates.cycle_hz=50"], {f"{PREFIX}ARM__PITCH_RADIUS_M": "0.021"})
    for key, name in {
        "arm.disks": "base.toml",
        "arm.length_m": "config.toml",
        "limits.tension_max_n": "10-early.toml",
        "vehicle.mass_kg": "20-late.toml",
        "arm.pitch_radius_m": f"environment {PREFIX}ARM__PITCH_RADIUS_M",
        "rates.cycle_hz": "--set rates.cycle_hz",
    }.items():
        assert (origin := layers.origin(key)) is not None
        assert origin.name == name
    assert layers.origin("perch.grip_tension_n") is None
    assert [path.name for path in files_of(file)] == ["config.toml", "base.toml", "10-early.toml", "20-late.toml"]


@pytest.mark.parametrize(
    ("settings", "environment", "words"),
    [
        ([], {}, "20-late.toml: vehicle.mass_kg = -1"),
        (["vehicle.mass_kg=0"], {}, "--set vehicle.mass_kg: vehicle.mass_kg = 0.0"),
        (
            [],
            {f"{PREFIX}VEHICLE__MASS_KG": "heavy"},
            f"environment {PREFIX}VEHICLE__MASS_KG: vehicle.mass_kg = 'heavy'",
        ),
        (["vehicle.mass_kg=1"], {f"{PREFIX}VEHICLE__COLOUR": "red"}, f"environment {PREFIX}VEHICLE__COLOUR: unknown"),
        ([], {f"{PREFIX}VEHICLE__": "3"}, f"{PREFIX}VEHICLE__"),
    ],
)
def test_the_layer_that_is_wrong_is_blamed(
    file: Path, settings: list[str], environment: dict[str, str], words: str
) -> None:
    if not settings and not environment:
        (file.with_suffix(".d") / "20-late.toml").write_text("[vehicle]\nmass_kg = -1\n")
    with pytest.raises(ConfigError) as caught:
        load(file, settings, environment)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [('extends = "base.toml"\n', "drop-in"), ("[vehicle\n", "not valid TOML"), (b"\xff\xfe", "not UTF-8")],
)
def test_a_drop_in_that_cannot_be_used_is_refused(file: Path, text: str | bytes, words: str) -> None:
    bad = file.with_suffix(".d") / "30-bad.toml"
    bad.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(ConfigError, match=r"30-bad\.toml") as caught:
        load(file)
    assert words in str(caught.value)


@given(st.sampled_from([option.key for option in every() if "[]" not in option.key and "NAME" not in option.key]))
def test_a_variable_reaches_every_option_whatever_its_capitals(key: str) -> None:
    assert ".".join(spelling(Config, key.upper().split("."))) == key


# --- what there is to configure ---


def test_every_option_says_what_it_means_and_the_page_has_them_all() -> None:
    keys = [option.key for option in every()]
    assert len(keys) == len(set(keys))
    assert all(option.option.doc for option in every())
    page = document.document()
    assert page == (ROOT / "docs" / "options.md").read_text(), (
        "python -m arm_companion.config.document > docs/options.md"
    )


def table_keys(table: object, path: str = "") -> list[str]:
    """Keys of all values in a table, as far as tables go."""
    if not isinstance(table, dict):
        return [path]
    return [key for name, value in table.items() for key in table_keys(value, f"{path}.{name}" if path else name)]


def test_the_description_and_the_reader_know_the_same_options() -> None:
    known = list(every())
    config = load("sim.toml", ["links.ground.url=udpout:127.0.0.1:1"])
    for key in table_keys(as_table(config)):
        if key.endswith(".rates_hz") or key == "arm.segments":
            continue
        assert any(option.fits(key) for option in known), key


def test_the_schema_takes_what_the_reader_takes() -> None:
    """Structure and types of every shipped file against the JSON Schema, by a checker of a few lines."""

    def check(value: object, schema: dict[str, object], path: str) -> None:
        kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float)}
        assert isinstance(value, kinds[str(schema["type"])]), path  # type: ignore[arg-type]
        if isinstance(value, dict):
            properties: dict[str, dict[str, object]] = schema.get("properties", {})  # type: ignore[assignment]
            for name, item in value.items():
                below = properties.get(name) or schema["additionalProperties"]
                assert isinstance(below, dict), f"{path}.{name}"
                check(item, below, f"{path}.{name}")
        elif isinstance(value, list):
            for item in value:
                check(item, schema["items"], f"{path}[]")  # type: ignore[arg-type]
        elif isinstance(value, int | float) and not isinstance(value, bool):
            assert float(str(schema.get("minimum", "-inf"))) <= value <= float(str(schema.get("maximum", "inf"))), path

    files = sorted(file for folder in shipped() for file in folder.rglob("*.toml"))
    assert files
    for file in files:
        check(collect(file).table, json_schema(), file.name)


@pytest.mark.parametrize("file", sorted((ROOT / "configs" / "examples").glob("*.toml")), ids=lambda file: file.stem)
def test_the_examples_can_be_used_and_all_but_the_bench_can_fly(file: Path) -> None:
    config = load(file)
    open_configured(config)
    if file.stem == "bench":
        with pytest.raises(ConfigError, match="autopilot"):
            check_flyable(config)
    else:
        check_flyable(config)
        assert config.vehicle.autopilot in file.stem or file.stem == "above_mount"
    up = mount(config.mount.position_m, config.mount.rpy_deg).rotation[2, 2] < 0
    assert up == (file.stem == "above_mount")


# --- the command ---


@pytest.mark.parametrize("file", [*sorted((ROOT / "configs/examples").glob("*.toml")), ROOT / "systemd/config.toml"])
def test_what_is_shipped_lets_our_own_ground_station_command(file: Path) -> None:
    commanders = load(file).vehicle.commanders
    assert not commanders or OUR_ADDRESS[0] in commanders


def test_explain_tells_meaning_range_value_and_origin(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "explain", "vehicle.mass_kg", "--config", str(file), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)
    assert told["value"] == 2.5
    assert told["default"] == 1.8
    assert told["allowed"] == "0.1 to 200 kg"
    assert told["from"].endswith("20-late.toml")
    assert main(["config", "explain", "links.ground.url", "--config", str(file)]) == 0
    out = capsys.readouterr().out
    assert "udpout:127.0.0.1:1" in out
    assert "must be given" in out
    assert main(["config", "explain", "perch", "--config", str(file)]) == 0
    assert capsys.readouterr().out.count("  means ") == sum(o.key.startswith("perch.") for o in every())


def test_explain_knows_no_other_option_and_says_what_is_close(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "explain", "perch.grip_tension", "--config", str(file)]) == 78
    assert "perch.grip_tension_n" in capsys.readouterr().err


def test_check_lists_the_layers_and_says_what_cannot_fly(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "check", "--config", str(file)]) == 0
    out = capsys.readouterr().out
    assert [line.rsplit("/", 1)[-1] for line in out.splitlines()[:4]] == [
        "base.toml",
        "config.toml",
        "10-early.toml",
        "20-late.toml",
    ]
    assert "not for the daemon: links: none has the role autopilot" in out
    assert main(["config", "check", "--config", "sim.toml"]) == 0
    assert capsys.readouterr().out.strip().endswith("sim.toml: usable")


def test_check_opens_the_files_that_the_daemon_needs(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = ["--set", "links.autopilot.url=udpin:127.0.0.1:1", "--set", "links.autopilot.role=autopilot"]
    for setting, words in (
        ("links.autopilot.signing_key=/nowhere/key", "link autopilot: signing_key /nowhere/key"),
        ("mqtt.user_file=/nowhere/user", "mqtt.user_file /nowhere/user"),
    ):
        assert main(["config", "check", "--config", str(file), *link, "--set", setting]) == 0
        assert f"not for the daemon: {words}" in capsys.readouterr().out


def test_a_file_anywhere_extends_one_that_comes_with_the_package(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('extends = "zhao2022.toml"\n[vehicle]\nmass_kg = 2.0\n')
    assert load(tmp_path / "mine.toml").vehicle.mass_kg == 2.0
    assert [path.name for path in files_of(tmp_path / "mine.toml")] == ["mine.toml", "zhao2022.toml"]
    (tmp_path / "zhao2022.toml").write_text("[arm]\ndisks = 7\n")  # one beside it comes first
    assert load(tmp_path / "mine.toml").arm.disks == 7


def test_a_folder_that_nobody_may_look_into_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(_: Path) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "is_file", closed)
    with pytest.raises(ConfigError, match=r"/closed/config\.toml: cannot be read: Permission denied"):
        load("/closed/config.toml")


def test_the_environment_reaches_the_command(file: Path) -> None:
    words = [sys.executable, "-m", "arm_companion", "config", "show", "--config", str(file)]
    environment = {f"{PREFIX}VEHICLE__MASS_KG": "3.25", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    assert json.loads(done.stdout)["vehicle"]["mass_kg"] == 3.25
