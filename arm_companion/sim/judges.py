"""Which script the operator flies in each scenario, and who judges the flight."""

from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from typing import Any

from arm_companion.config.schema import Config
from arm_companion.sim.abort_verdict import judge_aborts
from arm_companion.sim.flight import Flight
from arm_companion.sim.grasp_verdict import judge_grasp
from arm_companion.sim.hang_verdict import judge_hang
from arm_companion.sim.mishaps import fly_aborts, fly_in_gusts, fly_one_abort
from arm_companion.sim.mjcf import GRAVITY
from arm_companion.sim.reach_scenario import fly_reach, judge_reach
from arm_companion.sim.scenario import Operator
from arm_companion.sim.verdict import Verdict, judge


@dataclass(frozen=True)
class Scenario:
    """One flight with a script.

    Attributes:
        title: for people.
        done: what a success is called.
        fly: what the operator does; gives why it failed, or an empty string.
        judge: the verdict on a flight, with the script's failure and the world as it was.
        fly_trial: what the operator does in a trial, where that is shorter.
    """

    title: str
    done: str
    fly: Callable[[Operator], Coroutine[Any, Any, str]]
    judge: Callable[[Flight, str, Config], Verdict]
    fly_trial: Callable[[Operator], Coroutine[Any, Any, str]] | None = None


SCENARIOS: Mapping[str, Scenario] = {
    "perch": Scenario(
        "Anchor perch",
        "perched and let go",
        Operator.fly_perch,
        lambda flight, failure, _: judge(flight, failure),
    ),
    "hang": Scenario(
        "Hang perch",
        "hung and left",
        Operator.fly_hang,
        lambda flight, failure, world: judge_hang(flight, failure, GRAVITY * world.vehicle.mass_kg),
    ),
    "abort": Scenario(
        "Aborted perches",
        "let go each time",
        fly_aborts,
        lambda flight, failure, _: judge_aborts(flight, failure),
        fly_one_abort,
    ),
    "gust": Scenario(
        "Anchor perch in gusts",
        "perched and let go",
        fly_in_gusts,
        lambda flight, failure, _: judge(flight, failure, leaning=True),
    ),
    "reach": Scenario(
        "Reaching points",
        "every point reached",
        fly_reach,
        lambda flight, failure, _: judge_reach(flight, failure),
    ),
    "grasp": Scenario("Grasp", "grasped and put back", Operator.fly_grasp, judge_grasp, Operator.fly_grasp_once),
}
