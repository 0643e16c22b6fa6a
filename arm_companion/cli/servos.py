"""`arm-companion servos`: find, set up and watch the servos. Needs the bus for itself: stop the daemon first."""

import argparse
import contextlib
import dataclasses
import json
import signal
import sys
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.clock import run_real_time, ticks
from arm_companion.config.schema import ServosConfig
from arm_companion.drivers import servo_provision, servo_scan
from arm_companion.drivers.servo_health import BusCounters, ServoState
from arm_companion.drivers.servo_monitor import ServoMonitor
from arm_companion.drivers.servo_scan import FoundServo, OpenAt
from arm_companion.errors import CommandRejected, ConfigError, LinkError
from arm_companion.protocol.control_table import BAUD_CODES
from arm_companion.transport.base import Opener
from arm_companion.transport.serial import latency_advice
from arm_companion.transport.trace import recorded
from arm_companion.transport.urls import open_bus

_TROUBLE = 1
_REFUSED = 2
_FIRST_READS = 3  # until health has been looked up


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion servos`."""
    parser.epilog = (
        "The bus belongs to one program at a time: stop the daemon first (systemctl stop arm-companion). "
        "Exit code 0: well; 1: a servo or the port is not; 2: refused; 78: the configuration cannot be used."
    )
    commands = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    scan = commands.add_parser(
        "scan",
        help="list the servos that answer, at every speed and id",
        description="List the servos that answer. Nothing is written.",
    )
    _add_common(scan)
    scan.add_argument("--baud", type=_baud, action="append", metavar="BITS", help="only this speed; may be repeated")
    scan.add_argument("--id", type=_servo_id, action="append", default=[], help="ask this id one by one as well")
    scan.add_argument("--json", action="store_true", help="print one JSON list")
    setup = commands.add_parser(
        "setup",
        help="give one new servo its id, speed, mode and limits",
        description="Give one new servo its id, speed, mode and limits. Servos of the arm that are set up already may "
        "stay connected; of new ones only one at a time. What will be written is shown first; without --yes it is "
        "asked for, and where nobody can answer nothing is written. After an interruption run it again.",
    )
    _add_common(setup)
    setup.add_argument(
        "--id",
        type=_servo_id,
        help="id that it gets (default: the first of servos.ids, then gripper.servo_id, that is missing)",
    )
    answer = setup.add_mutually_exclusive_group()
    answer.add_argument("--yes", action="store_true", help="write without asking")
    answer.add_argument("--dry-run", action="store_true", help="show what would be written and stop")
    monitor = commands.add_parser(
        "monitor",
        help="watch position, load, voltage, temperature, errors and losses",
        description="Watch the servos. Nothing is written, torque stays as it is. Ctrl-C ends it.",
    )
    _add_common(monitor)
    monitor.add_argument("--rate", type=_rate, default=20.0, metavar="HZ", help="reads a second (default: 20)")
    monitor.add_argument("--once", action="store_true", help="print one reading and stop")
    monitor.add_argument("--json", action="store_true", help="one JSON object a line")
    monitor.add_argument("--trace", type=Path, metavar="FILE", help="record every byte on the bus, with times")


def run(arguments: argparse.Namespace) -> int:
    """Run one of the commands."""
    whole = load_from(arguments)
    port = arguments.port or whole.servos.port
    config = dataclasses.replace(whole.bus_servos, port=port)
    arguments.tendons = len(whole.servos.ids)
    bauds = list(getattr(arguments, "baud", None) or _bauds(config))
    try:
        code: int = run_real_time(_COMMANDS[arguments.what](arguments, config, bauds))
    except CommandRejected as rejected:
        print(f"arm-companion servos: {rejected}", file=sys.stderr)
        return _REFUSED
    except KeyboardInterrupt:
        return 0 if arguments.what == "monitor" else 130
    if advice := latency_advice(port):
        print(advice, file=sys.stderr)
    return code


def _add_common(parser: argparse.ArgumentParser) -> None:
    add_config_arguments(parser)
    parser.add_argument("--port", metavar="DEVICE", help="serial device or tcp:HOST:PORT (default: servos.port)")


def _bauds(config: ServosConfig) -> list[int]:
    """Speeds to look at, the arm's own and the factory's first; a bridge has but its own."""
    if config.port.startswith("tcp:"):
        return [config.baud]
    return list(dict.fromkeys((config.baud, 57_600, *BAUD_CODES.values())))


def _open_at(config: ServosConfig) -> OpenAt:
    def open_at(baud: int) -> Opener:
        if config.port.startswith("tcp:") and baud != config.baud:
            raise LinkError(f"{config.port}: a bridge's speed cannot be changed from here")
        return open_bus(config.port, baud)

    return open_at


def _report(text: str) -> None:
    print(text, file=sys.stderr)


# scan


async def _scan(arguments: argparse.Namespace, config: ServosConfig, bauds: Sequence[int]) -> int:
    quiet: Callable[[str], None] = lambda _: None  # noqa: E731 - a default for one line
    found = await servo_scan.scan(
        _open_at(config), bauds, (*config.ids, *arguments.id), quiet if arguments.json else _report
    )
    if arguments.json:
        print(json.dumps([dataclasses.asdict(servo) for servo in found]))
    else:
        for line in _scan_lines(found, config, arguments.tendons):
            print(line)
    placed = {servo.id for servo in found if servo.baud == config.baud and not servo.crowded}
    return 0 if placed >= set(config.ids) else _TROUBLE


def _scan_lines(found: Sequence[FoundServo], config: ServosConfig, tendons: int) -> list[str]:
    lines = []
    names = [f"tendon {i + 1}" for i in range(tendons)] + ["gripper"] * (len(config.ids) - tendons)
    for servo in found:
        if servo.crowded:
            remark = "damaged answers: two servos with this id, or a bad line"
        elif servo.baud == config.baud and servo.id in config.ids:
            remark = names[config.ids.index(servo.id)]
        else:
            remark = "not one of the arm's: `servos setup`"
        lines.append(f"id {servo.id:>3} at {servo.baud:>7} bit/s   {servo.kind:<26} {remark}")
    missing = set(config.ids) - {servo.id for servo in found if servo.baud == config.baud}
    if missing:
        lines.append(f"missing at {config.baud} bit/s: {', '.join(map(str, sorted(missing)))}")
    return lines


# setup


async def _setup(arguments: argparse.Namespace, config: ServosConfig, bauds: Sequence[int]) -> int:
    open_at = _open_at(config)
    servo_provision.baud_code(config.baud)
    if arguments.id is not None and arguments.id not in config.ids:
        raise CommandRejected(f"id {arguments.id} is none of the arm's servos {list(config.ids)}")
    found = await servo_scan.scan(open_at, bauds, config.ids, _report)
    servo, servo_id = servo_provision.choose(found, config, arguments.id)
    plan = await servo_provision.make_plan(open_at, servo, servo_id, config)
    print(f"servo {servo.id} at {servo.baud} bit/s ({servo.kind}) is to be servo {servo_id} at {config.baud} bit/s")
    if not plan.steps:
        print("nothing to be written: all of its registers are right")
        return 0
    print("\n".join(servo_provision.describe(plan.steps)))
    if arguments.dry_run or not (arguments.yes or _agreed()):
        print("nothing was written")
        return 0
    await servo_provision.carry_out(open_at, plan, config, print)
    return 0


def _agreed() -> bool:
    if not sys.stdin.isatty():
        print("nobody to ask: --yes writes it")
        return False
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # the loop's own waits for the line to end
    try:
        return input("Write this? [y/N] ").strip().lower() in {"y", "yes"}
    except EOFError:
        print()
        return False
    finally:
        signal.signal(signal.SIGINT, before)


# monitor


async def _monitor(arguments: argparse.Namespace, config: ServosConfig, _: Sequence[int]) -> int:
    opener = open_bus(config.port, config.baud)
    with contextlib.ExitStack() as stack:
        if arguments.trace is not None:
            try:
                stream = stack.enter_context(arguments.trace.open("w", encoding="ascii"))
            except OSError as error:
                raise ConfigError(f"{arguments.trace}: {error.strerror}") from error
            opener = recorded(opener, stream)
        monitor = ServoMonitor(opener, config)
        await monitor.open()
        try:
            return await _watch(monitor, arguments)
        finally:
            await monitor.close()


async def _watch(monitor: ServoMonitor, arguments: argparse.Namespace) -> int:
    reads = 0
    states: tuple[ServoState, ...] = ()
    clear = "\x1b[H\x1b[2J" if sys.stdout.isatty() and not arguments.once else ""
    async for tick in ticks(1.0 / arguments.rate):
        states = await monitor.survey()
        reads += 1
        if arguments.once and reads < _FIRST_READS:
            continue
        if arguments.json:
            print(json.dumps(_plain(tick.now, states, monitor.counters())), flush=True)
        else:
            print(clear + "\n".join(table(states, monitor.counters(), monitor.firmware())), flush=True)
        if arguments.once:
            break
    return _TROUBLE if any(state.fault is not None for state in states) else 0


def _plain(t: float, states: Sequence[ServoState], counters: BusCounters) -> dict[str, Any]:
    return {"t": round(t, 6), "servos": [dataclasses.asdict(s) for s in states], "bus": dataclasses.asdict(counters)}


def table(states: Sequence[ServoState], counters: BusCounters, firmware: Sequence[int]) -> list[str]:
    """The servos as a table for people, a line each, and the bus below."""
    head = ("id", "fw", "ticks", "ticks/s", "load %", "V", "degC", "torque", "lost", "missed")
    lines = ["".join(f"{word:>9}" for word in head) + "  state"]
    for state, version in zip(states, firmware, strict=True):
        counted = counters.servos[state.id]
        fault = state.fault
        if state.silent:
            measured = ("-",) * 6
        else:
            measured = (
                str(state.position),
                f"{state.speed:.0f}",
                f"{100 * state.load:.1f}",
                f"{state.voltage:.1f}",
                f"{state.temperature:.0f}",
                "on" if state.torque else "off",
            )
        cells = (str(state.id), str(version or "-"), *measured, str(counted.lost), str(counted.missed_cycles))
        said = "well" if fault is None else str(fault).partition(": ")[2]
        lines.append("".join(f"{cell:>9}" for cell in cells) + f"  {said}")
    lines.append(
        f"bus: {counters.frames} frames, {counters.crc_errors} damaged, {counters.garbage_bytes} stray bytes, "
        f"answers {1e3 * counters.latency_s:.2f} ms after their time on the wire"
    )
    return lines


def _baud(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if value not in BAUD_CODES.values():
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(map(str, BAUD_CODES.values()))}")
    return value


def _servo_id(text: str) -> int:
    if not text.isdecimal() or int(text) > servo_scan.ALL_IDS[-1]:
        raise argparse.ArgumentTypeError(f"{text!r} is no servo id: 0 to {servo_scan.ALL_IDS[-1]}")
    return int(text)


def _rate(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0.1 <= float(text) <= 200.0:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no rate: 0.1 to 200 Hz")


_COMMANDS: dict[str, Callable[[argparse.Namespace, ServosConfig, Sequence[int]], Coroutine[Any, Any, int]]] = {
    "scan": _scan,
    "setup": _setup,
    "monitor": _monitor,
}
