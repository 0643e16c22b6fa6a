"""`arm-companion model`: one equilibrium of the arm, or one of the paper's experiments.

Length of the vectors, axes and signs are those of `arm.model`: base axes, z from base to tip; the base force and
moment are what the arm exerts on its carrier at the base point, the tip force and moment what acts on the arm.
"""

import argparse
import importlib.util
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from arm_companion.arm import compiled
from arm_companion.arm.model import ArmSolution, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.cli import experiment_output as output
from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.cli.model_table import table
from arm_companion.cli.numbers import NumberParser
from arm_companion.config import Config
from arm_companion.errors import ModelError
from arm_companion.experiments import case, perching, stiffness_test
from arm_companion.geometry.arrays import Array

_CASES = {
    "pose": "where the tip is",
    "tensions": "what the tendons carry, and what their servos",
    "deflect": "how far a load moves the tip",
    "clamp": "what a base feels that moves while the tip is held",
    "stiffness": "compliance and stiffness of the tip",
}
_EXPERIMENTS = {
    "stiffness-test": "the paper's stiffness test: five bends, loaded inward and outward",
    "perching": "the paper's perching benchmark: tip held, base moved in x and z and back",
}
_LARGEST = 1e9  # of any argument: beyond it lie no arms, and squares overflow
_SLOWEST_MM_S = 1e-6  # slower than that, times are no numbers any more
_TIPS = {"clamped": HoldKind.CLAMPED, "pinned": HoldKind.PINNED}


class _RefusedError(Exception):
    """What the arguments ask for cannot be answered; the message is one line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion model`."""
    commands = parser.add_subparsers(dest="action", required=True, metavar="WHAT", parser_class=NumberParser)
    for name, text in {**_CASES, **_EXPERIMENTS}.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        add_config_arguments(sub, default="zhao2022.toml")
        _add_arm(sub)
        if name == "stiffness-test":
            _add_stiffness_test(sub)
        elif name == "perching":
            _add_perching(sub)
        else:
            _add_case(sub, held=name == "clamp")
        sub.add_argument("--json", action="store_true", help="print one JSON object (SI units)")
    text = "compile the mechanics into numba's cache, for the daemon to load (extra fast)"
    commands.add_parser("warm", help=text, description=text[0].upper() + text[1:] + ".")


def _add_arm(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--pretension-n", type=float, metavar="T0", help="of every tendon (default: configured)")
    parser.add_argument(
        "--guides",
        choices=[g.value for g in Guides],
        default=Guides.CONTINUOUS.value,
        help="continuous: tendons parallel to the backbone everywhere, as in the paper; disks: straight from disk to "
        "disk, as they really run and as the daemon flies (default: continuous)",
    )
    parser.add_argument(
        "--gravity",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="along +z of the base unless --attitude-deg is given, which implies it (default: none, as in the paper)",
    )
    parser.add_argument(
        "--attitude-deg",
        nargs=3,
        type=float,
        metavar=("R", "P", "Y"),
        help="of the vehicle, with the arm mounted as [mount] says",
    )


def _add_case(parser: argparse.ArgumentParser, *, held: bool) -> None:
    parser.add_argument(
        "--theta-deg",
        nargs="+",
        type=float,
        metavar="A",
        help="bend of the unloaded, gravity-free arm; for several segments one each, from base to tip (default: 0)",
    )
    parser.add_argument("--delta-deg", nargs="+", type=float, metavar="A", help="bending planes from x (default: 0)")
    parser.add_argument("--pull-m", nargs="+", type=float, metavar="Q", help="tendon goals instead of a bend")
    if held:
        parser.add_argument(
            "--base-move-mm",
            nargs=3,
            type=float,
            default=(0.0, 0.0, 0.0),
            metavar=("X", "Y", "Z"),
            help="of the base since the free, unloaded tip was caught",
        )
        parser.add_argument(
            "--base-turn-deg",
            nargs=3,
            type=float,
            default=(0.0, 0.0, 0.0),
            metavar=("R", "P", "Y"),
            help="of the base about its own point since then",
        )
        parser.add_argument("--tip", choices=sorted(_TIPS), default="clamped", help="how it is held (default: clamped)")
        return
    parser.add_argument("--force", nargs=3, type=float, metavar=("X", "Y", "Z"), help="on the tip, N, base axes")
    parser.add_argument("--moment", nargs=3, type=float, metavar=("X", "Y", "Z"), help="on the tip, N m, base axes")
    parser.add_argument("--follower", action="store_true", help="force and moment in tip axes, turning along")
    parser.add_argument("--payload-kg", type=float, default=0.0, metavar="M", help="carried at the tip, with --gravity")


def _add_stiffness_test(parser: argparse.ArgumentParser) -> None:
    _add_outputs(parser)
    parser.add_argument(
        "--bends-deg", nargs="+", type=float, default=stiffness_test.BENDS_DEG, metavar="A", help="configurations"
    )
    parser.add_argument("--cycles", type=int, default=stiffness_test.CYCLES, help="of loading and unloading")
    parser.add_argument("--steps", type=int, default=stiffness_test.STEPS, help="of 20 g up to the greatest load")
    parser.add_argument(
        "--friction", type=float, metavar="MU", help="of the tendons in their guides (default: configured)"
    )


def _add_perching(parser: argparse.ArgumentParser) -> None:
    _add_outputs(parser)
    parser.add_argument("--theta-deg", type=float, default=perching.BEND_DEG, metavar="A", help="bend")
    parser.add_argument("--x-mm", type=float, default=1e3 * perching.TRAVEL, help="travel along x of the base; 0: none")
    parser.add_argument(
        "--z-mm", type=float, default=1e3 * perching.TRAVEL, help="travel along z, positive towards the vise; 0: none"
    )
    parser.add_argument("--speed-mm-s", type=float, default=1e3 * perching.SPEED, help="of the base, for the time axis")
    parser.add_argument("--tip", choices=sorted(_TIPS), default="clamped", help="how it is held (default: clamped)")


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every reading")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw it as the paper does (PNG; extra sim)")


