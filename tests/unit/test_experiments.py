"""The paper's experiments: their laws, what they say, and the files that they write."""

import csv
import itertools
import json
import math
import re
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arm_companion.__main__ import main
from arm_companion.arm.model import HoldKind
from arm_companion.arm.parameters import Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import Config
from arm_companion.experiments import case, perching, stiffness_test
from arm_companion.geometry import so3

TABLES = json.loads((Path(__file__).parents[1] / "data" / "rod_reference.json").read_text(encoding="utf-8"))
FLAT = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def curves() -> list[stiffness_test.Curve]:
    return stiffness_test.run(case.arm(Config()), cycles=1)


@pytest.fixture(scope="module")
def travels() -> list[perching.Travel]:
    return perching.run(case.arm(Config()), step=5e-4)


# --- one case ---


def test_goals_are_the_same_for_either_kind_of_guide() -> None:
    smooth, disks = (case.arm(Config(), guides) for guides in Guides)
    assert np.array_equal(case.goals(smooth, 40, 10), case.goals(disks, 40, 10))
    bent = RodModel(disks).bend_for_pull(case.goals(disks, 60))
    assert 60.0 < math.degrees(math.hypot(*bent)) < 60.1


def test_k_psi_is_the_second_derivative_of_the_potential() -> None:
    """V = E + sum tau^2 / 2k - w . p of an arc, by central differences in theta and delta, under load."""
    P = case.arm(Config())
    model = RodModel(P)
    theta, delta = 0.7, 0.4
    force = np.array((0.03, -0.02, 0.05))
    pull = case.goals(P, math.degrees(theta), math.degrees(delta))
    solution = model.free(pull, FLAT)  # an arc: unloaded
    loaded = np.concatenate((force, np.zeros(3)))

    def potential(t: float, d: float) -> float:
        u = t * np.array((math.cos(d), math.sin(d)))
        tau = P.T0 + P.k_T * (pull - P.H @ u)
        chord = P.L / t * np.array((math.cos(d) * (1 - math.cos(t)), math.sin(d) * (1 - math.cos(t)), math.sin(t)))
        return float(P.EI / (2 * P.L) * t * t + (tau**2 / (2 * P.k_T)).sum() - force @ chord)

    h = 1e-4
    steps = ((h, 0.0), (0.0, h))
    numeric = np.empty((2, 2))
    for i, j in itertools.product(range(2), range(2)):
        (a, b), (c, d) = steps[i], steps[j]
        numeric[i, j] = (
            potential(theta + a + c, delta + b + d)
            - potential(theta + a - c, delta + b - d)
            - potential(theta - a + c, delta - b + d)
            + potential(theta - a - c, delta - b - d)
        ) / (4 * h * h)

    class Loaded:
        bend, tension, tip_wrench = solution.bend, solution.tension, loaded

    assert np.allclose(case.k_psi(Loaded, P), numeric, atol=2e-6)  # type: ignore[arg-type]


def test_the_clamp_catches_the_tip_before_the_base_turns() -> None:
    """The free tip hangs in the field as it was then, and stays where it was in the world."""
    P = case.arm(Config())
    R = so3.from_rpy(0.0, 0.1, 0.0)
    now = np.array((0.0, 0.0, 9.81))
    asked = case.Case(RodModel(P), case.goals(P, 30), now)
    before = case.Case(asked.model, asked.pull, R @ now).free()
    held = asked.held((0.001, 0.0, 0.002), base_turn=(0.0, 0.1, 0.0))
    assert np.allclose(held.tip_position, R.T @ (before.tip_position - (0.001, 0.0, 0.002)), atol=1e-9)
    assert np.allclose(held.tip_rotation, R.T @ before.tip_rotation, atol=1e-7)


# --- the stiffness test ---


def test_a_cycle_loads_and_unloads_in_equal_steps() -> None:
    once = list(stiffness_test.loads(0.2, 3, 1))
    assert [force for _, _, force in once] == pytest.approx([0.2, 0.4, 0.6, 0.4, 0.2, 0.0])
    assert [loading for _, loading, _ in once] == [True] * 3 + [False] * 3
    assert [cycle for cycle, _, _ in stiffness_test.loads(0.2, 3, 2)] == [1] * 6 + [2] * 6


