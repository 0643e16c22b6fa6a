"""`arm-companion ground`: a person on the ground, or a script, with an arm that flies."""

import argparse
import importlib.util
import json
import os
import sys
from collections.abc import Awaitable, Callable
from typing import Any, Final, TypeAlias

from arm_companion.cli.common import in_words
from arm_companion.clock import run_real_time
from arm_companion.errors import ArmError

DONE: Final = 0
FAILED: Final = 1
USAGE: Final = 2
NOT_HEARD: Final = 3
UNFINISHED: Final = 4
INTERRUPTED: Final = 130

Action: TypeAlias = Callable[[argparse.Namespace, Any], Awaitable[int]]
"""What a command does with an arm; returns the exit code."""

_URL: Final = "udpin://127.0.0.1:14560"  # ground.DEFAULT_URL, which needs mavsdk to be imported
_CODES: Final = """exit codes:
  0    done
  1    refused or failed; the reason is told
  2    wrong usage, or the extra 'ground' is not installed
  3    the arm is not heard, or does not answer
  4    no final answer within --timeout; the arm carries on
  130  ended by Ctrl-C before its end
"""

_SURE: Final = """The arm takes up its tendons one by one for some three minutes, and bends by 60 degrees to each side.
It must hang straight down and free, nothing and nobody may touch it, and the propellers must not turn.
The result is stored and used at once. Ctrl-C twice gives it up. Go on? [y/N] """

