"""From the wrench at the arm's base to the wrench on the airframe, with its spread and its validity.

Frames: b is the vehicle's body, FRD, with its origin in the airframe's centre of mass (the arm and payload do
not count with the airframe); a is the arm's base. The mount is T_ba: `p_b = T_ba @ p_a`. The result is the
force and torque that the arm exerts on the airframe, about that centre of mass, in body axes: what
`mission.facts.WrenchReport` carries.

The solution was found in a uniform field `solution.gravity`. The true field at a point x of the arm, as felt
in the moving base, is g - a_base - alpha x x - omega x (omega x x); the difference between the two, summed
over the arm's mass, is the inertial part. So whatever field the solution was found in, nothing counts twice.
"""

import functools
import math
from dataclasses import dataclass, field

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.model import ArmSolution
from arm_companion.arm.parameters import ArmParameters
from arm_companion.geometry import so3, wrench
from arm_companion.geometry.arrays import Array, frozen, sealed
from arm_companion.geometry.se3 import Pose

GRAVITY = 9.80665
"""Standard gravity, m/s^2."""

_ZERO = np.zeros(3)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


def _zero() -> Array:
    return np.zeros(3)


@functools.cache
def mount(position: tuple[float, ...], rpy_deg: tuple[float, ...]) -> Pose:
    """T_ba from [mount]: base point in body axes (3,), m, and roll, pitch, yaw of the base axes, deg."""
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return Pose(so3.from_rpy(roll, pitch, yaw), np.asarray(position, dtype=np.float64))


