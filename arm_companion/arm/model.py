"""What the rest of the system asks of a model of the arm, and the values it gets.

Frames and signs. All vectors are in the axes of the arm's base (a) unless said otherwise: z from base to tip
along the straight arm. `pull` is tendon taken in by its motor, m, zero for the straight arm at its
pretension. `gravity` is the field strength in base axes, m/s^2: R_ab R_bw [0, 0, 9.81] in NED, and with the
vehicle's acceleration subtracted when the arm is to hang in the accelerated frame. `base_wrench` is what the
ARM EXERTS ON ITS CARRIER about the base point; `tip_wrench` is what the outside exerts on the arm, about the
centre of the section it acts on.
"""

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from arm_companion.arm.parameters import ArmParameters
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed
from arm_companion.geometry.se3 import Pose


class HoldKind(enum.Enum):
    """How the surroundings hold a cross-section of the arm."""

    CLAMPED = "clamped"  # six components: position and orientation
    PINNED = "pinned"  # three: the held point stays, the section turns freely
    BAR = "bar"  # five: the held point stays, the section turns about the bar's axis only


@dataclass(frozen=True, eq=False)
class Hold:
    """A cross-section that is held, as seen from the present base.

    With s = L the tip itself is held. With s < L the part beyond is wrapped or gripped and keeps its shape:
    the arm between base and section is a rod of length s, whose tendons have their full-length stiffness and
    whatever tension the shape beyond leaves them, which `beyond` says.

    Attributes:
        arc_length: s, from the base to the held section along the backbone, m.
        pose: T_as of the held section.
        kind: which components are held.
        axis: direction of the bar (3,), unit, base axes; for BAR only.
        pivot: the held point in the section's own axes (3,), m: the bar's centre, or a gripper's jaw.
        beyond: by how much the part beyond shortens each tendon's path against a straight one (n,), m; None
            for a straight or absent part. `ArmSolution.hold` and `ArmModel.anchor` fill it in.
    """

    arc_length: float
    pose: Pose
    kind: HoldKind = HoldKind.CLAMPED
    axis: Array | None = None
    pivot: Array = field(default_factory=lambda: np.zeros(3))
    beyond: Array | None = None

    def __post_init__(self) -> None:
        if not self.arc_length > 0:
            raise ValueError(f"arc_length = {self.arc_length} must be positive")
        if (self.kind is HoldKind.BAR) != (self.axis is not None):
            raise ValueError("a bar has an axis, and nothing else has")
        if self.axis is not None:
            axis = np.asarray(self.axis, dtype=np.float64)
            length = float(np.sqrt(axis @ axis))
            if not length > 0:
                raise ValueError("the bar's axis has no direction")
            object.__setattr__(self, "axis", frozen(axis / length, (3,), "axis"))
        object.__setattr__(self, "pivot", frozen(self.pivot, (3,), "pivot"))
        if self.beyond is not None:
            object.__setattr__(self, "beyond", frozen(self.beyond, (-1,), "beyond"))

    def room(self, direction: ArrayLike) -> float:
        """How far the base may move along `direction` (3,), base axes, until the backbone is straight, m.

        Counted from the pose of the held section; negative when that is out of reach already. Forces grow without
        bound on the last millimetre or two of it.
        """
        e = np.asarray(direction, dtype=np.float64)
        length = math.sqrt(float(e @ e))
        if not length > 0:
            raise ValueError("the direction has no length")
        p = self.pose.position
        along = float(p @ e) / length
        across2 = max(0.0, float(p @ p) - along * along)
        if across2 >= self.arc_length**2:
            return -math.inf
        return along + math.sqrt(self.arc_length**2 - across2)

    def seen_from(self, T_now_then: Pose) -> "Hold":
        """The same hold in the axes of a base that has moved: `T_now_then` maps old base axes to new ones."""
        axis = None if self.axis is None else T_now_then.rotation @ self.axis
        return Hold(self.arc_length, T_now_then @ self.pose, self.kind, axis, self.pivot, self.beyond)


@dataclass(frozen=True, eq=False)
class Payload:
    """What the tip carries.

    Attributes:
        mass: kg.
        offset: its centre of mass in tip axes (3,), m.
    """

    mass: float
    offset: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not 0 <= self.mass < np.inf:
            raise ValueError(f"mass = {self.mass} must not be negative")
        object.__setattr__(self, "offset", frozen(self.offset, (3,), "offset"))