_ORDERS: Final = {
    "ready": "torque on, pretension, straight",
    "perch": "perch on the bar; ends when the grip is verified, or when the vehicle hangs",
    "grasp": "grasp the object; ends when it is carried",
    "release": "let go and clear what was held",
    "stow": "straighten the arm",
    "abort": "leave whatever runs on its shortest safe way",
    "clear": "clear errors whose cause is gone: servos that shut down are rebooted; the arm hangs straight",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion ground`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _CODES
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    common = _common()

    def add(name: str, text: str, *parents: argparse.ArgumentParser) -> argparse.ArgumentParser:
        return actions.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            parents=[common, *parents],
            epilog=_CODES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    add("status", "show once what the arm tells")
    watch = add("watch", "show live what the arm tells; lines when it is not a terminal")
    _seconds(watch)
    for name, text in _ORDERS.items():
        order = add(name, text)
        if name == "perch":
            _target(order, "bar", "a point on its axis")
            order.add_argument(
                "--hang", action="store_true", help="hang from the bar with idle motors, by an arm above the vehicle"
            )
        if name == "grasp":
            _target(order, "object", "the middle of its axis")
    calibrate = add("calibrate", "find the tendons' zeros by the daemon: on the ground, disarmed, the arm hanging free")
    calibrate.add_argument("--yes", action="store_true", help="nothing and nobody touches the arm: do not ask")
    _jog(add("jog", "bend the free arm from the keyboard or by numbers, or move the anchored vehicle"))
    _reach(add("reach", "bring the tip to a point and keep it there, by vehicle and arm together"))
    control = add("control", "take primary control, so that other stations may only stow and abort, or give it up")
    control.add_argument("verb", choices=("take", "release", "take-over"))
    _params(add("params", "list, read or set the parameters of the arm's component"))
    _record(add("record", "write what the arm tells to a file, until Ctrl-C"))
    _plot(add("plot", "draw a record, or what the arm tells now, as a PNG"))
    qgc = actions.add_parser("qgc-actions", help="print the file of buttons for QGroundControl")
    qgc.add_argument("--component", type=_id, default=192, metavar="ID", help="of the arm (default: 192)")


def run(arguments: argparse.Namespace) -> int:
    """Run one action; returns the exit code."""
    if arguments.action == "qgc-actions":
        from arm_companion.ground.qgc import as_text  # noqa: PLC0415 - the dialect takes time to import

        print(as_text(arguments.component), end="")
        return DONE
    if wrong := _wrong_usage(arguments):
        print(f"arm-companion ground {arguments.action}: {wrong}", file=sys.stderr)
        return USAGE
    for name in _needs(arguments):
        if importlib.util.find_spec(name) is None:
            print(f"arm-companion ground needs '{name}': pip install 'arm-companion[ground]'", file=sys.stderr)
            return USAGE
    if arguments.action == "calibrate" and not arguments.yes and (code := _refused_by_person(arguments)) is not None:
        return code
    from arm_companion.cli import ground_orders, ground_show  # noqa: PLC0415 - after the check for the extra

    table: dict[str, Action] = {**ground_show.ACTIONS, **ground_orders.ACTIONS}
    if arguments.action == "plot" and arguments.record is not None:
        return ground_show.plot_record(arguments)
    return _with_arm(arguments, table[arguments.action])


def say(arguments: argparse.Namespace, text: str) -> None:
    """Words for people: on standard error when standard output is for a program."""
    print(text, file=sys.stderr if arguments.json else sys.stdout, flush=True)


def tell(arguments: argparse.Namespace, **facts: Any) -> None:
    """The result for programs: one JSON object on a line of its own, with --json only."""
    if arguments.json:
        print(json.dumps(facts), flush=True)


def _refused_by_person(arguments: argparse.Namespace) -> int | None:
    """Ask on standard error, as standard output may be for a program; None: go on, else the exit code."""
    print(_SURE, end="", file=sys.stderr, flush=True)
    try:
        answer = sys.stdin.readline()
    except KeyboardInterrupt:
        return _ended(arguments, INTERRUPTED, "interrupted", "")
    if answer.strip().lower() in ("y", "yes"):
        return None
    return _ended(arguments, FAILED, "declined", "", "nothing is done")


def _with_arm(arguments: argparse.Namespace, action: Action) -> int:
    from arm_companion.ground import Arm, ArmSilent, CommandFailed, CommandUnfinished  # noqa: PLC0415

    async def main() -> int:
        async with Arm.connect(
            arguments.connect,
            timeout=arguments.connect_timeout,
            system=arguments.system,
            component=arguments.component,
            address=(arguments.source_system, arguments.source_component),
        ) as arm:
            return await action(arguments, arm)

    try:
        return run_real_time(main())
    except KeyboardInterrupt:
        return _ended(arguments, INTERRUPTED, "interrupted", "")
    except BrokenPipeError:
        raise
    except ArmSilent as error:
        return _ended(arguments, NOT_HEARD, "not heard", str(error))
    except CommandUnfinished as error:
        return _ended(arguments, UNFINISHED, "unfinished", str(error))
    except CommandFailed as error:
        return _ended(arguments, FAILED, error.result, error.reason, str(error))
    except (ArmError, OSError) as error:
        return _ended(arguments, FAILED, "failed", in_words(error))


def _ended(arguments: argparse.Namespace, code: int, result: str, reason: str, words: str = "") -> int:
    if words or reason:
        print(f"arm-companion ground: {words or reason}", file=sys.stderr)
    tell(arguments, action=arguments.action, result=result, reason=reason)
    return code


def _wrong_usage(arguments: argparse.Namespace) -> str:
    """What is wrong with options that argparse cannot judge, empty when nothing is."""
    match arguments.action:
        case "params":
            given = (arguments.name is not None, arguments.value is not None)
            wanted = {"list": (False, False), "get": (True, False), "set": (True, True)}[arguments.verb]
            return "" if given == wanted else "params list | params get NAME | params set NAME VALUE"
        case "perch":
            together = {arguments.bar is None, arguments.bar_axis_deg is None, arguments.bar_radius is None}
            return "" if len(together) == 1 else "--bar, --bar-axis-deg and --bar-radius belong together"
        case "grasp":
            together = {arguments.object is None, arguments.object_axis_deg is None, arguments.object_radius is None}
            return "" if len(together) == 1 else "--object, --object-axis-deg and --object-radius belong together"
        case "calibrate" if not (arguments.yes or sys.stdin.isatty()):
            return "nobody is there to confirm that nothing touches the arm: give --yes"
        case "jog" if arguments.theta_deg is not None and arguments.vehicle is not None:
            return "--theta-deg moves the arm and --vehicle the vehicle: give one of them"
        case "jog" if arguments.theta_deg is None and arguments.vehicle is None and not sys.stdin.isatty():
            return "the keyboard needs a terminal; without one give --theta-deg or --vehicle"
    return ""


def _needs(arguments: argparse.Namespace) -> list[str]:
    needs = {"watch": ["mavsdk", "rich"], "plot": ["mavsdk", "matplotlib"]}
    return needs.get(arguments.action, ["mavsdk"])


def _common() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    link = common.add_argument_group("connection")
    link.add_argument(
        "--connect",
        metavar="URL",
        default=os.environ.get("ARM_COMPANION_CONNECT", _URL),
        help="udpin://HOST:PORT, udpout://HOST:PORT, tcpout://HOST:PORT or serial://DEVICE:BAUD; the companion or "
        f"the autopilot (default: $ARM_COMPANION_CONNECT, or {_URL}, where `arm-companion sim world` sends)",
    )
    link.add_argument(
        "--connect-timeout",
        type=_positive,
        default=10.0,
        metavar="S",
        help="wait for the arm's heartbeat (default: 10)",
    )
    link.add_argument("--system", type=_id, default=0, metavar="ID", help="of the vehicle (default: the first heard)")
    link.add_argument("--component", type=_id, default=192, metavar="ID", help="of the arm (default: 192)")
    link.add_argument("--source-system", type=_id, default=245, metavar="ID", help="our own (default: 245)")
    link.add_argument("--source-component", type=_id, default=190, metavar="ID", help="our own (default: 190)")
    common.add_argument("--json", action="store_true", help="results as JSON lines on standard output")
    common.add_argument(
        "--timeout", type=_positive, metavar="S", help="wait for the end (default: as long as it is heard)"
    )
    return common


def _seconds(parser: argparse.ArgumentParser, default: float | None = None) -> None:
    text = "how long" + (" (default: until Ctrl-C)" if default is None else f" (default: {default:g})")
    parser.add_argument("--seconds", type=_positive, metavar="S", default=default, help=text)


def _target(parser: argparse.ArgumentParser, name: str, point: str) -> None:
    parser.add_argument(
        f"--{name}",
        type=float,
        nargs=3,
        metavar=("N", "E", "D"),
        help=f"first tell where the {name} is: {point}, m, in the autopilot's local frame",
    )
    parser.add_argument(f"--{name}-axis-deg", type=float, metavar="DEG", help="its heading; it is level")
    parser.add_argument(f"--{name}-radius", type=_positive, metavar="M", help="its radius")


def _jog(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--theta-deg", type=float, metavar="DEG", help="bend once to this angle instead of the keyboard"
    )
    parser.add_argument("--delta-deg", type=float, metavar="DEG", default=0.0, help="in this plane (default: 0)")
    parser.add_argument(
        "--vehicle", type=float, nargs=3, metavar=("N", "E", "D"), help="move the anchored vehicle: offset in m"
    )


def _reach(parser: argparse.ArgumentParser) -> None:
    for name in ("north", "east", "down"):
        parser.add_argument(name, type=float, metavar=name.upper(), help="of the point, m, autopilot's local frame")
    parser.add_argument("--arm-only", action="store_true", help="the vehicle stays: the arm does it alone or refuses")


def _params(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("verb", choices=("list", "get", "set"))
    parser.add_argument("name", nargs="?")
    parser.add_argument("value", nargs="?", type=float)


def _record(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--output", metavar="FILE", default="arm.jsonl", help="*.jsonl or *.csv (default: arm.jsonl)")
    _seconds(parser)


def _plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("record", nargs="?", metavar="RECORD", help="*.jsonl; without one, listen for --seconds")
    parser.add_argument("--output", metavar="FILE", default="arm.png", help="of the PNG (default: arm.png)")
    _seconds(parser, 20.0)


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError("must be over 0")
    return value


def _id(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 255:
        raise argparse.ArgumentTypeError("must be 1 to 255")
    return value
