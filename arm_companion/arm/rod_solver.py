"""Finds the equilibrium of a rod: Newton on curvature and support forces, and homotopy where Newton alone strays.

Supports are constraints with Lagrange multipliers, and the multipliers are the wrench that the support exerts.
Every answer is checked for what Newton does not see: that it lies on the branch that was followed, and that it
is stable (the tangent is positive on all motions that the support allows).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from arm_companion.arm.rod_equations import Loads, Rod, State, cross_rows
from arm_companion.errors import LimitViolated, NoSolution
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array

TOLERANCE = 1e-9
"""Of residual and constraint, relative to the rod's own moment and length; `Rod.rounding` where that is more."""

TOO_SHARP = "a bend sharper than the tendons' pitch radius"
NO_CONVERGENCE = "no convergence: the arm snaps, or is taut"
"""Why Newton gives up."""

ITERATIONS = 25
STEP_LIMIT = 0.6
"""Of any curvature mode in one Newton step, rad."""

_BRANCH = 0.8  # rad, that a mode may move in one homotopy step
_SMALLEST_STEP = 1 / 512
_STIFFEN = 1e4  # of forbidden motions, when only the allowed ones are to be judged
INDIFFERENT = 1e-6
"""Stiffness, relative to the rod's own, under which a motion costs nothing: a straight arm that buckles does so in any
plane, and which one is not the model's to say."""

_NO_DIRECTION = np.zeros((0, 3))
_EYE = np.eye(3)
_ORIGIN = [0.0, 0.0, 0.0]


@dataclass(frozen=True, eq=False)
class Support:
    """What holds the end section: a point of it, and none, two or three of its rotations.

    Attributes:
        pivot: held point in section axes (3,), m.
        point: where it is held (3,), m, base axes.
        R: held orientation (3, 3); None when the section turns freely.
        axis: of the bar (3,), base axes, when the section may turn about that; None otherwise.
    """

    pivot: Array
    point: Array
    R: Array | None = None
    axis: Array | None = None

    @cached_property
    def central(self) -> bool:
        """Whether the section is held at its own centre."""
        return bool(self.pivot.tolist() == _ORIGIN)

    @cached_property
    def moments(self) -> Array:
        """Directions in which the support can exert a moment (k, 3), base axes."""
        if self.R is None:
            return _NO_DIRECTION
        if self.axis is None:
            return _EYE
        return -cross_rows(so3.perpendicular(self.axis), self.axis)

    @property
    def components(self) -> int:
        """Number of multipliers: three forces, then moments along `moments`."""
        return 3 + len(self.moments)

    def gap(self, state: State) -> tuple[Array, Array]:
        """By how much the state misses the support (k,) [m; rad], and its derivative (size, k)."""
        if self.central:
            off, J = state.tip - self.point, state.J
        else:
            o = state.R_tip @ self.pivot
            off = state.tip + o - self.point
            J = np.concatenate((state.J_p + cross_rows(state.J_phi, o), state.J_phi), axis=1)
        if self.R is None:
            return off, J[:, :3]
        if self.axis is None:
            return np.concatenate((off, _turn(state.R_tip @ self.R.T))), J
        v = state.R_tip @ (self.R.T @ self.axis)
        across = so3.perpendicular(self.axis)
        rows = -state.J_phi @ cross_rows(across, v).T
        return np.concatenate((off, across @ v)), np.concatenate((J[:, :3], rows), axis=1)

    def forces(self, state: State) -> Array:
        """Generalised force of every multiplier (size, k)."""
        if self.R is not None and self.axis is None and self.central:
            return state.J
        at = state.J_p if self.central else state.J_p + cross_rows(state.J_phi, state.R_tip @ self.pivot)
        return np.concatenate((at, state.J_phi @ self.moments.T), axis=1)


def _turn(E: Array) -> Array:
    """Rotation vector of E (3, 3); near the identity to fourth order, which is all that Newton's last steps need."""
    (a, b, c), (d, e, f), (g, h, i) = E.tolist()
    if a + e + i < 2.99:  # a tenth of a radian
        return so3.log(E)
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    stretch = 1 + (x * x + y * y + z * z) / 6
    return np.array((stretch * x, stretch * y, stretch * z))


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything that one solve depends on.

    Attributes:
        pull: stretch of each tendon along the straight arm (n,), m; tension, N, where stiffness is zero.
        stiffness: of each tendon (n,), N/m.
        loads: besides support forces.
        support: None for a free end.
    """

    pull: Array
    stiffness: Array
    loads: Loads
    support: Support | None = None

    def loads_with(self, wrench: Array) -> Loads:
        """The loads with the support's forces, the multipliers (k,), among the dead ones."""
        loads, support = self.loads, self.support
        if support is None:
            return loads
        force, moment, hung = loads.force, loads.moment, loads.hung
        if support.R is not None:
            moment = moment + wrench[3:] @ support.moments
        if support.central:
            force = force + wrench[:3]
        else:
            hung = [*hung, (support.pivot, wrench[:3])]
        turning = loads.follower_force, loads.follower_moment
        return Loads(loads.gravity, loads.end_mass, force, moment, *turning, hung)


