"""The rod on compiled equations (extra `fast`); importing this module compiles them, or reads numba's cache."""

from typing import Any

import numpy as np

from arm_companion.arm import fast_equations, fast_newton
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_equations import Cables, Loads, Rod, State
from arm_companion.arm.rod_solver import (
    ITERATIONS,
    NO_CONVERGENCE,
    STEP_LIMIT,
    TOLERANCE,
    TOO_SHARP,
    BareEnds,
    Problem,
    Solved,
    Support,
)
from arm_companion.errors import LimitViolated
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array

_NOTHING = np.zeros(30)
_NONE_HUNG = np.zeros((0, 6))
_NO_TANGENT = np.zeros((0, 0))


class FastRod(Rod):
    """`Rod` whose equations, and Newton's method on them, are compiled."""

    def __init__(self, parameters: ArmParameters, s: float, bending: int, twist: int, per_piece: int) -> None:
        super().__init__(parameters, s, bending, twist, per_piece)
        mesh = self.mesh
        self._tables = (
            _own(mesh.steps),
            np.array(mesh.at_nodes, dtype=np.int64),
            _own(mesh.basis),
            _own(mesh.weighted),
            _own(mesh.inner),
            _own(np.column_stack((mesh.outer, mesh.weights))),
            _own(self.mass_beyond),
            _own(self.r),
            _own(self.cos.ravel()),
            _own(self.sin.ravel()),
            _own(self.straight),
            _own(self.cable_weights),
            _own(self.diagonal),
            _own(self.chord),
            _own(mesh.weights),
            _own(self.node_stiffness),
            _own(self.node_chord),
        )
        tolerance = max(TOLERANCE, self.rounding)
        self._limits = np.array((self.moment_scale, s, tolerance, STEP_LIMIT, float(ITERATIONS), self.arm_mass))
        self.compiled_newton = self._newton

    def evaluate(self, c: Array, loads: Loads, pull: Array, stiffness: Array) -> State:
        """See `Rod.evaluate`."""
        arguments = _own(c), _loads(loads), _hung(loads, None), _own(pull), _own(stiffness), self._tables
        inside, *fields = fast_equations.evaluate(*arguments)
        if not inside:
            raise LimitViolated("bend radius over pitch radius", float(1 / (1 - fields[12].min())), 1.0, np.inf)
        D, P, tip, R_tip, m, moment, F, M, kappa, tension, longer, path, near, length, residual, J = fields
        base = np.concatenate((F + self.arm_mass * loads.gravity, moment))
        return State(D, P, tip, R_tip, m, base, F, M, kappa, Cables(tension, longer, path, near, length), residual, J)

    def tangent(self, state: State, loads: Loads, stiffness: Array) -> Array:
        """See `Rod.tangent`; the state is one of this class's own."""
        k = state.cables
        fields = (
            state.D,
            state.P,
            state.tip,
            state.R_tip,
            state.m,
            state.base_wrench[3:],
            state.F,
            state.M,
            state.kappa,
        )
        cables = (k.tension, k.longer, k.path, k.near, k.length)
        full: Any = (True, *fields, *cables, state.residual, state.J)
        return np.asarray(
            fast_equations.tangent(full, _loads(loads), _hung(loads, None), _own(stiffness), self._tables)
        )

    def _newton(self, problem: Problem, c: Array, wrench: Array, tangent: Array | None = None) -> Solved | str:
        """See `rod_solver.newton`."""
        support = problem.support
        kind, packed = _packed(support)
        status, steps, error, apart, stable, c, wrench, K, C, ends = fast_newton.newton(
            _own(c),
            _own(wrench),
            kind,
            packed,
            _loads(problem.loads),
            _hung(problem.loads, support),
            _own(problem.pull),
            _own(problem.stiffness),
            _NO_TANGENT if tangent is None else tangent,
            tangent is not None,
            self._limits,
            self._tables,
        )
        if status != 0:
            return TOO_SHARP if status == 2 else NO_CONVERGENCE
        reached = BareEnds(ends[:3], ends[3:12].reshape(3, 3), ends[12:18], ends[18:])
        # Stiffened only so far, an unstable verdict may be wrong: then it is left to the exact test.
        verdict = True if stable else None
        held = None if support is None else C
        return Solved(self, problem, c, wrench, reached, steps, error, K, held, verdict, apart)


def _own(values: Array) -> Array:
    """A copy in row order that may be written: the compiled code takes nothing else."""
    return np.array(values, dtype=np.float64, order="C")


def _packed(support: Support | None) -> tuple[int, Array]:
    if support is None:
        return fast_newton.FREE, _NOTHING
    packed = np.zeros(30)
    packed[:3] = support.pivot
    packed[3:6] = support.point
    if support.R is None:
        return fast_newton.PINNED, packed
    packed[6:15] = support.R.ravel()
    if support.axis is None:
        return fast_newton.CLAMPED, packed
    packed[15:18] = support.axis
    packed[18:24] = so3.perpendicular(support.axis).ravel()
    packed[24:30] = support.moments.ravel()
    return fast_newton.BAR, packed


def _loads(loads: Loads) -> Array:
    packed = np.zeros(16)
    packed[:3] = loads.gravity
    packed[3] = loads.end_mass
    packed[4:7] = loads.force
    packed[7:10] = loads.moment
    if loads.follower_force is not None:
        packed[10:13] = loads.follower_force
    if loads.follower_moment is not None:
        packed[13:16] = loads.follower_moment
    return packed


def _hung(loads: Loads, support: Support | None) -> Array:
    """Points and forces that hang on the end section; the support's own row, when it has one, comes last."""
    extra = support is not None and not support.central
    if not loads.hung and not extra:
        return _NONE_HUNG
    rows = [np.concatenate(pair) for pair in loads.hung]
    if support is not None and extra:
        rows.append(np.concatenate((support.pivot, np.zeros(3))))
    return np.array(rows)
