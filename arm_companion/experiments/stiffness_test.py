"""The paper's stiffness test: how far the tip gives way to a force, inward and outward, for several bends.

A pulley keeps the force perpendicular to the end disk's normal in the bending plane, so it follows the end disk:
along +x_e it bends the arm further (inward), along -x_e it straightens it (outward). The paper loads to about 1 N
in steps of 20 g, in five cycles, for five configurations, and finds the straight arm softest and the arm stiffer
the more it is bent, both ways. It prints no numbers and not which bends; 0 to 60 deg in steps of 15 is our reading.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from arm_companion.arm import friction
from arm_companion.arm.model import ArmSolution
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ModelError
from arm_companion.experiments.case import GRAVITY, goals
from arm_companion.geometry.arrays import Array, ArrayLike

BENDS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
STEP_KG = 0.02
STEPS = 5
CYCLES = 5


@dataclass(frozen=True)
class Reading:
    """One load on the tip.

    Attributes:
        bend_deg: commanded, of the unloaded, gravity-free arm.
        inward: along +x_e, else along -x_e.
        cycle: counted from 1.
        loading: whether the load grew, else it shrank.
        force: N.
        deflection: of the tip from its place before the first load, m.
        shift: the same as a vector in base axes, m.
        turn_deg: of the end disk in the bending plane since then, positive where the bend grows.
        tension: of each tendon, N.
        base_force: on the carrier, N, base axes.
        base_moment: on the carrier at the base point, N m, base axes.
        residual: of the equilibrium.
    """

    bend_deg: float
    inward: bool
    cycle: int
    loading: bool
    force: float
    deflection: float
    shift: tuple[float, ...]
    turn_deg: float
    tension: tuple[float, ...]
    base_force: tuple[float, ...]
    base_moment: tuple[float, ...]
    residual: float


@dataclass(frozen=True)
class Curve:
    """One configuration in one direction.

    Attributes:
        bend_deg: commanded.
        inward: along +x_e, else along -x_e.
        initial: first grain of load over its deflection, N/m; the same inward and outward.
        readings: in the order of time.
        refusal: why the curve ends early; empty when it does not.
    """

    bend_deg: float
    inward: bool
    initial: float
    readings: tuple[Reading, ...]
    refusal: str = ""

    @property
    def stiffness(self) -> float:
        """Greatest load over its deflection on the first loading, N/m; nan when nothing was loaded."""
        first = [r for r in self.readings if r.cycle == 1 and r.loading and r.force > 0]
        return first[-1].force / first[-1].deflection if first else math.nan

    @property
    def hysteresis(self) -> float:
        """Greatest width of the last cycle's loop at one load, m; 0 without unloading."""
        last = max((r.cycle for r in self.readings), default=0)
        width = 0.0
        up = {r.force: r.deflection for r in self.readings if r.cycle == last and r.loading}
        for r in self.readings:
            if r.cycle == last and not r.loading and r.force in up:
                width = max(width, abs(r.deflection - up[r.force]))
        return width


def loads(
    step: float = STEP_KG * GRAVITY, steps: int = STEPS, cycles: int = CYCLES
) -> Iterator[tuple[int, bool, float]]:
    """(cycle, whether loading, force in N) of every reading after the first, which is unloaded."""
    for cycle in range(1, cycles + 1):
        for k in range(1, steps + 1):
            yield cycle, True, k * step
        for k in range(steps - 1, -1, -1):
            yield cycle, False, k * step


def run(
    parameters: ArmParameters,
    *,
    bends_deg: Sequence[float] = BENDS_DEG,
    gravity: ArrayLike = (0.0, 0.0, 0.0),
    mu: float = 0.0,
    step: float = STEP_KG * GRAVITY,
    steps: int = STEPS,
    cycles: int = CYCLES,
) -> list[Curve]:
    """The whole test, in the plane delta = 0.

    Args:
        parameters: the arm, one segment.
        bends_deg: configurations.
        gravity: (3,), m/s^2, base axes.
        mu: Coulomb coefficient of the tendons in their guides; before the first load they are relaxed.
        step: of the load, N.
        steps: loads up to the greatest.
        cycles: of loading and unloading.
    """
    model = RodModel(parameters)
    g = np.asarray(gravity, dtype=np.float64)
    return [
        _curve(model, angle, inward, g, mu, loads(step, steps, cycles))
        for inward in (True, False)
        for angle in bends_deg
    ]