def test_it_agrees_with_the_reference(curves: list[stiffness_test.Curve]) -> None:
    for row in TABLES["stiffness_test"]:
        curve = next(c for c in curves if c.bend_deg == row["theta0_deg"] and c.inward is (row["dir"] == "inward"))
        reading = next(r for r in curve.readings if r.loading and r.force == pytest.approx(row["F"]))
        assert np.allclose(reading.shift, (1e-3 * row["dx"], 0, 1e-3 * row["dz"]), atol=2e-6)
        assert np.allclose(reading.tension, row["tau"], atol=1e-5)


def test_without_friction_unloading_retraces_loading(curves: list[stiffness_test.Curve]) -> None:
    for curve in curves:
        assert curve.hysteresis < 1e-8
        assert curve.readings[-1].deflection < 1e-8
        up = [r.deflection for r in curve.readings if r.loading]
        assert all(b > a for a, b in itertools.pairwise(up))


def test_a_straight_arm_gives_the_same_both_ways(curves: list[stiffness_test.Curve]) -> None:
    inward, outward = (next(c for c in curves if c.bend_deg == 0 and c.inward is side) for side in (True, False))
    for a, b in zip(inward.readings, outward.readings, strict=True):
        assert a.shift[0] == pytest.approx(-b.shift[0], abs=1e-12)
        assert a.deflection == pytest.approx(b.deflection)


def test_initial_stiffness_is_the_limit_of_a_small_load() -> None:
    curve = next(iter(stiffness_test.run(case.arm(Config()), bends_deg=[30], step=1e-4, steps=1, cycles=1)))
    assert curve.stiffness == pytest.approx(curve.initial, rel=1e-4)


def test_the_findings_follow_from_the_numbers(curves: list[stiffness_test.Curve]) -> None:
    small, inward, outward, hysteresis = stiffness_test.findings(curves, 0.0)
    assert "agrees with the paper" in small
    assert "differs from the paper: up to 2.3 % softer than straight at 15, 30, 45 deg" in inward
    assert "agrees with the paper" in outward
    assert "none" in hysteresis


def test_friction_parts_loading_from_unloading_and_closes_its_loops() -> None:
    curves = stiffness_test.run(case.arm(Config()), bends_deg=[45], mu=0.2, cycles=3)
    for curve in curves:
        assert not curve.refusal
        assert 1e-4 < curve.hysteresis < 3e-3
        second, third = ([r.deflection for r in curve.readings if r.cycle == cycle] for cycle in (2, 3))
        assert np.allclose(second, third, atol=1e-6)
        # an arm that comes back lags behind: it is still bent
        up, down = (
            next(r for r in curve.readings if r.cycle == 1 and r.loading is way and r.force == pytest.approx(0.5886))
            for way in (True, False)
        )
        assert down.deflection > up.deflection
    assert "apart" in stiffness_test.findings(curves, 0.2)[-1]


# --- perching ---


def test_the_carrier_feels_a_smooth_rise_and_fall(travels: list[perching.Travel]) -> None:
    for travel in travels:
        assert not travel.refusal
        force = [float(np.linalg.norm(s.force)) for s in travel.samples]
        top = len(force) // 2
        assert all(b > a for a, b in itertools.pairwise(force[: top + 1]))
        assert np.allclose(force, force[::-1], atol=1e-6)
        assert travel.mismatch < 1e-6
        assert travel.samples[-1].time == pytest.approx(2 * 0.01 / perching.SPEED)
        assert max(abs(s.tension[0] - travel.samples[0].tension[0]) for s in travel.samples) < 1e-6


def test_the_x_travel_agrees_with_the_reference(travels: list[perching.Travel]) -> None:
    curve = next(c for c in TABLES["perching"] if c["bc"] == "clamp" and c["dir"] == "x+" and not c["g"])
    for point in curve["points"]:
        sample = next(s for s in travels[0].samples if s.travel == pytest.approx(1e-3 * point["d"], abs=1e-9))
        assert np.allclose(sample.force, point["N0"], atol=1e-3)
        assert np.allclose(sample.torque, point["M0"], atol=1e-5)


