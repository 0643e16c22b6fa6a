"""Several segments from the configuration file: what they are made of, what the commands say, and who refuses them."""

import asyncio
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arm_companion.__main__ import main
from arm_companion.app import Daemon, open_configured
from arm_companion.arm.parameters import ArmParameters, Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.clock import Clock
from arm_companion.config import Config, load
from arm_companion.errors import ConfigError
from arm_companion.supervisor import ServiceManager
from tests.unit.shooting import shoot

S_SHAPE = ("--config", "two_segments.toml", "--theta-deg", "40", "-40")


def of(text: str, tmp_path: Path) -> ArmParameters:
    path = tmp_path / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return ArmParameters.of(load(path).arm)


def test_what_a_segment_leaves_out_is_as_in_the_first(tmp_path: Path) -> None:
    P = of("[arm]\nlength_m = 0.2\ndisks = 7\n[arm.backbone]\ndiameter_m = 0.002\n[[arm.segments]]\n", tmp_path)
    assert P.segments[0] == P.segments[1]
    assert pytest.approx(0.4) == P.L
    assert [t.segment for t in P.tendons] == [0] * 4 + [1] * 4


def test_a_segment_has_its_own_geometry_backbone_mass_and_tendons(tmp_path: Path) -> None:
    text = (
        "[[arm.segments]]\nlength_m = 0.1\npitch_radius_m = 0.015\ndisks = 4\n"
        "[arm.segments.backbone]\ndiameter_m = 0.0008\n[arm.segments.mass]\nend_disk_kg = 0.002\n"
        "[arm.segments.tendons]\nangles_deg = [0, 120, 240]\npretension_n = 2\n[[arm.segments]]\nlength_m = 0.05\n"
    )
    P = of(text, tmp_path)
    first, second, third = P.segments
    assert (second.L, second.r, second.disks, second.end_mass) == (0.1, 0.015, 4, 0.002)
    assert pytest.approx(first.EI / 16) == second.EI
    assert (third.L, third.EI, third.r) == (0.05, first.EI, first.r)
    assert [t.T0 for t in P.tendons] == [4.0] * 4 + [2.0] * 3 + [4.0] * 4
    # a tendon is as long as all segments that it runs through
    assert P.tendons[4].k_T / P.tendons[0].k_T == pytest.approx(0.35 / 0.45)
    assert P.tendons[7].k_T / P.tendons[0].k_T == pytest.approx(0.35 / 0.5)
    assert P.runs[:, 0].sum() == 11
    assert P.runs[:, 2].sum() == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[arm.segments]]\nlength_m = 9\n", "arm.segments[0].length_m"),
        ("[[arm.segments]]\nradius = 1\n", "unknown key 'arm.segments[0].radius'"),
        ("[[arm.segments]]\n[arm.segments.tendons]\nangles_deg = [0, 90]\n", "at least 3"),
        ("[arm]\nsegments = 2\n", "a list"),
        ("[arm]\nsegments = [2]\n", "a table"),
    ],
)
def test_a_bad_segment_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        of(text, tmp_path)
    assert words in str(caught.value)