def gravity_in_base(R_wb: Array, T_ba: Pose, g: float = GRAVITY) -> Array:
    """Gravity (3,), m/s^2, in base axes, of a vehicle with attitude R_wb (world NED, so +z is down)."""
    return np.asarray(T_ba.rotation.T @ (R_wb.T @ np.array((0.0, 0.0, g))))


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion of the airframe, body axes, of its centre of mass.

    Attributes:
        acceleration: dv/dt (3,), m/s^2: accelerometer reading plus gravity, both in body axes.
        rate: omega (3,), rad/s.
        angular_acceleration: alpha (3,), rad/s^2.
    """

    acceleration: Array = field(default_factory=_zero)
    rate: Array = field(default_factory=_zero)
    angular_acceleration: Array = field(default_factory=_zero)

    def __post_init__(self) -> None:
        for name in ("acceleration", "rate", "angular_acceleration"):
            object.__setattr__(self, name, frozen(getattr(self, name), (3,), name))


@dataclass(frozen=True)
class Spread:
    """One sigma of everything that the prediction rests on; independent of one another.

    Attributes:
        EI: relative.
        GJ: relative.
        k_T: relative.
        T0: relative.
        mass: relative, of arm and payload.
        pull: of each tendon, m.
        hold_position: of the held section seen from the base, each axis, m.
        hold_rotation: of the same, each axis, rad.
        gravity_direction: attitude error, each axis, rad.
        tip_force: of a force known to act on a free tip, each axis, N.
        mount_position: each axis, m.
        mount_rotation: each axis, rad.
    """

    EI: float = 0.05
    GJ: float = 0.1
    k_T: float = 0.1
    T0: float = 0.1
    mass: float = 0.03
    pull: float = 2e-4
    hold_position: float = 2e-3
    hold_rotation: float = 0.02
    gravity_direction: float = 0.01
    tip_force: float = 0.0
    mount_position: float = 1e-3
    mount_rotation: float = 0.01


@dataclass(frozen=True, eq=False)
class Reaction:
    """Wrench of the arm on the airframe about its centre of mass, body axes.

    Attributes:
        wrench: [force; torque] (6,), N and N m.
        sigma: one sigma of each entry (6,); nan where the solution has no derivatives.
        valid: whether it may be acted upon.
        reason: why not, in words; empty when valid.
        taut_margin: of the solution, m; nan for a free tip.
        residual: of the solution.
    """

    wrench: Array
    sigma: Array
    valid: bool
    reason: str
    taut_margin: float
    residual: float


@dataclass(frozen=True)
class Validity:
    """When a reaction may be acted upon.

    Attributes:
        residual: largest allowed.
        taut_margin: least allowed, m.
        age: oldest allowed input, s.
        force_sigma: largest allowed of any component of the force, N.
    """

    residual: float = 1e-3
    taut_margin: float = 5e-4
    age: float = 0.25
    force_sigma: float = math.inf

    def refusal(self, solution: ArmSolution, sigma: Array, age: float) -> str:
        """Why the reaction of this solution may not be acted upon; empty when it may."""
        if not solution.residual <= self.residual:
            return f"residual {solution.residual:.2g} above {self.residual:.2g}"
        if solution.taut_margin < self.taut_margin:
            return f"{solution.taut_margin * 1e3:.2f} mm from taut"
        if not age <= self.age:
            return f"inputs are {age:.2f} s old"
        if math.isfinite(self.force_sigma) and not float(sigma[:3].max()) <= self.force_sigma:
            return f"one sigma of {float(sigma[:3].max()):.2g} N"
        return ""


def swing(
    parameters: ArmParameters,
    bend: Array,
    velocity: Array,
    acceleration: Array,
    rate: Array,
    tip_mass: float = 0.0,
) -> Array:
    """Wrench (6,) on the carrier of an arm that moves in its base, base point and axes.

    Minus the rate of change of its momentum: the arm's own acceleration and the Coriolis part, with the shape
    taken as an arc (a small correction needs no more). One segment.

    Args:
        parameters: the arm.
        bend: u (2,), rad.
        velocity: du/dt (2,), rad/s.
        acceleration: d2u/dt2 (2,), rad/s^2.
        rate: of the base, base axes (3,), rad/s.
        tip_mass: payload, kg.
    """
    s = parameters.segments[0]
    shares = [(0.5 * (float(x) + 1), 0.5 * float(w) * s.line_mass * s.L) for x, w in zip(_NODES, _WEIGHTS, strict=True)]
    result = np.zeros(6)
    for x, mass in (*shares, (1.0, s.end_mass + tip_mass)):
        at = arc.tip_position(x * bend, x * s.L)
        speed = arc.jacobian(x * bend, x * s.L)[:3] @ (x * velocity)
        change = arc.acceleration(x * bend, x * velocity, x * acceleration, x * s.L) + 2 * so3.cross(rate, speed)
        result += wrench.at_point(np.concatenate((-mass * change, _ZERO)), at)
    return result


def reaction(
    solution: ArmSolution,
    T_ba: Pose,
    gravity: Array,
    motion: BodyMotion | None = None,
    *,
    spread: Spread | None = None,
    validity: Validity | None = None,
    age: float = 0.0,
    moving: Array | None = None,
) -> Reaction:
    """The wrench on the airframe.

    Args:
        solution: the arm's equilibrium.
        T_ba: mount.
        gravity: true gravity in base axes (3,), m/s^2.
        motion: of the airframe; at rest when None.
        spread: one sigma of what the prediction rests on; the defaults when None.
        validity: its limits; the defaults when None.
        age: of the oldest input, s.
        moving: wrench (6,) of the arm's motion in its base, from `swing`.
    """
    at_base = solution.base_wrench + inertial(solution, T_ba, gravity, motion or BodyMotion())
    if moving is not None:
        at_base = at_base + moving
    total = wrench.transformed(at_base, T_ba)
    sigma = sealed(_sigma(solution, T_ba, at_base, spread or Spread()))
    reason = (validity or Validity()).refusal(solution, sigma, age)
    if not reason and not np.isfinite(total).all():
        reason = "not a finite number"
    return Reaction(sealed(total), sigma, not reason, reason, solution.taut_margin, solution.residual)


def inertial(solution: ArmSolution, T_ba: Pose, gravity: Array, motion: BodyMotion) -> Array:
    """What the arm's mass adds (6,), base point and axes, since the field is not the one it was solved in."""
    R, r = T_ba.rotation, T_ba.position
    omega, alpha = motion.rate, motion.angular_acceleration
    turning = so3.hat(omega)
    spin = so3.hat(alpha) + turning @ turning
    b = gravity - R.T @ (motion.acceleration + spin @ r) - solution.gravity
    A = -R.T @ spin @ R
    m = solution.moments
    # sum m (b + A x) and sum m x x (b + A x)
    turn = A @ m.second
    torque = so3.cross(m.first, b) + np.array(
        (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    )
    return np.concatenate((m.mass * b + A @ m.first, torque))


def _sigma(solution: ArmSolution, T_ba: Pose, at_base: Array, spread: Spread) -> Array:
    """One sigma (6,) of the transformed wrench: root of the summed squares of derivative times spread."""
    d = solution.derivatives
    g, by = solution.gravity, d.parameters
    parameters = (
        spread.EI * by["EI"],
        spread.GJ * by["GJ"],
        spread.k_T * by["k_T"],
        spread.T0 * by["T0"],
        spread.mass * (d.gravity @ g),  # a heavier arm is the same arm in a stronger field
    )
    columns = [
        np.array(parameters).T,
        spread.pull * d.pull,
        spread.hold_position * d.hold[:, :3],
        spread.hold_rotation * d.hold[:, 3:],
        spread.gravity_direction * (d.gravity @ so3.hat(g)),
    ]
    if spread.tip_force:
        columns.append(spread.tip_force * d.tip_wrench[:, :3])
    variance = np.square(wrench.transform_matrix(T_ba) @ np.concatenate(columns, axis=1)).sum(axis=1)
    F, M = T_ba.rotation @ at_base[:3], T_ba.rotation @ at_base[3:]
    shifted = so3.hat(F)
    turned = so3.hat(M) + so3.hat(T_ba.position) @ shifted
    by_shift = np.square(shifted).sum(axis=1)
    variance[:3] += spread.mount_rotation**2 * by_shift
    variance[3:] += spread.mount_rotation**2 * np.square(turned).sum(axis=1) + spread.mount_position**2 * by_shift
    return np.asarray(np.sqrt(variance))
