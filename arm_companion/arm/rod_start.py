"""A solved rod in plain numbers: enough for the next solve to start from it bit for bit, and for all that it tells."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from arm_companion.arm.model import ArmSolution, Payload
from arm_companion.arm.rod_detail import RodDetail
from arm_companion.arm.rod_equations import Loads, Rod
from arm_companion.arm.rod_solver import BareEnds, Problem, Solved, Support
from arm_companion.geometry.arrays import Array

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Held:
    """`rod_solver.Support`, rows one after the other."""

    pivot: Numbers
    point: Numbers
    rotation: Numbers = ()
    axis: Numbers = ()


@dataclass(frozen=True)
class RodStart:
    """An equilibrium as the solver leaves it.

    Attributes:
        pull: what it was solved for (n,), m.
        taut_margin: see `ArmSolution`.
        arc_length: of the modelled part, m.
        level: of the discretisations.
        easy: whether a coarser one is worth a try.
        payload: mass, kg, and offset, m (4,).
        beyond: path taken up beyond the modelled part (n,), m.
        stretch: the problem's pulls (n,).
        stiffness: of the tendons (n,), N/m.
        loads: gravity, end mass, force and moment (10,).
        hung: point and force of each hung load (6,).
        held: by what; None for a free end.
        coordinates: unknowns (size,).
        wrench: multipliers (k,).
        ends: tip, its frame row by row, base wrench and tensions (18 + n,).
        residual: relative.
        iterations: that it took.
        tangent: of the last Newton step (size * size,), row by row, from which the next solve makes its first; empty:
            there is none.
    """

    pull: Numbers
    taut_margin: float
    arc_length: float
    level: int
    easy: bool
    payload: Numbers
    beyond: Numbers
    stretch: Numbers
    stiffness: Numbers
    loads: Numbers
    hung: tuple[Numbers, ...]
    held: Held | None
    coordinates: Numbers
    wrench: Numbers
    ends: Numbers
    residual: float
    iterations: int
    tangent: Numbers

    def solved(self, rod: Rod) -> RodDetail:
        """The same on the tables that it was solved on: of its arc length and level."""
        a, size = self.loads, len(self.coordinates)
        hung = [(_array(h[:3]), _array(h[3:])) for h in self.hung]
        loads = Loads(_array(a[:3]), a[3], _array(a[4:7]), _array(a[7:]), hung=hung)
        held = self.held
        support = None if held is None else Support(_array(held.pivot), _array(held.point), *_turned(held))
        ends = _array(self.ends)
        solved = Solved(
            rod,
            Problem(_array(self.stretch), _array(self.stiffness), loads, support),
            _array(self.coordinates),
            _array(self.wrench),
            BareEnds(ends[:3], ends[3:12].reshape(3, 3), ends[12:18], ends[18:]),
            self.iterations,
            self.residual,
            _array(self.tangent).reshape(size, size) if self.tangent else None,
        )
        payload = Payload(self.payload[0], _array(self.payload[1:]))
        return RodDetail(rod, solved, payload, _array(self.beyond), self.level, self.easy)


def start_of(solution: ArmSolution | None) -> RodStart | None:
    """The numbers of a solution; None without one, and for one of another model or with following loads."""
    detail = None if solution is None else solution.detail
    if solution is None or not isinstance(detail, RodDetail):
        return None
    solved = detail.solved
    loads, support, ends = solved.problem.loads, solved.problem.support, solved.ends
    if loads.follower_force is not None or loads.follower_moment is not None:
        return None
    return RodStart(
        pull=_numbers(solution.pull),
        taut_margin=solution.taut_margin,
        arc_length=detail.rod.s,
        level=detail.level,
        easy=detail.easy,
        payload=(detail.payload.mass, *_numbers(detail.payload.offset)),
        beyond=_numbers(detail.beyond),
        stretch=_numbers(solved.problem.pull),
        stiffness=_numbers(solved.problem.stiffness),
        loads=(*_numbers(loads.gravity), loads.end_mass, *_numbers(loads.force), *_numbers(loads.moment)),
        hung=tuple((*_numbers(point), *_numbers(force)) for point, force in loads.hung),
        held=None if support is None else _held(support),
        coordinates=_numbers(solved.c),
        wrench=_numbers(solved.wrench),
        ends=(
            *_numbers(ends.tip),
            *_numbers(ends.R_tip),
            *_numbers(ends.base_wrench),
            *_numbers(ends.tension),
        ),
        residual=float(solved.residual),
        iterations=solved.iterations,
        tangent=() if solved.tangent is None else _numbers(solved.tangent),
    )


def _held(support: Support) -> Held:
    rotation = () if support.R is None else _numbers(support.R)
    axis = () if support.axis is None else _numbers(support.axis)
    return Held(_numbers(support.pivot), _numbers(support.point), rotation, axis)


def _turned(held: Held) -> tuple[Array | None, Array | None]:
    rotation = _array(held.rotation).reshape(3, 3) if held.rotation else None
    return rotation, _array(held.axis) if held.axis else None


def _numbers(values: Any) -> Numbers:
    return tuple(np.asarray(values, dtype=np.float64).ravel().tolist())


def _array(values: Numbers) -> Array:
    return np.array(values, dtype=np.float64)
