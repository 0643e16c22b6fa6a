"""The rod, and where it applies the arc, against numbers that other solvers found (tests/data/rod_reference.json)."""

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from arm_companion.arm import allocation, arc, paper, statics, stiffness
from arm_companion.arm.model import Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import ArmConfig
from arm_companion.geometry.se3 import Pose

TABLES = json.loads((Path(__file__).parents[1] / "data" / "rod_reference.json").read_text())
L = 0.25
TIP = 5e-4 * L  # the targets of the design: 0.05 % of the length, 0.5 % of a wrench
WRENCH = 5e-3


@functools.cache
def rod(T0=4.0, guides=Guides.CONTINUOUS):
    return RodModel(ArmParameters.of(ArmConfig(), guides).scaled(T0=T0 / 4))


def off(value, reference):
    """Relative distance of two vectors."""
    return np.linalg.norm(np.subtract(value, reference)) / np.linalg.norm(reference)


@pytest.mark.parametrize("row", TABLES["tensions"])
def test_tensions_of_the_unloaded_arm(row):
    P = rod(row["T0"]).parameters
    u = paper.bend_of(*np.radians((row["theta_deg"], row["delta_deg"])))
    assert np.allclose(statics.pull_for_bend(P, u), row["pull"], atol=1e-8)
    reached = statics.bend_for_pull(P, row["pull"])
    assert np.allclose(statics.stretch_tension(P, reached, row["pull"]), row["tau_bvp"], atol=2e-6)
    assert np.allclose(allocation.allocate(P, u, tension_min=0.5), row["tau_min_tension"], atol=1e-7)
    solution = rod(row["T0"]).free(row["pull"], (0.0, 0.0, 0.0))
    assert np.allclose(solution.tip_position, row["tip_p"], atol=1e-6 * L)
    assert np.allclose(solution.tension, row["tau_bvp"], atol=2e-6)
    assert np.allclose(solution.base_wrench, 0, atol=1e-12)


@pytest.mark.parametrize("row", TABLES["stiffness_test"])
def test_stiffness_test_of_the_paper(row):
    model, theta = rod(row["T0"]), np.radians(row["theta0_deg"])
    force = row["F"] if row["dir"] == "inward" else -row["F"]
    pull = model.pull_for_bend((theta, 0.0))
    solution = model.free(pull, (0.0, 0.0, row["g"]), follower_wrench=(force, 0, 0, 0, 0, 0))
    moved = solution.tip_position - arc.tip_position((theta, 0.0), L)
    assert np.allclose(moved, (row["dx"] * 1e-3, 0, row["dz"] * 1e-3), atol=0.1 * TIP)
    assert np.allclose(solution.tension, row["tau"], atol=1e-4)
    assert np.allclose(solution.base_wrench, row["N0"] + row["M0"], atol=1e-5)


@pytest.mark.parametrize("row", TABLES["free"])
def test_free_tip_in_three_dimensions(row):
    solution = rod(row["T0"]).free(row["pull"], (0.0, 0.0, row["g"]), row["F"] + row["M"])
    assert np.linalg.norm(solution.tip_position - row["p"]) < 0.1 * TIP
    assert np.allclose(solution.tip_rotation.ravel(), row["R"], atol=1e-4)
    assert np.allclose(solution.tension, row["tau"], atol=1e-3)
    assert off(solution.base_wrench[:3], row["N0"]) < 0.1 * WRENCH
    assert off(solution.base_wrench[3:], row["M0"]) < 0.1 * WRENCH


@pytest.mark.parametrize("row", TABLES["clamp"])
def test_clamped_tip_in_three_dimensions(row):
    hold = Hold(L, Pose(np.reshape(row["tip_R"], (3, 3)), np.array(row["tip_p"])))
    solution = rod(row["T0"]).held(row["pull"], hold, (0.0, 0.0, row["g"]))
    assert off(solution.base_wrench[:3], row["N0"]) < 0.1 * WRENCH
    assert off(solution.base_wrench[3:], row["M0"]) < 0.1 * WRENCH
    assert np.allclose(solution.tension, row["tau"], atol=1e-3)


