"""`python -m tests.bench.figure`: draws docs/images/model_arc_rod_reference.png, arc against rod against reference."""

import json
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arm_companion.arm import arc
from arm_companion.arm.arc_model import ArcModel
from arm_companion.arm.model import HoldKind
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import load
from arm_companion.experiments import case
from arm_companion.geometry.se3 import Pose

ROOT = Path(__file__).parents[2]
TABLES = json.loads((ROOT / "tests" / "data" / "rod_reference.json").read_text(encoding="utf-8"))
TARGET = ROOT / "docs" / "images" / "model_arc_rod_reference.png"
PARAMETERS = case.arm(load("zhao2022.toml"))
ROD, ARC = RodModel(PARAMETERS), ArcModel(PARAMETERS)
FLAT = np.zeros(3)
FULL = 0.981
_ARC, _ROD, _TRUTH, _FREE = "#dc2626", "#1d4ed8", "#000000", "#9aa5b1"


def arc_under_pulley(pull: np.ndarray, force: float) -> np.ndarray:
    """Bend (2,) of the one arc under a force that turns with its end disk."""
    return ARC.free(pull, FLAT, follower_wrench=(force, 0, 0, 0, 0, 0)).bend


def shapes(axis: Axes) -> None:
    """The arm bent by 30 deg, loaded inward by 0.981 N."""
    pull = case.goals(PARAMETERS, 30)
    free = ROD.free(pull, FLAT)
    loaded = ROD.free(pull, FLAT, follower_wrench=(FULL, 0, 0, 0, 0, 0))
    u = arc_under_pulley(pull, FULL)
    bent = np.array([arc.tip_position(s * u, s * PARAMETERS.L) for s in np.linspace(1e-6, 1, 60)])
    for points, colour, style, name in (
        (free.shape(), _FREE, "-", "unloaded"),
        (bent, _ARC, "--", "one arc"),
        (loaded.shape(), _ROD, "-", "rod"),
    ):
        axis.plot(1e3 * points[:, 0], 1e3 * points[:, 2], style, color=colour, lw=2, label=name)
    truth = [
        1e3 * free.tip_position + np.array((row["dx"], 0, row["dz"]))
        for row in TABLES["stiffness_test"]
        if row["theta0_deg"] == 30 and row["dir"] == "inward"
    ]
    axis.plot(*np.array(truth)[:, [0, 2]].T, "o", color=_TRUTH, ms=4, mfc="none", label="reference, tip")
    axis.set_aspect("equal")
    axis.set_xlim(-8, 190)
    axis.invert_yaxis()
    axis.set_xlabel("x, mm")
    axis.set_ylabel("z, mm")
    axis.set_title("(a) 30 deg, 0.981 N inward", loc="left")


def deflection(axis: Axes) -> None:
    """Tip deflection over load, inward, for three bends."""
    forces = np.linspace(0, FULL, 21)
    for theta in (0, 30, 60):
        pull = case.goals(PARAMETERS, theta)
        rest, start, rod, one = ROD.free(pull, FLAT), None, [], []
        for force in forces:
            start = ROD.free(pull, FLAT, follower_wrench=(force, 0, 0, 0, 0, 0), start=start)
            rod.append(1e3 * np.linalg.norm(start.tip_position - rest.tip_position))
            tip = arc.tip_position(arc_under_pulley(pull, force), PARAMETERS.L)
            one.append(1e3 * np.linalg.norm(tip - rest.tip_position))
        axis.plot(forces, rod, color=_ROD, lw=1.5)
        axis.plot(forces, one, "--", color=_ARC, lw=1.5)
        rows = [r for r in TABLES["stiffness_test"] if r["theta0_deg"] == theta and r["dir"] == "inward"]
        axis.plot(
            [r["F"] for r in rows], [np.hypot(r["dx"], r["dz"]) for r in rows], "o", color=_TRUTH, ms=4, mfc="none"
        )
        axis.annotate(f"{theta}", (FULL, rod[-1]), xytext=(4, -3), textcoords="offset points", fontsize=8)
    axis.set_xlabel("load, N")
    axis.set_ylabel("tip deflection, mm")
    axis.set_title("(b) inward loading, bends in deg", loc="left")


def perching(axis: Axes) -> None:
    """Force on the carrier over its travel with the tip clamped."""
    pull = case.goals(PARAMETERS, 30)
    hold, start, rod, one = ROD.free(pull, FLAT).hold(PARAMETERS.L, HoldKind.CLAMPED), None, [], []
    travel = np.linspace(0, 10, 41)
    for mm in travel:
        seen = hold.seen_from(Pose(np.eye(3), np.array((-1e-3 * mm, 0, 0))))
        start = ROD.held(pull, seen, FLAT, start=start)
        rod.append(np.linalg.norm(start.base_wrench[:3]))
        one.append(np.linalg.norm(ARC.held(pull, seen, FLAT).base_wrench[:3]))
    points = next(c for c in TABLES["perching"] if c["bc"] == "clamp" and c["dir"] == "x+" and not c["g"])["points"]
    axis.plot(travel, rod, color=_ROD, lw=1.5)
    axis.plot(travel, one, "--", color=_ARC, lw=1.5)
    axis.plot([p["d"] for p in points], [np.linalg.norm(p["N0"]) for p in points], "o", color=_TRUTH, ms=4, mfc="none")
    axis.set_xlabel("travel of the base along x, mm")
    axis.set_ylabel("force on the carrier, N")
    axis.set_title("(c) tip clamped, 30 deg", loc="left")


def main() -> None:
    style = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3}
    with mpl.rc_context(style):
        figure = Figure(figsize=(11, 3.9), layout="constrained")
        panels = figure.subplots(1, 3, width_ratios=[0.8, 1, 1])
        for axis, draw in zip(panels, (shapes, deflection, perching), strict=True):
            draw(axis)
        panels[0].legend(fontsize=8, frameon=False, loc="upper right")
        TARGET.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(TARGET, dpi=120)


if __name__ == "__main__":
    main()
