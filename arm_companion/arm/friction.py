"""Friction of the tendons in their guides: why unloading does not retrace loading. Off unless asked for.

A tendon that slides through guides loses tension by exp(-mu Theta), Theta the angle through which the guides have
turned it (capstan). Along an arm bent by Theta its mean is off by Phi = 1 - (1 - exp(-mu Theta)) / (mu Theta),
about mu Theta / 2, one way or the other by the direction of sliding, and anywhere in between while it sticks:

    tau_arm = tau (1 - z Phi),   -1 <= z <= 1

z is the memory. Tendon sliding towards its motor drives z to 1, away from it to -1; before it slides it stretches by
tau Phi / k_T each way. That is a play operator per tendon: independent of rate, and it closes its loops.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from arm_companion.arm.model import ArmModel, ArmSolution, Payload
from arm_companion.arm.parameters import ArmParameters
from arm_companion.errors import NoSolution
from arm_companion.geometry.arrays import Array, ArrayLike, frozen

_ITERATIONS = 60
_TOLERANCE = 1e-10  # m of tendon, of the drag
_LEAST_REACH = 1e-9  # m; keeps a slack tendon's memory defined


@dataclass(frozen=True, eq=False)
class Grip:
    """The memory of the guides.

    Attributes:
        z: state of every tendon (n,), from -1 (sliding out into the arm) to 1 (sliding towards the motor).
        path: path of every tendon inside the arm less its straight length when that was so (n,), m.
    """

    z: Array
    path: Array

    @classmethod
    def relaxed(cls, solution: ArmSolution) -> "Grip":
        """After shaking: no friction anywhere."""
        return cls(np.zeros(solution.tension.size), -solution.detail.path_beyond(0.0))


def loss(mu: float, turn: float) -> float:
    """Phi: share by which the mean tension of a sliding tendon is off, guides turning it by `turn`, rad."""
    x = mu * turn
    return 0.5 * x * (1 - x / 3 * (1 - x / 4)) if x < 1e-3 else 1 + math.expm1(-x) / x


def step(
    model: ArmModel,
    mu: float,
    before: Grip,
    pull: ArrayLike,
    gravity: ArrayLike,
    tip_wrench: ArrayLike | None = None,
    payload: Payload | None = None,
    *,
    follower_wrench: ArrayLike | None = None,
    start: ArmSolution | None = None,
) -> tuple[ArmSolution, Grip]:
    """Equilibrium of a free tip with friction, coming from what the guides remember.

    The tensions of the solution are those that act on the arm.

    Args:
        model: without friction.
        mu: Coulomb coefficient of tendon on guide.
        before: memory of the equilibrium before.
        pull: tendon goals (n,), m.
        gravity: (3,), m/s^2, base axes.
        tip_wrench: dead load at the tip (6,), base axes.
        payload: what the tip carries.
        follower_wrench: load that turns with the tip (6,), tip axes.
        start: a neighbouring solution.

    Raises:
        NoSolution: when the model has none, or memory and equilibrium do not agree.
        LimitViolated: as `ArmModel.free`.
    """
    P = model.parameters
    q = frozen(pull, (P.n,), "pull")

    def equilibrium(goals: Array, near: ArmSolution | None) -> ArmSolution:
        return model.free(goals, gravity, tip_wrench, payload, follower_wrench=follower_wrench, start=near)

    solution = start or equilibrium(q, None)
    z, reach = before.z, _reach(P, mu, q, solution)
    for _ in range(_ITERATIONS):
        # The arm sees tau (1 - z Phi), as if z tau Phi / k_T less had been pulled in.
        drag = z * reach
        solution = equilibrium(q - drag, solution)
        path, reach = -solution.detail.path_beyond(0.0), _reach(P, mu, q, solution)
        wish = before.z - (path - before.path) / reach
        target = np.clip(wish, -1.0, 1.0)
        # The force must be that of this equilibrium, not only its direction.
        if float(np.abs(target * reach - drag).max()) < _TOLERANCE:
            return solution, Grip(target, path)
        # Newton on target(z) = z: a tendon that sticks gives way with the arm, one that slides does not answer.
        sticks = (wish > -1.0) & (wish < 1.0)
        slope = sticks[:, None] * _give(P, solution.tension) * reach / reach[:, None]
        z = z + np.linalg.solve(np.eye(P.n) + slope, target - z)
    raise NoSolution(float(np.abs(target * reach - drag).max() / reach.max()), "friction and equilibrium do not agree")


def _reach(P: ArmParameters, mu: float, pull: Array, solution: ArmSolution) -> Array:
    """tau Phi / k_T (n,), m: what a tendon stretches, either way, before it slides through this solution's bend."""
    stretch = P.T0 / P.k_T + pull - solution.detail.path_beyond(0.0)
    return np.maximum(loss(mu, solution.detail.turning()) * np.maximum(stretch, 0.0), _LEAST_REACH)


def _give(P: ArmParameters, tension: Array) -> Array:
    """By how much the unloaded arm shortens every path (n, n) per tendon taken in, taut ones resisting."""
    k = P.k_T * (tension > 0)
    return np.asarray(P.H @ np.linalg.solve(np.diag(P.bending) + P.H.T @ (k[:, None] * P.H), P.H.T * k))


def cycle(
    model: ArmModel, mu: float, pull: ArrayLike, gravity: ArrayLike, tip_wrenches: Iterable[ArrayLike]
) -> list[ArmSolution]:
    """Equilibria of one load after the other, from a relaxed arm: loading and unloading branches of a test."""
    solution = model.free(pull, gravity)
    grip = Grip.relaxed(solution)
    path = []
    for wrench in tip_wrenches:
        solution, grip = step(model, mu, grip, pull, gravity, wrench, start=solution)
        path.append(solution)
    return path
