"""Calibrations of the tendons: kept whole, applied, and refused with the reason when they no longer fit."""

import asyncio
import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import precise_loop
from arm_companion.config import Config
from arm_companion.config.schema import CalibrationConfig
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibrated import Calibrated
from arm_companion.drivers.calibration import (
    VERSION,
    ServoIdentity,
    TendonCalibration,
    TendonZero,
    TensionCalibration,
    TensionFit,
    judge,
    too_old,
)
from arm_companion.drivers.servo_setup import ServoInfo
from arm_companion.drivers.tendons import nominal_curve
from arm_companion.mission.facts import CalibrationState
from tests.unit.test_tendons import STATE

NOW = 1_800_000_000.0
INFO = {i: ServoInfo(i, 1060, 46, 0, 52, fresh=False) for i in (1, 2, 3, 4)}
SERVOS = tuple(dataclasses.replace(STATE, id=i, position=2048) for i in (1, 2, 3, 4))


def config(directory: Path | str = "", **calibration: Any) -> Config:
    return dataclasses.replace(Config(), calibration=CalibrationConfig(directory=str(directory), **calibration))


def calibration(**changes: Any) -> TendonCalibration:
    plain = Config()
    zeros = tuple(
        TendonZero(ServoIdentity(i, 1060, 46), 1, 2000 + 10 * i, 0.0002 + 0.0001 * i, 5.0, 31.0) for i in (1, 2, 3, 4)
    )
    made = TendonCalibration(
        VERSION,
        NOW,
        "2027-01-15T08:00:00+00:00",
        "0.1.0",
        plain.arm.pulley_radius_m,
        plain.arm.tendons.pretension_n,
        plain.arm.tendons.angles_deg,
        (),
        zeros,
    )
    return dataclasses.replace(made, **changes)


def test_what_is_saved_is_read_back_and_can_be_read_by_people(tmp_path: Path) -> None:
    files.save(tmp_path / "state" / files.TENDONS, calibration())
    assert files.tendons(str(tmp_path / "state")) == calibration()
    text = (tmp_path / "state" / files.TENDONS).read_text(encoding="utf-8")
    assert json.loads(text)["tendons"][1]["zero_ticks"] == 2020
    assert text.count("\n") > 20
    assert [p.name for p in (tmp_path / "state").iterdir()] == [files.TENDONS], "nothing half written is left"


def test_no_directory_and_no_file_are_no_calibration(tmp_path: Path) -> None:
    assert files.tendons("") == files.tendons(str(tmp_path)) == ""
    assert files.tension("") is None is files.tension(str(tmp_path))


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"version": 1}', '"x"', "null"])
def test_a_damaged_file_is_told_and_never_flown_on(tmp_path: Path, text: str) -> None:
    (tmp_path / files.TENDONS).write_text(text, encoding="utf-8")
    found = files.tendons(str(tmp_path))
    assert isinstance(found, str)
    assert files.TENDONS in found
    verdict = judge(found, config(tmp_path), INFO, SERVOS, {})
    assert verdict.state is CalibrationState.STALE
    assert "damaged" in verdict.refusal


def test_a_file_of_another_version_is_refused(tmp_path: Path) -> None:
    files.save(tmp_path / files.TENDONS, calibration(version=VERSION + 1))
    assert "version 2" in str(files.tendons(str(tmp_path)))


def test_a_calibration_that_fits_is_valid_once_every_servo_has_been_seen() -> None:
    assert judge(calibration(), config(), INFO, SERVOS, {}).state is CalibrationState.VALID
    some = {i: INFO[i] for i in (1, 3)}
    assert judge(calibration(), config(), some, SERVOS, {}).state is CalibrationState.UNKNOWN


def test_without_one_the_arm_flies_only_where_that_is_allowed() -> None:
    allowed = judge("", config(), INFO, SERVOS, {})
    assert (allowed.state, allowed.refusal) == (CalibrationState.MISSING, "")
    needed = judge("", config(tendons="required"), INFO, SERVOS, {})
    assert needed.state is CalibrationState.MISSING
    assert "calibrate tendons" in needed.refusal


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"pulley_radius": 0.012}, "12 mm"),
        ({"pretension": 5.0}, "pretension"),
        ({"angles_deg": (0.0, 90.0, 180.0, 270.0)}, "angles"),
        ({"coupling": ((1.0,),)}, "coupling"),
        ({"tendons": calibration().tendons[:3]}, "servos [1, 2, 3]"),
        (
            {"tendons": (*calibration().tendons[:3], dataclasses.replace(calibration().tendons[3], direction=-1))},
            "direction of tendon 4",
        ),
    ],
)
def test_another_arm_is_refused_with_what_differs(changes: dict[str, Any], reason: str) -> None:
    verdict = judge(calibration(**changes), config(), INFO, SERVOS, {})
    assert verdict.state is CalibrationState.STALE
    assert reason in verdict.refusal


