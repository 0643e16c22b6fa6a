"""What a solved rod can tell on demand: its shape, where its mass is, and how its base wrench responds."""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.polynomial import legendre

from arm_companion.arm import rod_solver
from arm_companion.arm.model import Derivatives, MassMoments, Payload
from arm_companion.arm.rod_equations import WRAP, Rod, State, cross_rows
from arm_companion.errors import NoSolution
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, sealed


@dataclass(eq=False)
class RodDetail:
    """`Detail` of a rod.

    Attributes:
        rod: its tables.
        solved: the equilibrium.
        payload: what the end carries.
        beyond: path taken up beyond the modelled part (n,), m.
        level: which of the model's discretisations.
        easy: whether a coarser one is worth a try.
    """

    rod: Rod
    solved: rod_solver.Solved
    payload: Payload
    beyond: Array
    level: int
    easy: bool

    def moments(self) -> MassMoments:
        """See `Detail.moments`."""
        rod, state = self.rod, self.solved.state
        q, joints = rod.node_mass.size, len(rod.joint_masses)
        points, masses = np.empty((q + 2 + joints, 3)), np.empty(q + 2 + joints)
        np.subtract(state.tip, state.P.T, out=points[:q])
        points[q], points[q + 1] = state.tip, state.tip + state.R_tip @ self.payload.offset
        masses[:q], masses[q], masses[q + 1] = rod.node_mass, rod.end_mass, self.payload.mass
        for k, mass in enumerate(rod.joint_masses, q + 2):
            points[k], masses[k] = self._joint(k - q - 2), mass
        return MassMoments.of_points(masses, points)

    def _joint(self, k: int) -> Array:
        """Position (3,) of the end of piece k."""
        here = self.rod.mesh.piece <= k
        return np.asarray(self.solved.state.t[:, here] @ self.rod.mesh.weights[here])

    def sections(self, at: Array) -> tuple[Array, Array]:
        """See `Detail.sections`: the polynomials through the nodes' axes, made orthogonal again."""
        mesh, D = self.rod.mesh, self.solved.state.D
        count = len(mesh.lengths)
        per = mesh.nodes.size // count
        edges = np.concatenate(([0.0], np.cumsum(mesh.lengths)))
        piece = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, count - 1)
        R = np.empty((at.size, 3, 3))
        p = np.empty((at.size, 3))
        start = np.zeros(3)
        for k in range(count):
            nodes = slice(k * per, (k + 1) * per)
            y, t = (mesh.analysis @ D[a, :3, nodes].T for a in (0, 2))  # Legendre coefficients (per, 3)
            here = piece == k
            local = 2 * (at[here] - edges[k]) / mesh.lengths[k] - 1
            t_at, y_at = legendre.legval(local, t).T, legendre.legval(local, y).T
            R[here] = _orthogonal(t_at, y_at)
            integral = legendre.legint(t, lbnd=-1, axis=0)
            p[here] = start + 0.5 * mesh.lengths[k] * legendre.legval(local, integral).T
            start = start + 0.5 * mesh.lengths[k] * legendre.legval(1.0, integral)
        return R, p

    def line(self) -> Array:
        """See `Detail.line`: base, nodes and end."""
        state = self.solved.state
        return np.vstack((np.zeros(3), (state.t @ self.rod.mesh.inner).T, state.tip))

    def path_beyond(self, s: float) -> Array:
        """See `Detail.path_beyond`."""
        rod, mesh, cables = self.rod, self.rod.mesh, self.solved.state.cables
        if s <= 0:
            return np.asarray(self.beyond - cables.longer)
        # Shortening per length at the nodes, integrated from s to the end by its own polynomial.
        bend = (self.solved.state.kappa[:2] ** 2).sum(axis=0)
        rate = (rod.cable_weights > 0) * (1 - cables.length) + rod.node_chord * bend
        count = len(mesh.lengths)
        per = mesh.nodes.size // count
        total, before = self.beyond.copy(), 0.0
        for k, length in enumerate(mesh.lengths):
            local = float(np.clip(2 * (s - before) / length - 1, -1.0, 1.0))
            coefficients = mesh.analysis @ rate[:, k * per : (k + 1) * per].T
            integral = legendre.legint(coefficients, lbnd=-1, axis=0)
            total += 0.5 * length * (legendre.legval(1.0, integral) - legendre.legval(local, integral))
            before += length
        return np.asarray(total)

    def turning(self) -> float:
        """See `Detail.turning`."""
        kx, ky, _ = self.solved.state.kappa
        return float(self.rod.mesh.weights @ np.hypot(kx, ky))

    def derivatives(self) -> Derivatives:
        """See `Detail.derivatives`: one linear system, that of the last Newton step, for all of them."""
        rod, solved, state = self.rod, self.solved, self.solved.state
        K = rod.tangent(state, solved.loads, solved.problem.stiffness)
        problem, support = solved.problem, solved.problem.support
        cables = state.cables
        n = cables.tension.size
        taut = (cables.tension > 0) * (problem.stiffness > 0)
        J = state.J
        by_gravity, first = self._by_gravity(state)
        T0 = rod.parameters.T0
        stretch = (cables.tension - T0) * taut
        held_by = problem.stiffness * taut
        right = np.empty((solved.c.size, n + 13))  # what the unknowns answer to: minus dr / d parameter, then end loads
        right[:, :n] = -(cables.path * held_by[:, None]).T
        right[:, n : n + 3] = by_gravity
        right[:, n + 3] = -(rod.bend_diagonal * solved.c)
        right[:, n + 4] = -(rod.twist_diagonal * solved.c)
        right[:, n + 5] = -(stretch @ cables.path)
        right[:, n + 6] = -((T0 * taut) @ cables.path)
        right[:, n + 7 :] = J
        by_c = self._base_by_unknowns(state)
        position = state.tip if support is None else state.tip + state.R_tip @ support.pivot
        direct_tip = _wrench_at(position)
        try:
            if support is None:
                answer = np.linalg.solve(K, right)
                compliance, moved = J.T @ answer[:, -6:], answer[:, -6:]
                D = by_c @ answer
                hold, tip = np.zeros((6, 6)), D[:, -6:] + direct_tip
            else:
                D, hold, compliance, moved = self._held(K, right[:, : n + 7], by_c, J, support, direct_tip)
                tip = np.zeros((6, 6))
        except np.linalg.LinAlgError:
            raise NoSolution(float("inf"), "the equilibrium is singular") from None
        mass = rod.arm_mass + rod.end_mass + self.payload.mass
        gravity = D[:, n : n + 3] + np.vstack((mass * np.eye(3), so3.hat(first)))
        names = ("EI", "GJ", "k_T", "T0")
        return Derivatives(
            pull=sealed(D[:, :n].copy()),
            gravity=sealed(gravity),
            hold=sealed(hold),
            tip_wrench=sealed(tip),
            parameters=MappingProxyType({name: sealed(D[:, n + 3 + k].copy()) for k, name in enumerate(names)}),
            tension=sealed(held_by[:, None] * (cables.path @ moved)),
            compliance=sealed(compliance),
        )

    def _held(
        self, K: Array, by_parameters: Array, by_c: Array, J: Array, support: rod_solver.Support, direct: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Base wrench by parameters (6, p) and by hold (6, 6), compliance (6, 6), unknowns by hold (size, 6)."""
        state, size = self.solved.state, K.shape[0]
        _, C = support.gap(state)
        k = C.shape[1]
        o = state.R_tip @ support.pivot
        A = np.zeros((size + k, size + k))
        A[:size, :size] = K
        A[:size, size:] = -support.forces(state)
        A[size:, :size] = C.T
        hold = np.zeros((size + k, 6))  # d(residual, gap) by twist of the held section
        hold[size : size + 3, :3] = -np.eye(3)
        hold[size : size + 3, 3:] = so3.hat(o)
        moment = self.solved.wrench[3:] @ support.moments
        if support.R is not None:
            hold[size + 3 :, 3:] = -support.moments if support.axis is not None else -np.eye(3)
        if support.axis is not None:
            hold[:size, 3:] = state.J_phi @ so3.hat(moment)
        count = by_parameters.shape[1]
        right = np.zeros((size + k, count + 6))
        right[:size, :count] = by_parameters
        right[:, count:] = -hold
        answer = np.linalg.solve(A, right)
        out = np.zeros((6, size + k))
        out[:, :size] = by_c
        out[:, size : size + 3] = direct[:, :3]
        out[3:, size + 3 :] = support.moments.T
        D = out @ answer
        by_hold = D[:, count:]
        if support.axis is not None:
            by_hold = by_hold.copy()
            by_hold[3:, 3:] -= so3.hat(moment)
        compliance = J.T @ np.linalg.solve(K, J)
        return D[:, :count], by_hold, compliance, answer[:size, count:]

    def _by_gravity(self, state: State) -> tuple[Array, Array]:
        """Work of a unit field on every unknown (size, 3), and the first moment of mass (3,), kg m."""
        rod, mesh = self.rod, self.rod.mesh
        beyond = rod.mass_beyond + rod.end_mass + self.payload.mass
        o = state.R_tip @ self.payload.offset * self.payload.mass
        t = state.t
        rest = (t * beyond) @ mesh.outer + o[:, None]  # its moment per unit field is rest x g
        rest = rest[WRAP]
        turning = state.D[:, 1:4] * rest[2:5] - state.D[:, 2:5] * rest[1:4]
        work = (turning @ mesh.weighted.T).transpose(0, 2, 1).reshape(-1, 3)
        return work[: mesh.size], t @ (mesh.weights * beyond) + o

    def _base_by_unknowns(self, state: State) -> Array:
        """d base_wrench / dc (6, size) with dead loads as they are, followers turning along."""
        mesh, loads = self.rod.mesh, self.solved.loads
        gravity = self.solved.problem.loads.gravity
        t = state.t
        n = mesh.weights * (state.F[:, None] + gravity[:, None] * self.rod.mass_beyond)
        phi = self.rod.turns(state)
        # (phi x t) x n = t (phi . n) - phi (t . n)
        result = np.zeros((6, self.rod.mesh.size))
        force, moment = result[:3].T, result[3:].T
        moment += (phi * n).sum(axis=1) @ t.T - phi @ (t * n).sum(axis=0)
        for point, dead in loads.hung:
            moment += cross_rows(cross_rows(state.J_phi, state.R_tip @ point), dead)
        if loads.follower_force is not None:
            force += cross_rows(state.J_phi, state.R_tip @ loads.follower_force)
            moment -= cross_rows(force, state.tip)
        if loads.follower_moment is not None:
            moment += cross_rows(state.J_phi, state.R_tip @ loads.follower_moment)
        return result


def _wrench_at(p: Array) -> Array:
    """X (6, 6): the wrench about the base point of one at p (3,)."""
    X = np.eye(6)
    X[3:, :3] = so3.hat(p)
    return X


def _orthogonal(t: Array, y: Array) -> Array:
    """Frames (k, 3, 3) with third axis along t (k, 3) and second axis near y (k, 3)."""
    t = t / np.sqrt((t * t).sum(axis=1))[:, None]
    y = y - (y * t).sum(axis=1)[:, None] * t
    y = y / np.sqrt((y * y).sum(axis=1))[:, None]
    return np.stack((np.cross(y, t), y, t), axis=2)