def run(arguments: argparse.Namespace) -> int:
    """Answer; exit code 2 with one line on standard error when it is refused."""
    if arguments.action == "warm":
        return _warm()
    config = load_from(arguments)
    try:
        _check(arguments)
        parameters = case.arm(config, Guides(arguments.guides), arguments.pretension_n)
        on = arguments.gravity if arguments.gravity is not None else arguments.attitude_deg is not None
        gravity = case.field(config, on=on, attitude_deg=arguments.attitude_deg)
        if arguments.action in _EXPERIMENTS and len(parameters.segments) > 1:
            raise _RefusedError(f"the paper's arm has one segment, this one {len(parameters.segments)}")
        if arguments.action == "stiffness-test":
            return _stiffness_test(arguments, config, parameters, gravity)
        if arguments.action == "perching":
            return _perching(arguments, parameters, gravity)
        return _case(arguments, config, parameters, gravity)
    except (_RefusedError, ModelError) as error:
        print(f"arm-companion model {arguments.action}: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.filename is None:  # not a file of ours, such as a closed pipe
            raise
        print(f"arm-companion model {arguments.action}: {error.filename}: {error.strerror}", file=sys.stderr)
        return 1


def _warm() -> int:
    begun = time.perf_counter()
    try:
        place = compiled.load(compiling=True)
    except compiled.NotCompiled as error:
        print(f"arm-companion model warm: {error}", file=sys.stderr)
        return 2
    print(f"compiled mechanics are in {place}, after {time.perf_counter() - begun:.1f} s")
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what no case can have."""
    for name, value in vars(arguments).items():
        values = value if isinstance(value, list | tuple) else [value]
        if any(isinstance(v, float) and not abs(v) <= _LARGEST for v in values):
            raise _RefusedError(f"--{name.replace('_', '-')} takes finite numbers, up to {_LARGEST:g}")
    if arguments.pretension_n is not None and arguments.pretension_n < 0:
        raise _RefusedError(f"--pretension-n {arguments.pretension_n:g}: tendons cannot push")
    if getattr(arguments, "payload_kg", 0.0) < 0:
        raise _RefusedError("--payload-kg must not be negative")
    if getattr(arguments, "figure", None) is not None and importlib.util.find_spec("matplotlib") is None:
        raise _RefusedError("--figure needs 'matplotlib': pip install 'arm-companion[sim]'")


def _pull(arguments: argparse.Namespace, parameters: ArmParameters) -> Array:
    if arguments.pull_m is None:
        theta, delta = (given or [0.0] for given in (arguments.theta_deg, arguments.delta_deg))
        segments = len(parameters.segments)
        if max(len(theta), len(delta)) > segments:
            raise _RefusedError(f"{max(len(theta), len(delta))} bends for {segments} segment{'s' * (segments > 1)}")
        if len(delta) not in (1, len(theta)):
            raise _RefusedError(f"--delta-deg has {len(delta)} planes for {len(theta)} bends")
        return case.goals(parameters, theta, delta)
    if arguments.theta_deg is not None or arguments.delta_deg is not None:
        raise _RefusedError("give a bend or --pull-m, not both")
    if len(arguments.pull_m) != parameters.n:
        raise _RefusedError(f"--pull-m has {len(arguments.pull_m)} goals for {parameters.n} tendons")
    return np.array(arguments.pull_m)


def _case(arguments: argparse.Namespace, config: Config, parameters: ArmParameters, gravity: Array) -> int:
    model = RodModel(parameters)
    held = arguments.action == "clamp"
    payload = None if held or arguments.payload_kg == 0 else Payload(arguments.payload_kg)
    asked = case.Case(model, _pull(arguments, parameters), gravity, payload)
    begun = time.perf_counter()
    if held:
        move = [1e-3 * value for value in arguments.base_move_mm]
        turn = [math.radians(value) for value in arguments.base_turn_deg]
        solution = asked.held(move, _TIPS[arguments.tip], base_turn=turn)
    else:
        nothing = (0.0, 0.0, 0.0)
        force, moment = arguments.force or nothing, arguments.moment or nothing
        solution = asked.free(force, moment, follower=arguments.follower)
    elapsed = time.perf_counter() - begun
    delta = math.radians((arguments.delta_deg or [0.0])[0])
    answer = _answer(solution, parameters, delta, elapsed)
    if arguments.json:
        print(json.dumps(answer))
    else:
        print(table(arguments.action, answer, solution, asked, config))
    return 0


def _answer(solution: ArmSolution, parameters: ArmParameters, delta: float, elapsed: float) -> dict[str, Any]:
    """The command-line contract: every key of it, SI units; K_psi is defined for one segment, null for more."""
    return {
        "tip_position_m": solution.tip_position.tolist(),
        "tip_rotation": solution.tip_rotation.tolist(),
        "tension_n": solution.tension.tolist(),
        "base_force_n": solution.base_wrench[:3].tolist(),
        "base_moment_nm": solution.base_wrench[3:].tolist(),
        "tip_force_n": solution.tip_wrench[:3].tolist(),
        "tip_moment_nm": solution.tip_wrench[3:].tolist(),
        "stiffness_n_per_m": case.stiffness(solution.compliance).tolist(),
        "compliance": solution.compliance.tolist(),
        "k_psi": case.k_psi(solution, parameters, delta).tolist() if len(parameters.segments) == 1 else None,
        "converged": True,  # what does not converge is refused
        "residual": solution.residual,
        "solve_time_s": elapsed,
    }


def _stiffness_test(arguments: argparse.Namespace, config: Config, parameters: ArmParameters, gravity: Array) -> int:
    mu = config.arm.tendons.guide_friction if arguments.friction is None else arguments.friction
    if arguments.cycles < 1 or arguments.steps < 1:
        raise _RefusedError("--cycles and --steps start at 1")
    if mu < 0:
        raise _RefusedError("--friction must not be negative")
    curves = stiffness_test.run(
        parameters,
        bends_deg=arguments.bends_deg,
        gravity=gravity,
        mu=mu,
        steps=arguments.steps,
        cycles=arguments.cycles,
    )
    said = stiffness_test.findings(curves, mu)
    if arguments.csv is not None:
        output.write_csv(arguments.csv, output.stiffness_rows(curves))
    if arguments.figure is not None:
        from arm_companion.experiments import figures  # noqa: PLC0415 - matplotlib is optional

        figures.stiffness_test(curves, arguments.figure)
    if arguments.json:
        print(json.dumps(output.stiffness_json(curves, said)))
    else:
        print(output.stiffness_table(curves, said))
    return _ended(arguments, [f"{c.bend_deg:g} deg {output.side(c.inward)}: {c.refusal}" for c in curves if c.refusal])


def _perching(arguments: argparse.Namespace, parameters: ArmParameters, gravity: Array) -> int:
    if arguments.speed_mm_s < _SLOWEST_MM_S:
        raise _RefusedError(f"--speed-mm-s starts at {_SLOWEST_MM_S:g}")
    asked = (("x", 1e-3 * arguments.x_mm), ("z", 1e-3 * arguments.z_mm))
    travels = perching.run(
        parameters,
        bend_deg=arguments.theta_deg,
        travels=[(axis, distance) for axis, distance in asked if distance != 0],
        gravity=gravity,
        kind=_TIPS[arguments.tip],
        speed=1e-3 * arguments.speed_mm_s,
    )
    if not travels:
        raise _RefusedError("--x-mm 0 and --z-mm 0 leave nothing to do")
    said = perching.findings(travels)
    if arguments.csv is not None:
        output.write_csv(arguments.csv, output.perching_rows(travels))
    if arguments.figure is not None:
        from arm_companion.experiments import figures  # noqa: PLC0415 - matplotlib is optional

        figures.perching(travels, arguments.figure)
    if arguments.json:
        print(json.dumps(output.perching_json(travels, said)))
    else:
        print(output.perching_table(travels, said))
    return _ended(arguments, [f"{t.axis} {t.refusal}" for t in travels if t.refusal])


def _ended(arguments: argparse.Namespace, refusals: list[str]) -> int:
    """Exit code of an experiment, of which every part that has a solution has been shown."""
    if not refusals:
        return 0
    print(f"arm-companion model {arguments.action}: ends early: {'; '.join(refusals)}", file=sys.stderr)
    return 2
