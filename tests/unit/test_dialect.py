"""The dialect: laid out as the standard has it, within the limits that autopilots set, and built only when needed."""

import importlib.util
import io
import shutil
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType
from typing import Any

import pymavlink.dialects.v20.common as standard
import pytest
from lxml import etree
from pymavlink.generator import mavgen

from arm_companion.drivers import commands
from arm_companion.mission.facts import WrenchSource
from arm_companion.mission.state import Phase
from arm_companion.protocol.dialect import XML, mav
from arm_companion.protocol.dialect.document import document

OURS = range(64000, 64008)
TREE = ET.parse(XML)
REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def hatch_build() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hatch_build", REPOSITORY / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_standard_message_has_the_standards_layout() -> None:
    shared = standard.mavlink_map.keys() & mav.mavlink_map.keys()
    assert len(shared) == len(standard.mavlink_map)
    for id_ in shared:
        ours, theirs = mav.mavlink_map[id_], standard.mavlink_map[id_]
        assert (ours.msgname, ours.crc_extra, ours.unpacker.format) == (
            theirs.msgname,
            theirs.crc_extra,
            theirs.unpacker.format,
        )


# CRC_EXTRA and payload length as the standard's C headers have them.
@pytest.mark.parametrize(
    ("name", "id_", "crc_extra", "size"),
    [
        ("LINK_NODE_STATUS", 8, 117, 36),
        ("COMMAND_CANCEL", 80, 14, 4),
        ("COMPONENT_INFORMATION_BASIC", 396, 50, 160),
        ("COMPONENT_METADATA", 397, 182, 108),
        ("EVENT", 410, 160, 53),
    ],
)
def test_standard_messages_that_pymavlink_lacks(name: str, id_: int, crc_extra: int, size: int) -> None:
    cls = mav.mavlink_map[id_]
    assert (cls.msgname, cls.crc_extra, cls.unpacker.size) == (name, crc_extra, size)


def test_our_messages_stand_in_their_block_and_fit_into_a_tunnel() -> None:
    names = [mav.mavlink_map[id_].msgname for id_ in OURS]
    assert names == [
        "ARM_STATUS",
        "ARM_REACTION_WRENCH",
        "ARM_TENDONS",
        "ARM_STIFFNESS",
        "ARM_TARGET",
        "ARM_SETPOINT",
        "ARM_PAYLOAD",
        "ARM_SERVOS",
    ]
    for id_ in OURS:
        assert mav.mavlink_map[id_].unpacker.size <= 116, mav.mavlink_map[id_].msgname


def test_messages_to_us_carry_exact_addresses() -> None:
    for name in ("ARM_TARGET", "ARM_SETPOINT"):
        (cls,) = (c for c in mav.mavlink_map.values() if c.msgname == name)
        assert cls.fieldnames[:2] == ["target_system", "target_component"]


def test_the_xml_is_valid_by_the_standards_schema_and_knows_its_enums() -> None:
    schema_tree = etree.parse(mavgen.schemaFile)
    for attribute in schema_tree.iterfind('xs:attribute[@name="units"]', {"xs": "http://www.w3.org/2001/XMLSchema"}):
        attribute.set("type", "xs:string")  # force and torque units are not in the schema's list
    etree.XMLSchema(schema_tree).assertValid(etree.parse(str(XML)))
    for field in TREE.iter("field"):
        if enum := field.get("enum"):
            assert enum in mav.enums, enum


def test_every_physical_field_of_ours_has_a_unit() -> None:
    dimensionless = {"residual", "axis", "q", "matrix"}
    for message in TREE.iter("message"):
        if int(message.get("id", 0)) in OURS:
            for field in message.iter("field"):
                if (field.get("type") or "").startswith("float") and field.get("name") not in dimensionless:
                    assert field.get("units"), (message.get("name"), field.get("name"))


def test_commands_stand_in_their_block_in_order() -> None:
    names = {value: entry.name for value, entry in mav.enums["MAV_CMD"].items() if 64000 <= value < 64012}
    expected = [
        "READY",
        "STOW",
        "PERCH",
        "GRASP",
        "RELEASE",
        "ABORT",
        "JOG",
        "CALIBRATE",
        "CLEAR_ERRORS",
        "FEEDFORWARD",
        "CONTROL",
        "REACH",
    ]
    assert names == {64000 + i: f"MAV_CMD_ARM_{name}" for i, name in enumerate(expected)}
    assert all(commands.name_of(64000 + i) == name for i, name in enumerate(expected))


