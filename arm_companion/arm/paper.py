"""The paper's model in its own coordinates psi = (theta, delta): the research face of the library.

Zhao, Zhang, Jafarnejadsani, Wang, "A Modular Continuum Manipulator for Aerial Manipulation and Perching", IDETC
2022. Equations as printed, with two departures that the literature needs: the sign of the last term of K_psi (see
`configuration_stiffness`), and the angle of every tendon as the configuration says instead of -k beta. psi is polar:
delta means nothing at theta = 0 and the Jacobians lose rank there. Use `arc` to compute, this to compare. One
segment; q > 0 is tendon taken in.
"""

import math

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.parameters import ArmParameters
from arm_companion.geometry.arrays import Array, ArrayLike


def bend_of(theta: float, delta: float) -> Array:
    """The vector u (2,) = (theta cos delta, theta sin delta), rad."""
    return np.array((theta * math.cos(delta), theta * math.sin(delta)))


def psi_of(u: ArrayLike) -> tuple[float, float]:
    """(theta, delta), rad, theta >= 0; delta is 0 for the straight arm."""
    x, y = float(u[0]), float(u[1])  # type: ignore[arg-type]
    return math.hypot(x, y), math.atan2(y, x)


def tip_position(parameters: ArmParameters, theta: float, delta: float) -> Array:
    """p_tip_base (3,), m (eq. 7)."""
    return arc.tip_position(bend_of(theta, delta), parameters.L)


def tip_rotation(theta: float, delta: float) -> Array:
    """R of frame {G} in the base (3, 3): Rz(delta) Ry(theta) Rz(-delta) (eqs. 1 and 2)."""
    return arc.tip_rotation(bend_of(theta, delta))


def joint(parameters: ArmParameters, theta: float, delta: float) -> Array:
    """Tendon displacements q (n,), m: q_i = r theta cos(phi_i - delta) (eq. 3)."""
    return np.asarray(parameters.r * theta * np.cos(parameters.angles - delta))


def joint_jacobian(parameters: ArmParameters, theta: float, delta: float) -> Array:
    """J_q_psi (n, 2), m/rad (eq. 5)."""
    angle = parameters.angles - delta
    return parameters.r * np.column_stack((np.cos(angle), theta * np.sin(angle)))


def task_jacobian(parameters: ArmParameters, theta: float, delta: float) -> Array:
    """J_x_psi (6, 2): tip twist [m; rad] per rad of theta and delta, base axes (eqs. 6, 8 and 10)."""
    c, s = math.cos(delta), math.sin(delta)
    polar = np.array(((c, -theta * s), (s, theta * c)))  # du / dpsi
    return np.asarray(arc.jacobian(bend_of(theta, delta), parameters.L) @ polar)


def energy(parameters: ArmParameters, theta: float) -> float:
    """Elastic energy of the backbone, J: theta^2 EI / (2 L) (eq. 11)."""
    return theta * theta * parameters.EI / (2 * parameters.L)


def energy_gradient(parameters: ArmParameters, theta: float) -> Array:
    """Its gradient by psi (2,), N m (eq. 13)."""
    return np.array((theta * parameters.EI / parameters.L, 0.0))


def configuration_stiffness(
    parameters: ArmParameters, theta: float, delta: float, tension: ArrayLike, *, printed: bool = False
) -> Array:
    """K_psi (2, 2), N m/rad: H - [dJ_q^T/dpsi] tau + J_q^T K_q J_q, slack tendons left out.

    The paper prints a minus before the last term, which gives the straight arm a tip stiffness of -160 N/m. From
    the potential V = E + sum k (q_m - q)^2 / 2 of locked motors it is a plus.

    Args:
        parameters: the arm; K_q is the stiffness of the whole tendon, housing and servo included.
        theta: bend, rad.
        delta: bending plane, rad.
        tension: of each tendon (n,), N.
        printed: the formula as the paper has it.
    """
    tau = np.asarray(tension, dtype=np.float64)
    J = joint_jacobian(parameters, theta, delta)
    angle = parameters.angles - delta
    mixed = float(tau @ (parameters.r * np.sin(angle)))
    turning = np.array(((0.0, mixed), (mixed, -theta * float(tau @ (parameters.r * np.cos(angle))))))
    H = np.array(((parameters.EI / parameters.L, 0.0), (0.0, 0.0)))
    k = parameters.k_T * (tau > 0)
    springs = J.T @ (k[:, None] * J)
    return np.asarray(H - turning - springs if printed else H - turning + springs)


def task_stiffness(
    parameters: ArmParameters, theta: float, delta: float, tension: ArrayLike, *, printed: bool = False
) -> Array:
    """K_X (3, 3), N/m, at zero tip force: (J_v^T)^+ K_psi J_v^+ (eq. 21).

    Of rank two: it says nothing of the direction in which an arc cannot give. `stiffness.tip_compliance` is the
    well-posed statement.
    """
    J = np.linalg.pinv(task_jacobian(parameters, theta, delta)[:3])
    return np.asarray(J.T @ configuration_stiffness(parameters, theta, delta, tension, printed=printed) @ J)