def test_tendons_all_on_one_side_cannot_bend_a_segment_every_way(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="segment 1"):
        of("[[arm.segments]]\n[arm.segments.tendons]\nangles_deg = [0, 20, 40]\n", tmp_path)


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["model", *words, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_opposite_bends_make_an_s(capsys: pytest.CaptureFixture[str]) -> None:
    """Two arcs, one after the other; unloaded, whatever the coupling of the tendons."""
    found = answer(capsys, "pose", *S_SHAPE)
    t, first, second = math.radians(40), 0.25, 0.2
    x = (first + second) * (1 - math.cos(t)) / t
    z = (first + second) * math.sin(t) / t
    assert np.allclose(found["tip_position_m"], (x, 0, z), atol=1e-9)
    assert np.allclose(found["tip_rotation"], np.eye(3), atol=1e-9)
    assert len(found["tension_n"]) == 8
    assert found["k_psi"] is None


def test_pulling_the_second_segment_loads_the_first(capsys: pytest.CaptureFixture[str]) -> None:
    straight = answer(capsys, "pose", "--config", "two_segments.toml", "--theta-deg", "0", "40")
    assert straight["tip_position_m"][0] == pytest.approx(0.2 * (1 - math.cos(math.radians(40))) / math.radians(40))
    # the first stays straight only because its own tendons hold against the second's
    assert straight["tension_n"][0] < 4 - 0.3
    assert straight["tension_n"][2] > 4 + 0.3


def test_a_loaded_s_holds_in_a_solver_that_shares_no_code() -> None:
    config = load("two_segments.toml")
    P = ArmParameters.of(config.arm, Guides.DISKS)
    model = RodModel(P)
    solution = model.free(model.pull_for_bend((0.7, 0.0, -0.5, 0.4)), (1.0, 0.5, 9.7), (0.1, -0.05, 0.1, 0, 0, 0.01))
    p, R, wrench, longer = shoot(P, solution)
    assert np.allclose(p, solution.tip_position, atol=1e-7)
    assert np.allclose(R, solution.tip_rotation, atol=1e-6)
    assert np.allclose(wrench, solution.tip_wrench, atol=1e-6)
    assert np.allclose(solution.detail.path_beyond(0.0), -longer, atol=1e-8)


@pytest.mark.parametrize("action", ["pose", "tensions", "deflect", "clamp", "stiffness"])
def test_every_command_takes_it(capsys: pytest.CaptureFixture[str], action: str) -> None:
    words = (*S_SHAPE, "--delta-deg", "0", "60", "--gravity", "--guides", "disks")
    found = answer(capsys, action, *words)
    assert np.shape(found["compliance"]) == (6, 6)
    assert main(["model", action, *words]) == 0
    assert "tip position" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("pose", "--theta-deg", "30", "40"), "2 bends for 1 segment"),
        (("pose", "--config", "two_segments.toml", "--theta-deg", "1", "2", "3"), "3 bends for 2 segments"),
        (("pose", *S_SHAPE, "--delta-deg", "1", "2", "3"), "3 bends for 2 segments"),
        (("pose", "--config", "two_segments.toml", "--delta-deg", "1", "2"), "2 planes for 1 bends"),
        (("pose", "--config", "two_segments.toml", "--pull-m", "0", "0", "0", "0"), "4 goals for 8 tendons"),
        (("perching", "--config", "two_segments.toml"), "one segment"),
        (("stiffness-test", "--config", "two_segments.toml"), "one segment"),
    ],
)
def test_what_does_not_fit_the_segments_is_refused(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], reason: str
) -> None:
    assert main(["model", *words]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert reason in err


def test_a_loading_test_is_for_one_segment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "stiffness", "none.csv", "--config", "two_segments.toml"]) == 2
    assert "one segment" in capsys.readouterr().err


def test_the_configuration_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "show", "--config", "two_segments.toml"]) == 0
    (segment,) = json.loads(capsys.readouterr().out)["arm"]["segments"]
    assert segment["length_m"] == 0.2
    assert segment["tendons"]["angles_deg"] == [-45, -135, -225, -315]


def daemon(config: Config) -> None:
    async def build() -> None:
        Daemon(config, open_configured(config), Clock(asyncio.get_running_loop(), 0.0), ServiceManager(""))

    asyncio.run(build())


LINK = ['links.a.url="udpin:127.0.0.1:24541"', 'links.a.role="autopilot"']


def test_the_daemon_flies_one_segment_with_a_servo_for_every_tendon() -> None:
    with pytest.raises(ConfigError, match="one segment"):
        daemon(load("two_segments.toml", LINK))
    three = load("zhao2022.toml", [*LINK, "arm.tendons.angles_deg=[0, 120, 240]"])
    assert ArmParameters.of(three.arm).n == 3  # research needs no servos
    with pytest.raises(ConfigError, match="4 entries for 3 tendons"):
        daemon(three)
