"""`arm-companion config`: check, show and explain a configuration, or describe all that there is to configure."""

import argparse
import difflib
import json
import os
from typing import Any

from arm_companion.app import open_configured
from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.config.describe import Described, every, json_schema
from arm_companion.config.flyable import check_flyable
from arm_companion.config.layers import Layers, collect
from arm_companion.config.load import checked
from arm_companion.config.options import spelling
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table
from arm_companion.doctor.config_checks import unusable_files
from arm_companion.errors import ConfigError
from arm_companion.record import check_installed

_EPILOG = """\
Where values come from, the last one wins: the file and those that it extends; drop-ins, which are the *.toml files in
the folder beside it that is called as the file with .d for .toml (config.toml: config.d/); environment variables
ARM_COMPANION__SECTION__KEY=VALUE; --set.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion config`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    check = actions.add_parser("check", help="refuse or accept a configuration, and tell its layers")
    show = actions.add_parser("show", help="every value as JSON")
    explain = actions.add_parser(
        "explain", help="what an option or a section means, its range, its value and its origin"
    )
    explain.add_argument("key", metavar="KEY", help="such as perch.grip_tension_n, or a section such as perch")
    explain.add_argument("--json", action="store_true", help="as JSON")
    for action in (check, show, explain):
        add_config_arguments(action)
    actions.add_parser("schema", help="the configuration file as JSON Schema, for editors")


def run(arguments: argparse.Namespace) -> int:
    """Carry out one action.

    Raises:
        ConfigError: the configuration cannot be used, or there is no such option.
    """
    match arguments.action:
        case "schema":
            print(json.dumps(json_schema(), indent=2))
        case "show":
            print(json.dumps(as_table(load_from(arguments)), indent=2))
        case "check":
            _check(arguments)
        case "explain":
            _explain(arguments)
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Tell the layers of a configuration that is accepted, and whether it can fly too."""
    layers = _layers(arguments)
    config = checked(layers)
    for layer in layers:
        print(f"  {layer.path or layer.name}")
    try:
        open_configured(config)
        check_flyable(config)
        check_installed(config)
        for file in unusable_files(config):
            raise ConfigError(file)
    except ConfigError as refused:
        print(f"{arguments.config}: usable, but not for the daemon: {refused}")
    else:
        print(f"{arguments.config}: usable")


def _layers(arguments: argparse.Namespace) -> Layers:
    return collect(arguments.config, arguments.settings, os.environ)


def _explain(arguments: argparse.Namespace) -> None:
    key = ".".join(spelling(Config, arguments.key.split(".")))
    found = [option for option in every() if option.fits(key)]
    if not found:
        found = [option for option in every() if option.is_below(key)]
    if not found:
        known = [option.key for option in every()]
        close = difflib.get_close_matches(key, known, n=3) or [k for k in known if key.split(".")[-1] in k][:3]
        hint = f": did you mean {' or '.join(close)}?" if close else ""
        raise ConfigError(f"there is no option '{arguments.key}'{hint}")
    layers = _layers(arguments)
    config = as_table(checked(layers))
    told = [_tell(option, key if option.fits(key) else option.within(key), config, layers) for option in found]
    if arguments.json:
        print(json.dumps(told, indent=2))
        return
    for i, fact in enumerate(told):
        if i:
            print()
        print(fact.pop("key"))
        for name, value in fact.items():
            if value not in ("", None):
                print(f"  {name:<8} {value if isinstance(value, str) else json.dumps(value)}")


def _tell(option: Described, key: str, config: Any, layers: Layers) -> dict[str, Any]:
    known, value = _value(config, key)
    origin = layers.origin(key)
    default = None if option.required else as_table(option.default)
    return {
        "key": key,
        "means": option.option.doc,
        "type": option.kind,
        "allowed": option.allowed,
        "unit": option.option.unit,
        "default": "none: it must be given" if option.required else default,
        "value": value if known else None,
        "from": (str(origin.path or origin.name) if origin is not None else "default") if known else None,
    }


def _value(table: Any, key: str) -> tuple[bool, Any]:
    """Whether the configuration has the key with its real name, and its value."""
    for part in key.split("."):
        if not isinstance(table, dict) or part not in table:
            return False, None
        table = table[part]
    return True, table
