"""Options of `arm-companion sim` for real flight stacks: which, where its program is, or where one runs already."""

import argparse
import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from arm_companion.config import Config
from arm_companion.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from arm_companion.sim.sitl import Sitl

STACKS = ("ardupilot", "px4")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options, in a group of their own."""
    group = parser.add_argument_group(
        "a real flight stack", "ArduPilot copter or PX4 SITL in place of the stand-in, flying the same plant"
    )
    group.add_argument("--sitl", choices=STACKS, help="the flight stack that flies")
    group.add_argument(
        "--sitl-binary",
        type=Path,
        metavar="PATH",
        help="your own arducopter or px4 program, built for SITL (default: the environment's "
        "ARM_COMPANION_ARDUPILOT_SITL or ARM_COMPANION_PX4_SITL)",
    )
    group.add_argument(
        "--sitl-visible",
        action="store_true",
        help="leave its ports open to this machine's network, for a ground station elsewhere; otherwise it runs in a "
        "network of its own, where the system allows that",
    )
    group.add_argument(
        "--sitl-connect",
        metavar="URL",
        help="instead: check a flight stack that runs already (udpin:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD), "
        "without the plant",
    )
    group.add_argument(
        "--sitl-fly",
        action="store_true",
        help="with --sitl-connect: arm it, take off and fly set-points too. IN A SIMULATOR ONLY: propellers will turn",
    )


def check(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together.

    Raises:
        ConfigError: with what does not.
    """
    if arguments.sitl is None:
        given = (arguments.sitl_binary, arguments.sitl_connect, arguments.sitl_visible, arguments.sitl_fly)
        if any(given):
            raise ConfigError("--sitl-... options need --sitl ardupilot or --sitl px4")
        return
    if arguments.trials is not None or arguments.scenario == "world":
        raise ConfigError("--sitl flies one flight: neither --trials nor world")
    if arguments.sitl_connect and arguments.sitl_binary:
        raise ConfigError("--sitl-connect takes a flight stack that runs already, --sitl-binary starts one: not both")
    if arguments.sitl_fly and not arguments.sitl_connect:
        raise ConfigError("--sitl-fly goes with --sitl-connect")
    arguments.settings.append(f'vehicle.autopilot="{arguments.sitl}"')


@contextlib.contextmanager
def flying(arguments: argparse.Namespace, config: Config) -> "Iterator[Sitl | None]":
    """The flight stack that the options name, running for the time of the block; None is the stand-in.

    Raises:
        ConfigError: no program is named, or it cannot be started like this.
        ArmError: it does not start.
    """
    if arguments.sitl is None:
        yield None
        return
    from arm_companion.sim import isolation, sitl  # noqa: PLC0415 - after the check for the extra

    program = sitl.binary(arguments.sitl, arguments.sitl_binary)
    if not arguments.sitl_visible:
        try:
            isolation.isolate()
        except isolation.NotIsolated as reason:
            print(
                f"arm-companion sim: {reason}. The flight stack's ports are open on every address of this machine.",
                file=sys.stderr,
            )
    log = arguments.output / f"{arguments.sitl}.log"
    with sitl.running(arguments.sitl, program, config, log, simulated=arguments.simulated) as stack:
        yield stack


def check_running(arguments: argparse.Namespace) -> int:
    """Look at a flight stack that runs already; exit code 0 only when it does all that was asked."""
    from rich.console import Console  # noqa: PLC0415 - after the check for the extra
    from rich.table import Table  # noqa: PLC0415

    from arm_companion.clock import run_real_time  # noqa: PLC0415
    from arm_companion.sim.operator_link import OperatorLink  # noqa: PLC0415
    from arm_companion.sim.progress import Progress  # noqa: PLC0415
    from arm_companion.sim.sitl_check import Check, CheckFailed  # noqa: PLC0415
    from arm_companion.transport.urls import open_url  # noqa: PLC0415

    link = OperatorLink([open_url(arguments.sitl_connect)])
    checks = Check(link, arguments.sitl, Progress(sys.stderr).say)

    async def main() -> str:
        async with link.running():
            try:
                await checks.listen()
                if arguments.sitl_fly:
                    await checks.fly()
            except (CheckFailed, LinkError, TimeoutError) as error:
                return str(error)
        return ""

    failure = run_real_time(main())
    table = Table(title=f"{arguments.sitl} at {arguments.sitl_connect}", title_justify="left", show_header=False)
    for row in checks.findings.lines():
        table.add_row(*row)
    Console(highlight=False).print(table)
    if failure:
        print(f"arm-companion sim: {failure}", file=sys.stderr)
    return 1 if failure else 0