class Ends(Protocol):
    """The part of a `State` that every caller needs."""

    tip: Array
    R_tip: Array
    base_wrench: Array

    @property
    def tension(self) -> Array:
        """Of the tendons (n,), N."""


@dataclass(eq=False, slots=True)
class BareEnds:
    """`Ends` and nothing else; the whole state can be worked out again."""

    tip: Array
    R_tip: Array
    base_wrench: Array
    tension: Array


@dataclass(eq=False)
class Solved:
    """An equilibrium.

    Attributes:
        rod: what was solved on.
        problem: what was solved.
        c: unknowns (size,).
        wrench: multipliers (k,): force at the held point [N], then moments along `Support.moments` [N m].
        ends: the rod's ends and tensions there.
        iterations: Newton steps taken, all in all.
        residual: of Newton's own stop test.
        tangent: from the last Newton step, so a little old; None when there was none of its own.
        held: derivative of the support's constraints (size, k); None without a support.
        stable: whether it is; None when that was not looked at.
        imbalance: between the modes; None when that was not looked at.
    """

    rod: Rod
    problem: Problem
    c: Array
    wrench: Array
    ends: Ends
    iterations: int
    residual: float
    tangent: Array | None = None
    held: Array | None = None
    stable: bool | None = None
    imbalance: float | None = None

    @property
    def loads(self) -> Loads:
        """The problem's loads with the support's forces among them."""
        return self.problem.loads_with(self.wrench)

    @cached_property
    def state(self) -> State:
        """The whole state."""
        if isinstance(self.ends, State):
            return self.ends
        return self.rod.evaluate(self.c, self.loads, self.problem.pull, self.problem.stiffness)


def newton(rod: Rod, problem: Problem, c: Array, wrench: Array, tangent: Array | None = None) -> Solved | str:
    """Newton from a guess; the reason in words when it does not converge.

    Args:
        rod: tables.
        problem: what to solve.
        c: guess (size,).
        wrench: guess of the support's forces (k,).
        tangent: of a neighbouring solution, good enough for the first step.
    """
    if rod.compiled_newton is not None:
        found: Solved | str = rod.compiled_newton(problem, c, wrench, tangent)
        return found
    support, L, last, tolerance = problem.support, rod.s, math.inf, max(TOLERANCE, rod.rounding)
    K, C, own = tangent, None, False
    for iteration in range(ITERATIONS):
        loads = problem.loads_with(wrench)
        try:
            state = rod.evaluate(c, loads, problem.pull, problem.stiffness)
        except LimitViolated:
            return TOO_SHARP
        gap: Array | None = None
        error = _largest(state.residual)
        if support is None:
            error /= rod.moment_scale
        else:
            gap, C = support.gap(state)
            error /= rod.moment_scale + _largest(wrench) * L
            error = max(error, _largest(gap[:3]) / L, _largest(gap[3:]))
        if error < tolerance:
            # A neighbour's tangent says nothing about the stability of this equilibrium.
            return Solved(rod, problem, c, wrench, state, iteration, error, K if own else None, C)
        if not error < 1e3 * max(last, 1e-3):
            return NO_CONVERGENCE
        last = error
        if K is None or iteration > 0:
            K, own = rod.tangent(state, loads, problem.stiffness), True
        try:
            if support is None or gap is None or C is None:
                step, push = np.asarray(np.linalg.solve(K, state.residual)), wrench
            else:
                step, push = _saddle_step(K, state.residual, gap, C, support.forces(state), L)
        except np.linalg.LinAlgError:
            return NO_CONVERGENCE
        largest = _largest(step)
        share = 1.0 if largest < STEP_LIMIT else STEP_LIMIT / largest
        c = c - share * step
        wrench = wrench - share * push
    return NO_CONVERGENCE


def _largest(values: Array) -> float:
    """Largest magnitude of a short vector, 0 of an empty one; faster than NumPy on a dozen entries."""
    return max(map(abs, values.tolist()), default=0.0)


def _saddle_step(K: Array, residual: Array, gap: Array, C: Array, forces: Array, L: float) -> tuple[Array, Array]:
    """Newton step of curvature and multipliers together; forces are scaled by the length."""
    n, k = C.shape
    scale = np.ones(k)
    scale[:3] = L
    A = np.zeros((n + k, n + k))
    A[:n, :n] = K
    np.divide(C.T, scale[:, None], out=A[n:, :n])
    np.divide(forces, -scale, out=A[:n, n:])
    step = np.linalg.solve(A, np.concatenate((residual, gap / scale)))
    return np.asarray(step[:n]), np.asarray(step[n:] / scale)


