"""`arm-companion config`: check or show a configuration."""

import argparse
import json

from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.config.table import as_table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion config`."""
    parser.add_argument("action", choices=("check", "show"), help="check: refuse or accept; show: every value as JSON")
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Check the configuration and, when asked, print all of its values."""
    config = load_from(arguments)
    if arguments.action == "show":
        print(json.dumps(as_table(config), indent=2))
    else:
        print(f"{arguments.config}: usable")
    return 0
