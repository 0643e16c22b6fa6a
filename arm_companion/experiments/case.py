"""One question to the model: an arm, tendon goals, a field, and a load or a clamp."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from arm_companion.arm import arc, reaction, statics
from arm_companion.arm import stiffness as arc_stiffness
from arm_companion.arm.model import ArmSolution, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import Config
from arm_companion.errors import ModelError
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, frozen, sealed
from arm_companion.geometry.se3 import Pose

GRAVITY = 9.81
"""Field of the reference tables, m/s^2; the daemon flies with the standard 9.80665."""

_NOTHING = (0.0, 0.0, 0.0)
_STRAIGHT = 1e-9  # rad, under which the bend has no direction of its own


def arm(config: Config, guides: Guides = Guides.CONTINUOUS, pretension: float | None = None) -> ArmParameters:
    """The configured arm, with another pretension, N, when one is given."""
    parameters = ArmParameters.of(config.arm, guides)
    if pretension is None:
        return parameters
    return replace(parameters, tendons=tuple(replace(t, T0=pretension) for t in parameters.tendons))


def bend(theta_deg: float | Sequence[float], delta_deg: float | Sequence[float] = 0.0) -> Array:
    """u (2 m,), rad, of the paper's psi in degrees, one pair for each of m segments."""
    theta, delta = np.broadcast_arrays(np.radians(np.atleast_1d(theta_deg)), np.radians(delta_deg))
    return np.column_stack((theta * np.cos(delta), theta * np.sin(delta))).ravel()


def goals(
    parameters: ArmParameters, theta_deg: float | Sequence[float], delta_deg: float | Sequence[float] = 0.0
) -> Array:
    """Tendon goals (n,), m, for an unloaded, gravity-free bend; they make up for the tendons' own stretch.

    The same goals whatever the guides, so that two kinds of guides are compared under one command: with real disks
    the chords take in a little more, and the bend comes out larger, by 0.07 deg in 60 for the reference arm. Where a
    tendon would have to push it goes slack, and the bend comes out smaller.

    Args:
        parameters: the arm.
        theta_deg: bend of its segment, or of each from base to tip; those not named stay straight.
        delta_deg: bending plane, likewise.

    Raises:
        ModelError: no tendon could be on the inside of such a bend.
    """
    u = np.zeros(2 * len(parameters.segments))
    asked = bend(theta_deg, delta_deg)
    u[: asked.size] = asked
    _check_sharpness(parameters, u)
    return statics.pull_for_bend(replace(parameters, guides=Guides.CONTINUOUS), u)


def _check_sharpness(parameters: ArmParameters, u: Array) -> None:
    """Refuse bends with a radius under the tendons' own, in words about the bend; the solver knows of radii alone.

    Raises:
        ModelError: of the first segment that is asked too much.
    """
    for k, segment in enumerate(parameters.segments):
        taken = float((parameters.H[:, 2 * k : 2 * k + 2] @ u[2 * k : 2 * k + 2]).max())  # of the tendon inside, m
        if taken < segment.L:
            continue
        theta = math.degrees(math.hypot(*u[2 * k : 2 * k + 2]))
        which = f" of segment {k + 1}" if len(parameters.segments) > 1 else ""
        raise ModelError(
            f"a bend{which} of {theta:.6g} deg is too sharp: at {theta * segment.L / taken:.0f} deg in that plane "
            "nothing is left of the tendon on its inside"
        )


def field(config: Config, *, on: bool, attitude_deg: Sequence[float] | None = None) -> Array:
    """Gravity (3,), m/s^2, base axes.

    Args:
        config: for the mount, when there is an attitude.
        on: zero field when false.
        attitude_deg: roll, pitch and yaw of the vehicle; along +z of the base (the arm hangs) when None.
    """
    if not on:
        return np.zeros(3)
    if attitude_deg is None:
        return np.array((0.0, 0.0, GRAVITY))
    R_wb = so3.from_rpy(*(math.radians(angle) for angle in attitude_deg))
    return reaction.gravity_in_base(R_wb, reaction.mount(config.mount.position_m, config.mount.rpy_deg), GRAVITY)


