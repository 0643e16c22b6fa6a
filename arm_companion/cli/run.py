"""`arm-companion run`: the daemon."""

import argparse
import asyncio
import logging
from pathlib import Path

from arm_companion.app import Daemon, open_configured
from arm_companion.cli.common import add_config_arguments, add_live_argument, load_from
from arm_companion.clock import Clock, run_real_time, unix_now
from arm_companion.drivers.computer import ComputerWatch
from arm_companion.drivers.settings import state_directory, with_kept_changes
from arm_companion.drivers.standard_services import Power
from arm_companion.service_log import log_to_stderr
from arm_companion.supervisor import ServiceManager, stop_on_signals, take_priority

log = logging.getLogger(__name__)

START_AGAIN = 75
"""Exit code after PREFLIGHT_REBOOT_SHUTDOWN asked for a restart; systemd takes it for a failure and starts anew."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion run`."""
    add_config_arguments(parser)
    add_live_argument(parser)
    parser.add_argument("--verbose", action="store_true", help="log every state of links and servos")


def run(arguments: argparse.Namespace) -> int:
    """Run the daemon until SIGTERM or SIGINT; exit code 0 after an orderly stop, 75 when it is to be started again."""
    log_to_stderr(verbose=arguments.verbose)
    config = with_kept_changes(load_from(arguments))

    for words in take_priority():
        log.info("%s", words)

    async def main() -> int:
        stop = asyncio.Event()
        restore = stop_on_signals(stop)
        manager = ServiceManager()
        try:
            clock = Clock(asyncio.get_running_loop(), unix_now(), unix_now)
            computer = ComputerWatch(state_directory(config) or Path("/"))
            openers = open_configured(config)
            daemon = Daemon(
                config, openers, clock, manager, compiled_model=True, computer=computer, live=arguments.live
            )
            await daemon.run(stop)
            return START_AGAIN if daemon.power is Power.RESTART else 0
        finally:
            restore()
            manager.close()

    return run_real_time(main())
