"""`arm-companion replay`: recorded facts through today's code."""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

from arm_companion.config import Config, load
from arm_companion.config.table import as_table, from_table
from arm_companion.record import require

_SHOWN = 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion replay`."""
    parser.add_argument("log", type=Path, metavar="LOG", help="a record (*.mcap); the parts that follow it come along")
    parser.add_argument("--config", metavar="FILE", help="what if: this configuration instead of the recorded one")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        dest="settings",
        help="what if: override one option, such as perch.grip_tension_n=25; may be repeated",
    )
    parser.add_argument(
        "--mechanics", choices=("numpy", "numba"), help="run the mechanics on this (default: as recorded)"
    )
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")
    parser.epilog = "Exit code: 0 all commands are the same bit for bit, 3 some are not, 1 no record, 78 wrong options."


def run(arguments: argparse.Namespace) -> int:
    """Replay and compare."""
    require()
    from arm_companion.record.reader import Reader  # noqa: PLC0415 - after the check for the extra
    from arm_companion.record.replay import replay, summary  # noqa: PLC0415
    from arm_companion.record.shares import replay_in_shares  # noqa: PLC0415

    asks = bool(arguments.config or arguments.settings)
    other = load(arguments.config, arguments.settings) if arguments.config else None

    def change(config: Config) -> Config:
        if other is not None:
            return other
        return from_table(as_table(config), "recorded configuration", arguments.settings)

    started = time.perf_counter()
    mechanics = arguments.mechanics or ""
    outcome = None if asks else replay_in_shares(arguments.log, mechanics)
    if outcome is None:
        outcome = replay(Reader(arguments.log), change=change if asks else None, mechanics=mechanics)
    wall = time.perf_counter() - started
    if arguments.json:
        print(json.dumps(summary(outcome) | {"wall_s": round(wall, 3)}))
    else:
        _show(outcome, wall, asks)
    return 0 if outcome.identical else 3


def _show_failed(failed: list[Any]) -> None:
    """What was raised in flight, each kind once, and what becomes of it today."""
    kinds: dict[tuple[str, str, str], list[Any]] = {}
    for one in failed:
        kinds.setdefault((one.recorded, one.where, one.now), []).append(one)
    for (recorded, where, now), same in list(kinds.items())[:_SHOWN]:
        first = f"cycle {same[0].cycle}, {same[0].seconds:.2f} s"
        if len(same) == 1:
            print(f"{first} failed in flight: {recorded} ({where})")
        else:
            print(f"{len(same)} cycles failed in flight, from {first} on: {recorded} ({where})")
        if now:
            print(f"  today's code fails there {'in the same way' if now == recorded else f'too: {now}'}")
        else:
            print("  today's code does not fail there")


def _show(outcome: Any, wall: float, asks: bool) -> None:
    print(f"{outcome.cycles} cycles, {outcome.seconds:.1f} s of flight, replayed in {wall:.1f} s")
    for remark in outcome.remarks:
        print(f"note: {remark}")
    for first, count in outcome.gaps:
        print(f"note: {count} cycles are missing from cycle {first} on; memory is taken from the record there")
    _show_failed(outcome.failed)
    if outcome.identical:
        print("every command is the same, bit for bit")
        return
    print(f"{outcome.cycles - outcome.same} of {outcome.cycles} cycles command something else")
    first = outcome.first
    print(f"first difference: cycle {first.cycle}, {first.seconds:.2f} s: {first.field}")
    print(f"  recorded: {first.recorded}")
    print(f"  now:      {first.now}")
    for name, greatest in outcome.greatest.items():
        print(f"greatest difference of {name}: {greatest.value:.3g} {greatest.unit} at {greatest.seconds:.2f} s")
    told = {failed.cycle for failed in outcome.failed}
    for cycle, text in [failure for failure in outcome.failures if failure[0] not in told][:_SHOWN]:
        print(f"today's code failed in cycle {cycle}: {text}")
    for reason in outcome.why or ["nothing around the code differs: the code itself does"]:
        print(f"why: {reason}")
    same = [dataclasses.astuple(a)[1:] for a in outcome.recorded] == [dataclasses.astuple(a)[1:] for a in outcome.now]
    if same and not asks:
        print("the states passed are the same")
        return
    for title, moves in (("states as recorded", outcome.recorded), ("states now", outcome.now)):
        print(f"{title}:")
        for move in moves[:_SHOWN]:
            print(f"  {move.seconds:8.2f} s  {move.before} -> {move.after}: {move.cause}")
    print("the facts stay as recorded: the world does not answer to what would have been commanded", file=sys.stderr)
