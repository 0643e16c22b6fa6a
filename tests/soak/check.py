"""Whether an answer of the rod model is an equilibrium: multiple shooting, sharing no code with the package's rod.

The arm is cut into short pieces. Every piece starts with the place and frame that the solution gives and with the
force and moment that the base wrench leaves there, and is integrated by Runge and Kutta's method with the
constitutive law of `tests.unit.shooting`; it must end where the next one starts. Shooting over the whole arm would
say the same, but near the taut limit it multiplies rounding by e^50.
"""

from dataclasses import dataclass

import numpy as np

from arm_companion.arm.model import ArmSolution, Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides
from tests.unit.shooting import curvature, hat

PIECES, STEPS = 60, 4  # per segment, and per piece
FINE = 8  # Gauss nodes on every piece, for the moment of the weight


@dataclass(frozen=True, eq=False)
class Asked:
    """What an equilibrium was asked for.

    Attributes:
        parameters: the arm.
        pull: goals (n,), m.
        gravity: (3,), m/s^2.
        tension: of each tendon under tension control (n,), N, or None.
        payload: at a free tip, or None.
        dead: tip wrench (6,).
        follower: tip wrench (6,), tip axes.
        hold: what is held, or None for a free tip.
    """

    parameters: ArmParameters
    pull: np.ndarray
    gravity: np.ndarray
    tension: np.ndarray | None = None
    payload: Payload | None = None
    dead: np.ndarray | None = None
    follower: np.ndarray | None = None
    hold: Hold | None = None


@dataclass
class Defects:
    """By how much the answer fails, each relative to what it is worth.

    Attributes:
        moment: of the internal moment anywhere, over the largest moment in the arm.
        tip: of the load at the end, over the largest load.
        tendon: of any tension, over the largest tension.
        support: of what is held, over the length.
    """

    moment: float
    tip: float
    tendon: float
    support: float

    @property
    def worst(self) -> float:
        return max(self.moment, self.tip, self.tendon, self.support)


def defects(asked: Asked, solution: ArmSolution, pieces: int = PIECES) -> Defects:
    """Every law that the answer must obey; sharper bends take more `pieces`."""
    P, g, s_end = asked.parameters, asked.gravity, solution.arc_length
    N0, M0 = solution.base_wrench[:3], solution.base_wrench[3:]
    longer = np.zeros(P.n)
    wrong_moment, largest = 0.0, 1e-3 * P.EI / s_end
    before, mass, first = 0.0, 0.0, np.zeros(3)
    x, w = np.polynomial.legendre.leggauss(FINE)
    for k, segment in enumerate(P.segments):
        length = min(segment.L, s_end - before)
        if length <= 1e-12:
            break
        edges = before + np.linspace(0, length, pieces + 1)
        h = length / pieces
        R, p = solution.detail.sections(edges)
        if before + length > s_end - 1e-12:  # the end is known better than the interpolated shape
            R[-1], p[-1] = solution.tip_rotation, solution.tip_position
        inner = (edges[:-1, None] + 0.5 * h * (x + 1)).ravel()
        at = solution.detail.sections(inner)[1].reshape(pieces, FINE, 3)
        piece = segment.line_mass * 0.5 * h * np.einsum("f,kfi->ki", w, at)
        first_at = first + np.vstack((np.zeros(3), np.cumsum(piece, axis=0)))  # of the mass before every edge
        n = N0 - np.outer(mass + segment.line_mass * (edges - before), g)
        m = M0 - np.cross(p, n) - np.cross(first_at, g)
        ends, grown = _integrated(P, k, segment, solution.tension, R, p, n, m, g, h)
        longer += grown
        turn = np.sqrt((_turn(np.einsum("kji,kjl->kil", ends[0], R[1:])) ** 2).sum(axis=1))
        stiff = min(segment.EI, segment.GJ)
        moments = np.sqrt((m**2).sum(axis=1))
        wrong_moment = max(wrong_moment, stiff / h * float(turn.max()))
        shift = np.sqrt(((ends[1] - p[1:]) ** 2).sum(axis=1))
        wrong_moment = max(wrong_moment, stiff / h**2 * float(shift.max()))
        wrong_moment = max(wrong_moment, float(np.abs(ends[2] - m[1:]).max()))
        largest = max(largest, float(moments.max()), segment.EI / segment.L * float(np.abs(solution.bend).max()))
        before += length
        mass += segment.line_mass * length
        first = first_at[-1]
        if before < s_end - 1e-12:
            mass += segment.end_mass
            first = first + segment.end_mass * p[-1]
        end_m = m[-1]
    if before < s_end - 1e-9:
        raise ValueError("the solution is longer than the arm")
    return Defects(
        moment=wrong_moment / largest,
        tip=_tip(asked, solution, N0 - mass * g, end_m, solution.tip_rotation),
        tendon=_tendons(asked, solution, longer),
        support=_support(asked, solution.tip_rotation, solution.tip_position) / s_end,
    )


