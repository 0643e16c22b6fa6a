"""A mission that calibrates, with servos and an arm that are a few lines of arithmetic."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from arm_companion.mission.facts import Answer, ArmAction, Commands, Facts, Order, Result, Workshop
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase, State
from arm_companion.procedures.tendon_zeros import Zero
from tests.unit.conftest import HOVER, tendons
from tests.unit.mission_rig import DT, SETUP, Run, ask, memory
from tests.unit.test_procedures import hanging

ZEROS = np.array((0.003, -0.002, 0.006, 0.001))
START = np.array((0.001, 0.0005, 0.0, -0.002))  # m, where the tendons are when it is ordered
ON_GROUND = dataclasses.replace(HOVER, armed=False, landed=True, position_age_s=math.inf, attitude_age_s=math.inf)
CALIBRATE = (1.0, 1.0)
Change = Callable[[Facts], Facts]
Force = Callable[[np.ndarray], np.ndarray]


class Bench:
    """A mission on the ground, with servos that do at once what they are told.

    Args:
        parameters: of the mission.
        force: tensions (n,) N at wound lengths (n,) m.
        torque: at the beginning.
    """

    def __init__(self, parameters: Parameters, force: Force | None = None, *, torque: bool = False) -> None:
        self.run = Run(memory(Phase.STOWED, armed=False, streaming=False, reference=None), parameters)
        self.force = hanging(ZEROS) if force is None else force
        self.wound = START.copy()
        self.way = np.zeros(4)
        self.torque = [torque] * 4
        self.kept: str | None = None
        self.stuck: set[int] = set()
        self.rng = np.random.default_rng(5)
        self.facts: list[Facts] = []

    def see(self) -> Facts:
        """Facts of the next cycle."""
        pulling = (self.force(self.wound) + 5.0 * self.way) / 150.0 + self.rng.normal(0.0, 0.01, 4)
        found = tendons(tuple(self.wound.tolist()), tuple(self.force(self.wound).tolist()))
        found = tuple(
            dataclasses.replace(t, load=float(load), torque=on)
            for t, load, on in zip(found, pulling, self.torque, strict=True)
        )
        return Facts(ON_GROUND, found, workshop=Workshop(SETUP.curves, SETUP.m_per_tick, self.kept))

    def cycle(self, change: Change = lambda facts: facts) -> Commands:
        facts = change(self.see())
        self.facts.append(facts)
        commands = self.run.cycle(facts)
        before = self.wound
        if commands.pulls is not None:
            moves = [i for i in range(4) if i not in self.stuck]
            self.wound = before.copy()
            self.wound[moves] = np.asarray(commands.pulls)[moves]
            self.torque = [True] * 4
        elif commands.arm is ArmAction.LIMP:
            self.torque = [False] * 4
        self.way = np.sign(self.wound - before)
        return commands

    def order(self, change: Change = lambda facts: facts) -> None:
        self.cycle(lambda facts: change(ask(facts, Order.CALIBRATE, *CALIBRATE)))

    def until(self, *phases: Phase, seconds: float = 120.0, change: Change = lambda facts: facts) -> None:
        for _ in range(round(seconds / DT)):
            if self.phase in phases:
                return
            self.cycle(change)
        raise AssertionError(f"still {self.phase.name}: {self.run.texts[-3:]}")

    def for_a_while(self, seconds: float, change: Change = lambda facts: facts) -> None:
        for _ in range(round(seconds / DT)):
            self.cycle(change)

    @property
    def phase(self) -> Phase:
        return self.run.state.phase

    @property
    def answers(self) -> list[Answer]:
        return [answer for commands in self.run.said for answer in commands.answers]

    @property
    def zeros(self) -> list[tuple[Zero, ...]]:
        """What was told to be stored, each time."""
        return [commands.zeros for commands in self.run.said if commands.zeros]

    def results(self) -> list[Result]:
        return [answer.result for answer in self.answers if answer.result is not Result.IN_PROGRESS]


def resumed(parameters: Parameters, state: State, wound: np.ndarray, torque: list[bool]) -> Bench:
    bench = Bench(parameters)
    bench.run = Run(state, parameters)
    bench.wound, bench.torque = wound.copy(), list(torque)
    return bench
