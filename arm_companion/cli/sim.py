"""`arm-companion sim`: a scenario in the simulated world, with the real daemon."""

import argparse
import asyncio
import contextlib
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from arm_companion.cli import sitl
from arm_companion.cli.common import add_config_arguments, add_live_argument, load_from
from arm_companion.cli.sim_summary import number, summary
from arm_companion.config import Config
from arm_companion.errors import ArmError, ConfigError
from arm_companion.supervisor import ending_on_terminate

_CONFIGS = {
    "perch": "sim.toml",
    "hang": "sim_hang.toml",
    "grasp": "sim_grasp.toml",
    "abort": "sim.toml",
    "gust": "sim_gust.toml",
    "reach": "sim.toml",
    "world": "sim.toml",
}
TOO_SLOW = 75
"""Exit code of a flight that failed on a machine that could not keep up with real time (EX_TEMPFAIL)."""

_LOST_S = 0.2  # the vehicle's state is stale after a quarter of a second
_FILMS = (".mp4", ".mkv", ".webm", ".gif")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion sim`."""
    parser.add_argument(
        "scenario",
        choices=tuple(_CONFIGS),
        help="perch: take off, wrap a bar, be pulled, let go, land; hang: wrap a bar overhead, hang with idle motors, "
        "let go, land; grasp: pick an object up and put it back, without and with compensation, land; abort: one "
        "perch after the other, each aborted in another state; gust: a perch in gusts; reach: the tip to five "
        "points around the vehicle; world: no script, your own ground station flies",
    )
    add_config_arguments(
        parser, default="sim.toml, or the scenario's own: sim_hang.toml, sim_grasp.toml, sim_gust.toml"
    )
    parser.set_defaults(config=None)
    add_live_argument(parser)
    parser.add_argument("--simulated", action="store_true", help="one process in simulated time, as fast as it goes")
    parser.add_argument("--seed", type=int, metavar="N", help="of every random number in the world")
    parser.add_argument(
        "--trials",
        type=_count,
        metavar="N",
        help="fly N drawn worlds (bar, wind, masses, stiffness, friction), with seeds from --seed upwards; "
        "needs --simulated; exit code 0 only when all succeed",
    )
    parser.add_argument(
        "--jobs",
        type=_count,
        metavar="N",
        default=os.cpu_count() or 1,
        help="processes that fly trials at the same time (default: one a processor)",
    )
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help=f"draw the flight off-screen when it is over, as {', '.join(_FILMS)}; takes OpenGL and ffmpeg",
    )
    parser.add_argument("--json", action="store_true", help="print the verdict as one JSON object on the last line")
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("build/sim"),
        metavar="DIR",
        help="for log and figure (default: build/sim)",
    )
    parser.add_argument(
        "--log", type=Path, metavar="FILE", help="write the daemon's record here (default: DIR/record.mcap)"
    )
    sitl.add_arguments(parser)


def _count(text: str) -> int:
    """A whole number from 1 upwards."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is not 1 or more")
    return number


def run(arguments: argparse.Namespace) -> int:
    """Fly the scenario; exit code 0 only when it did what it is for."""
    if why := _wrong_usage(arguments):
        print(f"arm-companion sim: {why}", file=sys.stderr)
        return 2
    arguments.config = arguments.config or _CONFIGS[arguments.scenario]
    for name in ("matplotlib", "mcap", "mujoco", "orjson", "rich"):
        if importlib.util.find_spec(name) is None:
            print(f"arm-companion sim needs '{name}': pip install 'arm-companion[sim]'", file=sys.stderr)
            return 2
    sitl.check(arguments)
    if arguments.seed is not None:
        arguments.settings.append(f"sim.seed={arguments.seed}")
    config = load_from(arguments)
    if arguments.trials is not None:
        with ending_on_terminate():
            return _trials(arguments, config)
    _make_folder(arguments.output)
    if arguments.sitl_connect:
        return sitl.check_running(arguments)
    _truth_path(arguments).unlink(missing_ok=True)  # the report must not take an earlier run's for this one's
    if arguments.scenario == "world":
        return _serve(arguments, config)
    with ending_on_terminate():  # it ends the daemon and the flight stack too, as Ctrl-C does
        return _fly(arguments, config)


def _make_folder(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--output {output}: {error.strerror}") from error


def _wrong_usage(arguments: argparse.Namespace) -> str:
    """What is wrong with options that argparse cannot judge, empty when nothing is."""
    if arguments.trials is not None and not (arguments.simulated and arguments.scenario != "world"):
        return "--trials needs --simulated and a scenario with a script"
    if arguments.scenario == "world" and arguments.simulated:
        return "world waits for people, in real time: leave out --simulated"
    if arguments.live is not None and arguments.simulated:
        return "--live shows real time: leave out --simulated"
    if arguments.video is not None and (why := _no_video(arguments)):
        return f"--video {why}"
    return ""


def _no_video(arguments: argparse.Namespace) -> str:
    """Why there can be no film whatever is installed; empty: there can."""
    if arguments.scenario == "world" or arguments.trials is not None:
        return "films one flight with a script, without --trials"
    if arguments.video.suffix not in _FILMS:
        return f"{arguments.video}: a film's name ends with one of {', '.join(_FILMS)}"
    return ""


def _serve(arguments: argparse.Namespace, config: Config) -> int:
    from arm_companion.clock import run_real_time  # noqa: PLC0415 - after the check for the extra
    from arm_companion.sim.progress import Progress  # noqa: PLC0415
    from arm_companion.sim.runner import serve  # noqa: PLC0415
    from arm_companion.supervisor import stop_on_signals  # noqa: PLC0415

    async def main() -> None:
        stop = asyncio.Event()
        restore = stop_on_signals(stop)
        try:
            say = Progress(sys.stdout).say
            await serve(config, _daemon_words(arguments), arguments.output / "daemon.log", say, stop)
        finally:
            restore()

    run_real_time(main())
    return 0


def _fly(arguments: argparse.Namespace, config: Config) -> int:
    from arm_companion.sim import film  # noqa: PLC0415 - after the check for the extra
    from arm_companion.sim.figure import draw  # noqa: PLC0415
    from arm_companion.sim.judges import SCENARIOS  # noqa: PLC0415
    from arm_companion.sim.progress import Progress, show_verdict  # noqa: PLC0415
    from arm_companion.sim.world import World  # noqa: PLC0415

    output: Path = arguments.output
    figure, log = output / f"{arguments.scenario}.png", output / "events.log"
    started = time.perf_counter()
    progress = Progress(sys.stderr if arguments.json else sys.stdout)
    fly = _simulated if arguments.simulated else _real_time
    try:
        studio = None if arguments.video is None else film.studio()
    except film.NoFilm as error:
        print(f"arm-companion sim: no video: {error}", file=sys.stderr)
        return 2

    def prepare(world: World) -> None:
        world.pose_every_s = None if studio is None else 1.0 / film.PICTURES_PER_S

    try:
        with sitl.flying(arguments, config) as stack:
            places = (figure, log, output / "daemon.log", _record_path(arguments), arguments.video)
            for old in filter(None, places):
                old.unlink(missing_ok=True)  # a flight that fails leaves none of an earlier one's behind
            result = fly(arguments, config, progress, prepare, stack)
    except ConfigError:
        raise
    except (ArmError, OSError) as error:
        print(f"arm-companion sim: {error}", file=sys.stderr)
        return 1
    scenario = SCENARIOS[arguments.scenario]
    verdict = scenario.judge(result.flight, result.failure, config)
    title = f"{scenario.title}: {verdict.verdict}"
    written = _written(arguments, result.flight, lambda: draw(result.flight, config, title, figure), log)
    files = [figure, log, _record_path(arguments)]
    if studio is not None:
        written = _film(arguments.video, config, result.poses, studio, progress.console) and written
        files.append(arguments.video)
    show_verdict(scenario.title, verdict, progress.console, files)
    if arguments.json:
        wall = time.perf_counter() - started
        print(json.dumps(summary(arguments.scenario, verdict, result, wall)))
    if not verdict.success and result.lost_s > _LOST_S:
        print(
            f"arm-companion sim: no fair flight: this machine fell {result.lost_s:.1f} s behind real time; "
            "--simulated takes the time that it takes",
            file=sys.stderr,
        )
        return TOO_SLOW
    return 0 if verdict.success and written else 1


def _film(path: Path, config: Config, poses: Any, studio: Any, console: Any) -> bool:
    """Draw it; whether that went well, which is said when not."""
    from arm_companion.sim import film  # noqa: PLC0415 - after the check for the extra

    console.print(f"drawing {len(poses)} pictures")
    try:
        film.make(path, config, poses, studio)
    except (film.NoFilm, OSError) as error:
        with contextlib.suppress(OSError):  # half a film is none
            path.unlink(missing_ok=True)
        print(f"arm-companion sim: {error}", file=sys.stderr)
        return False
    return True


def _trials(arguments: argparse.Namespace, config: Config) -> int:
    from arm_companion.sim.judges import SCENARIOS  # noqa: PLC0415 - after the check for the extra
    from arm_companion.sim.progress import show_outcome, show_summary  # noqa: PLC0415
    from arm_companion.sim.trials import fly  # noqa: PLC0415

    started = time.perf_counter()
    stream = sys.stderr if arguments.json else sys.stdout
    seeds = range(config.sim.seed, config.sim.seed + arguments.trials)
    scenario = SCENARIOS[arguments.scenario]
    outcome = fly(
        arguments.config,
        arguments.settings,
        seeds,
        arguments.jobs,
        lambda one: show_outcome(one, scenario.done, stream),
        arguments.scenario,
    )
    show_summary(scenario.title, scenario.done, outcome, stream)
    if arguments.json:
        low, high = outcome.interval
        contract = {
            "scenario": arguments.scenario,
            "success": outcome.success,
            "trials": len(outcome.outcomes),
            "failures": outcome.failures,
            "interval_95": [round(low, 4), round(high, 4)],
            "harmed": outcome.harmed,
            "wrench_two_sigma_share": number(outcome.covered),
            "seed": config.sim.seed,
            "wall_s": round(time.perf_counter() - started, 3),
        }
        print(json.dumps(contract))
    return 0 if outcome.success == len(outcome.outcomes) else 1


def _written(arguments: argparse.Namespace, flight: Any, draw: Callable[[], None], log: Path) -> bool:
    """Write what a flight leaves, the truth where `report` looks for it; whether the disk took it, which is told."""
    from arm_companion.clock import SIMULATED_EPOCH_S, unix_now  # noqa: PLC0415
    from arm_companion.sim.truth import write_truth  # noqa: PLC0415

    offset = SIMULATED_EPOCH_S if arguments.simulated else unix_now() - time.perf_counter()
    start = flight.samples[0].t if flight.samples else 0.0
    try:
        draw()
        log.write_text("".join(f"{t - start:8.2f} s  {text}\n" for t, text in flight.texts), encoding="utf-8")
        write_truth(_truth_path(arguments), flight.samples, lambda t: t + offset)
    except OSError as error:  # the verdict on a flight of minutes is not lost with it
        print(f"arm-companion sim: {error}", file=sys.stderr)
        return False
    return True


def _record_path(arguments: argparse.Namespace) -> Path:
    path: Path = arguments.log or arguments.output / "record.mcap"
    return path


def _truth_path(arguments: argparse.Namespace) -> Path:
    from arm_companion.record.reader import truth_beside  # noqa: PLC0415

    return truth_beside(_record_path(arguments))


def _simulated(arguments: argparse.Namespace, config: Config, progress: Any, prepare: Any, stack: Any) -> Any:
    from arm_companion.clock import run_simulated  # noqa: PLC0415
    from arm_companion.service_log import logging_to  # noqa: PLC0415
    from arm_companion.sim.judges import SCENARIOS  # noqa: PLC0415
    from arm_companion.sim.runner import fly_simulated  # noqa: PLC0415

    script, log = SCENARIOS[arguments.scenario].fly, _record_path(arguments)
    with logging_to(arguments.output / "daemon.log"):
        return run_simulated(fly_simulated(config, progress.say, prepare, log, fly=script, flown_by=stack))


def _real_time(arguments: argparse.Namespace, config: Config, progress: Any, prepare: Any, stack: Any) -> Any:
    from arm_companion.clock import run_real_time  # noqa: PLC0415
    from arm_companion.sim.asked import asked  # noqa: PLC0415
    from arm_companion.sim.judges import SCENARIOS  # noqa: PLC0415
    from arm_companion.sim.runner import fly_real_time  # noqa: PLC0415

    words, fly = _daemon_words(arguments), SCENARIOS[arguments.scenario].fly
    log = arguments.output / "daemon.log"
    result = run_real_time(fly_real_time(config, words, log, progress.say, prepare, fly=fly, flown_by=stack))
    result.flight.asked = asked(_record_path(arguments))
    return result


def _daemon_words(arguments: argparse.Namespace) -> list[str]:
    """The daemon's command line: as in flight, with the settings of this run."""
    words = ["run", "--config", arguments.config]
    for setting in (*arguments.settings, f'record.file="{_record_path(arguments).resolve()}"'):
        words += ["--set", setting]
    if arguments.live is not None:
        words += ["--live", str(arguments.live)]
    return words
