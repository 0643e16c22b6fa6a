"""`arm-companion config`: check or show a configuration."""

import argparse
import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from arm_companion.cli.common import add_config_arguments, load_from


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion config`."""
    parser.add_argument("action", choices=("check", "show"), help="check: refuse or accept; show: every value as JSON")
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Check the configuration and, when asked, print all of its values."""
    config = load_from(arguments)
    if arguments.action == "show":
        print(json.dumps(_plain(config), indent=2))
    else:
        print(f"{arguments.config}: usable")
    return 0


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
