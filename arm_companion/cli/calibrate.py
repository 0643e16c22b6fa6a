"""`arm-companion calibrate`: the tendons on the bench, and the model from measurements of the real arm."""

import argparse
import importlib.util
import json
import math
import sys
from pathlib import Path
from typing import Any

from arm_companion.arm import compiled, identification
from arm_companion.arm.identification import Fit, LoadingTest
from arm_companion.arm.parameters import Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.cli import calibrate_tendons, calibrate_tension
from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.cli.numbers import NumberParser
from arm_companion.config import Config, load
from arm_companion.config.layers import locate
from arm_companion.errors import ArmError, ConfigError
from arm_companion.experiments import case, loading_csv

_UNITS = {"EI": "N m^2", "k_T": "N/m", "T0": "N", "mu": ""}
_FULL_TURN_DEG = 360.0
_KEYS = {"EI": "EI_n_m2", "k_T": "k_T_n_per_m", "T0": "T0_n", "mu": "mu"}


class _RefusedError(ArmError):
    """The arguments do not go together; the message is one line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion calibrate`; every calibration sets `calibrate`, which does it."""
    commands = parser.add_subparsers(dest="what", required=True, metavar="WHAT", parser_class=NumberParser)
    calibrate_tendons.add_parser(commands)
    calibrate_tension.add_parser(commands)
    _add_stiffness(commands)