@pytest.mark.parametrize(
    ("command", "parameter"),
    [("PERCH", commands._PERCH_KIND), ("JOG", commands._JOG_KIND), ("REACH", commands._REACH_KIND)],
)
def test_the_ranges_that_are_enforced_are_the_documented_ones(command: str, parameter: Any) -> None:
    (param,) = TREE.iterfind(f".//entry[@name='MAV_CMD_ARM_{command}']/param[@index='{parameter.index}']")
    assert (float(param.get("minValue", "nan")), float(param.get("maxValue", "nan"))) == (
        parameter.lower,
        parameter.upper,
    )


def test_the_missions_numbers_are_the_dialects() -> None:
    for phase in Phase:
        assert mav.enums["ARM_STATE"][phase.value].name == f"ARM_STATE_{phase.name}"
    for source in WrenchSource:
        assert mav.enums["ARM_WRENCH_SOURCE"][source.value].name == f"ARM_WRENCH_SOURCE_{source.name}"


def test_bitmasks_have_one_bit_each() -> None:
    for name in ("ARM_FLAG", "ARM_ERROR", "ARM_VALIDITY"):
        values = [v for v, entry in mav.enums[name].items() if not entry.name.endswith("_ENUM_END")]
        assert mav.enums[name].bitmask
        assert all(v.bit_count() == 1 for v in values)


def test_generation_happens_once_per_change(
    hatch_build: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(XML, tmp_path)
    assert hatch_build.generate(tmp_path) is True
    made = (tmp_path / "generated.py").stat().st_mtime_ns
    assert hatch_build.generate(tmp_path) is False
    assert (tmp_path / "generated.py").stat().st_mtime_ns == made
    text = (tmp_path / XML.name).read_text(encoding="utf-8")
    (tmp_path / XML.name).write_text(text.replace('name="theta" units', 'name="bend" units'), encoding="utf-8")
    assert hatch_build.generate(tmp_path) is True
    code = (tmp_path / "generated.py").read_text(encoding="utf-8")
    assert "self.bend = bend" in code
    assert str(tmp_path) not in code
    assert capsys.readouterr() == ("", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["__pycache__", XML.name, "generated.py"]


def test_what_the_include_already_has_is_left_out(hatch_build: ModuleType, tmp_path: Path) -> None:
    text = XML.read_text(encoding="utf-8")
    text = text.replace('id="80" name="COMMAND_CANCEL"', 'id="77" name="OTHER"')
    text = text.replace('value="6" name="MAV_RESULT_CANCELLED"', 'value="4" name="MAV_RESULT_OTHER"')
    (tmp_path / XML.name).write_text(text, encoding="utf-8")
    hatch_build.generate(tmp_path)
    code = (tmp_path / "generated.py").read_text(encoding="utf-8")
    assert "class MAVLink_command_ack_message" in code
    assert "class MAVLink_other_message" not in code
    assert "MAV_RESULT_OTHER" not in code
    assert "MAV_RESULT_FAILED" in code


def test_a_broken_dialect_stops_the_build_with_the_generators_words(hatch_build: ModuleType, tmp_path: Path) -> None:
    text = XML.read_text(encoding="utf-8")
    (tmp_path / XML.name).write_text(text.replace('id="64001"', 'id="64000"'))
    with pytest.raises(RuntimeError, match="Duplicate message id 64000"):
        hatch_build.generate(tmp_path)
    assert not (tmp_path / "generated.py").exists()


def test_a_missing_build_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    package = "arm_companion.protocol.dialect"
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.loader is not None
    fresh = importlib.util.module_from_spec(spec)
    real = sys.modules[package]
    monkeypatch.delattr(real, "generated", raising=False)
    monkeypatch.setitem(sys.modules, f"{package}.generated", None)
    with pytest.raises(ImportError, match="has not been generated: install the package"):
        spec.loader.exec_module(fresh)


def test_the_generator_names_no_folder() -> None:
    code = io.StringIO(Path(mav.__file__).read_text(encoding="utf-8"))
    assert "arm_companion.xml,common.xml" in "".join(next(code) for _ in range(8))


def test_the_page_about_the_dialect_is_current() -> None:
    page = (REPOSITORY / "docs" / "dialect.md").read_text(encoding="utf-8")
    assert page == document(XML.read_text(encoding="utf-8")), "python -m arm_companion.protocol.dialect.document"


def test_the_page_names_every_message_field_and_entry() -> None:
    page = document(XML.read_text(encoding="utf-8"))
    for element in TREE.iter():
        if element.tag in ("message", "entry") and (element.get("name") or "") != "MAV_RESULT_CANCELLED":
            assert f"{element.get('name')}" in page
    wrench = page.split("### ARM_REACTION_WRENCH (64001)")[1].split("###")[0]
    assert "| force | float[3] | 8 | N |" in wrench
    assert "| source | uint8_t | 64 |" in wrench
