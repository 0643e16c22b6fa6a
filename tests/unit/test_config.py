"""Configuration: what fits is read, what does not is refused with file, key, value and allowed range."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.config import Config, load
from arm_companion.config.options import describe
from arm_companion.errors import ConfigError


def write(tmp_path: Path, text: str, name: str = "arm.toml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["sim.toml", "two_segments.toml", "zhao2022.toml"])
def test_shipped_files_are_usable(name: str) -> None:
    assert load(name).arm.length_m == 0.25


def test_a_file_extends_another_and_overrides_single_keys(tmp_path: Path) -> None:
    write(tmp_path, "[arm]\nlength_m = 0.3\ndisks = 12\n", "base.toml")
    path = write(tmp_path, 'extends = "base.toml"\n[arm]\ndisks = 8\n')
    config = load(path)
    assert (config.arm.length_m, config.arm.disks) == (0.3, 8)


def test_settings_override_files_and_whole_numbers_pass_as_reals(tmp_path: Path) -> None:
    path = write(tmp_path, "[arm]\nlength_m = 0.3\n")
    config = load(path, ["arm.length_m=1", "vehicle.autopilot=ardupilot", "mount.position_m=[0, 0, 0.1]"])
    assert config.arm.length_m == 1.0
    assert config.vehicle.autopilot == "ardupilot"
    assert config.mount.position_m == (0.0, 0.0, 0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[arm]\nlength_m = 30\n", ["arm.toml", "arm.length_m", "30.0", "0.02 to 3 m"]),
        ("[arm]\nlenght_m = 0.3\n", ["unknown key 'arm.lenght_m'", "did you mean 'arm.length_m'"]),
        ("[arm]\nlength_m = nan\n", ["arm.length_m", "nan", "0.02 to 3 m"]),
        ("[arm]\nlength_m = true\n", ["arm.length_m", "True", "a number"]),
        ("[arm]\ndisks = 2.5\n", ["arm.disks", "2.5", "a whole number", "2 to 200"]),
        ('[vehicle]\nautopilot = "inav"\n', ["vehicle.autopilot", "'inav'", "px4, ardupilot"]),
        ("[mount]\nposition_m = [0, 0]\n", ["mount.position_m", "3 entries"]),
        ("[arm.tendons]\nangles_deg = [0, 180]\n", ["angles_deg", "at least 3"]),
        ("[servos]\nids = [1, 1, 2, 3]\n", ["twice"]),
        (
            "[servos]\nids = [1, 2, 3]\ndirections = [1, 1, 1]\nzero_ticks = [0, 0, 0]\n",
            ["servos.ids", "4 tendons"],
        ),
        ("[perch]\nwrap_bend_rad = 6.0\n", ["perch.wrap_bend_rad", "limits.bend_max_rad"]),
        ("[links.a]\nrole = 'ground'\n", ["links.a.url", "missing"]),
        ("[links]\na = 3\n", ["links.a", "a table"]),
        ("arm = 3\n", ["arm", "a table"]),
        ("[arm\n", ["not valid TOML"]),
        ('extends = "arm.toml"\n', ["circle"]),
        ('extends = "none.toml"\n', ["none.toml", "no such"]),
    ],
)
def test_what_does_not_fit_is_refused_with_all_that_helps(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load(write(tmp_path, text))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("setting", ["arm.length_m", "=3", "arm.length_m.x=3", "arm.nothing=1"])
def test_a_setting_that_makes_no_sense_is_refused(setting: str) -> None:
    with pytest.raises(ConfigError):
        load("zhao2022.toml", [setting])


@pytest.mark.parametrize("key", ["perch.bar_radius_m", "vehicle.component_id", "mount.position_m"])
def test_a_whole_number_without_end_is_refused(key: str) -> None:
    huge = "1" + 400 * "0"
    with pytest.raises(ConfigError, match=key):
        load("zhao2022.toml", [f"{key}={huge if key != 'mount.position_m' else [0, 0, int(huge)]}"])


@pytest.mark.parametrize(("setting", "end"), [("mqtt.vehicle=7", "a string"), ("mqtt.tls=1", "true or false")])
def test_a_refusal_names_a_range_only_where_there_is_one(setting: str, end: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load("zhao2022.toml", [setting])
    assert str(caught.value).endswith(f"is not allowed: {end}")


def test_a_configuration_cannot_be_changed() -> None:
    config = load("zhao2022.toml")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.arm.length_m = 1.0  # type: ignore[misc]


def options(cls: type, path: str = "") -> list[tuple[str, dataclasses.Field[Any]]]:
    found = []
    for field in dataclasses.fields(cls):
        if describe(field) is not None:
            found.append((f"{path}{field.name}", field))
        elif isinstance(field.type, type) and dataclasses.is_dataclass(field.type):
            found += options(field.type, f"{path}{field.name}.")
    return found


@pytest.mark.parametrize(("key", "field"), options(Config))
def test_every_default_lies_within_its_own_bounds(key: str, field: dataclasses.Field[Any]) -> None:
    meta = describe(field)
    assert meta is not None
    values = field.default if isinstance(field.default, tuple) else (field.default,)
    for value in values:
        if isinstance(value, int | float) and not isinstance(value, bool):
            assert meta.lower <= value <= meta.upper, key
        if meta.choices:
            assert value in meta.choices, key


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_bounded_number_is_taken_exactly_when_it_is_within(value: float) -> None:
    def attempt() -> float:
        return load("zhao2022.toml", [f"arm.length_m={value!r}"]).arm.length_m

    if 0.02 <= value <= 3.0:
        assert attempt() == value
    else:
        with pytest.raises(ConfigError):
            attempt()