@pytest.mark.parametrize("curve", TABLES["perching"], ids=lambda c: f"{c['bc']} {c['dir']} g={c['g']}")
@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
def test_perching_benchmark_of_the_paper(curve, warm):
    model, gravity = rod(), (0.0, 0.0, curve["g"])
    pull = model.pull_for_bend((np.radians(30), 0.0))
    kind = HoldKind.CLAMPED if curve["bc"] == "clamp" else HoldKind.PINNED
    hold = model.free(pull, gravity).hold(L, kind)
    towards = np.eye(3)["xyz".index(curve["dir"][0])] * (1 if curve["dir"][1] == "+" else -1)
    solution = None
    for point in curve["points"]:
        seen = hold.seen_from(Pose(np.eye(3), -1e-3 * point["d"] * towards))
        solution = model.held(pull, seen, gravity, start=solution if warm else None)
        assert np.allclose(solution.tension, point["tau"], atol=1e-4)
        if point["d"] > 0:
            assert off(solution.base_wrench[:3], point["N0"]) < 0.1 * WRENCH
            assert off(solution.base_wrench[3:], point["M0"]) < 0.1 * WRENCH
            assert off(solution.tip_wrench[:3], point["tip_F"]) < 0.1 * WRENCH
            assert np.allclose(solution.tip_wrench[3:], point["tip_M"], atol=1e-5)


@pytest.mark.parametrize("row", TABLES["payload"])
def test_payload(row):
    model = rod()
    pull = model.pull_for_bend((np.radians(row["theta"]), 0.0))
    solution = model.free(pull, (0.0, 0.0, 9.81), payload=Payload(row["m"]))
    assert np.allclose(solution.tip_position, row["tip"], atol=0.1 * TIP)
    assert np.allclose(solution.base_wrench[3:], (0, row["M0_true"], 0), atol=1e-6)


@pytest.mark.parametrize("row", TABLES["stiffness"])
def test_tip_compliance_and_what_the_formulas_give(row):
    model, theta = rod(), np.radians(row["theta_deg"])
    P, u = model.parameters, np.array((theta, 0.0))
    C = model.free(model.pull_for_bend(u), (0.0, 0.0, 0.0)).compliance
    assert np.allclose(C, row["C6_numeric"], atol=1e-5)
    assert np.allclose(C, C.T, atol=1e-12)
    x_e = arc.tip_rotation(u)[:, 0]
    assert stiffness.stiffness_along(C, x_e) == pytest.approx(row["k_xe_truth"], rel=1e-5)
    assert stiffness.stiffness_along(C, (0, 1, 0)) == pytest.approx(row["k_y_truth"], rel=1e-5)
    tau = statics.symmetric_tension(P, u, 4.0)
    arcs = stiffness.tip_compliance(P, u, tau)
    assert stiffness.stiffness_along(arcs, x_e) == pytest.approx(row["k_xe_pcc"], rel=1e-4)
    assert stiffness.stiffness_along(arcs, (0, 1, 0)) == pytest.approx(row["k_y_pcc"], rel=1e-4)
    assert np.allclose(paper.configuration_stiffness(P, theta, 0.0, tau), row["K_psi_corrected"], atol=1e-4)
    printed = paper.configuration_stiffness(P, theta, 0.0, tau, printed=True)
    assert np.allclose(printed, row["K_psi_printed"], atol=1e-4)
    K_X = paper.task_stiffness(P, max(theta, 1e-6), 0.0, tau, printed=True)
    assert np.allclose(K_X[[0, 2], 0], np.array(row["KX_printed"])[[0, 2], 0], atol=2e-3)


@pytest.mark.parametrize("row", TABLES["disks"])
def test_real_disks(row):
    """Against a chain with ten real guides; without the correction it is off by up to four per cent."""
    theta = np.radians(row["theta"])
    pull = rod(row["T0"]).pull_for_bend((theta, 0.0))

    def deflection(guides):
        model = rod(row["T0"], guides)
        before = model.free(pull, (0.0, 0.0, 0.0)).tip_position
        after = model.free(pull, (0.0, 0.0, 0.0), follower_wrench=(0.981, 0, 0, 0, 0, 0)).tip_position
        return 1e3 * np.linalg.norm(after - before)

    assert deflection(Guides.CONTINUOUS) == pytest.approx(row["d_cont"], rel=1e-4)
    assert deflection(Guides.DISKS) == pytest.approx(row["d_mujoco"], rel=4e-3)
