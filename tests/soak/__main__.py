"""`python -m tests.soak`, that is `make soak`: random cases of the rod model, none of them wrong and silent.

Every answer is checked by `tests.soak.check`, which knows nothing of the solver; every refusal is counted with its
reason. Exit code 1 when an answer is wrong. In parts: `--seed` begins another series, `--first` goes on with one,
and a case is told by the seed and number printed with it.
"""

import argparse
import collections
import contextlib
import importlib.util
import json
import re
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from arm_companion.arm.model import ArmSolution
from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ModelError
from tests.soak.cases import Case, cases
from tests.soak.check import PIECES, Asked, Defects, defects

PLAIN = 1e-6  # relative defect of loads and support that an answer may have
SHARP, TIGHT = 5e-3, 1e-3  # of moment and tension: above it the answer is compared with a much finer one
WRONG = 0.01  # of base wrench and tensions
HOPELESS = 0.03  # of anything: no answer that others could be compared with
FINER = ((12, 8, 26), (16, 10, 34), (24, 16, 50))


@dataclass
class Tally:
    """What came of the cases."""

    cases: int = 0
    solved: int = 0
    refused: "collections.Counter[str]" = field(default_factory=collections.Counter)
    compared: int = 0
    unconfirmed: int = 0
    wrong: list[str] = field(default_factory=list)
    worst: float = 0.0
    off: float = 0.0
    seconds: float = 0.0

    def plain(self) -> dict[str, Any]:
        return {**vars(self), "refused": dict(self.refused)}


def ask(model: RodModel, asked: Asked, start: ArmSolution | None = None) -> ArmSolution:
    """The model's answer."""
    if asked.hold is not None:
        return model.held(asked.pull, asked.hold, asked.gravity, tension=asked.tension, start=start)
    turning, tension = asked.follower, asked.tension
    return model.free(
        asked.pull, asked.gravity, asked.dead, asked.payload, follower_wrench=turning, tension=tension, start=start
    )


def judge(case: Case, model: RodModel, tally: Tally) -> None:
    """Ask, and count what comes."""
    tally.cases += 1
    begun = time.perf_counter()
    try:
        solution = ask(model, case.asked, case.start)
    except ModelError as error:
        tally.refused[reason(error)] += 1
        return
    finally:
        tally.seconds += time.perf_counter() - begun
    tally.solved += 1
    found = defects(case.asked, solution)
    laws = max(found.tip, found.support)
    tally.worst = max(tally.worst, laws)
    if not laws <= PLAIN:
        tally.wrong.append(f"seed {case.seed}, case {case.number}: {found}")
    elif found.moment > SHARP or found.tendon > TIGHT:
        tally.compared += 1
        _compare(case, solution, found, tally)


def _compare(case: Case, solution: ArmSolution, found: Defects, tally: Tally) -> None:
    """Against many more modes, which must themselves be an equilibrium by the same check."""
    P = case.asked.parameters
    truth = _finer(case, solution)
    if truth is None or defects(case.asked, truth, 4 * PIECES).worst > HOPELESS:
        tally.unconfirmed += 1
        if defects(case.asked, solution, 4 * PIECES).worst > HOPELESS:
            tally.wrong.append(f"seed {case.seed}, case {case.number}: {found}, and no finer answer")
        return
    units = np.repeat((1.0, 1 / P.L), 3)
    bent = 0.1 * (1 + float(np.abs(truth.bend).max())) * P.EI / P.L**2  # a force is little beside what bends an arm so
    size = float(np.abs(truth.base_wrench * units).max()) + bent
    off = float(np.abs((solution.base_wrench - truth.base_wrench) * units).max()) / size
    size = float(truth.tension.max()) + bent * P.L / P.r
    off = max(off, float(np.abs(solution.tension - truth.tension).max()) / size)
    tally.off = max(tally.off, off)
    if off > WRONG:
        tally.wrong.append(f"seed {case.seed}, case {case.number}: off by {100 * off:.1f} %")


def _finer(case: Case, solution: ArmSolution) -> ArmSolution | None:
    model = RodModel(case.asked.parameters, levels=FINER, tolerance=1e-9)
    for start in (solution, None):
        with contextlib.suppress(ModelError):
            return ask(model, case.asked, start)
    return None


def reason(error: ModelError) -> str:
    """The refusal without its numbers."""
    text = str(error).split(": ", 1)[-1] if str(error).startswith("no equilibrium") else str(error)
    return re.sub(r" at [\d.]+ % of the way| = [^ ]+ is outside.*", "", text)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description="Random cases of the rod model.")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first case; ten share an arm")
    parser.add_argument("--numpy", action="store_true", help="without numba")
    parser.add_argument("--output", type=Path, help="write the tally as JSON")
    arguments = parser.parse_args()
    fast = not arguments.numpy and importlib.util.find_spec("numba") is not None
    tally = Tally()
    told = 0
    for case, model in cases(arguments.seed, arguments.cases, first=arguments.first, fast=fast):
        judge(case, model, tally)
        if len(tally.wrong) > told:
            told = len(tally.wrong)
            sys.stderr.write(f"wrong: {tally.wrong[-1]}\n")
        if tally.cases % 1000 == 0:
            sys.stderr.write(f"{tally.cases} cases, {tally.solved} solved, {len(tally.wrong)} wrong\n")
    again = f"{tally.compared} with sharp bends were solved again with more modes"
    lines = [
        f"{tally.cases} cases, {tally.solved} solved in {1e3 * tally.seconds / max(tally.cases, 1):.1f} ms a case",
        *(f"{count:6d} refused: {text}" for text, count in tally.refused.most_common()),
        f"worst defect of loads and supports: {tally.worst:.1e}",
        f"{again}: wrench and tensions off by at most {100 * tally.off:.2g} %, {tally.unconfirmed} not confirmed so",
        f"wrong and silent: {len(tally.wrong)}",
        *tally.wrong,
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    if arguments.output is not None:
        arguments.output.write_text(json.dumps(tally.plain(), indent=1) + "\n", encoding="utf-8")
    return 1 if tally.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
