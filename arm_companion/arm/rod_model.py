"""The Kirchhoff rod behind the interface of `model`: the arm's mechanics as they fly."""

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from arm_companion.arm import compiled, rod_solver, statics
from arm_companion.arm.model import ArmSolution, Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_detail import RodDetail
from arm_companion.arm.rod_equations import FAINT, Loads, Rod
from arm_companion.arm.rod_solver import Problem, Solved, Support
from arm_companion.arm.rod_start import RodStart
from arm_companion.arm.unloaded import UnloadedArm
from arm_companion.errors import LimitViolated, ModelError, NoSolution
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed

LEVELS = ((5, 3, 12), (8, 5, 18), (12, 8, 26))
"""Discretisations, coarse to fine: degree of the bend modes, of the twist modes, Gauss nodes per segment."""

_NOTHING = Payload(0.0)
_ZERO = sealed(np.zeros(3))
_WORTH_A_TRY = 30.0  # of the tolerance, in energy of the modes that a coarser discretisation lacks


class RodModel(UnloadedArm):
    """`ArmModel` by the rod with curvature modes.

    Args:
        parameters: the arm; any number of segments.
        tolerance: imbalance between the modes (`Rod.imbalance`) above which a finer discretisation is taken;
            tip and base wrench are good to about ten times this.
        refuse: imbalance of the finest discretisation above which the answer is refused.
        levels: the discretisations, coarse to fine, as `LEVELS`.
        fast: whether to use numba (the extra `fast`). What `compiled.load` has not loaded yet is loaded, or
            compiled, here and now, and never in flight.

    Raises:
        ImportError: when `fast` is asked for and numba is not installed.
    """

    def __init__(
        self,
        parameters: ArmParameters,
        *,
        tolerance: float = 3e-6,
        refuse: float = 1e-4,
        levels: tuple[tuple[int, int, int], ...] = LEVELS,
        fast: bool = False,
    ) -> None:
        super().__init__(parameters)
        self._tolerance, self._refuse, self._levels = tolerance, refuse, levels
        self._none = sealed(np.zeros(parameters.n))
        self._slack = sealed(parameters.T0 / parameters.k_T)  # stretch at zero pull
        self._rods: dict[tuple[float, int], Rod] = {}
        self._make: type[Rod] = Rod
        self.fast = fast
        """Whether it is compiled."""
        if fast:
            from arm_companion.arm.fast import FastRod  # noqa: PLC0415 - numba is optional, and slow to import

            self._make = FastRod

    def free(
        self,
        pull: ArrayLike,
        gravity: ArrayLike,
        tip_wrench: ArrayLike | None = None,
        payload: Payload | None = None,
        *,
        follower_wrench: ArrayLike | None = None,
        tension: ArrayLike | None = None,
        start: ArmSolution | None = None,
    ) -> ArmSolution:
        """See `ArmModel.free`.

        With `tension` (n,), N, the tendons are under tension control: the motors give way as needed, and `pull`
        does not count.

        Raises:
            NoSolution: when no stable equilibrium is found on the branch that loading follows.
            LimitViolated: where the rod is bent sharper than the tendons' pitch radius.
        """
        load = payload or _NOTHING
        q = frozen(pull, (self._parameters.n,), "pull")
        goal = self._problem(self._parameters.L, q, gravity, self._none, load, tension, None)
        if tip_wrench is not None:
            w = frozen(tip_wrench, (6,), "tip_wrench")
            goal.loads.force, goal.loads.moment = w[:3], w[3:]
        if follower_wrench is not None:
            w = frozen(follower_wrench, (6,), "follower_wrench")
            goal.loads.follower_force, goal.loads.follower_moment = w[:3], w[3:]
        return _solution(self._solve(self._parameters.L, goal, load, self._none, start), q, math.nan)

    def held(
        self,
        pull: ArrayLike,
        hold: Hold,
        gravity: ArrayLike,
        *,
        tension: ArrayLike | None = None,
        start: ArmSolution | None = None,
    ) -> ArmSolution:
        """See `ArmModel.held`.

        With `tension` (n,), N, the tendons are under tension control: `pull` and `hold.beyond` do not count.

        Raises:
            NoSolution: when no stable equilibrium is found on the branch that leads there.
            LimitViolated: when the held section is out of the backbone's reach.
        """
        q = frozen(pull, (self._parameters.n,), "pull")
        detail = self._held(q, hold, gravity, tension, start)
        return _solution(detail, q, detail.rod.s - _norm(detail.solved.ends.tip))

    def resumed(self, start: RodStart) -> ArmSolution:
        """A solution of this model that was written down, with all that it could tell."""
        detail = start.solved(self._rod(start.arc_length, start.level))
        return _solution(detail, np.array(start.pull), start.taut_margin)

    def _held(
        self, pull: Array, hold: Hold, gravity: ArrayLike, tension: ArrayLike | None, start: ArmSolution | None
    ) -> RodDetail:
        s = min(hold.arc_length, self._parameters.L)
        beyond = self._none if hold.beyond is None else frozen(hold.beyond, (self._parameters.n,), "beyond")
        support = _support(hold)
        if hold.kind is HoldKind.CLAMPED:
            reach, limit = _norm(hold.pose.position), s
        else:  # only the held point is known, and the section may lie on either side of it
            reach, limit = _norm(support.point), s + _norm(hold.pivot)
        if reach >= limit:
            raise LimitViolated("distance of the held section from the base", reach, 0.0, limit)
        goal = self._problem(s, pull, gravity, beyond, _NOTHING, tension, support)
        return self._solve(s, goal, _NOTHING, beyond, start)

    def anchor(self, hold: Hold, pull: ArrayLike, tension: ArrayLike, gravity: ArrayLike) -> Hold:
        """See `ArmModel.anchor`."""
        P = self._parameters
        q, tau = frozen(pull, (P.n,), "pull"), frozen(tension, (P.n,), "tension")
        detail = self._held(q, hold, gravity, tau, None)
        return replace(hold, beyond=q + detail.solved.state.cables.longer - (tau - P.T0) / P.k_T)

    def _problem(
        self,
        s: float,
        pull: Array,
        gravity: ArrayLike,
        beyond: Array,
        payload: Payload,
        tension: ArrayLike | None,
        support: Support | None,
    ) -> Problem:
        P = self._parameters
        g = frozen(gravity, (3,), "gravity")
        loads = Loads(g, self._rod(s, 0).end_mass, _ZERO, _ZERO)
        if payload.mass > 0:
            loads.hung.append((payload.offset, payload.mass * g))
        if tension is None:
            return Problem(pull + self._slack - beyond, P.k_T, loads, support)
        tau = frozen(tension, (P.n,), "tension")
        if tau.min() < 0:
            raise LimitViolated("tendon tension", float(tau.min()), 0.0, math.inf)
        return Problem(tau, self._none, loads, support)

    def _rod(self, s: float, level: int) -> Rod:
        """Tables up to arc length s, kept: they depend on nothing else."""
        key = (s, level)
        rod = self._rods.get(key)
        if rod is None:
            if len(self._rods) >= 64:  # a hold that wanders along the arm must not fill the memory
                self._rods.clear()
            rod = self._rods[key] = self._make(self._parameters, s, *self._levels[level])
        return rod

    def _solve(self, s: float, goal: Problem, payload: Payload, beyond: Array, start: ArmSolution | None) -> RodDetail:
        """Solve at the discretisation that the start needed, then as fine as this one needs."""
        level, solved = self._from(s, goal, start)
        while True:
            rod = self._rod(s, level)
            imbalance = rod.imbalance(solved.state) if solved.imbalance is None else solved.imbalance
            if imbalance <= self._tolerance or level + 1 == len(self._levels):
                break
            level += 1
            solved = self._refined(rod, self._rod(s, level), goal, solved, imbalance)
        if not imbalance <= self._refuse:
            raise NoSolution(imbalance, "the backbone bends sharper than the finest discretisation can show")
        solved.residual = max(solved.residual, imbalance)
        return RodDetail(rod, solved, payload, beyond, level, self._would_do(level - 1, rod, solved.c))

    def _would_do(self, level: int, rod: Rod, c: Array) -> bool:
        """Whether this coarser discretisation is worth a try: the modes that it lacks hold next to no energy.

        Next to what varies along the arm: the mean bend is the tendons' own, and hides what loads do. Whatever would be
        accepted is tried, with room to spare: else the way to a load would decide about its last digits.
        """
        if level < 0:
            return False
        (bending, twist, _), mesh = self._levels[level], rod.mesh
        energy = rod.diagonal * c * c
        missed = energy[: 2 * mesh.modes] @ (mesh.degree[: 2 * mesh.modes] > bending)
        missed += energy[2 * mesh.modes :] @ (mesh.degree[2 * mesh.modes :] > twist)
        return bool(missed < _WORTH_A_TRY * self._tolerance * (energy @ (mesh.degree > 0) + FAINT * rod.moment_scale))

    @staticmethod
    def _refined(rod: Rod, finer: Rod, goal: Problem, solved: Solved, imbalance: float) -> Solved:
        """The same equilibrium with more modes.

        Raises:
            NoSolution: when that is another one, or none.
        """
        found = rod_solver.newton(finer, goal, _padded(solved.c, rod, finer), solved.wrench)
        if isinstance(found, str) or not rod_solver.is_stable(finer, found):
            raise NoSolution(imbalance, "a finer discretisation does not confirm the equilibrium")
        found.iterations += solved.iterations
        return found

    def _from(self, s: float, goal: Problem, start: ArmSolution | None) -> tuple[int, Solved]:
        """A solution and its level: from the start given, or from the unloaded arm.

        Near the taut limit few modes cannot follow the branch, so what fails is tried again with more.
        """
        detail = None if start is None else start.detail
        if not isinstance(detail, RodDetail) or detail.rod.s != s or not _same_kind(detail.solved.problem, goal):
            detail = None
        lowest = 0 if detail is None else max(0, detail.level - detail.easy)
        for level in range(lowest, len(self._levels)):
            rod = self._rod(s, level)
            try:
                if detail is None:
                    return level, self._cold(rod, goal)
                begin = detail.solved
                if rod is not detail.rod:
                    begin = _at(rod, begin.problem, _padded(begin.c, detail.rod, rod), begin.wrench)
                return level, rod_solver.follow(rod, begin, goal, "from the solution given")
            except NoSolution:
                if level + 1 == len(self._levels):
                    raise
        raise NoSolution(math.inf, "no discretisation")

    def _cold(self, rod: Rod, goal: Problem) -> Solved:
        """From the unloaded arm, whose segments are exact arcs, to the free arm, and on to what holds it."""
        c = np.zeros(rod.mesh.size)
        modes, count = rod.mesh.modes, len(rod.mesh.lengths)
        u = self._unloaded(rod, goal)
        c[:count], c[modes : modes + count] = u[0::2], u[1::2]
        nothing = Loads(_ZERO, goal.loads.end_mass, _ZERO, _ZERO)
        unloaded = _at(rod, Problem(goal.pull, goal.stiffness, nothing), c, np.zeros(0))
        free = rod_solver.follow(rod, unloaded, replace(goal, support=None), "loading")
        if goal.support is None:
            return free
        held = rod_solver.follow(rod, rod_solver.grip(free, goal), goal, "moving the held section")
        held.iterations += free.iterations
        return held

    def _unloaded(self, rod: Rod, goal: Problem) -> Array:
        """Bends (2 m,) of the pieces without load, rad."""
        part = self._parameters.up_to(rod.s)
        if goal.stiffness[0] > 0:
            return statics.bend_for_pull(part, goal.pull - self._slack)
        stiffness = part.bending - 2 * goal.pull @ part.chord_loss
        if stiffness.min() <= 0:
            raise LimitViolated("sum of tensions", float(goal.pull.sum()), 0.0, statics.buckling_tension(part))
        return np.asarray(goal.pull @ part.H / stiffness)