def is_stable(rod: Rod, solved: Solved) -> bool:
    """Whether every motion that the support allows costs energy (second variation positive)."""
    if solved.stable is not None:
        return solved.stable
    if solved.tangent is None:
        solved.tangent = rod.tangent(solved.state, solved.loads, solved.problem.stiffness)
    K = 0.5 * (solved.tangent + solved.tangent.T)
    K.reshape(-1)[:: len(K) + 1] -= INDIFFERENT * rod.moment_scale
    C = solved.held
    if C is None:
        return _positive(K)
    # Positive with the forbidden motions made stiff implies positive on the allowed ones.
    stiff = C * np.sqrt(_STIFFEN * rod.moment_scale)
    stiff[:, :3] /= rod.s
    if _positive(K + stiff @ stiff.T):
        return True
    q, _ = np.linalg.qr(C, mode="complete")
    allowed = q[:, C.shape[1] :]
    return _positive(allowed.T @ K @ allowed)


def _positive(K: Array) -> bool:
    try:
        np.linalg.cholesky(K)
    except np.linalg.LinAlgError:
        return False
    return True


def follow(rod: Rod, start: Solved, goal: Problem, what: str) -> Solved:
    """From one equilibrium to that of another problem along the branch between them.

    Tries the whole way first, then ever shorter steps. Steps count only when they stay on the branch: short in
    curvature, and stable.

    Args:
        rod: tables.
        start: where to begin; its problem has the same kind of support.
        goal: the problem to solve.
        what: for messages.

    Raises:
        NoSolution: where the branch ends: the arm would buckle or snap, or Newton fails.
    """
    here, done, step = start, 0.0, 1.0
    iterations = 0
    while done < 1.0:
        to = min(1.0, done + step)
        problem = goal if to >= 1.0 else between(here, goal, (to - done) / (1 - done))
        found = newton(rod, problem, here.c, _carried(here, problem), here.tangent)
        reason = ""
        if isinstance(found, str):
            reason = found
        elif _largest(found.c - here.c) > _BRANCH:
            reason = "another branch"
        elif not is_stable(rod, found):
            reason = "the arm buckles or snaps, or nothing says which way"
        if isinstance(found, str) or reason:
            step = 0.5 * (to - done)
            if step < _SMALLEST_STEP:
                raise NoSolution(here.residual, f"{what}: {reason} at {100 * done:.1f} % of the way")
            continue
        iterations += found.iterations
        here, step = found, 2 * (to - done)
        done = to
    here.iterations = iterations
    return here


def grip(free: Solved, goal: Problem) -> Solved:
    """The free arm, with the goal's support put on it where it is and exerting nothing yet."""
    support = _support_between(free.ends, goal.support, 0.0)
    k = 0 if support is None else support.components
    problem = replace(free.problem, support=support)
    return Solved(free.rod, problem, free.c, np.zeros(k), free.ends, 0, free.residual, free.tangent)


def _carried(here: Solved, problem: Problem) -> Array:
    """The multipliers of a solution along the moment directions of another support of its kind."""
    old, new = here.problem.support, problem.support
    if old is None or new is None or new.axis is None:
        return here.wrench
    return np.concatenate((here.wrench[:3], new.moments @ (here.wrench[3:] @ old.moments)))


def between(start: Solved, goal: Problem, x: float) -> Problem:
    """The problem at share x of the way from a solution's to `goal`."""
    a, b = start.problem.loads, goal.loads

    def mix(p: Array | None, q: Array | None) -> Array | None:
        if p is None and q is None:
            return None
        zero = np.zeros(3)
        return (1 - x) * (zero if p is None else p) + x * (zero if q is None else q)

    hung = [(point, (1 - x) * force) for point, force in a.hung] + [(point, x * force) for point, force in b.hung]
    loads = Loads(
        gravity=(1 - x) * a.gravity + x * b.gravity,
        end_mass=(1 - x) * a.end_mass + x * b.end_mass,
        force=(1 - x) * a.force + x * b.force,
        moment=(1 - x) * a.moment + x * b.moment,
        follower_force=mix(a.follower_force, b.follower_force),
        follower_moment=mix(a.follower_moment, b.follower_moment),
        hung=hung,
    )
    pull = (1 - x) * start.problem.pull + x * goal.pull
    return Problem(pull, goal.stiffness, loads, _support_between(start.ends, goal.support, x))


def _support_between(ends: Ends, goal: Support | None, x: float) -> Support | None:
    """The support at share x of the way from where the end is."""
    if goal is None:
        return None
    here = ends.tip + ends.R_tip @ goal.pivot
    point = (1 - x) * here + x * goal.point
    if goal.R is None:
        return Support(goal.pivot, point)
    if goal.axis is None:
        R = so3.exp(x * so3.log(goal.R @ ends.R_tip.T)) @ ends.R_tip
        return Support(goal.pivot, point, R)
    # The shortest turn that lays the bar's axis, as the section sees it now, on where it is to be.
    now = ends.R_tip @ (goal.R.T @ goal.axis)
    turn = so3.cross(now, goal.axis)
    sine = math.sqrt(float(turn @ turn))
    if sine < 1e-12:
        return Support(goal.pivot, point, ends.R_tip, now)
    part = so3.exp(turn * (x * math.atan2(sine, float(now @ goal.axis)) / sine))
    axis = part @ now
    return Support(goal.pivot, point, part @ ends.R_tip, axis / math.sqrt(float(axis @ axis)))
