"""The soak's check itself: it passes what is an equilibrium, and catches what is not."""

from dataclasses import replace

import numpy as np
import pytest

from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ModelError
from tests.soak.__main__ import PLAIN, SHARP, TIGHT, Tally, ask, judge
from tests.soak.cases import Case, cases
from tests.soak.check import defects


def solved(count: int) -> list[tuple[Case, RodModel]]:
    return [pair for pair in cases(3, count, fast=False) if pair[0].asked.hold is None or pair[0].number % 2]


def test_random_cases_are_solved_or_refused_and_none_is_wrong() -> None:
    tally = Tally()
    for case, model in cases(5, 60, fast=False):
        judge(case, model, tally)
    assert tally.wrong == []
    assert tally.cases == tally.solved + sum(tally.refused.values()) == 60
    assert tally.solved > 35


@pytest.mark.parametrize(
    ("seed", "number"),
    [
        (12, 1187),  # two turns held by tendons hid an error of a small force on the base
        (12, 1339),  # a sharp bend at either end
        (12, 519),  # nothing but tendons
        (11, 394),  # a tendon near the centre of curvature
    ],
)
def test_what_was_hard_once(seed: int, number: int) -> None:
    tally = Tally()
    for case, model in cases(seed, 1, first=number, fast=False):
        if case.number == number:
            judge(case, model, tally)
    assert (tally.cases, tally.solved, tally.wrong) == (1, 1, [])


@pytest.mark.parametrize("wrong", ["load", "moment", "gravity", "pull", "stiffness", "hold"])
def test_an_answer_to_another_question_is_caught(wrong: str) -> None:
    """A hundredth off in what was asked shows far above what an answer may be off."""
    rng = np.random.default_rng(4)
    caught = tried = 0
    for case, model in solved(40):
        asked = case.asked
        try:
            answer = ask(model, asked)
        except ModelError:
            continue
        P = asked.parameters
        wrench = answer.base_wrench.copy()
        units = np.repeat((1.0, P.L), 3)
        size = float(np.abs(wrench / units).max()) + P.EI / P.L**2
        match wrong:
            case "load":
                wrench[:3] += 0.01 * size * rng.normal(size=3)
            case "moment":
                wrench[3:] += 0.01 * size * P.L * rng.normal(size=3)
            case "gravity":
                asked = replace(asked, gravity=asked.gravity + size / P.mass * 0.01 * rng.normal(size=3))
            case "pull" if asked.tension is None and answer.tension.max() > 0.1:
                asked = replace(asked, pull=asked.pull + 0.02 * answer.tension.max() / P.k_T)
            case "stiffness" if float(np.abs(answer.bend).max()) > 0.3:
                asked = replace(asked, parameters=P.scaled(EI=1.05, GJ=1.05))
            case "hold" if asked.hold is not None:
                asked = replace(
                    asked, hold=replace(asked.hold, pose=asked.hold.pose.moved((1e-3 * P.L, 0, 0, 0, 0, 0)))
                )
            case _:
                continue
        tried += 1
        found = defects(asked, replace(answer, base_wrench=wrench))
        caught += max(found.tip, found.support) > PLAIN or found.moment > SHARP or found.tendon > TIGHT
    assert tried > 5
    assert caught == tried
