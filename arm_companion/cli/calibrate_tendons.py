"""`arm-companion calibrate tendons`: guided, resumable; zeros of the tendons into the state directory."""

import argparse
import contextlib
import dataclasses
from pathlib import Path
from typing import Any

from arm_companion.arm.parameters import ArmParameters
from arm_companion.cli.common import add_config_arguments
from arm_companion.cli.guide import RefusedError, Terminal, add_guide_arguments, on_the_bench, state_directory
from arm_companion.cli.numbers import NumberParser
from arm_companion.clock import unix_now
from arm_companion.config import Config
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibration import VERSION, Progress, ServoIdentity, curves, identity, made_of
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.procedures.tendon_zeros import Found, Options, Setup, Zero, least_slack, procedure
from arm_companion.protocol.control_table import TICKS_PER_TURN
from arm_companion.workshop.rig import Rig, m_per_tick

_PROGRESS = "tendons.progress.json"
_PROGRESS_LASTS_S = 12 * 3600.0


def add_parser(commands: "argparse._SubParsersAction[NumberParser]") -> None:
    """The options of `calibrate tendons`."""
    sub = commands.add_parser(
        "tendons",
        help="zero of every tendon, guided, on the servo bus",
        description="Find the zero of every tendon. Stop the daemon first; the arm hangs straight, propellers off.",
    )
    add_config_arguments(sub)
    add_guide_arguments(sub)
    sub.set_defaults(calibrate=run)
    sub.add_argument("--restart", action="store_true", help="do not go on from an interrupted run")
    defaults = Options()
    for name, unit, scale, text in (
        ("threshold", "n", 1.0, "tension at which one tendon counts as taken up"),
        ("slack", "mm", 1e3, "by how much all tendons are let out first"),
        ("speed", "mm-s", 1e3, "of the tendons"),
        ("travel", "mm", 1e3, "farthest way of one tendon"),
    ):
        default = getattr(defaults, name) * scale
        help_ = f"{text} (default: {default:g})"
        sub.add_argument(f"--{name}-{unit}", type=float, default=default, metavar="X", dest=name, help=help_)


def run(arguments: argparse.Namespace, config: Config) -> int:
    """Guide; exit code 0 with a stored calibration, 130 after an interruption.

    Raises:
        RefusedError: it cannot be done; one line for people.
    """
    config.check_servos()
    directory = state_directory(arguments, config)
    if config.servos.coupling:
        raise RefusedError("coupled tendons cannot be taken up one at a time: set servos.zero_ticks by hand")
    options = _options(arguments, config)
    terminal = Terminal(yes=arguments.yes)

    async def work(rig: Rig, bus: ServoBus) -> bool:
        known = tuple(identity(bus.info[servo]) for servo in config.servos.ids)
        terminal.say("\n".join(f"tendon {i + 1}: {servo}" for i, servo in enumerate(known)))
        setup = _setup(config, directory, options)
        stand = tuple(state.position for state in await bus.read())
        done = () if arguments.restart else await _resumed(directory, known, stand, bus, config, terminal)
        zeros = await rig.run(
            procedure(setup, done), terminal, lambda found: _keep(directory, known, stand, config, found)
        )
        for i, zero in enumerate(zeros):
            terminal.say(f"tendon {i + 1}: zero at {zero.ticks} ticks, give or take {1e3 * zero.sigma:.2f} mm")
        _store(directory, config, known, zeros, {state.id: state.position for state in await bus.read()})
        terminal.say(f"stored in {directory / files.TENDONS}")
        return True

    return 0 if on_the_bench(config, work) else 130


def _options(arguments: argparse.Namespace, config: Config) -> Options:
    options = Options(arguments.threshold, arguments.slack / 1e3, arguments.speed / 1e3, arguments.travel / 1e3)
    bounds = {
        "threshold": (0.5, 0.5 * config.limits.tension_max_n),
        "slack": (0.01, 0.5 * config.limits.pull_max_m),
        "speed": (0.001, min(0.04, 0.5 * config.limits.pull_speed_m_per_s)),
        "travel": (0.01, config.limits.pull_max_m),
    }
    for field in dataclasses.fields(options):
        value, (lower, upper) = getattr(options, field.name), bounds[field.name]
        if not lower <= value <= upper:
            scale = 1.0 if field.name == "threshold" else 1e3
            raise RefusedError(f"--{field.name}: {scale * value:g} is not in {scale * lower:g} to {scale * upper:g}")
    needed = least_slack(ArmParameters.of(config.arm), options.threshold)
    if options.slack < needed:
        raise RefusedError(
            f"--slack: {options.threshold:g} N bend the arm so far that {1e3 * needed:.0f} mm are needed"
        )
    return options


def _setup(config: Config, directory: Path, options: Options) -> Setup:
    servos = config.servos
    try:
        tension = files.tension(str(directory))
    except ValueError as error:
        raise RefusedError(str(error)) from error
    return Setup(
        ArmParameters.of(config.arm),
        curves(tension, config)[0],
        servos.directions,
        servos.ids,
        m_per_tick(config.arm.pulley_radius_m),
        config.limits.tension_max_n,
        options,
    )


async def _resumed(
    directory: Path,
    known: tuple[ServoIdentity, ...],
    stand: tuple[int, ...],
    bus: ServoBus,
    config: Config,
    terminal: Terminal,
) -> tuple[Found, ...]:
    """What an interrupted run has found, if it still holds and the person wants it."""
    try:
        before = files.read(Progress, directory / _PROGRESS)
    except ValueError as error:
        terminal.say(f"starting afresh: {error}")
        return ()
    if before is None:
        return ()
    why = ""
    if before.servos != known:
        why = "the servos are others"
    elif before.pulley_radius != config.arm.pulley_radius_m:
        why = "the pulleys are others"
    elif any(bus.info[servo].fresh for servo in config.servos.ids):
        why = "the servos have been without power since"
    elif any(abs(now - then) >= TICKS_PER_TURN // 2 for now, then in zip(stand, before.stood, strict=True)):
        # a daemon that met them after a loss of power leaves them set up, and counting in another turn
        why = "the servos stand elsewhere, and may have been without power since"
    elif unix_now() - before.made_unix_s > _PROGRESS_LASTS_S:
        why = "it is too long ago"
    if why:
        terminal.say(f"an interrupted run cannot be resumed: {why}; starting afresh")
        return ()
    count = f"{len(before.found)} of {len(known)} tendons"
    line = await terminal.ask(
        f"An interrupted run has found {count}. Enter: go on from there. n: start afresh.", sure=True
    )
    return () if line is None or line.strip().lower() in {"n", "no"} else before.found


def _keep(
    directory: Path, known: tuple[ServoIdentity, ...], stand: tuple[int, ...], config: Config, found: Any
) -> None:
    _write(directory / _PROGRESS, Progress(VERSION, unix_now(), known, config.arm.pulley_radius_m, stand, found))


def _store(
    directory: Path,
    config: Config,
    known: tuple[ServoIdentity, ...],
    zeros: tuple[Zero, ...],
    parked: dict[int, int],
) -> None:
    _write(directory / files.TENDONS, made_of(zeros, known, config, unix_now()))
    _write(directory / files.PARKED, files.Parked(tuple(parked), tuple(parked.values())))
    with contextlib.suppress(FileNotFoundError):
        (directory / _PROGRESS).unlink()


def _write(path: Path, value: object) -> None:
    try:
        files.save(path, value)
    except OSError as error:
        raise RefusedError(f"{path} cannot be written: {error.strerror}") from error
