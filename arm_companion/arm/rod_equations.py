"""Equilibrium of a discretised Kirchhoff rod: unbalanced force and its derivative, at given curvature and loads.

Coordinate a = 0, 1, 2 (u_x, u_y, u_z) turns a section about D_a: its own y axis, minus its x axis, its tangent t.
With phi_j(s) the turn of the section at s per unknown c_j, phi_j' = beta_j D_a. Internal force n and moment m are
what the part beyond s exerts on the part before it:

    n(s) = F + g mu(s)                                                  mu(s) the mass beyond s
    m(s) = M + P(s) x F + Q(s) x g        P, Q the integrals of t and of mu t from s to the end
    r_j  = dE/dc_j - integral of m . phi_j'                                         (virtual work)
    d(integral of m . phi_j')/dc_i = integral of phi_i . (phi_j' x m + n (t . phi_j) - (t . n) phi_j)

The last line is for dead F and M, given in base axes; a dead moment makes it unsymmetric at the end by
M . (phi_i x phi_j). That is the true derivative, so that Newton's method is quadratic.

Tendon i runs at r (cos phi_i, sin phi_i) off the backbone; its path is the integral of |t + kappa x r_i|, twist
included: twist stretches every tendon, and tension stiffens the arm against it (by a third in the reference arm).

The cost here is that of calling NumPy some hundred times, so the code stacks what can be stacked. "Wrapped" arrays
hold components x, y, z, x, y, ... along one axis: the vector product, two shorter, is then a[1:] b[2:] - a[2:] b[1:].
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from arm_companion.arm import rod_mesh
from arm_companion.arm.parameters import ArmParameters, Guides, Segment
from arm_companion.errors import LimitViolated
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array

WRAP = np.array((0, 1, 2, 0, 1))
"""Components of a vector, wrapped."""
_WRAP_THRICE = np.array((0, 1, 2, 0, 1, 2, 0, 1, 2))
_SYMMETRIC = np.array((0, 1, 3, 1, 2, 4, 3, 4, 5))  # where the six distinct blocks of a symmetric 3 x 3 go
_EYE = np.eye(3)
# Skew matrix, row by row, of a turn given in (u_x, u_y, u_z): about y, -x and the tangent.
_SKEW = np.zeros((3, 9))
_SKEW[[0, 0, 1, 1, 2, 2], [2, 6, 5, 7, 3, 1]] = (1.0, -1.0) * 3
FAINT = 1e-4  # energy of loads, beside that of a radian's bend, under which `Rod.imbalance` does not tell them apart
_ROUNDING = 16 * 2.0**-52
_TINY = 1e-300


@dataclass(eq=False)
class Loads:
    """What acts on the rod besides its tendons.

    Attributes:
        gravity: field (3,), m/s^2, base axes.
        end_mass: at the end section's centre, kg.
        force: dead force at the end section's centre (3,), N, base axes.
        moment: dead moment on the end section (3,), N m, base axes.
        follower_force: (3,), N, end section's axes.
        follower_moment: (3,), N m, end section's axes.
        hung: dead forces at points of the end section: (point in its axes (3,), m; force (3,), N, base axes).
    """

    gravity: Array
    end_mass: float
    force: Array
    moment: Array
    follower_force: Array | None = None
    follower_moment: Array | None = None
    hung: list[tuple[Array, Array]] = field(default_factory=list)

    def at_end(self, R: Array) -> tuple[Array, Array]:
        """Resultant force and moment (3,) of all end loads about the end section's centre; R is its frame."""
        F = self.force + self.end_mass * self.gravity
        M = self.moment
        for point, force in self.hung:
            F = F + force
            M = M + so3.cross(R @ point, force)
        if self.follower_force is not None:
            F = F + R @ self.follower_force
        if self.follower_moment is not None:
            M = M + R @ self.follower_moment
        return F, M


@dataclass(eq=False, slots=True)
class Cables:
    """The tendons at one set of unknowns.

    Attributes:
        tension: (n,), N.
        longer: path inside the modelled part minus its length (n,), m.
        path: derivative of the paths by the unknowns (n, size), m.
        near: 1 - r_i . (curvature towards the tendon) (n, q).
        length: path length per backbone length (n, q).
    """

    tension: Array
    longer: Array
    path: Array
    near: Array
    length: Array