def _curve(
    model: RodModel,
    bend_deg: float,
    inward: bool,
    gravity: Array,
    mu: float,
    schedule: Iterable[tuple[int, bool, float]],
) -> Curve:
    readings: list[Reading] = []
    initial = math.nan
    try:
        pull = goals(model.parameters, bend_deg)
        rest = model.free(pull, gravity)
        give = rest.compliance[:3, :3] @ rest.tip_rotation[:, 0]
        initial = 1 / math.sqrt(float(give @ give))
        readings.append(_reading(bend_deg, inward, 1, True, 0.0, rest, rest))
        now, grip = rest, friction.Grip.relaxed(rest)
        for cycle, loading, force in schedule:
            load = np.array((force if inward else -force, 0.0, 0.0, 0.0, 0.0, 0.0))
            if mu > 0:
                now, grip = friction.step(model, mu, grip, pull, gravity, follower_wrench=load, start=now)
            else:
                now = model.free(pull, gravity, follower_wrench=load, start=now)
            readings.append(_reading(bend_deg, inward, cycle, loading, force, now, rest))
    except ModelError as error:
        return Curve(bend_deg, inward, initial, tuple(readings), str(error))
    return Curve(bend_deg, inward, initial, tuple(readings))


def _reading(
    bend_deg: float, inward: bool, cycle: int, loading: bool, force: float, now: ArmSolution, rest: ArmSolution
) -> Reading:
    shift = now.tip_position - rest.tip_position
    angle, before = (math.degrees(math.atan2(R[0, 2], R[2, 2])) for R in (now.tip_rotation, rest.tip_rotation))
    return Reading(
        bend_deg,
        inward,
        cycle,
        loading,
        force,
        float(np.sqrt(shift @ shift)),
        tuple(shift.tolist()),
        angle - before,
        tuple(now.tension.tolist()),
        tuple(now.base_wrench[:3].tolist()),
        tuple(now.base_wrench[3:].tolist()),
        now.residual,
    )


def findings(curves: Sequence[Curve], mu: float) -> list[str]:
    """What the test says beside the paper's findings, in sentences that follow from the numbers.

    The paper: the straight arm is softest, and the arm stiffens with bend both ways.
    """
    said: list[str] = []
    for inward in (True, False):
        side = sorted((c for c in curves if c.inward is inward and not c.refusal), key=lambda c: c.bend_deg)
        if len(side) < 2 or side[0].bend_deg != 0.0:
            continue
        if not said:
            said.append(_compared("at small load", [c.initial for c in side], side))
        name = "inward" if inward else "outward"
        said.append(_compared(f"at full load, {name}", [c.stiffness for c in side], side))
    width = max((c.hysteresis for c in curves), default=0.0)
    if mu > 0:
        said.append(f"friction mu = {mu:g}: loading and unloading lie up to {1e3 * width:.2f} mm apart.")
    else:
        said.append(
            "hysteresis: none. Loading and unloading coincide; a gap between a test's branches takes friction"
            " of the tendons in their guides (--friction)."
        )
    return said


def _compared(what: str, stiffness: Sequence[float], side: Sequence[Curve]) -> str:
    ratios = [k / stiffness[0] for k in stiffness]
    listed = ", ".join(f"{r:.3f} ({c.bend_deg:g} deg)" for r, c in zip(ratios[1:], side[1:], strict=True))
    softer = [f"{c.bend_deg:g}" for r, c in zip(ratios, side, strict=True) if r < 1]
    if softer:
        least = min(ratios)
        verdict = (
            f"differs from the paper: up to {100 * (1 - least):.1f} % softer than straight at {', '.join(softer)} deg"
        )
    elif all(b >= a for a, b in itertools.pairwise(ratios)):
        verdict = "agrees with the paper: straight is softest, and the arm stiffens with bend"
    else:
        verdict = "agrees with the paper in that straight is softest; stiffness does not rise with every bend"
    return f"{what}: stiffness over the straight arm's {listed}: {verdict}."
