"""Tables of one discretised backbone: Legendre modes at Gauss nodes, integration, and steps between nodes.

The backbone up to the end of the modelled part is a row of pieces, one per segment. On each piece curvature
is a polynomial: bend about both axes of degree `bending`, twist of degree `twist` (at most `bending`). The
unknowns c are the Legendre coefficients of curvature times piece length, rad, ordered [u_x modes, u_y modes,
u_z modes]; within each axis by degree, then piece, so that c[0] and c[modes] of a single piece are the paper's
u. Everything here depends on lengths only and is computed once.
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from arm_companion.geometry.arrays import Array, sealed


@dataclass(frozen=True, eq=False)
class Mesh:
    """Tables for pieces of given lengths.

    Attributes:
        lengths: of the pieces (m,), m.
        bending: degree of the bend modes.
        twist: degree of the twist modes.
        size: number of unknowns.
        modes: bend modes per axis.
        twists: twist modes.
        degree: of the mode of each unknown (size,).
        piece: piece of each node (q,).
        nodes: arc length of each node (q,), m.
        weights: quadrature weights (q,), m.
        basis: mode values (modes, q), 1/m: curvature per unknown.
        weighted: basis times weights (modes, q).
        inner: (q, q): `f @ inner` is the integral of f from the base to each node.
        outer: (q, q): `f @ outer` is the integral of f from each node to the end.
        norms: integral of basis squared (modes,), 1/m; the modes are orthogonal.
        steps: (3 k, modes): moments of the modes over the k intervals between nodes, for the Magnus steps.
        at_nodes: which interval ends at each node (q,).
        ends: index into the intervals of each piece's end (m,).
        analysis: (per, per) from values at the nodes of one piece to Legendre coefficients of their interpolant.
    """

    lengths: tuple[float, ...]
    bending: int
    twist: int
    size: int
    modes: int
    twists: int
    degree: "np.typing.NDArray[np.intp]"
    piece: "np.typing.NDArray[np.intp]"
    nodes: Array
    weights: Array
    basis: Array
    weighted: Array
    inner: Array
    outer: Array
    norms: Array
    steps: Array
    at_nodes: "np.typing.NDArray[np.intp]"
    ends: "np.typing.NDArray[np.intp]"
    analysis: Array


@functools.lru_cache(maxsize=64)
def build(lengths: tuple[float, ...], bending: int, twist: int, per_piece: int) -> Mesh:
    """The tables, kept: many rods differ in stiffness only.

    Args:
        lengths: of the pieces, m.
        bending: degree of the bend modes.
        twist: degree of the twist modes, at most `bending`.
        per_piece: Gauss nodes on each piece.
    """
    x, w = legendre.leggauss(per_piece)
    analysis = (legendre.legvander(x, per_piece - 1) * w[:, None]).T * (np.arange(per_piece)[:, None] + 0.5)
    local = _integration(x, analysis)
    count, total = len(lengths), per_piece * len(lengths)
    modes = (bending + 1) * count
    starts = np.concatenate(([0.0], np.cumsum(lengths)))
    nodes, weights = np.empty(total), np.empty(total)
    basis = np.zeros((modes, total))
    inner = np.zeros((total, total))
    norms = np.empty(modes)
    values = legendre.legvander(x, bending)
    moments = []
    for k, length in enumerate(lengths):
        here = slice(k * per_piece, (k + 1) * per_piece)
        nodes[here] = starts[k] + 0.5 * length * (x + 1)
        weights[here] = 0.5 * length * w
        inner[here, here] = 0.5 * length * local.T
        inner[here, (k + 1) * per_piece :] = weights[here, None]
        for degree in range(bending + 1):
            basis[degree * count + k, here] = values[:, degree] / length
            norms[degree * count + k] = 1 / (length * (2 * degree + 1))
        moments.append(_interval_moments(x, bending, k, count))
    steps = np.concatenate(moments, axis=1).reshape(-1, modes)
    place = np.arange(total)
    piece = place // per_piece
    size = 2 * modes + (twist + 1) * count
    return Mesh(
        lengths=lengths,
        bending=bending,
        twist=twist,
        size=size,
        modes=modes,
        twists=(twist + 1) * count,
        degree=np.arange(size) % modes // count,
        piece=piece,
        nodes=sealed(nodes),
        weights=sealed(weights),
        basis=sealed(basis),
        weighted=sealed(basis * weights),
        inner=sealed(inner),
        outer=sealed(weights[:, None] - inner),
        norms=sealed(norms),
        steps=sealed(steps),
        at_nodes=place + piece,  # one interval more than nodes on every piece
        ends=(np.arange(count) + 1) * (per_piece + 1) - 1,
        analysis=sealed(analysis),
    )


def _integration(x: Array, analysis: Array) -> Array:
    """A (q, q): A @ f is the integral of the interpolant of f from -1 to each Gauss node."""
    integrals = np.column_stack([legendre.legval(x, legendre.legint(row, lbnd=-1)) for row in np.eye(x.size)])
    return np.asarray(integrals @ analysis)


def _interval_moments(x: Array, degree: int, piece: int, count: int) -> Array:
    """Moments (3, intervals, modes) of a piece's modes over the intervals between its start, nodes and end.

    With t in (-1/2, 1/2) across an interval they are the integrals of curvature times ds, t ds and t^2 ds;
    combined to alpha_1, alpha_2, alpha_3 of the Magnus expansion (Blanes et al., sixth order).
    """
    edges = np.concatenate(([-1.0], x, [1.0]))
    g, w = legendre.leggauss(degree // 2 + 3)
    half = 0.5 * np.diff(edges)
    mid = 0.5 * (edges[1:] + edges[:-1])
    values = legendre.legvander(mid[:, None] + half[:, None] * g, degree)  # intervals, points, degree + 1
    scale = 0.5 * half  # of w over (-1, 1) -> ds / piece length
    b0, b1, b2 = (np.einsum("ipd,p->id", values, w * (0.5 * g) ** n) * scale[:, None] for n in range(3))
    alpha = np.stack((2.25 * b0 - 15 * b2, 12 * b1, 180 * b2 - 15 * b0))
    table = np.zeros((3, edges.size - 1, (degree + 1) * count))
    table[:, :, piece::count] = alpha
    return table