@dataclass(frozen=True, eq=False)
class MassMoments:
    """Where the arm's own mass (and payload) is, about the base point, base axes.

    Attributes:
        mass: kg.
        first: sum of m x (3,), kg m.
        second: sum of m x x^T (3, 3), kg m^2.
    """

    mass: float
    first: Array
    second: Array

    @classmethod
    def of_points(cls, masses: Array, points: Array) -> "MassMoments":
        """From point masses (q,), kg, at `points` (q, 3), m."""
        weighted = masses[:, None] * points
        return cls(float(masses.sum()), sealed(weighted.sum(axis=0)), sealed(points.T @ weighted))


@dataclass(frozen=True, eq=False)
class Derivatives:
    """How the base wrench answers to what it depends on, by the equations' own derivatives at the solution.

    Twists and wrenches in base axes; `[force; moment]` about the base point, as `ArmSolution.base_wrench`.

    Attributes:
        pull: (6, n) per m of tendon taken in.
        gravity: (6, 3) per m/s^2.
        hold: (6, 6) per twist [m; rad] of what holds the section, about `tip_position`; zero for a free tip.
        tip_wrench: (6, 6) per dead tip wrench [N; N m]; zero for a held tip.
        parameters: (6,) each per relative change of "EI", "GJ", "k_T", "T0".
        tension: of each tendon (n, 6), N per dead tip wrench [N; N m] of a free tip, or per twist [m; rad] of
            what holds the section.
        compliance: (6, 6) tip twist [m; rad] per wrench [N; N m] at the end of the modelled part, as if it
            were free there.
    """

    pull: Array
    gravity: Array
    hold: Array
    tip_wrench: Array
    parameters: Mapping[str, Array]
    tension: Array
    compliance: Array


class Detail(Protocol):
    """What a solution can tell beyond its numbers, worked out only when asked for."""

    def moments(self) -> MassMoments:
        """Where the mass is."""

    def sections(self, at: Array) -> tuple[Array, Array]:
        """Rotations (k, 3, 3) and positions (k, 3) of the sections at arc lengths `at` (k,), m."""

    def line(self) -> Array:
        """Backbone (k, 3), m, from base to end at whatever points are known anyway: cheap enough for a cycle."""

    def path_beyond(self, s: float) -> Array:
        """How much the arm beyond arc length s shortens each tendon's path (n,), m."""

    def turning(self) -> float:
        """Angle through which the modelled part bends from base to end, rad; there and back counts twice."""

    def derivatives(self) -> Derivatives:
        """Sensitivities of the base wrench.

        Raises:
            NoSolution: where the equilibrium is singular.
        """