def compiled_model(parameters: ArmParameters) -> RodModel:
    """A model on compiled mechanics, as numba's cache has them, that need not build anything any more.

    Raises:
        NotCompiled: there are none.
    """
    compiled.load(compiling=False)
    model = RodModel(parameters, fast=True)
    with suppress(ModelError):
        model.free([0.0] * parameters.n, (0.0, 0.0, 0.0))  # builds its tables
    return model


def _at(rod: Rod, problem: Problem, c: Array, wrench: Array) -> Solved:
    """A place to start from: given unknowns on this rod, not an equilibrium of it yet."""
    state = rod.evaluate(c, problem.loads_with(wrench), problem.pull, problem.stiffness)
    return Solved(rod, problem, c, wrench, state, 0, math.inf)


def _support(hold: Hold) -> Support:
    point = hold.pose @ hold.pivot if any(hold.pivot.tolist()) else hold.pose.position
    if hold.kind is HoldKind.PINNED:
        return Support(hold.pivot, point)
    return Support(hold.pivot, point, hold.pose.rotation, hold.axis)


def _norm(v: Array) -> float:
    x, y, z = v.tolist()
    return math.sqrt(x * x + y * y + z * z)


def _same_kind(old: Problem, new: Problem) -> bool:
    """Whether a solution of one problem is a place to start the other from."""
    a, b = old.support, new.support
    if (old.stiffness[0] > 0) != (new.stiffness[0] > 0):
        return False
    if a is None or b is None:
        return a is b
    alike = (a.R is None) == (b.R is None) and (a.axis is None) == (b.axis is None)
    return alike and a.pivot.tolist() == b.pivot.tolist()


