"""The paper's one arc of constant curvature behind the interface of `model`: the rod's zeroth mode.

Exact without load; under load far too stiff (an arc can only bend as a whole), and a held tip is met only
as far as two degrees of freedom allow. It serves for comparison; the rod flies.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from arm_companion.arm import arc, statics, stiffness
from arm_companion.arm.model import ArmSolution, Derivatives, Hold, MassMoments, Payload
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.unloaded import UnloadedArm
from arm_companion.errors import ConfigError, LimitViolated, NoSolution
from arm_companion.geometry import so3, wrench
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_SIGMA = 0.5 * (_NODES + 1)
_SHARE = 0.5 * _WEIGHTS
_ITERATIONS = 50
_TOLERANCE = 1e-11
_STEP = 1e-6

_Solve = Callable[[ArmParameters, Array], ArmSolution]


class ArcModel(UnloadedArm):
    """`ArmModel` by the arc; one segment only.

    Raises:
        ConfigError: for an arm of several segments.
    """

    def __init__(self, parameters: ArmParameters) -> None:
        if len(parameters.segments) != 1:
            raise ConfigError("the arc model has one segment")
        super().__init__(parameters)

    def free(
        self,
        pull: ArrayLike,
        gravity: ArrayLike,
        tip_wrench: ArrayLike | None = None,
        payload: Payload | None = None,
        *,
        follower_wrench: ArrayLike | None = None,
        start: ArmSolution | None = None,
    ) -> ArmSolution:
        """See `ArmModel.free`; a payload counts as a point at the tip."""
        P = self._parameters
        q = frozen(pull, (P.n,), "pull")
        g = frozen(gravity, (3,), "gravity")
        w = frozen(np.zeros(6) if tip_wrench is None else tip_wrench, (6,), "tip_wrench")
        turning = frozen(np.zeros(6) if follower_wrench is None else follower_wrench, (6,), "follower_wrench")
        end_mass = P.segments[0].end_mass + (0.0 if payload is None else payload.mass)
        loads = _Loads.of(P, g, w, end_mass, turning)
        u, residual, iterations = _equilibrium(P, q, loads, start)

        def solve(changed: ArmParameters, x: Array) -> ArmSolution:
            n = changed.n
            return ArcModel(changed).free(x[:n], x[n : n + 3], x[n + 3 :], payload, follower_wrench=turning)

        point = np.concatenate((q, g, w))
        detail = _Detail(P, u, loads, np.zeros(P.n), loads.at_tip(u), solve, point, held=False)
        tip, R = arc.tip_position(u, P.L), arc.tip_rotation(u)
        tension = statics.stretch_tension(P, u, q)
        return _solution(detail, q, g, tip, R, tension, residual, iterations, float("nan"))

    def held(self, pull: ArrayLike, hold: Hold, gravity: ArrayLike, *, start: ArmSolution | None = None) -> ArmSolution:
        """See `ArmModel.held`.

        The held point pulls the arc as a spring along the two directions in which an arc can give; what lies
        across them is not resisted, and its share of the displacement is the residual.
        """
        q = frozen(pull, (self._parameters.n,), "pull")
        g = frozen(gravity, (3,), "gravity")
        s, target = hold.arc_length, hold.pose.position
        reach = float(np.sqrt(target @ target))
        if reach >= s:
            raise LimitViolated("distance of the held section from the base", reach, 0.0, s)
        P = self._parameters.up_to(s)
        beyond = np.zeros(P.n) if hold.beyond is None else hold.beyond
        end_mass = P.segments[0].end_mass
        loads = _Loads.of(P, g, np.zeros(6), end_mass)
        u, _, iterations = _equilibrium(P, q - beyond, loads, start)
        J = arc.jacobian(u, s)[:3]
        away = target - arc.tip_position(u, s)
        give = np.linalg.lstsq(J, away, rcond=None)[0]
        K = stiffness.bend_stiffness(P, u, statics.stretch_tension(P, u, q - beyond))
        push = np.concatenate((np.linalg.lstsq(J.T, K @ give, rcond=None)[0], np.zeros(3)))

        def solve(changed: ArmParameters, x: Array) -> ArmSolution:
            n = changed.n
            moved = replace(hold, pose=hold.pose.moved(x[n + 3 :]))
            return ArcModel(changed).held(x[:n], moved, x[n : n + 3])

        point = np.concatenate((q, g, np.zeros(6)))
        detail = _Detail(P, u, replace(loads, tip=push), beyond, push, solve, point, held=True, whole=self._parameters)
        residual = float(np.abs(away - J @ give).max()) / s
        tension = statics.stretch_tension(P, u + give, q - beyond)
        return _solution(detail, q, g, target, hold.pose.rotation, tension, residual, iterations, s - reach)

    def anchor(self, hold: Hold, pull: ArrayLike, tension: ArrayLike, gravity: ArrayLike) -> Hold:
        """See `ArmModel.anchor`; the arc between base and hold takes the bend that the tensions give it."""
        P = self._parameters.up_to(hold.arc_length)
        frozen(gravity, (3,), "gravity")
        tau = frozen(tension, (P.n,), "tension")
        u = (tau @ P.H) / P.bending
        return replace(hold, beyond=frozen(pull, (P.n,), "pull") - statics.pull_for_tension(P, u, tau))


@dataclass(frozen=True, eq=False)
class _Loads:
    """Dead forces along the arc, (fraction of the length, force (3,)), and tip wrenches (6,): dead, turning along."""

    points: tuple[tuple[float, Array], ...]
    tip: Array
    follower: Array
    end_mass: float

    @classmethod
    def of(
        cls, P: ArmParameters, gravity: Array, tip: Array, end_mass: float, follower: Array | None = None
    ) -> "_Loads":
        spread = P.segments[0].line_mass * P.L
        points = [(float(x), float(w) * spread * gravity) for x, w in zip(_SIGMA, _SHARE, strict=True)]
        return cls((*points, (1.0, end_mass * gravity)), tip, np.zeros(6) if follower is None else follower, end_mass)

    def at_tip(self, u: Array) -> Array:
        """The whole tip wrench (6,), base axes."""
        R = arc.tip_rotation(u)
        return sealed(self.tip + np.concatenate((R @ self.follower[:3], R @ self.follower[3:])))


@dataclass(frozen=True, eq=False)
class _Detail:
    """`Detail` of an arc; derivatives by central differences."""

    P: ArmParameters
    u: Array
    loads: _Loads
    beyond: Array
    tip_wrench: Array
    solve: _Solve
    point: Array  # pull, gravity, and tip wrench or twist of the hold
    held: bool
    whole: ArmParameters | None = None

    def moments(self) -> MassMoments:
        """See `Detail.moments`."""
        L = self.P.L
        points = np.array([arc.tip_position(x * self.u, x * L) for x in (*_SIGMA, 1.0)])
        return MassMoments.of_points(np.append(_SHARE * self.P.segments[0].line_mass * L, self.loads.end_mass), points)

    def sections(self, at: Array) -> tuple[Array, Array]:
        """See `Detail.sections`."""
        shares = [float(s) / self.P.L for s in at]
        return (
            np.array([arc.tip_rotation(x * self.u) for x in shares]),
            np.array([arc.tip_position(x * self.u, x * self.P.L) for x in shares]),
        )

    def line(self) -> Array:
        """See `Detail.line`."""
        return self.sections(np.linspace(0.0, self.P.L, 13))[1]

    def path_beyond(self, s: float) -> Array:
        """See `Detail.path_beyond`."""
        rest = 1 - s / self.P.L
        return np.asarray(self.beyond + rest * (self.P.H @ self.u + self.P.chord_loss @ (self.u * self.u)))

    def turning(self) -> float:
        """See `Detail.turning`."""
        return float(np.hypot(*self.u))

    def derivatives(self) -> Derivatives:
        """See `Detail.derivatives`."""
        P = self.whole or self.P
        n = P.n
        D = np.empty((6 + n, self.point.size))
        for j, step in enumerate(_STEP * np.eye(self.point.size)):
            D[:, j] = self._difference((P, self.point + step), (P, self.point - step))
        relative = {}
        for name in ("EI", "GJ", "k_T", "T0"):
            up, down = P.scaled(**{name: 1 + _STEP}), P.scaled(**{name: 1 - _STEP})
            relative[name] = sealed(self._difference((up, self.point), (down, self.point))[:6])
        _, K = _force_and_stiffness(self.P, self.u, self.point[:n] - self.beyond, self.loads)
        J = arc.jacobian(self.u, self.P.L)
        return Derivatives(
            pull=sealed(D[:6, :n].copy()),
            gravity=sealed(D[:6, n : n + 3].copy()),
            hold=sealed(self.held * D[:6, n + 3 :]),
            tip_wrench=sealed((not self.held) * D[:6, n + 3 :]),
            parameters=MappingProxyType(relative),
            tension=sealed(D[6:, n + 3 :].copy()),
            compliance=sealed(np.asarray(J @ np.linalg.solve(K, J.T))),
        )

    def _difference(self, up: tuple[ArmParameters, Array], down: tuple[ArmParameters, Array]) -> Array:
        """Central difference of base wrench and tensions (6 + n,)."""
        a, b = self.solve(*up), self.solve(*down)
        return np.concatenate((a.base_wrench - b.base_wrench, a.tension - b.tension)) / (2 * _STEP)


def _solution(
    detail: _Detail,
    pull: Array,
    gravity: Array,
    tip: Array,
    R: Array,
    tension: Array,
    residual: float,
    iterations: int,
    margin: float,
) -> ArmSolution:
    moments = detail.moments()
    base = wrench.at_point(detail.tip_wrench, tip)
    base[:3] += moments.mass * gravity
    base[3:] += so3.cross(moments.first, gravity)
    return ArmSolution(
        pull=pull,
        bend=sealed(detail.u),
        tip_position=sealed(tip),
        tip_rotation=sealed(R),
        tension=sealed(tension),
        base_wrench=sealed(base),
        tip_wrench=sealed(detail.tip_wrench),
        residual=residual,
        taut_margin=margin,
        gravity=gravity,
        arc_length=detail.P.L,
        coordinates=detail.u,
        iterations=iterations,
        detail=detail,
    )


def _equilibrium(P: ArmParameters, pull: Array, loads: _Loads, start: ArmSolution | None) -> tuple[Array, float, int]:
    u = statics.bend_for_pull(P, pull) if start is None else np.array(start.bend)
    scale = float(P.bending.max()) + float(P.k_T.max()) * P.r**2
    residual = np.inf
    for iteration in range(_ITERATIONS):
        g, K = _force_and_stiffness(P, u, pull, loads)
        residual = float(np.abs(g).max()) / scale
        if residual < _TOLERANCE:
            return u, residual, iteration
        step = np.linalg.solve(K, g)
        for _ in range(20):
            trial, _ = _force_and_stiffness(P, u - step, pull, loads)
            if float(trial @ trial) < float(g @ g):
                break
            step = 0.5 * step
        u = u - step
    raise NoSolution(residual, "loaded arc")


def _force_and_stiffness(P: ArmParameters, u: Array, pull: Array, loads: _Loads) -> tuple[Array, Array]:
    """Unbalanced generalised force (2,) and its derivative (2, 2) at the bend u."""
    tau = statics.stretch_tension(P, u, pull)
    J, w = arc.jacobian(u, P.L), loads.at_tip(u)
    g = statics.bending_moment(P, u, tau) - J.T @ w
    turning = w - loads.tip  # the follower, which a turn of the tip takes along
    K = stiffness.bend_stiffness(P, u, tau, w) + J[:3].T @ so3.hat(turning[:3]) @ J[3:]
    K = K + J[3:].T @ so3.hat(turning[3:]) @ J[3:]
    for x, force in loads.points:
        w = np.concatenate((force, np.zeros(3)))
        g = g - x * (arc.jacobian(x * u, x * P.L).T @ w)
        K = K - x * x * arc.twist_jacobians(x * u, w, x * P.L)
    return g, K