@dataclass(frozen=True, eq=False)
class ArmSolution:
    """One equilibrium of the arm.

    Attributes:
        pull: tendon goals it was solved for (n,), m.
        bend: bend of the modelled part (2,), rad: mean curvature times length, in the section's own axes.
        tip_position: of the end of the modelled part (3,), m (the tip, or the held section).
        tip_rotation: its R_at (3, 3).
        tension: of each tendon (n,), N.
        base_wrench: [force; moment] (6,) that the arm exerts on its carrier at the base point.
        tip_wrench: [force; moment] (6,) that the outside exerts on the end section, without payload.
        residual: of the equilibrium, relative, checked apart from the solver's own stop test.
        taut_margin: how much farther the held section could be before the backbone is straight, m; nan for
            a free tip.
        gravity: field it was solved in (3,), m/s^2.
        arc_length: length of the modelled part, m.
        coordinates: the model's own unknowns, to start a neighbouring solve from.
        iterations: Newton steps taken.
        detail: source of what is worked out on demand.
    """

    pull: Array
    bend: Array
    tip_position: Array
    tip_rotation: Array
    tension: Array
    base_wrench: Array
    tip_wrench: Array
    residual: float
    taut_margin: float
    gravity: Array
    arc_length: float
    coordinates: Array = field(repr=False)
    iterations: int
    detail: Detail = field(repr=False)

    @cached_property
    def moments(self) -> MassMoments:
        """Where the mass of the modelled part is, payload included."""
        return self.detail.moments()

    @cached_property
    def derivatives(self) -> Derivatives:
        """Sensitivities at this solution, computed when first asked for.

        Raises:
            NoSolution: where the equilibrium is singular and they do not exist.
        """
        return self.detail.derivatives()

    @property
    def compliance(self) -> Array:
        """Tip twist per tip wrench (6, 6), motors locked: `Derivatives.compliance`."""
        return self.derivatives.compliance

    @cached_property
    def base_stiffness(self) -> Array:
        """d base_wrench / d base twist (6, 6): the base moves by [m; rad] in its own axes, the hold stays.

        Components stay in the moving base axes, and gravity keeps its direction in the world.

        Raises:
            NoSolution: where the equilibrium is singular.
        """
        d = self.derivatives
        p, g = self.tip_position, self.gravity
        # Seen from a base that moves by (v, w), the outside moves by -(v + w x p), -w, and g by -w x g.
        hold = np.zeros((6, 6))
        hold[:3, :3] = hold[3:, 3:] = -np.eye(3)
        hold[:3, 3:] = so3.hat(p)
        return sealed(d.hold @ hold + np.hstack((np.zeros((6, 3)), d.gravity @ so3.hat(g))))

    def section(self, s: float) -> Pose:
        """T_as of the cross-section at arc length s, m, of the modelled part."""
        rotation, position = self.detail.sections(np.array([s]))
        return Pose(rotation[0], position[0])

    def shape(self, points: int = 50) -> Array:
        """Backbone (points, 3), m, from the base to the end of the modelled part."""
        return self.detail.sections(np.linspace(0.0, self.arc_length, points))[1]

    def hold(
        self, s: float, kind: HoldKind, *, axis: ArrayLike | None = None, pivot: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Hold:
        """The hold that grips the arm here and now at arc length s, m, without changing anything yet.

        The part beyond keeps the shape it has in this solution, so the tendons keep their tension.
        """
        bar = None if axis is None else np.asarray(axis, dtype=np.float64)
        point = np.asarray(pivot, dtype=np.float64)
        return Hold(s, self.section(s), kind, bar, point, self.detail.path_beyond(s))


class ArmModel(Protocol):
    """Mechanics of one arm. Methods are pure: the same arguments give the same result."""

    @property
    def parameters(self) -> ArmParameters:
        """The arm."""

    def pull_for_bend(self, bend: ArrayLike, pretension: float | None = None) -> Array:
        """Tendon goals (n,), m, for the unloaded, gravity-free bend u (2,), rad, own stretch included.

        Goals are differential about the pretension, N (the configured one when None). A bend so large that
        the outer tendon goes slack is not fully reached; `bend_for_pull` tells what is.
        """

    def pull_for_tension(self, bend: ArrayLike, tension: ArrayLike) -> Array:
        """Tendon goals (n,), m, that give these tensions (n,), N, when the arm has this bend (2,), rad."""

    def bend_for_pull(self, pull: ArrayLike) -> Array:
        """The unloaded, gravity-free bend u (2,), rad, of tendon goals (n,), m.

        Raises:
            NoSolution: when none is found.
        """

    def bend_for_tip(self, p_tip_base: ArrayLike, tolerance: float | None = None) -> Array:
        """The bend u (2,), rad, of the unloaded arm whose tip is at `p_tip_base` (3,), m.

        Args:
            p_tip_base: target, base axes.
            tolerance: how far along its own direction the target may miss the reachable surface, m; a
                hundredth of the length when None.

        Raises:
            LimitViolated: when it misses it by more.
        """

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
        """Equilibrium with a free tip, motors locked.

        Args:
            pull: tendon goals (n,), m.
            gravity: (3,), m/s^2, base axes.
            tip_wrench: dead load at the tip (6,) [N; N m], base axes; none when None.
            payload: what the tip carries.
            follower_wrench: load that turns with the tip (6,) [N; N m], tip axes.
            start: a neighbouring solution to start from.

        Raises:
            NoSolution: when no equilibrium is found.
            LimitViolated: when it lies where the model does not hold.
        """

    def held(self, pull: ArrayLike, hold: Hold, gravity: ArrayLike, *, start: ArmSolution | None = None) -> ArmSolution:
        """Equilibrium with a held section, motors locked.

        Args:
            pull: tendon goals (n,), m.
            hold: what is held and where it is now, in present base axes.
            gravity: (3,), m/s^2, base axes.
            start: a neighbouring solution to start from.

        Raises:
            NoSolution: when no equilibrium is found.
            LimitViolated: when the held section is out of the backbone's reach, or the model does not hold.
        """

    def anchor(self, hold: Hold, pull: ArrayLike, tension: ArrayLike, gravity: ArrayLike) -> Hold:
        """The same hold with `beyond` such that tendons at `pull` (n,), m, have `tension` (n,), N, right now.

        For a wrap, whose shape nobody knows but whose tendon tensions the servos report.

        Raises:
            NoSolution: when no equilibrium with these tensions is found.
            LimitViolated: as `held`.
        """