@dataclass(frozen=True, eq=False)
class Case:
    """An arm with its motors locked.

    Attributes:
        model: mechanics.
        pull: tendon goals (n,), m.
        gravity: (3,), m/s^2, base axes.
        payload: what a free tip carries.
    """

    model: RodModel
    pull: Array
    gravity: Array
    payload: Payload | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "pull", frozen(self.pull, (self.model.parameters.n,), "pull"))
        object.__setattr__(self, "gravity", frozen(self.gravity, (3,), "gravity"))

    def free(
        self,
        force: Sequence[float] = _NOTHING,
        moment: Sequence[float] = _NOTHING,
        *,
        follower: bool = False,
        start: ArmSolution | None = None,
    ) -> ArmSolution:
        """Equilibrium with a free tip.

        Args:
            force: on the tip (3,), N.
            moment: on the tip (3,), N m.
            follower: whether force and moment are in tip axes and turn along; base axes and dead otherwise.
            start: a neighbouring solution.

        Raises:
            ModelError: when it has none that the model may show.
        """
        load = np.array((*force, *moment), dtype=np.float64)
        if not load.any():
            return self.model.free(self.pull, self.gravity, payload=self.payload, start=start)
        if follower:
            return self.model.free(self.pull, self.gravity, payload=self.payload, follower_wrench=load, start=start)
        return self.model.free(self.pull, self.gravity, load, self.payload, start=start)

    def held(
        self,
        base_move: Sequence[float],
        kind: HoldKind = HoldKind.CLAMPED,
        *,
        base_turn: Sequence[float] = _NOTHING,
        unloaded: ArmSolution | None = None,
        start: ArmSolution | None = None,
    ) -> ArmSolution:
        """Equilibrium with the tip held where it was when the arm was free, and the base moved since.

        Args:
            base_move: of the base point (3,), m, in the base axes before the move.
            kind: what is held of the tip.
            base_turn: of the base about its own point: roll, pitch, yaw (3,), rad. `gravity` is in the axes after it.
            unloaded: the free arm, when already known.
            start: a neighbouring solution.

        Raises:
            ModelError: when it has none that the model may show.
        """
        R = so3.from_rpy(*base_turn)
        before = replace(self, gravity=R @ self.gravity).free() if unloaded is None else unloaded
        moved = Pose(R, np.asarray(base_move, dtype=np.float64))
        hold = before.hold(self.model.parameters.L, kind).seen_from(moved.inverse())
        return self.model.held(self.pull, hold, self.gravity, start=start)


def stiffness(compliance: Array) -> Array:
    """Force per tip displacement (3, 3), N/m, base axes, tip free to turn: the inverse where there is one.

    An inextensible arm cannot give along a straight backbone. Such directions are left out (zero), as in a
    pseudo-inverse: their stiffness is not finite. Negative where only the hold keeps the arm from buckling, and
    unsymmetric under loads that have no potential, such as those that turn with the tip.
    """
    return sealed(np.asarray(np.linalg.pinv(compliance[:3, :3], rcond=1e-9), dtype=np.float64))


def k_psi(solution: ArmSolution, parameters: ArmParameters, delta: float = 0.0) -> Array:
    """The paper's K_psi, its sign put right, at the solution's mean bend (2, 2), N m/rad; one segment.

    K_psi = H - [dJ_q^T/dpsi] tau + J_q^T K_q J_q - [dJ_x^T/dpsi] w over taut tendons (the paper's eq. 17 prints a
    minus before the third term and leaves the last out). Here by the chain rule from u = theta (cos delta,
    sin delta): T^T K_u T + g . d2u/dpsi2, with g the force on u that backbone, tendons and tip load leave. The
    arm's weight does not count, and a tip load counts as dead.

    Args:
        solution: whose bend, tensions and tip wrench are taken.
        parameters: the arm.
        delta: direction of the bending plane where the arm is straight and has none, rad.
    """
    x, y = solution.bend[:2].tolist()
    theta = math.hypot(x, y)
    if theta > _STRAIGHT:
        delta = math.atan2(y, x)
    along, across = np.array((math.cos(delta), math.sin(delta))), np.array((-math.sin(delta), math.cos(delta)))
    u, tau, w = theta * along, solution.tension, solution.tip_wrench
    g = statics.bending_moment(parameters, u, tau) - arc.jacobian(u, parameters.L).T @ w
    T = np.column_stack((along, theta * across))
    turning = np.array(((0.0, g @ across), (g @ across, -theta * (g @ along))))
    return sealed(T.T @ arc_stiffness.bend_stiffness(parameters, u, tau, w) @ T + turning)
