"""Parameters: the table fits the schema and MAVLink, values come and go exactly, and what must not change does not."""

import asyncio
import json
import math
import os
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.config import Config, load
from arm_companion.config.parameters import NAME_LENGTH, PARAMETERS, Parameter, When, overlay
from arm_companion.drivers.component_metadata import metadata_files
from arm_companion.drivers.keeper import Keeper, write_atomically
from arm_companion.drivers.settings import FILE, Settings, read_changes, with_kept_changes
from arm_companion.errors import CommandRejected, ConfigError, ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.param_value import INT32, REAL32, from_bytes, from_float, to_bytes, to_float
from tests.unit.component_rig import ServiceRig, serve

BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}
STANDOFF, WRENCH, COMPID = BY_NAME["PERCH_STANDOFF"], BY_NAME["RATE_WRENCH"], BY_NAME["VEH_COMPID"]


async def soon() -> None:
    await asyncio.sleep(0.05)


# --- the table ---


def test_names_are_mavlinks_unique_and_sorted() -> None:
    names = [parameter.name for parameter in PARAMETERS]
    assert names == sorted(set(names))
    assert len({parameter.path for parameter in PARAMETERS}) == len(names)
    assert all(0 < len(name) <= NAME_LENGTH and name.replace("_", "").isalnum() for name in names)


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda p: p.name)
def test_every_parameter_reads_and_writes_its_option_within_the_schemas_bounds(parameter: Parameter) -> None:
    config = load("sim.toml")
    option = parameter.option
    assert option.doc
    assert math.isfinite(option.lower)
    assert math.isfinite(option.upper)
    value = parameter.read(config)
    assert parameter.write(config, value) == config
    for beyond in (option.lower - 1.0, option.upper + 1.0):
        with pytest.raises(ConfigError, match=parameter.name):
            parameter.write(config, beyond)
    middle = round(0.5 * (option.lower + option.upper)) if parameter.whole else 0.4 * option.lower + 0.6 * option.upper
    if parameter.name not in ("PERCH_WRAP_BEND", "LIM_BEND", "LIM_TEN_MIN"):  # others bound these
        changed = parameter.write(config, middle)
        assert parameter.read(changed) == pytest.approx(middle, rel=1e-6)
        others = [p for p in PARAMETERS if p is not parameter]
        assert [p.read(changed) for p in others] == [p.read(config) for p in others]


def test_rules_that_span_two_options_hold_and_whole_numbers_stay_whole() -> None:
    with pytest.raises(ConfigError, match="wrap_bend_rad"):
        BY_NAME["PERCH_WRAP_BEND"].write(Config(), 5.6)
    with pytest.raises(ConfigError, match="tension_min_n = 30 is over"):
        BY_NAME["LIM_TEN_MIN"].write(Config(), 30.0)
    assert BY_NAME["LIM_TEN_MIN"].write(Config(), 4.0).limits.tension_min_n == 4.0
    with pytest.raises(ConfigError, match="whole number"):
        COMPID.write(Config(), 12.5)


# --- on the wire ---


@given(st.floats(width=32, allow_nan=False))
def test_real_numbers_come_back_exactly(value: float) -> None:
    assert from_float(to_float(value, whole=False), REAL32, whole=False) == value
    assert from_bytes(to_bytes(value, whole=False), REAL32, whole=False) == value


@given(st.integers(-(2**22), 2**31 - 2**23 - 1))
def test_whole_numbers_travel_as_their_bytes(value: int) -> None:
    field = to_float(value, whole=True)
    assert struct.pack("<f", field) == struct.pack("<i", value)
    assert from_float(field, INT32, whole=True) == value


def test_a_value_of_the_wrong_type_or_size_is_refused() -> None:
    with pytest.raises(ProtocolError, match="type 9"):
        from_float(1.0, REAL32, whole=True)
    with pytest.raises(ProtocolError, match="no parameter value"):
        to_bytes(2**31, whole=True)


# --- settings ---


def test_a_change_is_applied_when_its_time_has_come() -> None:
    settings = Settings(Config())
    applied: list[Config] = []
    settings.apply = applied.append
    settings.stowed = lambda: "it is PERCHED"
    with pytest.raises(CommandRejected, match="only while the arm is stowed: it is PERCHED"):
        settings.set(STANDOFF, 0.8)
    assert settings.value(STANDOFF) == 0.6
    settings.set(WRENCH, 10.0)
    settings.stowed = lambda: None
    settings.set(STANDOFF, struct.unpack("<f", struct.pack("<f", 0.8))[0])
    settings.set(COMPID, 200.0)
    assert settings.value(COMPID) == 200.0
    assert settings.config.vehicle.component_id == 192  # until the next start
    assert [(c.rates.wrench_hz, c.perch.standoff_m) for c in applied] == [(10.0, 0.6), (10.0, 0.8)]
    settings.set(STANDOFF, 0.8)  # no change
    assert len(applied) == 2
    for bad in (math.nan, math.inf, 1e9):
        with pytest.raises(CommandRejected):
            settings.set(STANDOFF, bad)
    assert STANDOFF.when is When.STOWED


