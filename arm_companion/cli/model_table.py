"""One equilibrium as a table for people: millimetres and degrees."""

import math
from typing import Any

import numpy as np

from arm_companion.arm.allocation import hold_moment
from arm_companion.arm.model import ArmSolution
from arm_companion.arm.stiffness import stiffness_along
from arm_companion.config import Config
from arm_companion.experiments.case import Case


def table(action: str, answer: dict[str, Any], solution: ArmSolution, asked: Case, config: Config) -> str:
    """The answer to one of the `model` commands, as lines."""
    lines = _pose(answer)
    if action == "tensions":
        lines += _tendons(solution, asked, config)
    else:
        lines.append(_row("tendon tension", answer["tension_n"], "N"))
    if action == "deflect":
        lines += _deflection(solution, asked)
    if action == "stiffness":
        lines += _stiffness(answer, solution)
    lines.append(_row("force on the carrier", answer["base_force_n"], "N"))
    lines.append(_row("moment on the carrier", answer["base_moment_nm"], "N m", 5))
    if action in ("clamp", "deflect"):
        lines.append(_row("force on the tip", answer["tip_force_n"], "N"))
        lines.append(_row("moment on the tip", answer["tip_moment_nm"], "N m", 5))
    if action == "clamp":
        lines.append(f"{'before it is taut':<24}{1e3 * solution.taut_margin:10.3f} mm")
    lines.append(f"{'residual':<24}{solution.residual:10.1e}    solved in {1e3 * answer['solve_time_s']:.1f} ms")
    return "\n".join(lines)


def _row(name: str, values: Any, unit: str, digits: int = 4) -> str:
    return f"{name:<24}" + "".join(f"{round(value, digits) + 0.0:10.{digits}f}" for value in values) + f"  {unit}"


def _pose(answer: dict[str, Any]) -> list[str]:
    R = np.array(answer["tip_rotation"])
    tilt = math.degrees(math.atan2(math.hypot(R[0, 2], R[1, 2]), R[2, 2]))
    plane = math.degrees(math.atan2(R[1, 2], R[0, 2])) if tilt > 1e-9 else 0.0
    return [
        _row("tip position", [1e3 * x for x in answer["tip_position_m"]], "mm", 3),
        f"{'end disk tilted by':<24}{tilt:10.3f}  deg towards {plane:z.3f} deg",
    ]


def _tendons(solution: ArmSolution, asked: Case, config: Config) -> list[str]:
    parameters, floor = asked.model.parameters, config.limits.tension_min_n
    # What tendons do to the bend is H^T tension, whatever load and weight do beside: all that makes the same holds it.
    H = parameters.H
    found = hold_moment(H, H.T @ solution.tension, np.full(parameters.n, floor), floor, np.inf)
    least = [math.nan] * parameters.n if found is None else found.tolist()
    lines = [f"{'tendon':<8}{'at, deg':>10}{'goal, mm':>12}{'tension, N':>12}{'servo, N m':>12}{'least, N':>12}"]
    for i in range(parameters.n):
        tension = float(solution.tension[i])
        lines.append(
            f"{i + 1:<8}{math.degrees(parameters.angles[i]):>10.1f}{1e3 * asked.pull[i]:>12.4f}{tension:>12.4f}"
            f"{tension * config.arm.pulley_radius_m:>12.4f}{least[i]:>12.4f}"
        )
    lines.append(f"(least: the tensions that hold the same bend under the same load with none under {floor:g} N)")
    return lines


def _deflection(solution: ArmSolution, asked: Case) -> list[str]:
    unloaded = Case(asked.model, asked.pull, asked.gravity).free()
    moved = 1e3 * (solution.tip_position - unloaded.tip_position)
    return [_row("tip moved by", moved, f"mm, {np.sqrt(moved @ moved):.3f} mm in all", 3)]


def _stiffness(answer: dict[str, Any], solution: ArmSolution) -> list[str]:
    lines = ["stiffness of the tip, N/m, free to turn, base axes (0 where an inextensible arm cannot give):"]
    lines += ["".join(f"{round(value, 4) + 0.0:12.4f}" for value in row) for row in answer["stiffness_n_per_m"]]
    for name, axis in (("x", 0), ("y", 1), ("z", 2)):
        k = stiffness_along(solution.compliance, solution.tip_rotation[:, axis])
        lines.append(f"{'along ' + name + ' of the end disk':<24}{k:10.4f}  N/m, free to give sideways")
    lines.append("compliance [m; rad] per [N; N m]:")
    lines += ["".join(f"{round(value, 6) + 0.0:12.6f}" for value in row) for row in answer["compliance"]]
    if answer["k_psi"] is not None:
        lines.append("K_psi of the paper, corrected, N m/rad, in (theta, delta):")
        lines += ["".join(f"{round(value, 6) + 0.0:12.6f}" for value in row) for row in answer["k_psi"]]
    return lines
