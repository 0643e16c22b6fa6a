"""`arm-companion model`: the JSON contract, refusals, and agreement with numbers that other solvers found."""

import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arm_companion.__main__ import main
from arm_companion.arm.parameters import ArmParameters
from arm_companion.config import load as load_config

TABLES = json.loads((Path(__file__).parents[1] / "data" / "rod_reference.json").read_text(encoding="utf-8"))
L = 0.25
KEYS = {
    "tip_position_m": (3,),
    "tip_rotation": (3, 3),
    "tension_n": (4,),
    "base_force_n": (3,),
    "base_moment_nm": (3,),
    "tip_force_n": (3,),
    "tip_moment_nm": (3,),
    "stiffness_n_per_m": (3, 3),
    "compliance": (6, 6),
    "k_psi": (2, 2),
    "converged": (),
    "residual": (),
    "solve_time_s": (),
}


class Asker:
    """Runs the command in this process and reads what it printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self.capsys = capsys

    def code(self, *words: object) -> tuple[int, str, str]:
        try:
            code = main(["model", *map(str, words)])
        except SystemExit as stop:
            code = int(stop.code or 0)
        out, err = self.capsys.readouterr()
        return code, out, err

    def json(self, *words: object) -> dict[str, Any]:
        code, out, err = self.code(*words, "--json")
        assert (code, err) == (0, "")
        return {key: np.array(value) for key, value in json.loads(out).items()}

    def refusal(self, *words: object) -> str:
        code, out, err = self.code(*words)
        assert (code, out) == (2, "")
        assert err.count("\n") == 1
        assert err.endswith("\n")
        return err


@pytest.fixture
def ask(capsys: pytest.CaptureFixture[str]) -> Asker:
    return Asker(capsys)


def gravity(row: dict[str, Any]) -> str:
    return "--gravity" if row["g"] else "--no-gravity"


def off(value: Any, truth: Any) -> float:
    return float(np.linalg.norm(np.subtract(value, truth)) / np.linalg.norm(truth))


# --- the contract ---


@pytest.mark.parametrize("action", ["pose", "tensions", "deflect", "clamp", "stiffness"])
def test_every_command_prints_every_key_and_nothing_else(ask: Asker, action: str) -> None:
    answer = ask.json(action, "--theta-deg", 20, "--delta-deg", 50, "--gravity", "--guides", "disks")
    assert {key: value.shape for key, value in answer.items()} == KEYS
    assert answer["converged"]
    assert 0 <= answer["residual"] < 1e-4
    assert 0 < answer["solve_time_s"] < 5
    assert np.allclose(answer["tip_rotation"].T @ answer["tip_rotation"], np.eye(3))


def test_a_straight_arm_answers_in_finite_numbers(ask: Asker) -> None:
    _, out, _ = ask.code("stiffness", "--json")
    answer = json.loads(out, parse_constant=pytest.fail)  # NaN and Infinity are no JSON
    K = np.array(answer["stiffness_n_per_m"])
    assert np.allclose((K[2], K[:, 2]), 0)  # it cannot give along z
    assert K[0, 0] == pytest.approx(K[1, 1]) == pytest.approx(1 / answer["compliance"][0][0])


@pytest.mark.parametrize("action", ["pose", "tensions", "deflect", "clamp", "stiffness"])
def test_without_json_a_table_for_people(ask: Asker, action: str) -> None:
    code, out, err = ask.code(action, "--theta-deg", 30)
    assert (code, err) == (0, "")
    assert "tip position" in out
    assert "63.968" in out
    assert ("servo, N m" in out) is (action == "tensions")


def test_numbers_may_be_negative_in_every_notation(ask: Asker) -> None:
    plain = ask.json("deflect", "--theta-deg", -20, "--force", "-0.05", "0", "-.002")
    other = ask.json("deflect", "--theta-deg", "-2e1", "--force", "-5e-2", "-0e-5", "-2E-3")
    assert np.allclose(plain["tip_position_m"], other["tip_position_m"], atol=1e-15)
    assert plain["tip_position_m"][0] < 0


def test_goals_may_be_given_instead_of_a_bend(ask: Asker) -> None:
    row = next(r for r in TABLES["tensions"] if r["T0"] == 4.0 and r["theta_deg"] == 30 and r["delta_deg"] == 45)
    by_bend = ask.json("pose", "--theta-deg", 30, "--delta-deg", 45)
    by_goals = ask.json("pose", "--pull-m", *row["pull"])
    assert np.allclose(by_bend["tip_position_m"], by_goals["tip_position_m"], atol=1e-8)


def test_settings_change_the_arm(ask: Asker) -> None:
    longer = ask.json("pose", "--set", "arm.length_m=0.4")
    assert np.allclose(longer["tip_position_m"], (0, 0, 0.4))
    softer = ask.json("stiffness", "--set", "arm.backbone.youngs_modulus_pa=30e9")
    stock = ask.json("stiffness")
    assert softer["stiffness_n_per_m"][0, 0] < 0.6 * stock["stiffness_n_per_m"][0, 0]


def test_gravity_is_off_unless_asked_for_and_an_attitude_asks(ask: Asker) -> None:
    assert np.allclose(ask.json("pose")["base_force_n"], 0)
    hanging = ask.json("pose", "--gravity")["base_force_n"]
    assert np.allclose(hanging, (0, 0, 0.36044), atol=1e-5)
    level = ask.json("pose", "--attitude-deg", 0, 0, 77)["base_force_n"]
    assert np.allclose(level, hanging)
    rolled = ask.json("pose", "--attitude-deg", 90, 0, 0)["base_force_n"]
    assert np.allclose(rolled, (0, 0.36044, 0), atol=1e-5)
    nose_up = ask.json("pose", "--attitude-deg", 0, 30, 0)["base_force_n"]
    assert np.allclose(nose_up, 0.36044 * np.array((-0.5, 0, math.cos(math.pi / 6))), atol=1e-5)
    assert np.allclose(ask.json("pose", "--attitude-deg", 90, 0, 0, "--no-gravity")["base_force_n"], 0)


def test_a_follower_turns_with_the_tip_and_a_dead_force_does_not(ask: Asker) -> None:
    dead = ask.json("deflect", "--theta-deg", 45, "--force", 0.5, 0, 0)
    assert np.allclose(dead["tip_force_n"], (0.5, 0, 0))
    follower = ask.json("deflect", "--theta-deg", 45, "--force", 0.5, 0, 0, "--follower")
    assert np.allclose(follower["tip_force_n"], follower["tip_rotation"] @ (0.5, 0, 0))


def test_a_payload_is_a_dead_force_and_a_mass_on_the_carrier(ask: Asker) -> None:
    carried = ask.json("deflect", "--theta-deg", 30, "--gravity", "--payload-kg", 0.05)
    pushed = ask.json("deflect", "--theta-deg", 30, "--gravity", "--force", 0, 0, 0.05 * 9.81)
    assert np.allclose(carried["tip_position_m"], pushed["tip_position_m"], atol=1e-9)
    assert np.allclose(carried["base_force_n"], pushed["base_force_n"], atol=1e-9)


def test_a_clamp_that_only_takes_hold_exerts_nothing(ask: Asker) -> None:
    free = ask.json("pose", "--theta-deg", 30)
    held = ask.json("clamp", "--theta-deg", 30)
    assert np.allclose(held["tip_position_m"], free["tip_position_m"])
    assert np.allclose(held["base_force_n"], 0, atol=1e-6)


def test_base_turns_either_way_mirror_each_other(ask: Asker) -> None:
    left, right = (ask.json("clamp", "--theta-deg", 30, "--base-turn-deg", 0, 0, yaw) for yaw in (4, -4))
    assert abs(left["base_moment_nm"][2]) > 1e-3
    assert np.allclose(left["base_force_n"], right["base_force_n"] * (1, -1, 1), atol=1e-6)
    assert np.allclose(left["base_moment_nm"], right["base_moment_nm"] * (-1, 1, -1), atol=1e-6)


# --- what is refused ---


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["clamp", "--theta-deg", 30, "--base-move-mm", 0, 0, -10], "distance of the held section"),
        (["deflect", "--theta-deg", 30, "--force", 400, 0, 300], "no equilibrium"),
        (["pose", "--pull-m", 0.01, 0.0], "2 goals for 4 tendons"),
        (["pose", "--pull-m", 0, 0, 0, 0, "--theta-deg", 5], "not both"),
        (["pose", "--theta-deg", "nan"], "finite"),
        (["pose", "--theta-deg", "1e308"], "up to 1e+09"),
        (["pose", "--theta-deg", "1e9"], "too sharp"),
        (["pose", "--theta-deg", 900], "a bend of 900 deg is too sharp: at 716 deg in that plane nothing is left of"),
        (["clamp", "--theta-deg", 1100, "--delta-deg", 45], "a bend of 1100 deg is too sharp: at 1013 deg"),
        (["perching", "--theta-deg", -900], "a bend of 900 deg is too sharp"),
        (["deflect", "--force", "1e9", 0, 0], "no equilibrium"),
        (["clamp", "--force", 1, 0, 0], "unrecognized arguments: --force 1 0 0"),
        (["clamp", "--base-move-mm", 0, 0, 10], "nothing says which way"),
        (["deflect", "--force", 1, "inf", 0], "finite"),
        (["deflect", "--force", 1, 0], "expected 3 arguments"),
        (["deflect", "--force", 1, 0, "up"], "invalid float"),
        (["pose", "--pretension-n", -1], "cannot push"),
        (["deflect", "--payload-kg", -1], "negative"),
        (["pose", "--guides", "rings"], "invalid choice"),
        (["stiffness-test", "--cycles", 0], "start at 1"),
        (["stiffness-test", "--friction", -0.1], "negative"),
        (["perching", "--x-mm", 0, "--z-mm", 0], "nothing to do"),
        (["perching", "--speed-mm-s", 0], "starts at"),
        (["perching", "--speed-mm-s", 1e-320], "starts at"),
    ],
)
def test_refusals_are_one_line_and_exit_code_two(ask: Asker, words: list[object], reason: str) -> None:
    assert reason in ask.refusal(*words)


def test_a_bad_configuration_is_not_a_refused_case(ask: Asker) -> None:
    code, _, err = ask.code("pose", "--set", "arm.length_m=-1")
    assert code == 78
    assert "arm.length_m" in err


def test_a_figure_without_matplotlib_is_refused_before_the_work(ask: Asker, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name))
    assert "arm-companion[sim]" in ask.refusal("perching", "--figure", "perching.png")


def test_a_file_that_cannot_be_written_is_named(ask: Asker, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, _, err = ask.code("perching", "--x-mm", 1, "--z-mm", 0, "--csv", tmp_path / "file" / "out.csv")
    assert code == 1
    assert "out.csv" in err or "file" in err


# --- the reference tables, through the command line ---


@pytest.mark.parametrize("row", TABLES["tensions"][::3])
def test_tensions(ask: Asker, row: dict[str, Any]) -> None:
    bend = ("--theta-deg", row["theta_deg"], "--delta-deg", row["delta_deg"], "--pretension-n", row["T0"])
    answer = ask.json("tensions", *bend)
    assert np.allclose(answer["tension_n"], row["tau_bvp"], atol=5e-6)
    assert np.linalg.norm(answer["tip_position_m"] - row["tip_p"]) < 1e-6 * L


@pytest.mark.parametrize("load", [(), ("--force", 1, 0, 0), ("--gravity", "--payload-kg", 0.05)])
def test_the_least_tensions_hold_the_loaded_arm_where_it_is(ask: Asker, load: tuple[object, ...]) -> None:
    arm = ArmParameters.of(load_config("zhao2022.toml").arm)
    code, text, _ = ask.code("tensions", "--theta-deg", 30, *load)
    assert code == 0
    table = np.array([line.split()[1:] for line in text.splitlines() if line[:1] in set("1234")], dtype=float)
    goals, tension, least = table[:, 1] * 1e-3, table[:, 2], table[:, 4]
    before = ask.json("tensions", "--theta-deg", 30, *load)
    eased = ask.json("tensions", "--pull-m", *(goals + (least - tension) / arm.k_T), *load)
    assert np.allclose(eased["tension_n"], least, atol=0.01)
    assert eased["tip_position_m"] == pytest.approx(before["tip_position_m"], abs=2e-5)


@pytest.mark.parametrize("row", [r for r in TABLES["stiffness_test"] if r["F"] in (0.3924, 0.981)])
def test_the_papers_stiffness_test(ask: Asker, row: dict[str, Any]) -> None:
    arm = ("--theta-deg", row["theta0_deg"], "--pretension-n", row["T0"], gravity(row))
    force = row["F"] if row["dir"] == "inward" else -row["F"]
    loaded = ask.json("deflect", *arm, "--force", force, 0, 0, "--follower")
    moved = loaded["tip_position_m"] - ask.json("pose", *arm)["tip_position_m"]
    assert np.allclose(moved, (1e-3 * row["dx"], 0, 1e-3 * row["dz"]), atol=1e-5 * L)
    assert np.allclose(loaded["tension_n"], row["tau"], atol=1e-5)
    assert off(loaded["base_force_n"], row["N0"]) < 1e-5
    assert off(loaded["base_moment_nm"], row["M0"]) < 1e-5


@pytest.mark.parametrize("row", TABLES["stiffness"])
def test_stiffness(ask: Asker, row: dict[str, Any]) -> None:
    answer = ask.json("stiffness", "--theta-deg", row["theta_deg"])
    C = np.array(row["C6_numeric"])
    assert np.allclose(answer["compliance"], C, atol=1e-6 * np.abs(C).max())
    assert np.allclose(answer["k_psi"], row["K_psi_corrected"], atol=1e-4)
    direction = answer["tip_rotation"][:, 0]
    assert 1 / (direction @ answer["compliance"][:3, :3] @ direction) == pytest.approx(row["k_xe_truth"], rel=1e-5)


def test_stiffness_inverts_the_compliance_of_a_bent_arm(ask: Asker) -> None:
    answer = ask.json("stiffness", "--theta-deg", 30)
    assert np.allclose(answer["stiffness_n_per_m"] @ answer["compliance"][:3, :3], np.eye(3), atol=1e-8)


@pytest.mark.parametrize(
    "words",
    [
        ("clamp", "--base-move-mm", 0, 0, 12),  # only the clamp keeps it from buckling
        ("deflect", "--follower", "--force", 1, 0.5, 0.3),  # no potential: unsymmetric
    ],
)
def test_stiffness_inverts_the_compliance_of_a_loaded_arm(ask: Asker, words: tuple[object, ...]) -> None:
    answer = ask.json(*words, "--theta-deg", 30)
    unit = answer["stiffness_n_per_m"] @ answer["compliance"][:3, :3]
    assert np.allclose(unit, np.eye(3), atol=1e-9)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="counts threads by /proc")
def test_small_matrices_take_no_threads() -> None:
    program = (
        "import os\nfrom arm_companion.__main__ import main\nmain(['model', 'pose', '--json'])\n"
        "print(len(os.listdir('/proc/self/task')))"
    )
    bare = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", program], env=bare, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "1"


@pytest.mark.parametrize("curve", TABLES["perching"], ids=lambda c: f"{c['bc']} {c['dir']} {c['g']:g}")
def test_perching(ask: Asker, curve: dict[str, Any]) -> None:
    sign = 1 if curve["dir"][1] == "+" else -1
    tip = {"clamp": "clamped", "pinned": "pinned"}[curve["bc"]]
    for point in curve["points"][2::5]:
        move = (sign * point["d"], 0, 0)
        answer = ask.json("clamp", "--theta-deg", 30, "--base-move-mm", *move, "--tip", tip, gravity(curve))
        assert off(answer["base_force_n"], point["N0"]) < 1e-4
        assert off(answer["base_moment_nm"], point["M0"]) < 1e-4
        assert off(answer["tip_force_n"], point["tip_F"]) < 1e-4
        assert np.allclose(answer["tip_moment_nm"], point["tip_M"], atol=1e-5)
        assert np.allclose(answer["tension_n"], point["tau"], atol=5e-5)


@pytest.mark.parametrize("row", TABLES["free"][::2])
def test_random_loads_in_three_dimensions(ask: Asker, row: dict[str, Any]) -> None:
    arm = ("--pull-m", *row["pull"], "--pretension-n", row["T0"], gravity(row))
    answer = ask.json("deflect", *arm, "--force", *row["F"], "--moment", *row["M"])
    assert np.linalg.norm(answer["tip_position_m"] - row["p"]) < 1e-5 * L
    assert np.allclose(answer["tip_rotation"].ravel(), row["R"], atol=1e-5)
    assert np.allclose(answer["tension_n"], row["tau"], atol=1e-4)
    assert off(answer["base_moment_nm"], row["M0"]) < 1e-4


@pytest.mark.parametrize("row", [r for r in TABLES["clamp"] if not r["g"]])
def test_a_base_that_moves_and_turns(ask: Asker, row: dict[str, Any]) -> None:
    arm = ("--pull-m", *row["pull"], "--pretension-n", row["T0"])
    free = ask.json("pose", *arm)
    # The tip stays in the world: T_then_now = T_free T_given^-1 is how the base has moved.
    R = free["tip_rotation"] @ np.reshape(row["tip_R"], (3, 3)).T
    move = 1e3 * (free["tip_position_m"] - R @ row["tip_p"])
    turn = np.degrees((math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])))
    answer = ask.json("clamp", *arm, "--base-move-mm", *move, "--base-turn-deg", *turn)
    assert off(answer["base_force_n"], row["N0"]) < 2e-4
    assert off(answer["base_moment_nm"], row["M0"]) < 2e-4


@pytest.mark.parametrize("row", TABLES["payload"][4::3])
def test_payload(ask: Asker, row: dict[str, Any]) -> None:
    answer = ask.json("deflect", "--theta-deg", row["theta"], "--gravity", "--payload-kg", row["m"])
    assert answer["base_moment_nm"][1] == pytest.approx(row["M0_true"], rel=1e-5)
    assert np.linalg.norm(answer["tip_position_m"] - row["tip"]) < 1e-6 * L


@pytest.mark.parametrize("row", TABLES["disks"][::3])
def test_ten_real_guides_in_mujoco(ask: Asker, row: dict[str, Any]) -> None:
    moved = {}
    for guides in ("continuous", "disks"):
        arm = ("--theta-deg", row["theta"], "--pretension-n", row["T0"], "--guides", guides)
        loaded = ask.json("deflect", *arm, "--force", 0.981, 0, 0, "--follower")
        moved[guides] = 1e3 * np.linalg.norm(loaded["tip_position_m"] - ask.json("pose", *arm)["tip_position_m"])
    assert moved["continuous"] == pytest.approx(row["d_cont"], rel=1e-5)
    assert moved["disks"] == pytest.approx(row["d_mujoco"], rel=0.005)


def test_a_bend_that_is_too_sharp_leaves_the_others_of_a_test(ask: Asker) -> None:
    code, out, err = ask.code("stiffness-test", "--bends-deg", 900, 20, "--steps", 1, "--cycles", 1)
    assert code == 2
    assert "20 deg" in out
    assert "900 deg inward: a bend of 900 deg is too sharp" in err