def _integrated(P, k, segment, tension, R, p, n, m, g, h):
    """Frames, places and moments at the ends of all pieces of a segment, by the classical Runge and Kutta method."""
    here = P.runs[:, k] > 0
    tau, angle = tension[here], P.angles[here]
    offsets = segment.r * np.column_stack((np.cos(angle), np.sin(angle), np.zeros(angle.size)))
    gap2 = (segment.L / segment.disks) ** 2 / 24 if P.guides is Guides.DISKS else 0.0
    # The law may have another root where a tendon runs near the centre of curvature: begin near the one that is told.
    guess = _turn(np.einsum("kji,kjl->kil", R[:-1], R[1:])) / h
    R, p, n, m = R[:-1], p[:-1], n[:-1], m[:-1]

    def slope(state):
        nonlocal guess
        R, n, m = state[0], state[2], state[3]
        kappa = guess = curvature(np.einsum("kji,kj->ki", R, m), tau, offsets, segment.EI, segment.GJ, gap2, guess)
        strand = np.array([0.0, 0.0, 1.0]) + np.cross(kappa[:, None], offsets)
        paths = np.sqrt((strand**2).sum(axis=2)) - 1 - gap2 * (kappa[:, :2] ** 2).sum(axis=1)[:, None]
        t = R[:, :, 2]
        return R @ hat(kappa), t, np.broadcast_to(-segment.line_mass * g, n.shape), -np.cross(t, n), paths

    state = (R, p, n, m, np.zeros((len(p), tau.size)))
    step = h / STEPS
    for _ in range(STEPS):
        a = slope(state)
        b = slope(tuple(y + 0.5 * step * d for y, d in zip(state, a, strict=True)))
        c = slope(tuple(y + 0.5 * step * d for y, d in zip(state, b, strict=True)))
        d = slope(tuple(y + step * e for y, e in zip(state, c, strict=True)))
        state = tuple(
            y + step / 6 * (e1 + 2 * e2 + 2 * e3 + e4) for y, e1, e2, e3, e4 in zip(state, a, b, c, d, strict=True)
        )
    grown = np.zeros(P.n)
    grown[here] = state[4].sum(axis=0)
    return (state[0], state[1], state[3]), grown


def _turn(R):
    """Rotation vectors (k, 3) of small rotations, which need not be quite orthogonal."""
    return 0.5 * np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1)


def _tip(asked, solution, n, m, R):
    """What the end section passes on must be what acts on it; for a free tip, what was asked to act."""
    P, g = asked.parameters, asked.gravity
    force, moment = solution.tip_wrench[:3].copy(), solution.tip_wrench[3:].copy()
    scale = float(np.abs(solution.base_wrench[:3]).max()) + 1e-3 * P.EI / P.L**2
    wrong = 0.0
    if asked.hold is None:
        asked_for = np.zeros(6)
        if asked.dead is not None:
            asked_for += asked.dead
        if asked.follower is not None:
            asked_for += np.concatenate((R @ asked.follower[:3], R @ asked.follower[3:]))
        wrong = max(float(np.abs(asked_for[:3] - force).max()), float(np.abs(asked_for[3:] - moment).max()) / P.L)
    if solution.arc_length >= P.L - 1e-12:
        force += P.segments[-1].end_mass * g
    if asked.payload is not None:
        force += asked.payload.mass * g
        moment += np.cross(R @ asked.payload.offset, asked.payload.mass * g)
    scale += float(np.abs(force).max()) + float(np.abs(moment).max()) / P.L
    wrong = max(wrong, float(np.abs(n - force).max()), float(np.abs(m - moment).max()) / P.L)
    if asked.hold is not None:
        wrong = max(wrong, _held_moment(asked.hold, solution.tip_wrench, R) / P.L)
    return wrong / scale


def _held_moment(hold, wrench, R):
    """A pin passes on no moment about its pivot, a bar none about its axis."""
    about = wrench[3:] - np.cross(R @ hold.pivot, wrench[:3])
    if hold.kind is HoldKind.PINNED:
        return float(np.abs(about).max())
    return abs(float(about @ hold.axis)) if hold.kind is HoldKind.BAR else 0.0


def _tendons(asked, solution, longer):
    P = asked.parameters
    scale = float(solution.tension.max()) + 1e-3 * P.EI / P.L / P.r
    if asked.tension is not None:
        return float(np.abs(asked.tension - solution.tension).max()) / scale
    beyond = 0.0 if asked.hold is None or asked.hold.beyond is None else asked.hold.beyond
    law = np.maximum(0.0, P.T0 + P.k_T * (asked.pull + longer - beyond))
    return float(np.abs(law - solution.tension).max()) / scale


def _support(asked, R, p):
    hold = asked.hold
    if hold is None:
        return 0.0
    want = hold.pose
    off = float(np.abs(p + R @ hold.pivot - (want @ hold.pivot)).max())
    turned = R @ want.rotation.T
    if hold.kind is HoldKind.CLAMPED:
        off = max(off, hold.arc_length * float(np.abs(turned - np.eye(3)).max()))
    if hold.kind is HoldKind.BAR:
        off = max(off, hold.arc_length * float(np.abs(turned @ hold.axis - hold.axis).max()))
    return off