def test_changes_survive_a_restart_and_the_file_wins_where_nothing_was_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = Keeper()
    settings = Settings(Config(), tmp_path, keeper)
    settings.set(STANDOFF, 0.8)
    settings.set(COMPID, 200.0)
    settings.set(WRENCH, 5.0)
    keeper.close()
    assert json.loads((tmp_path / FILE).read_text()) == {
        "perch.standoff_m": 0.8,
        "rates.wrench_hz": 5.0,
        "vehicle.component_id": 200.0,
    }
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    config = with_kept_changes(load("sim.toml"))
    assert (config.perch.standoff_m, config.vehicle.component_id, config.vehicle.mass_kg) == (0.8, 200, 1.8)
    assert [p.name for p in tmp_path.iterdir()] == [FILE]


@pytest.mark.parametrize("content", ["", "[1]", '{"perch.standoff_m": "x"}', "{", '{"perch.standoff_m": null}'])
def test_a_damaged_file_is_left_aside(tmp_path: Path, content: str, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE).write_text(content)
    assert read_changes(tmp_path) == {}
    assert "left aside" in caplog.text


def test_kept_values_that_no_longer_fit_are_left_out() -> None:
    config, complaints = overlay(Config(), {"perch.standoff_m": 99.0, "gone.option": 1.0, "perch.bar_radius_m": 0.05})
    assert (config.perch.standoff_m, config.perch.bar_radius_m) == (0.6, 0.05)
    assert len(complaints) == 2


def test_a_limit_that_was_lowered_after_what_it_limits_is_kept() -> None:
    """The file is sorted, so that the limit comes before the value that has to make room for it."""
    settings = Settings(Config())
    settings.set(BY_NAME["PERCH_WRAP_BEND"], 3.0)
    settings.set(BY_NAME["LIM_BEND"], 3.5)
    config, complaints = overlay(Config(), {"limits.bend_max_rad": 3.5, "perch.wrap_bend_rad": 3.0})
    assert (config.limits.bend_max_rad, config.perch.wrap_bend_rad) == (3.5, 3.0)
    assert not complaints
    _, complaints = overlay(Config(), {"limits.bend_max_rad": 3.5})
    assert len(complaints) == 1


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / FILE
    write_atomically(file, b"old")

    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space"):
        write_atomically(file, b"new")
    assert file.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == [FILE]


# --- the service ---


def parameter_set(name: str, value: float, kind: int = REAL32, to: tuple[int, int] = (1, 192)) -> Any:
    return mav.MAVLink_param_set_message(*to, name.encode(), value, kind)


def test_the_whole_list_comes_in_order_and_paced() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(mav.MAVLink_param_request_list_message(1, 0))
        await asyncio.sleep(0.2)
        assert 0 < len(rig.ground.all("PARAM_VALUE")) < 25
        await asyncio.sleep(1.0)
        values = rig.ground.all("PARAM_VALUE")
        assert [m.param_index for m in values] == list(range(len(PARAMETERS)))
        assert {m.param_count for m in values} == {len(PARAMETERS)}
        assert [m.param_id for m in values] == [p.name for p in PARAMETERS]
        for message, parameter in zip(values, PARAMETERS, strict=True):
            read = from_float(message.param_value, message.param_type, whole=parameter.whole)
            assert read == pytest.approx(parameter.read(Config()), rel=1e-6)

    serve(body)


def test_a_list_asked_for_again_begins_anew() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(mav.MAVLink_param_request_list_message(1, 192))
        await asyncio.sleep(0.1)
        rig.ground.send(mav.MAVLink_param_request_list_message(1, 192))
        await asyncio.sleep(1.5)
        indices = [m.param_index for m in rig.ground.all("PARAM_VALUE")]
        assert indices[-len(PARAMETERS) :] == list(range(len(PARAMETERS)))
        assert len(indices) < len(PARAMETERS) + 15  # the first list did not go on beside it

    serve(body)


def test_one_value_is_read_by_name_and_by_index_and_what_is_not_there_is_not_answered() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(
            mav.MAVLink_param_request_read_message(1, 192, b"PERCH_STANDOFF", -1),
            mav.MAVLink_param_request_read_message(1, 192, b"", 0),
            mav.MAVLink_param_request_read_message(1, 192, b"NOTHING", -1),
            mav.MAVLink_param_request_read_message(1, 192, b"", 999),
            mav.MAVLink_param_request_read_message(1, 0, b"PERCH_STANDOFF", -1),
        )
        await soon()
        assert [m.param_id for m in rig.ground.all("PARAM_VALUE")] == ["PERCH_STANDOFF", PARAMETERS[0].name]

    serve(body)