def test_another_firmware_is_refused() -> None:
    verdict = judge(calibration(), config(), INFO | {3: dataclasses.replace(INFO[3], firmware=47)}, SERVOS, {})
    assert "tendon 3" in verdict.refusal
    assert "firmware 47" in verdict.refusal


def test_a_servo_that_was_turned_without_power_is_refused_with_how_far() -> None:
    lost = (*SERVOS[:1], dataclasses.replace(SERVOS[1], position=300, turns_lost=True), *SERVOS[2:])
    verdict = judge(calibration(), config(), INFO, lost, {2: 4096 + 100})
    assert verdict.state is CalibrationState.STALE
    assert "servo 2 (tendon 2) was turned by 200 ticks without power" in verdict.refusal
    assert "lost its turns" in judge(calibration(), config(), INFO, lost, {}).refusal


def test_age_is_a_warning_and_no_refusal() -> None:
    old = NOW + 100 * 86_400.0
    assert "100 days" in too_old(calibration(), config(), old)
    assert too_old(calibration(), config(), NOW + 86_400.0) == ""


def test_the_daemon_flies_on_the_calibrated_zeros(tmp_path: Path) -> None:
    files.save(tmp_path / files.TENDONS, calibration())
    found = Calibrated(config(tmp_path), NOW + 200 * 86_400.0)
    assert found.servos.zero_ticks == (2010, 2020, 2030, 2040)
    assert found.servos.zero_sigma_m == pytest.approx(0.0006)
    assert any("200 days" in warning for warning in found.warnings)
    found.close()


def test_zeros_that_do_not_fit_are_not_applied(tmp_path: Path) -> None:
    files.save(tmp_path / files.TENDONS, calibration(pulley_radius=0.02))
    found = Calibrated(config(tmp_path), NOW)
    assert found.servos == Config().servos
    assert found.judge(INFO, ()).state is CalibrationState.STALE
    found.close()


def fitted(servo: int, **changes: Any) -> TensionFit:
    curve = dataclasses.replace(nominal_curve(Config().servos, 0.01), gain=151.0, friction_sigma=0.2)
    plain = TensionFit(ServoIdentity(servo, 1060, 46), NOW, Config().arm.pulley_radius_m, curve, 0.1, 8)
    return dataclasses.replace(plain, **changes)


def test_measured_tensions_replace_the_configured_ones_servo_by_servo(tmp_path: Path) -> None:
    files.save(tmp_path / files.TENSION, TensionCalibration(VERSION, (fitted(2), fitted(3, pulley_radius=0.02))))
    found = Calibrated(config(tmp_path), NOW)
    assert [round(curve.gain) for curve in found.curves] == [140, 151, 140, 140]
    assert any("servo 3" in warning for warning in found.warnings)
    found.close()


def test_damaged_tensions_are_told_and_the_configured_ones_used(tmp_path: Path) -> None:
    (tmp_path / files.TENSION).write_text("{", encoding="utf-8")
    found = Calibrated(config(tmp_path), NOW)
    assert any("damaged" in warning for warning in found.warnings)
    assert len(found.curves) == 4
    found.close()


# Where the servos stand.


def note(directory: Path, *rounds: tuple[Any, ...], known: dict[int, int] | None = None) -> dict[int, int]:
    async def main() -> None:
        log = files.ParkingLog(str(directory), known or {})
        for states in rounds:
            log.note(states)
        log.close(rounds[-1])

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())
    return files.parked(str(directory))


def test_servos_that_stand_are_noted_and_those_that_turn_or_are_lost_are_not(tmp_path: Path) -> None:
    one, two, three, four = SERVOS
    states = (
        dataclasses.replace(one, position=5000),
        dataclasses.replace(two, position=6000, speed=500.0),
        dataclasses.replace(three, position=7000, turns_lost=True),
        dataclasses.replace(four, position=8000, silent=True),
    )
    assert note(tmp_path, states, known={2: 1, 3: 2}) == {1: 5000, 2: 1, 3: 2}


def test_a_directory_that_cannot_be_written_costs_nothing_else(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("", encoding="utf-8")
    assert note(blocked / "below", SERVOS) == {}
    assert list(tmp_path.iterdir()) == [blocked]