@dataclass(eq=False, slots=True)
class State:
    """The rod at one set of unknowns.

    Attributes:
        D: turning axes, wrapped (3, 5, q): coordinate, component, node.
        P: from each node to the end (3, q), m.
        tip: position of the end (3,), m.
        R_tip: its frame (3, 3).
        m: internal moment (3, q), N m.
        base_wrench: N0, M0 (6,), N and N m: force and moment on the carrier at the base point.
        F: resultant of all loads on the end section (3,), N.
        M: their moment about its centre (3,), N m.
        kappa: curvature by coordinate (3, q), 1/m.
        cables: the tendons.
        residual: r (size,), N m.
        J: d tip / dc and turn of the end per unknown, as one (size, 6).
    """

    D: Array
    P: Array
    tip: Array
    R_tip: Array
    m: Array
    base_wrench: Array
    F: Array
    M: Array
    kappa: Array
    cables: Cables
    residual: Array
    J: Array

    @property
    def tension(self) -> Array:
        """Of the tendons (n,), N."""
        return self.cables.tension

    @property
    def t(self) -> Array:
        """Tangents at the nodes (3, q)."""
        return self.D[2, :3]

    @property
    def J_p(self) -> Array:
        """Derivative of the end's position by the unknowns (size, 3), m."""
        return self.J[:, :3]

    @property
    def J_phi(self) -> Array:
        """Turn of the end per unknown (size, 3)."""
        return self.J[:, 3:]


