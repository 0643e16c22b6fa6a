"""The Kirchhoff rod behind the interface of `model`: the arm's mechanics as they fly."""

import math
from dataclasses import replace

import numpy as np

from arm_companion.arm import arc, rod_solver, statics
from arm_companion.arm.model import ArmSolution, Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_detail import RodDetail
from arm_companion.arm.rod_equations import Loads, Rod
from arm_companion.arm.rod_solver import Problem, Solved, Support
from arm_companion.errors import LimitViolated, NoSolution
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed

LEVELS = ((5, 3, 13), (8, 5, 18), (12, 8, 26))
"""Discretisations, coarse to fine: degree of the bend modes, of the twist modes, Gauss nodes per segment."""

_NOTHING = Payload(0.0)


class RodModel:
    """`ArmModel` by the rod with curvature modes.

    Args:
        parameters: the arm; any number of segments.
        tolerance: imbalance between the modes (`Rod.imbalance`) above which a finer discretisation is taken;
            tip and base wrench are good to about ten times this.
        refuse: imbalance of the finest discretisation above which the answer is refused.
    """

    def __init__(self, parameters: ArmParameters, *, tolerance: float = 3e-6, refuse: float = 3e-4) -> None:
        self._parameters = parameters
        self._tolerance, self._refuse = tolerance, refuse
        self._rods: dict[tuple[float, int], Rod] = {}

    @property
    def parameters(self) -> ArmParameters:
        """The arm."""
        return self._parameters

    def pull_for_bend(self, bend: ArrayLike, pretension: float | None = None) -> Array:
        """See `ArmModel.pull_for_bend`."""
        return statics.pull_for_bend(self._parameters, bend, pretension)

    def pull_for_tension(self, bend: ArrayLike, tension: ArrayLike) -> Array:
        """See `ArmModel.pull_for_tension`."""
        return statics.pull_for_tension(self._parameters, bend, tension)

    def bend_for_pull(self, pull: ArrayLike) -> Array:
        """See `ArmModel.bend_for_pull`."""
        return statics.bend_for_pull(self._parameters, pull)

    def bend_for_tip(self, p_tip_base: ArrayLike, tolerance: float | None = None) -> Array:
        """See `ArmModel.bend_for_tip`; an unloaded segment is an arc."""
        L = self._parameters.L
        return arc.bend_for_tip(p_tip_base, L, 0.01 * L if tolerance is None else tolerance)

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

        Args:
            pull: tendon goals (n,), m.
            gravity: (3,), m/s^2, base axes.
            tip_wrench: dead load at the tip (6,) [N; N m], base axes.
            payload: what the tip carries.
            follower_wrench: load that turns with the tip (6,) [N; N m], tip axes.
            tension: of each tendon under tension control (n,), N; the motors give way as needed and `pull`
                does not count.
            start: a neighbouring solution to start from.

        Raises:
            NoSolution: when no stable equilibrium is found on the branch that loading follows.
            LimitViolated: where the rod is bent sharper than the tendons' pitch radius.
        """
        load = payload or _NOTHING
        goal = self._problem(self._parameters.L, pull, gravity, np.zeros(self._parameters.n), load, tension)
        if tip_wrench is not None:
            w = frozen(tip_wrench, (6,), "tip_wrench")
            goal.loads.force, goal.loads.moment = w[:3], w[3:]
        if follower_wrench is not None:
            w = frozen(follower_wrench, (6,), "follower_wrench")
            goal.loads.follower_force, goal.loads.follower_moment = w[:3], w[3:]
        detail = self._solve(self._parameters.L, goal, load, np.zeros(self._parameters.n), start)
        return _solution(detail, frozen(pull, (self._parameters.n,), "pull"), math.nan)

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

        Args:
            pull: tendon goals (n,), m.
            hold: what is held and where it is now.
            gravity: (3,), m/s^2, base axes.
            tension: of each tendon under tension control (n,), N; `pull` and `hold.beyond` do not count.
            start: a neighbouring solution of the same kind of hold.

        Raises:
            NoSolution: when no stable equilibrium is found on the branch that leads there.
            LimitViolated: when the held section is out of the backbone's reach.
        """
        detail = self._held(pull, hold, gravity, tension, start)
        tip = detail.solved.state.tip
        margin = detail.rod.s - math.sqrt(float(tip @ tip))
        return _solution(detail, frozen(pull, (self._parameters.n,), "pull"), margin)

    def _held(
        self, pull: ArrayLike, hold: Hold, gravity: ArrayLike, tension: ArrayLike | None, start: ArmSolution | None
    ) -> RodDetail:
        P = self._parameters
        s = min(hold.arc_length, P.L)
        beyond = np.zeros(P.n) if hold.beyond is None else frozen(hold.beyond, (P.n,), "beyond")
        support = _support(hold)
        reach = float(np.sqrt(support.point @ support.point))
        slack = float(np.sqrt(hold.pivot @ hold.pivot))
        if hold.kind is HoldKind.CLAMPED:
            reach, slack = float(np.sqrt(hold.pose.position @ hold.pose.position)), 0.0
        if reach >= s + slack:
            raise LimitViolated("distance of the held section from the base", reach, 0.0, s + slack)
        goal = replace(self._problem(s, pull, gravity, beyond, _NOTHING, tension), support=support)
        return self._solve(s, goal, _NOTHING, beyond, start)

    def anchor(self, hold: Hold, pull: ArrayLike, tension: ArrayLike, gravity: ArrayLike) -> Hold:
        """See `ArmModel.anchor`."""
        P = self._parameters
        tau = frozen(tension, (P.n,), "tension")
        detail = self._held(pull, hold, gravity, tau, None)
        longer = detail.solved.state.cables.longer
        return replace(hold, beyond=frozen(pull, (P.n,), "pull") + longer - (tau - P.T0) / P.k_T)

    def _problem(
        self, s: float, pull: ArrayLike, gravity: ArrayLike, beyond: Array, payload: Payload, tension: ArrayLike | None
    ) -> Problem:
        P = self._parameters
        g = frozen(gravity, (3,), "gravity")
        loads = Loads(g, self._rod(s, 0).end_mass, np.zeros(3), np.zeros(3))
        if payload.mass > 0:
            loads.hung.append((payload.offset, payload.mass * g))
        if tension is not None:
            return Problem(np.maximum(frozen(tension, (P.n,), "tension"), 0.0), np.zeros(P.n), loads)
        return Problem(frozen(pull, (P.n,), "pull") + P.T0 / P.k_T - beyond, P.k_T, loads)

    def _rod(self, s: float, level: int) -> Rod:
        """Tables up to arc length s, kept: they depend on nothing else."""
        key = (s, level)
        rod = self._rods.get(key)
        if rod is None:
            if len(self._rods) >= 64:  # a hold that wanders along the arm must not fill the memory
                self._rods.clear()
            rod = self._rods[key] = Rod(self._parameters, s, *LEVELS[level])
        return rod

    def _solve(self, s: float, goal: Problem, payload: Payload, beyond: Array, start: ArmSolution | None) -> RodDetail:
        """Solve at the discretisation that the start needed, then as fine as this one needs."""
        level, solved = self._from(s, goal, start)
        while True:
            rod = self._rod(s, level)
            imbalance = rod.imbalance(solved.state)
            if imbalance <= self._tolerance or level + 1 == len(LEVELS):
                break
            level += 1
            finer = rod_solver.newton(
                self._rod(s, level), goal, _padded(solved.c, rod, self._rod(s, level)), solved.wrench
            )
            if finer is None or not rod_solver.is_stable(self._rod(s, level), finer):
                raise NoSolution(imbalance, "a finer discretisation does not confirm the equilibrium")
            finer.iterations += solved.iterations
            solved = finer
        if imbalance > self._refuse:
            raise NoSolution(imbalance, "the backbone bends sharper than the finest discretisation can show")
        solved.residual = max(solved.residual, imbalance)
        return RodDetail(rod, solved, payload, beyond, level, imbalance < 1e-3 * self._tolerance)

    def _from(self, s: float, goal: Problem, start: ArmSolution | None) -> tuple[int, Solved]:
        if start is not None and isinstance(start.detail, RodDetail):
            detail = start.detail
            if detail.rod.s == s and _same_kind(detail.solved.problem, goal):
                level = max(0, detail.level - detail.easy)
                rod = self._rod(s, level)
                begin = detail.solved
                if rod is not detail.rod:
                    begin = self._restated(rod, begin, _padded(begin.c, detail.rod, rod))
                return level, rod_solver.follow(rod, begin, goal, "from the solution given")
        return 0, self._cold(s, goal)

    def _cold(self, s: float, goal: Problem) -> Solved:
        """From the unloaded arm, whose segments are exact arcs, to the free arm, and on to what holds it."""
        rod = self._rod(s, 0)
        c = np.zeros(rod.mesh.size)
        modes, count = rod.mesh.modes, len(rod.mesh.lengths)
        u = self._unloaded(rod, goal)
        c[:count], c[modes : modes + count] = u[0::2], u[1::2]
        nothing = Loads(np.zeros(3), goal.loads.end_mass, np.zeros(3), np.zeros(3))
        unloaded = self._restated(rod, None, c, Problem(goal.pull, goal.stiffness, nothing))
        free = rod_solver.follow(rod, unloaded, replace(goal, support=None), "loading")
        if goal.support is None:
            return free
        begin = rod_solver.grip(free, goal)
        held = rod_solver.follow(rod, begin, goal, "moving the held section")
        held.iterations += free.iterations
        return held

    def _unloaded(self, rod: Rod, goal: Problem) -> Array:
        """Bends (2 m,) of the pieces without load, rad."""
        P = self._parameters
        part = P.up_to(rod.s)
        if goal.stiffness.any():
            return statics.bend_for_pull(part, goal.pull - P.T0 / P.k_T)
        return np.asarray((goal.pull @ part.H) / (part.bending - 2 * goal.pull @ part.chord_loss))

    @staticmethod
    def _restated(rod: Rod, old: Solved | None, c: Array, problem: Problem | None = None) -> Solved:
        """A starting point: another's unknowns on this rod, not an equilibrium of it yet."""
        at = problem if old is None else old.problem
        if at is None:
            raise ValueError("neither a solution nor a problem")
        wrench = np.zeros(0) if old is None else old.wrench
        loads = at.loads_with(wrench)
        state = rod.evaluate(c, loads, at.pull, at.stiffness)
        return Solved(c, wrench, state, loads, at, 0, math.inf)


