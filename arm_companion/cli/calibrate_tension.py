"""`arm-companion calibrate tension`: load to tension of each servo, with weights or a spring scale."""

import argparse
from pathlib import Path

from arm_companion.cli.common import add_config_arguments
from arm_companion.cli.guide import RefusedError, Terminal, add_guide_arguments, on_the_bench, state_directory
from arm_companion.cli.numbers import NumberParser
from arm_companion.clock import unix_now
from arm_companion.config import Config
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibration import VERSION, TensionCalibration, TensionFit, identity
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.workshop.rig import Rig
from arm_companion.workshop.tension_gain import Bench, describe, procedure


def add_parser(commands: "argparse._SubParsersAction[NumberParser]") -> None:
    """The options of `calibrate tension`."""
    sub = commands.add_parser(
        "tension",
        help="load to tension of each servo, with weights or a spring scale, guided",
        description="Fit gain, offset and friction of each servo to known tensions. Stop the daemon first.",
    )
    add_config_arguments(sub)
    add_guide_arguments(sub)
    sub.set_defaults(calibrate=run)
    sub.add_argument("--tendon", type=int, action="append", metavar="N", help="only this one; may be repeated")
    sub.add_argument("--with", choices=("weights", "scale"), default="weights", dest="means", help="default: weights")
    sub.add_argument("--travel-mm", type=float, default=20.0, metavar="X", help="of each stroke (default: 20)")
    sub.add_argument("--speed-mm-s", type=float, default=4.0, metavar="X", help="of each stroke (default: 4)")


def run(arguments: argparse.Namespace, config: Config) -> int:
    """Guide; exit code 0 with the fits stored, 130 after an interruption.

    Raises:
        RefusedError: it cannot be done; one line for people.
    """
    path = state_directory(arguments, config) / files.TENSION
    _stored(path)
    n = len(config.servos.ids)
    chosen = sorted(set(arguments.tendon or range(1, n + 1)))
    if not all(1 <= number <= n for number in chosen):
        raise RefusedError(f"--tendon: there are tendons 1 to {n}")
    if not 4.0 <= arguments.travel_mm <= 1e3 * config.limits.pull_max_m:
        raise RefusedError(f"--travel-mm: {arguments.travel_mm:g} is not in 4 to {1e3 * config.limits.pull_max_m:g}")
    fastest = 1e3 * config.limits.pull_speed_m_per_s
    if not 1.0 <= arguments.speed_mm_s <= fastest:
        raise RefusedError(f"--speed-mm-s: {arguments.speed_mm_s:g} is not in 1 to {fastest:g}")
    bench = Bench(
        arguments.means == "scale", arguments.travel_mm / 1e3, arguments.speed_mm_s / 1e3, config.limits.tension_max_n
    )
    terminal = Terminal(yes=arguments.yes)

    async def work(rig: Rig, bus: ServoBus) -> bool:
        for number in chosen:
            servo = config.servos.ids[number - 1]
            name = f"tendon {number} (servo {servo})"
            result = await rig.run(procedure(number - 1, name, n, bench), terminal, lambda _: None)
            found = TensionFit(
                identity(bus.info[servo]),
                unix_now(),
                config.arm.pulley_radius_m,
                result.curve,
                result.scatter,
                result.readings,
            )
            terminal.say(f"{name}:\n{describe(result)}")  # first: a disk that fails costs nobody the numbers
            _store(path, found)
            terminal.say(f"  stored in {path}")
        return True

    return 0 if on_the_bench(config, work) else 130


def _stored(path: Path) -> tuple[TensionFit, ...]:
    """The fits that are there.

    Raises:
        RefusedError: the file is damaged.
    """
    try:
        found = files.read(TensionCalibration, path)
    except ValueError as error:
        raise RefusedError(f"{error}; remove it first") from error
    return () if found is None else found.fits


def _store(path: Path, fit: TensionFit) -> None:
    """Replace this servo's fit, and keep those of the others."""
    others = tuple(other for other in _stored(path) if other.servo.id != fit.servo.id)
    try:
        files.save(path, TensionCalibration(VERSION, (*others, fit)))
    except OSError as error:
        raise RefusedError(f"{path} cannot be written: {error.strerror}") from error