def _padded(c: Array, old: Rod, new: Rod) -> Array:
    """Unknowns on another discretisation of the same pieces: more modes, or fewer."""
    result = np.zeros((3, new.mesh.modes))
    given = np.zeros((3, old.mesh.modes))
    given.reshape(-1)[: c.size] = c
    shared = min(old.mesh.modes, new.mesh.modes)
    result[:, :shared] = given[:, :shared]
    return result.reshape(-1)[: new.mesh.size].copy()


def _solution(detail: RodDetail, pull: Array, margin: float) -> ArmSolution:
    rod, solved, ends = detail.rod, detail.solved, detail.solved.ends
    count, modes = len(rod.mesh.lengths), rod.mesh.modes
    bend = np.empty(2 * count)
    bend[0::2], bend[1::2] = solved.c[:count], solved.c[modes : modes + count]
    return ArmSolution(
        pull=pull,
        bend=sealed(bend),
        tip_position=sealed(ends.tip),
        tip_rotation=sealed(ends.R_tip),
        tension=sealed(ends.tension),
        base_wrench=sealed(ends.base_wrench),
        tip_wrench=sealed(_tip_wrench(solved)),
        residual=solved.residual,
        taut_margin=margin,
        gravity=solved.problem.loads.gravity,
        arc_length=rod.s,
        coordinates=sealed(solved.c),
        iterations=solved.iterations,
        detail=detail,
    )


def _tip_wrench(solved: Solved) -> Array:
    """What the outside exerts on the end section (6,), about its centre, payload left out."""
    support, loads, R = solved.problem.support, solved.problem.loads, solved.ends.R_tip
    if support is None:
        w = np.concatenate((loads.force, loads.moment))
        if loads.follower_force is not None and loads.follower_moment is not None:
            w += np.concatenate((R @ loads.follower_force, R @ loads.follower_moment))
        return w
    if support.central and support.R is not None and support.axis is None:
        return solved.wrench.copy()
    moment = so3.cross(R @ support.pivot, solved.wrench[:3])
    if support.R is not None:
        moment = moment + solved.wrench[3:] @ support.moments
    return np.concatenate((solved.wrench[:3], moment))
