"""What several commands share."""

import argparse
import os

from arm_companion.config import Config, load
from arm_companion.config.layers import SYSTEM_FILE
from arm_companion.live.feed import Address


def add_config_arguments(parser: argparse.ArgumentParser, default: str = str(SYSTEM_FILE)) -> None:
    """`--config` and `--set`."""
    parser.add_argument("--config", metavar="FILE", default=default, help=f"configuration file (default: {default})")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        dest="settings",
        help="override one option, such as perch.bar_radius_m=0.02; may be repeated",
    )


def add_live_argument(parser: argparse.ArgumentParser) -> None:
    """`--live`."""
    parser.add_argument(
        "--live",
        type=_address,
        nargs="?",
        const=Address(),
        metavar="HOST:PORT",
        help=f"serve a live view for Foxglove (default: {Address()}); whoever reaches it can look",
    )


def _address(text: str) -> Address:
    try:
        return Address.read(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT, such as {Address()}") from None


def in_words(error: Exception) -> str:
    """What an error says, without the number and the quotes that Python gives those of the system."""
    if isinstance(error, OSError) and error.strerror:
        return ": ".join(str(part) for part in (error.filename, error.strerror) if part)
    return str(error)


def load_from(arguments: argparse.Namespace) -> Config:
    """The configuration that the arguments name, with what the environment overrides.

    Raises:
        ConfigError: it cannot be used.
    """
    return load(arguments.config, arguments.settings, os.environ)