def test_a_change_is_answered_with_the_new_value_and_a_refusal_with_the_old_one() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(
            parameter_set("PERCH_STANDOFF", 0.75),
            parameter_set("VEH_COMPID", to_float(200, whole=True), INT32),
            parameter_set("PERCH_STANDOFF", 99.0),
            parameter_set("PERCH_STANDOFF", math.nan),
            parameter_set("VEH_COMPID", 201.0, REAL32),
            parameter_set("PERCH_STANDOFF", 0.7, to=(1, 0)),
            parameter_set("PERCH_STANDOFF", 0.7, to=(1, 1)),
        )
        await soon()
        shown = [(m.param_id, m.param_value) for m in rig.ground.all("PARAM_VALUE")]
        two_hundred = to_float(200, whole=True)
        assert shown == [
            ("PERCH_STANDOFF", 0.75),
            ("VEH_COMPID", two_hundred),
            ("PERCH_STANDOFF", 0.75),
            ("PERCH_STANDOFF", 0.75),
            ("VEH_COMPID", two_hundred),
        ]
        assert "parameter refused: PERCH_STANDOFF = 99 is not allowed: 0.05 to 5 m" in rig.words()
        assert rig.settings.config.perch.standoff_m == 0.75
        counters = rig.component.parameters.counters if rig.component.parameters else None
        assert counters is not None
        assert (counters.changes, counters.refused) == (2, 3)

    serve(body)


def test_what_is_answered_is_what_was_set_to_the_last_bit() -> None:
    """A ground station compares: 60 degrees in rad need more than seven digits."""
    sixty = struct.unpack("<f", struct.pack("<f", math.radians(60.0)))[0]

    async def body(rig: ServiceRig) -> None:
        rig.ground.send(parameter_set("PERCH_WRAP_BEND", sixty), parameter_set("PERCH_STANDOFF", 0.8))
        await soon()
        assert rig.ground.all("PARAM_VALUE")[0].param_value == sixty
        assert rig.settings.config.perch.standoff_m == 0.8

    serve(body)


def test_a_stranger_reads_but_does_not_change() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(parameter_set("PERCH_STANDOFF", 0.75))
        await soon()
        (value,) = rig.ground.all("PARAM_VALUE")
        assert value.param_value == pytest.approx(0.6)
        assert "system 255 may not command the arm" in rig.words()

    serve(body, commanders=(7,))


def test_the_extended_protocol_has_the_same_values() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(mav.MAVLink_param_ext_request_list_message(1, 192))
        await asyncio.sleep(1.0)
        values = rig.ground.all("PARAM_EXT_VALUE")
        assert [m.param_id for m in values] == [p.name for p in PARAMETERS]
        for message, parameter in zip(values, PARAMETERS, strict=True):
            read = from_bytes(message._param_value_raw, message.param_type, whole=parameter.whole)
            assert read == pytest.approx(parameter.read(Config()), rel=1e-6)
        rig.ground.send(
            mav.MAVLink_param_ext_set_message(1, 192, b"PERCH_STANDOFF", struct.pack("<f", 0.75), REAL32),
            mav.MAVLink_param_ext_set_message(1, 192, b"PERCH_STANDOFF", struct.pack("<f", 99.0), REAL32),
            mav.MAVLink_param_ext_set_message(1, 192, b"NOTHING", struct.pack("<f", 99.0), REAL32),
            mav.MAVLink_param_ext_request_read_message(1, 192, b"PERCH_STANDOFF", -1),
        )
        await soon()
        acks = rig.ground.all("PARAM_EXT_ACK")
        assert [m.param_result for m in acks] == [mav.PARAM_ACK_ACCEPTED, mav.PARAM_ACK_VALUE_UNSUPPORTED]
        assert from_bytes(rig.ground.all("PARAM_EXT_VALUE")[-1]._param_value_raw, REAL32, whole=False) == 0.75

    serve(body)


def test_the_metadata_describes_every_parameter() -> None:
    files = metadata_files(192)
    described = json.loads(files["/parameter.json"])["parameters"]
    assert [d["name"] for d in described] == [p.name for p in PARAMETERS]
    for entry, parameter in zip(described, PARAMETERS, strict=True):
        assert entry["min"] <= entry["default"] <= entry["max"]
        assert entry["rebootRequired"] is (parameter.when is When.RESTART)
        assert entry["type"] == ("Int32" if parameter.whole else "Float")


def test_a_disk_that_does_not_take_it_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    keeper = Keeper()
    keeper.put(tmp_path / "file" / FILE, b"x")
    keeper.put(tmp_path / FILE, b"old")
    keeper.put(tmp_path / FILE, b"new")
    keeper.close()
    assert "is not kept" in caplog.text
    assert keeper.troubles() == ["parameters.json is not kept: File exists"]
    assert keeper.troubles() == []
    assert (tmp_path / FILE).read_bytes() == b"new"
