"""`python -m tests.bench`, that is `make bench`: measures speed and accuracy beside peers, in one run.

Prints one table and writes build/bench.json: a list of {name, value, unit, peer, peer_value, ratio}, ratio being the
peer's value over ours, so that above 1 we are faster, or nearer to the truth. Medians over several rounds; ours and
the peer take turns, so that what else the machine does meets both. These are no tests: nothing here can fail.
"""

import argparse
import json
import sys
from pathlib import Path

from tests.bench.daemon import daemon
from tests.bench.listening import listening
from tests.bench.measure import Result
from tests.bench.mechanics import mechanics
from tests.bench.protocols import protocols
from tests.bench.replaying import replaying
from tests.bench.servo_cycle import servo_cycle


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description="Measure beside peers.")
    parser.add_argument("--rounds", type=int, default=7, help="of every measurement (default: 7)")
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"))
    arguments = parser.parse_args()
    results: list[Result] = []
    _say(f"{'':<44}{'ours':>11} {'unit':<6}{'peer':>11}  {'ratio':>8}  beside")
    for part in (mechanics, protocols, replaying, servo_cycle, lambda _: listening(), daemon):
        for result in part(arguments.rounds):
            results.append(result)
            _say(result.line())
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps([result.plain() for result in results], indent=1) + "\n", encoding="utf-8")
    _say(f"written: {arguments.output}")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