def _support(hold: Hold) -> Support:
    point = hold.pose @ hold.pivot
    if hold.kind is HoldKind.PINNED:
        return Support(hold.pivot, point)
    return Support(hold.pivot, point, hold.pose.rotation, hold.axis)


def _same_kind(old: Problem, new: Problem) -> bool:
    """Whether a solution of one problem is a place to start the other from."""
    if old.stiffness.any() != new.stiffness.any() or (old.support is None) != (new.support is None):
        return False
    if old.support is None or new.support is None:
        return True
    return old.support.moments.shape == new.support.moments.shape and bool(
        (old.support.pivot == new.support.pivot).all()
    )


def _padded(c: Array, old: Rod, new: Rod) -> Array:
    """Unknowns on another discretisation of the same pieces: more modes, or fewer."""
    result = np.zeros((3, new.mesh.modes))
    given = np.zeros((3, old.mesh.modes))
    given.reshape(-1)[: c.size] = c
    shared = min(old.mesh.modes, new.mesh.modes)
    result[:, :shared] = given[:, :shared]
    return result.reshape(-1)[: new.mesh.size].copy()


def _solution(detail: RodDetail, pull: Array, margin: float) -> ArmSolution:
    rod, solved, state = detail.rod, detail.solved, detail.solved.state
    gravity = solved.problem.loads.gravity
    base = np.empty(6)
    base[:3] = state.F + rod.arm_mass * gravity
    base[3:] = state.base_moment
    support, loads = solved.problem.support, solved.problem.loads
    tip = np.empty(6)
    if support is None:
        tip[:3], tip[3:] = loads.force, loads.moment
        if loads.follower_force is not None and loads.follower_moment is not None:
            tip[:3] += state.R_tip @ loads.follower_force
            tip[3:] += state.R_tip @ loads.follower_moment
    else:
        tip[:3] = solved.wrench[:3]
        tip[3:] = solved.wrench[3:] @ support.moments
        if not support.central:
            tip[3:] += so3.cross(state.R_tip @ support.pivot, solved.wrench[:3])
    count, modes = len(rod.mesh.lengths), rod.mesh.modes
    bend = np.column_stack((solved.c[:count], solved.c[modes : modes + count])).reshape(-1)
    return ArmSolution(
        pull=pull,
        bend=sealed(bend),
        tip_position=sealed(state.tip),
        tip_rotation=sealed(state.R_tip.copy()),
        tension=sealed(state.cables.tension),
        base_wrench=sealed(base),
        tip_wrench=sealed(tip),
        residual=solved.residual,
        taut_margin=margin,
        gravity=gravity,
        arc_length=rod.s,
        coordinates=sealed(solved.c),
        iterations=solved.iterations,
        detail=detail,
    )