def test_force_and_torque_balance_what_the_vise_exerts(travels: list[perching.Travel]) -> None:
    """Without weight the carrier feels the vise's force, and its moment moved from tip to base."""
    model = RodModel(case.arm(Config()))
    tip = case.Case(model, case.goals(model.parameters, perching.BEND_DEG), FLAT).free().tip_position
    for travel, axis in zip(travels, (0, 2), strict=True):
        for s in travel.samples[::7]:
            lever = tip - s.travel * np.eye(3)[axis]
            assert np.allclose(s.force, s.tip_force, atol=1e-9)
            assert np.allclose(s.torque, s.tip_moment + np.cross(lever, s.tip_force), atol=1e-6)


def test_away_from_the_vise_it_ends_taut_and_says_so() -> None:
    (travel,) = perching.run(case.arm(Config()), travels=[("z", -0.01)])
    assert travel.refusal.startswith("at -")
    assert 0 < travel.samples[-1].taut_margin < 1e-3
    assert travel.largest_force > 50
    assert any("it ends at -" in line for line in perching.findings([travel]))


def test_pinned_is_softer_than_clamped_and_moves_the_tendons(travels: list[perching.Travel]) -> None:
    (pinned,) = perching.run(case.arm(Config()), travels=[("x", 0.01)], kind=HoldKind.PINNED, step=1e-3)
    assert pinned.largest_force < travels[0].largest_force
    assert all(np.allclose(s.tip_moment, 0, atol=1e-8) for s in pinned.samples)
    assert "slide" in perching.findings([pinned])[-1]
    assert "no hysteresis" in perching.findings(travels)[-1]


def test_an_absurd_travel_or_load_ends_where_the_arm_does_and_takes_no_memory_for_the_rest() -> None:
    """A million millimetres were a list of four million places before the first was looked at."""
    arm = case.arm(Config())
    tracemalloc.start()
    try:
        (travel,) = perching.run(arm, travels=[("x", 1e3)], step=1e-3)
        curves = stiffness_test.run(arm, bends_deg=(0.0,), steps=1_000_000, cycles=1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert travel.refusal
    assert all(curve.refusal for curve in curves)
    assert peak < 20e6


# --- files ---


def test_commands_write_csv_figure_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, figure = tmp_path / "out" / "test.csv", tmp_path / "out" / "test.png"
    words = ["--csv", str(table), "--figure", str(figure), "--json"]
    assert main(["model", "stiffness-test", "--bends-deg", "0", "30", "--cycles", "1", *words]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [(c["theta_deg"], c["direction"]) for c in answer["curves"]] == [
        (0, "inward"),
        (30, "inward"),
        (0, "outward"),
        (30, "outward"),
    ]
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == sum(len(c["readings"]) for c in answer["curves"]) == 4 * 11
    assert float(rows[5]["deflection_m"]) == answer["curves"][0]["readings"][5]["deflection_m"]
    assert figure.read_bytes().startswith(b"\x89PNG")

    assert main(["model", "perching", "--x-mm", "2", "--z-mm", "-3", *words]) == 2  # taut: shown as far as it goes
    out, err = capsys.readouterr()
    x, z = json.loads(out)["travels"]
    assert (x["axis"], x["refusal"], z["axis"]) == ("x", None, "z")
    assert "ends early: z at -" in err
    assert err.count("\n") == 1
    with table.open(encoding="utf-8", newline="") as stream:
        assert len(list(csv.DictReader(stream))) == len(x["samples"]) + len(z["samples"])
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_the_tables_show_one_number_where_the_branches_coincide(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["model", "stiffness-test", "--bends-deg", "0", "--cycles", "1"]) == 0
    out = capsys.readouterr().out
    assert "68.542" in out
    assert " / " not in out.split("\n", 1)[1].split("outward")[0]


def test_the_documentations_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parents[2] / "docs" / "model.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    found: dict[str, Any] = {}
    exec(example, found)
    assert found["held"].base_wrench[2] == pytest.approx(-3.675, abs=1e-3)
    assert capsys.readouterr().out.count("\n") > 5