class Rod:
    """The arm from its base to arc length `s`, discretised.

    Args:
        parameters: the arm.
        s: end of the modelled part, m; at most the arm's length.
        bending: degree of the bend modes on every segment.
        twist: degree of the twist modes.
        per_piece: quadrature nodes on every segment.
    """

    def __init__(self, parameters: ArmParameters, s: float, bending: int, twist: int, per_piece: int) -> None:
        self.parameters, self.s = parameters, s
        segments = parameters.up_to(s).segments
        mesh = self.mesh = rod_mesh.build(tuple(g.L for g in segments), bending, twist, per_piece)
        self._backbone(segments)
        self._cables(segments)
        self._masses(segments)
        nb, q = mesh.modes, mesh.nodes.size
        a1, a2, a3 = mesh.steps.reshape(3, -1, nb)
        steps = (a1 / 240, a2, 4 * a1, a3 / 120, (20 * a1 + a3) / 240, a1 + a3 / 12)
        self._steps = np.ascontiguousarray(np.concatenate(steps).T)
        self._basis = np.asarray(mesh.basis)
        self._basis_t = np.ascontiguousarray(mesh.basis.T)
        self._weighted_t = np.ascontiguousarray(mesh.weighted.T)
        self._outer = np.column_stack((mesh.outer, mesh.weights))
        self._products = np.ascontiguousarray((mesh.basis[:, None] * mesh.basis[None]).reshape(nb * nb, q).T)
        self._diagonal_index = np.arange(mesh.size) * (mesh.size + 1)
        self.compiled_newton: Any = None  # of `fast.FastRod`

    def _backbone(self, segments: tuple[Segment, ...]) -> None:
        """Modal stiffness (size,): the modes are orthogonal, so it is diagonal."""
        mesh = self.mesh
        EI, GJ = np.array([g.EI for g in segments]), np.array([g.GJ for g in segments])
        of_mode = np.arange(mesh.modes) % len(segments)
        bend, twist = EI[of_mode] * mesh.norms, (GJ[of_mode] * mesh.norms)[: mesh.twists]
        self.bend_diagonal = np.concatenate((bend, bend, 0 * twist))
        self.twist_diagonal = np.concatenate((0 * bend, 0 * bend, twist))
        self.diagonal = self.bend_diagonal + self.twist_diagonal
        self.node_stiffness = np.stack((EI[mesh.piece], EI[mesh.piece], GJ[mesh.piece]))
        self.moment_scale = float(EI.max()) / self.s

    def _cables(self, segments: tuple[Segment, ...]) -> None:
        mesh, P = self.mesh, self.parameters
        runs = P.runs[:, mesh.piece]
        self.r = np.array([g.r for g in segments])[mesh.piece]
        self.r2 = self.r * self.r
        self.cos, self.sin = np.cos(P.angles)[:, None], np.sin(P.angles)[:, None]
        self.directions = np.hstack((self.cos, self.sin))
        self._squares = np.stack((self.cos**2, self.cos * self.sin, self.sin**2))
        self.cable_weights = runs * mesh.weights
        self.straight = self.cable_weights.sum(axis=1)
        # What rounding of the tendons' paths leaves of the unbalanced moment, in the rod's own.
        self.rounding = _ROUNDING * self.s * float(self.r.max() * P.k_T.max()) / self.moment_scale
        self._radial_t = np.ascontiguousarray((mesh.basis * self.r).T)
        # Chords between disks: path density l_d^2 / 24 |kappa|^2 less, l_d the distance of the disks.
        disks = P.guides is Guides.DISKS
        gap2 = np.array([(g.L / g.disks) ** 2 / 24 * disks for g in segments])
        of_mode = np.arange(mesh.modes) % len(segments)
        loss = P.runs[:, : len(segments)][:, of_mode] * gap2[of_mode] * mesh.norms
        self.chord = np.hstack((loss, loss, np.zeros((P.n, mesh.twists))))
        self.node_chord = runs * gap2[mesh.piece]

    def _masses(self, segments: tuple[Segment, ...]) -> None:
        mesh = self.mesh
        line = np.array([g.line_mass for g in segments])
        lengths, edges = np.array(mesh.lengths), np.cumsum(mesh.lengths)
        self.node_mass = line[mesh.piece] * mesh.weights
        self.joint_masses = [g.end_mass for g in segments[:-1]]  # end disks of inner segments
        beyond = line[mesh.piece] * (edges[mesh.piece] - mesh.nodes)
        for k, mass in enumerate(self.joint_masses):
            beyond += (mesh.piece <= k) * (mass + line[k + 1] * lengths[k + 1])
        self.mass_beyond = beyond  # without what sits at the end
        self.end_mass = segments[-1].end_mass
        self.arm_mass = float(self.node_mass.sum() + sum(self.joint_masses))  # without the end's

    def _frames(self, x: Array) -> Array:
        """Frames (k, 3, 3) at the ends of all intervals, from modal curvature x (3, modes).

        Sixth-order Magnus steps on every interval, in (u_x, u_y, u_z), which are section axes turned by a
        quarter about the tangent; then products by doubling.
        """
        # turn = a1 + a3/12 + (20 a1 + a3 + c1) x (a2 + c2/60) / 240, c1 = a1 x a2, c2 = a1 x (2 a3 - c1)
        mixed = (x @ self._steps)[_WRAP_THRICE]
        k = mixed.shape[1] // 6
        a, b, c, d, e, f = (mixed[:, i * k : (i + 1) * k] for i in range(6))
        c1 = _wrapped_cross(a, b)
        c2 = _wrapped_cross(c[:7], d[:7] - c1)
        turn = f[:3] + _wrapped_cross(e[:5] + c1[:5], b[:5] + c2)
        t = np.sqrt(np.add.reduce(turn * turn, axis=0) + _TINY)
        half = np.sin(0.5 * t) / t
        K = (turn.T @ _SKEW).reshape(k, 3, 3)
        R = _EYE + (np.sin(t) / t)[:, None, None] * K + (2 * half * half)[:, None, None] * (K @ K)
        step = 1
        while step < k:
            R[step:] = R[:-step] @ R[step:]
            step *= 2
        return np.asarray(R)

    def evaluate(self, c: Array, loads: Loads, pull: Array, stiffness: Array) -> State:
        """Residual and Jacobians.

        Args:
            c: unknowns (size,).
            loads: what acts on the rod.
            pull: stretch (n,), m, of each tendon along the straight arm; with zero stiffness its tension, N.
            stiffness: of each tendon (n,), N/m; zero for all under tension control.

        Raises:
            LimitViolated: where the backbone is bent sharper than the tendons' pitch radius.
        """
        mesh = self.mesh
        nb, size, q = mesh.modes, mesh.size, mesh.nodes.size
        x = np.zeros((3, nb))
        x.reshape(-1)[:size] = c
        frames = self._frames(x)
        R = frames[mesh.at_nodes].transpose(2, 1, 0)  # axis, component, node
        D = np.empty((3, 5, q))
        D[0, :3] = R[1]
        np.negative(R[0], out=D[1, :3])
        D[2, :3] = R[2]
        D[:, 3:] = D[:, :2]
        t = D[2, :3]
        along = np.empty((6, q))
        along[:3] = t
        np.multiply(t, self.mass_beyond, out=along[3:])
        PQ = along @ self._outer  # from each node, and last from the base, to the end
        R_tip = frames[-1]
        F, M = loads.at_end(R_tip)
        turning = np.concatenate((_moment_of(F), _moment_of(loads.gravity)), axis=1)
        moments = turning @ PQ + M[:, None]
        m = moments[:, :q]
        P = PQ[WRAP, :q]
        terms = np.empty((3, 7, q))
        np.subtract(D[:, 1:4] * P[2:5], D[:, 2:5] * P[1:4], out=terms[:, :3])
        terms[:, 3:6] = D[:, :3]
        np.add.reduce(D[:, :3] * m, axis=1, out=terms[:, 6])
        projected = (terms @ self._weighted_t).transpose(0, 2, 1).reshape(3 * nb, 7)[:size]
        kappa = x @ self._basis
        cables = self._tendons(kappa, c, pull, stiffness)
        residual = self.diagonal * c - projected[:, 6] + cables.tension @ cables.path
        J = projected[:, :6]
        base = np.concatenate((F + self.arm_mass * loads.gravity, moments[:, q]))
        return State(D, P[:3], PQ[:3, q], R_tip, m, base, F, M, kappa, cables, residual, J)

    def _tendons(self, kappa: Array, c: Array, pull: Array, stiffness: Array) -> Cables:
        n, nb = stiffness.size, self.mesh.modes
        near = 1 - self.directions @ (self.r * kappa[:2])
        if near.min() <= 0:
            raise LimitViolated("bend radius over pitch radius", float(1 / (1 - near.min())), 1.0, np.inf)
        twist = self.r2 * kappa[2]
        length = np.sqrt(near * near + twist * kappa[2])
        chord = self.chord * c
        longer = np.add.reduce(self.cable_weights * length, axis=1) - self.straight - chord @ c
        tension = np.maximum(stiffness * (pull + longer), 0.0) if stiffness[0] > 0 else pull
        share = self.cable_weights / length
        bent = (near * share) @ self._radial_t
        path = np.empty((n, 3, nb))
        np.multiply(bent, -self.cos, out=path[:, 0])
        np.multiply(bent, -self.sin, out=path[:, 1])
        np.matmul(share, twist[:, None] * self._basis_t, out=path[:, 2])
        path = path.reshape(n, 3 * nb)[:, : self.mesh.size] - 2 * chord
        return Cables(tension, longer, path, near, length)

    def tangent(self, state: State, loads: Loads, stiffness: Array) -> Array:
        """dr/dc (size, size), N m/rad, at an evaluated state."""
        K = self._cable_tangent(state)
        tension, path = state.cables.tension, state.cables.path
        K.reshape(-1)[self._diagonal_index] += self.diagonal - 2 * (tension @ self.chord)
        K += (path.T * (stiffness * (tension > 0))) @ path
        K -= self._geometric(state, loads)
        return K

    def _cable_tangent(self, state: State) -> Array:
        """Second derivative of the tendons' paths, weighted by tension (size, size)."""
        mesh, cables, kz = self.mesh, state.cables, state.kappa[2]
        cubed = cables.length * cables.length * cables.length
        weight = cables.tension[:, None] * self.cable_weights / cubed
        bent = cables.near * weight
        h = np.empty((6, kz.size))
        twist = self.r2 * kz
        np.multiply((self._squares[..., 0] @ weight), twist * twist, out=h[:3])
        np.multiply(self.directions.T @ bent, self.r * twist, out=h[3:5])
        np.multiply(np.add.reduce(bent * cables.near, axis=0), self.r2, out=h[5])
        nb, size = mesh.modes, mesh.size
        blocks = (h @ self._products)[_SYMMETRIC].reshape(3, 3, nb, nb).transpose(0, 2, 1, 3)
        return np.array(blocks.reshape(3 * nb, 3 * nb)[:size, :size])

    def turns(self, state: State) -> Array:
        """phi_j at the nodes (size, 3, q): turn of every section per unknown."""
        mesh = self.mesh
        q = mesh.nodes.size
        rate = state.D[:, None, :3] * self._basis[:, None]  # coordinate, mode, component, node
        return np.asarray((rate.reshape(-1, q) @ mesh.inner).reshape(-1, 3, q)[: mesh.size])

    def _geometric(self, state: State, loads: Loads) -> Array:
        """d(work of the loads)/dc (size, size): row the force that changes, column the unknown that moves."""
        mesh, D, t = self.mesh, state.D, state.t
        size, q = mesh.size, mesh.nodes.size
        phi = self.turns(state)
        m = state.m[WRAP]
        bent = D[:, 1:4] * m[2:5] - D[:, 2:5] * m[1:4]
        side = (bent[:, None] * mesh.weighted[:, None]).reshape(-1, 3, q)[:size]
        wn = mesh.weights * (state.F[:, None] + loads.gravity[:, None] * self.mass_beyond)
        side += np.add.reduce(phi * t, axis=1)[:, None] * wn
        side -= phi * np.add.reduce(wn * t, axis=0)
        G = np.asarray(side.reshape(size, -1) @ phi.reshape(size, -1).T)
        turn = state.J_phi
        for point, force in loads.hung:
            o = state.R_tip @ point
            G += np.outer(turn @ o, turn @ force) - float(o @ force) * (turn @ turn.T)
        if loads.follower_force is not None:
            G += state.J_p @ cross_rows(turn, state.R_tip @ loads.follower_force).T
        if loads.follower_moment is not None:
            G += turn @ cross_rows(turn, state.R_tip @ loads.follower_moment).T
        return G

    def imbalance(self, state: State) -> float:
        """How far the moment balance fails between the modes: relative energy of EI kappa - m, tendons included.

        The weak form is blind to what its modes cannot show; this is not. By Galerkin orthogonality the error
        of tip and base wrench is of this order (ten times it in the reference cases), not of its root.
        """
        cables = state.cables
        pulled = cables.tension[:, None] * (self.cable_weights > 0) / cables.length
        own = self.node_stiffness * state.kappa
        moment = np.sum(state.D[:, :3] * state.m, axis=1)
        rest = own - moment
        drop = 2 * (cables.tension @ self.node_chord)
        rest[:2] -= self.r * (self.directions.T @ (cables.near * pulled)) + drop * state.kappa[:2]
        rest[2] += self.r2 * state.kappa[2] * np.add.reduce(pulled, axis=0)
        give = self.mesh.weights / self.node_stiffness
        bend, load = float(np.sum(give * own * own)), float(np.sum(give * moment * moment))
        # a bend that tendons hold has energy enough to hide what small loads do
        return float(np.sum(give * rest * rest)) / (load + min(bend, 3 * load) + FAINT * self.moment_scale)


def _wrapped_cross(a: Array, b: Array) -> Array:
    """Vector products (rows - 2, k) of wrapped columns (rows, k)."""
    return a[1:-1] * b[2:] - a[2:] * b[1:-1]


def _moment_of(force: Array) -> Array:
    """Matrix (3, 3) that takes an arm to its moment: arm x force."""
    x, y, z = force.tolist()
    return np.array(((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0)))


def cross_rows(a: Array, b: Array) -> Array:
    """Rows a_i x b (k, 3)."""
    return np.asarray(a @ _moment_of(b).T)
