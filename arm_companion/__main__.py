"""The `arm-companion` command."""

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Collection

from arm_companion import __version__
from arm_companion.errors import ArmError, ConfigError

_INTERRUPTED = 130  # 128 + SIGINT, as shells count
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")  # our matrices are small: threads wait more than they work
_COMMANDS = {
    "run": "the daemon: fly the arm",
    "ground": "hear and command the arm from the ground",
    "sim": "fly a scenario in the simulated world with the real daemon",
    "model": "the arm's mechanics: one equilibrium, or the paper's experiments",
    "calibrate": "tendons and tensions on the bench, the model from measurements",
    "servos": "find, set up and watch the servos",
    "jog": "bend the arm from the keyboard, while no daemon runs",
    "replay": "run a recorded flight through today's code, or ask what would have been",
    "report": "one page of a recorded flight, for people",
    "config": "check, show and explain a configuration",
    "doctor": "look at the whole installation, and say what to mend",
}


def command_line(named: Collection[str] = tuple(_COMMANDS)) -> argparse.ArgumentParser:
    """The parser of `arm-companion`.

    Args:
        named: commands whose options it knows; only their modules are imported, so that the daemon starts quickly.
    """
    parser = argparse.ArgumentParser(
        prog="arm-companion", description="Companion-computer service for a continuum arm on a drone."
    )
    parser.add_argument("--version", action="version", version=f"arm-companion {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in _COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name in named:
            module = importlib.import_module(f"arm_companion.cli.{name}")
            module.add_arguments(sub)
            sub.set_defaults(run=module.run)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run one command; returns the exit code."""
    for name in _ONE_THREAD:  # before a command imports NumPy
        os.environ.setdefault(name, "1")
    words = sys.argv[1:] if argv is None else argv
    named = next((word for word in words if not word.startswith("-")), "")
    try:
        arguments = command_line([named]).parse_args(words)
        code: int = arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:  # what has an orderly end of its own takes the signal before it gets here
        if argv is None:  # a process of its own: a second press has nothing left to end
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print("arm-companion: interrupted", file=sys.stderr)
        return _INTERRUPTED
    except ConfigError as error:
        print(f"arm-companion: {error}", file=sys.stderr)
        return error.exit_code
    except ArmError as error:
        print(f"arm-companion: {error}", file=sys.stderr)
        return 1
    return code


if __name__ == "__main__":
    sys.exit(main())