def _add_stiffness(commands: "argparse._SubParsersAction[NumberParser]") -> None:
    sub = commands.add_parser(
        "stiffness",
        help="EI, tendon stiffness, pretension and guide friction from a loading test",
        description="Fit EI, k_T, T0 and guide friction to a loading test.",
        epilog=loading_csv.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    sub.set_defaults(calibrate=_stiffness)
    sub.add_argument("data", type=Path, metavar="DATA.csv", help="the measurements; columns below")
    add_config_arguments(sub, default="zhao2022.toml")
    sub.add_argument(
        "--fit",
        default=",".join(identification.NAMES),
        metavar="NAMES",
        help="what to fit, separated by commas (default: %(default)s)",
    )
    sub.add_argument(
        "--guides",
        choices=[g.value for g in Guides],
        default=Guides.DISKS.value,
        help="what leads the tendons (default: disks, as on a real arm)",
    )
    sub.add_argument(
        "--gravity",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="along +z of the base unless --attitude-deg is given",
    )
    sub.add_argument(
        "--attitude-deg",
        nargs=3,
        type=float,
        metavar=("R", "P", "Y"),
        help="of the vehicle during the test, with the arm mounted as [mount] says",
    )
    sub.add_argument("--output", type=Path, metavar="DROPIN.toml", help="write the fit as a file that others extend")
    sub.add_argument("--figure", type=Path, metavar="FILE", help="draw fit and residuals (PNG; extra sim)")
    sub.add_argument("--json", action="store_true", help="print one JSON object (SI units)")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; exit code 2 with one line on standard error when data or arguments are refused."""
    config = load_from(arguments)
    try:
        code: int = arguments.calibrate(arguments, config)
    except ConfigError:
        raise
    except loading_csv.DataError as error:
        print(f"arm-companion calibrate: {arguments.data}: {error}", file=sys.stderr)
    except ArmError as error:
        print(f"arm-companion calibrate: {error}", file=sys.stderr)
    except UnicodeDecodeError:
        print(f"arm-companion calibrate: {arguments.data}: not UTF-8 text", file=sys.stderr)
    except OSError as error:
        if error.filename is None:  # not a file of ours, such as a closed pipe
            raise
        print(f"arm-companion calibrate: {error.filename}: {error.strerror}", file=sys.stderr)
    else:
        return code
    return 2


def _stiffness(arguments: argparse.Namespace, config: Config) -> int:
    """Fit EI, k_T, T0 and friction to a loading test."""
    if arguments.figure is not None and importlib.util.find_spec("matplotlib") is None:
        raise _RefusedError("--figure needs 'matplotlib': pip install 'arm-companion[sim]'")
    if arguments.output is not None and arguments.settings:
        raise _RefusedError("--output extends the configuration file: put what --set changes into that file")
    if not all(abs(angle) <= _FULL_TURN_DEG for angle in arguments.attitude_deg or ()):
        raise _RefusedError(f"--attitude-deg takes angles up to {_FULL_TURN_DEG:g}")
    if config.arm.segments:
        raise _RefusedError(f"a loading test is fitted for one segment, and this arm has {len(config.arm.chain)}")
    if arguments.output is not None and arguments.output.resolve() == arguments.data.resolve():
        raise _RefusedError(f"--output: {arguments.output} is the file of the measurements")
    parameters = case.arm(config, Guides(arguments.guides))
    readings = loading_csv.parse(arguments.data.read_text(encoding="utf-8-sig"), RodModel(parameters))
    field = case.field(config, on=arguments.gravity, attitude_deg=arguments.attitude_deg)
    test = LoadingTest(readings, field)
    names = [name.strip() for name in arguments.fit.split(",") if name.strip()]
    fit = identification.fit(parameters, test, names, mu=config.arm.tendons.guide_friction, fast=_compiled())
    if arguments.output is not None:
        _write(fit, config, locate(arguments.config), arguments.output)
    if arguments.figure is not None:
        from arm_companion.experiments import figures  # noqa: PLC0415 - matplotlib is optional

        figures.calibration(test, fit, arguments.figure)
    print(json.dumps(_plain(fit, len(readings))) if arguments.json else _table(fit, len(readings)))
    return 0


def _write(fit: Fit, config: Config, base: Path, target: Path) -> None:
    """The drop-in, when it can be used; what was there before stays when it cannot.

    Raises:
        ConfigError: it would extend itself, or what was fitted is out of bounds.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    before = target.read_bytes() if target.exists() else None
    try:
        target.write_text(drop_in(fit, config, base, target), encoding="utf-8")
        load(base if _among_drop_ins(base, target) else target)
    except (ConfigError, OSError):
        if before is not None:
            target.write_bytes(before)
        else:
            target.unlink(missing_ok=True)
        raise


def _compiled() -> bool:
    """Whether compiled mechanics are at hand; compiling them would take longer than a fit."""
    try:
        compiled.load(compiling=False)
    except compiled.NotCompiled:
        return False
    return True


def drop_in(fit: Fit, config: Config, base: Path, target: Path) -> str:
    """TOML that extends the configuration `base` by what was fitted, to be written to `target`."""
    beside = base.resolve().parent == target.resolve().parent
    lines = ["# Written by `arm-companion calibrate stiffness`; intervals are of 95 % confidence."]
    if not _among_drop_ins(base, target):
        lines.append(f"extends = {json.dumps(base.name if beside else str(base.resolve()))}")
    estimates = fit.estimates
    if estimates["EI"].fitted:
        lines += ["", "[arm.backbone]", *_entry("EI", fit)]
        I_p = math.pi * config.arm.backbone.diameter_m**4 / 64
        lines.append(f"youngs_modulus_pa = {estimates['EI'].value / I_p:.6e}")
    tendons: list[str] = []
    if estimates["k_T"].fitted:
        tendons += [*_entry("k_T", fit), *_tendon_stiffness(estimates["k_T"].value, config)]
    if estimates["T0"].fitted:
        tendons += [*_entry("T0", fit), f"pretension_n = {estimates['T0'].value:.6g}"]
    if estimates["mu"].fitted:
        tendons += [*_entry("mu", fit), f"guide_friction = {estimates['mu'].value:.6g}"]
    if tendons:
        lines += ["", "[arm.tendons]", *tendons]
    return "\n".join(lines) + "\n"


def _among_drop_ins(base: Path, target: Path) -> bool:
    """Whether `target` lies where the configuration `base` takes its drop-ins from by itself."""
    return target.resolve().parent == base.with_suffix(".d").resolve()


def _entry(name: str, fit: Fit) -> list[str]:
    e = fit.estimates[name]
    return [f"# {name} = {e.value:.5g} {_UNITS[name]} ({e.lower:.5g} to {e.upper:.5g})".rstrip()]


def _tendon_stiffness(k_T: float, config: Config) -> list[str]:
    """Young's modulus that gives k_T, the servo's compliance in series as configured where that leaves any."""
    cable = config.arm.tendons
    length = config.arm.length_m + cable.routing_length_m
    rest = 1 / k_T - 1 / cable.servo_stiffness_n_per_m
    lines = []
    if rest <= 0:
        rest = 1 / k_T
        lines.append("servo_stiffness_n_per_m = 1e9   # the tendon carries all of the compliance measured")
    modulus = length / rest / (math.pi * cable.diameter_m**2 / 4)
    return [*lines, f"youngs_modulus_pa = {modulus:.6e}"]


def _table(fit: Fit, readings: int) -> str:
    lines = [f"{'':<6}{'value':>12}{'one sigma':>12}{'95 % from':>12}{'to':>12}"]
    for name, e in fit.estimates.items():
        if e.fitted:
            numbers = "".join(f"{v:>12.5g}" for v in (e.value, e.sigma, e.lower, e.upper))
            lines.append(f"{name:<6}{numbers}  {_UNITS[name]}".rstrip())
        else:
            lines.append(f"{name:<6}{e.value:>12.5g}{'not fitted':>36}  {_UNITS[name]}".rstrip())
    lines.append(f"{readings} readings, {len(fit.measured)} values, {fit.degrees} degrees of freedom")
    for kind, sigma in fit.scatter.items():
        unit, scale = ("N", 1.0) if kind == identification.TENSION else ("mm", 1e3)
        before = scale * fit.scatter_before[kind]
        lines.append(f"{kind}: scatter {scale * sigma:.4g} {unit} about the fit, {before:.4g} {unit} as configured")
    return "\n".join([*lines, *fit.notes])


def _plain(fit: Fit, readings: int) -> dict[str, Any]:
    def by_unit(scatter: dict[str, float]) -> dict[str, float]:
        return {
            f"{kind.replace(' ', '_')}_{'n' if kind == identification.TENSION else 'm'}": value
            for kind, value in scatter.items()
        }

    return {
        "parameters": {
            _KEYS[name]: {
                "value": e.value,
                "sigma": e.sigma,
                "lower": e.lower,
                "upper": e.upper,
                "fitted": e.fitted,
            }
            for name, e in fit.estimates.items()
        },
        "correlation": fit.correlation.tolist(),
        "scatter": by_unit(dict(fit.scatter)),
        "scatter_before": by_unit(dict(fit.scatter_before)),
        "residuals": [
            {"reading": row, "kind": kind, "measured": m, "fitted": p}
            for row, kind, m, p in zip(
                fit.rows, fit.channels, fit.measured.tolist(), fit.predicted.tolist(), strict=True
            )
        ],
        "readings": readings,
        "degrees_of_freedom": fit.degrees,
        "notes": list(fit.notes),
    }
