"""What several commands share."""

import argparse

from arm_companion.config import Config, load


def add_config_arguments(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """`--config` and `--set`."""
    parser.add_argument(
        "--config",
        metavar="FILE",
        default=default,
        required=default is None,
        help="configuration file" + (f" (default: {default})" if default else ""),
    )
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        dest="settings",
        help="override one option, such as perch.bar_radius_m=0.02; may be repeated",
    )


def load_from(arguments: argparse.Namespace) -> Config:
    """The configuration that the arguments name.

    Raises:
        ConfigError: it cannot be used.
    """
    return load(arguments.config, arguments.settings)
