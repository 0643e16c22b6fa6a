"""Stiffness and compliance of the arc: the paper's section on stiffness, with its sign put right.

The paper prints K_psi = H - [dJ_q^T/dpsi] tau - J_q^T K_q J_q. From the potential V = E + sum k (q_m - q)^2
/ 2 the last term is positive: a tendon whose motor is locked resists bending. Only taut tendons count.
"""

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.parameters import ArmParameters
from arm_companion.geometry.arrays import Array, ArrayLike


def bend_stiffness(
    parameters: ArmParameters, u: ArrayLike, tension: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """K_u (2, 2), N m/rad: (EI/L) I + H^T diag(k taut) H - d(J_xu^T w)/du, motors locked, one segment.

    Args:
        parameters: the arm.
        u: bend (2,), rad.
        tension: of each tendon (n,), N; zero means slack.
        wrench: dead tip wrench (6,) [N; N m], base axes.
    """
    b = np.asarray(u, dtype=np.float64)
    tau = np.asarray(tension, dtype=np.float64)
    path = parameters.H + 2 * parameters.chord_loss * b
    k = parameters.k_T * (tau > 0)
    K = np.diag(parameters.bending - 2 * tau @ parameters.chord_loss) + path.T @ (k[:, None] * path)
    if wrench is not None:
        K = K - arc.twist_jacobians(b, wrench, parameters.L)
    return np.asarray(K)


def tip_compliance(
    parameters: ArmParameters, u: ArrayLike, tension: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """C (6, 6): tip twist [m; rad] per wrench [N; N m], base axes, tip point: J_xu K_u^-1 J_xu^T, rank 2."""
    J = arc.jacobian(u, parameters.L)
    return np.asarray(J @ np.linalg.solve(bend_stiffness(parameters, u, tension, wrench), J.T))


def stiffness_along(compliance: Array, direction: ArrayLike) -> float:
    """Force per deflection, N/m, along a direction d (3,), the tip free to give in all others: 1 / (d^T C d).

    Infinite where the model cannot give at all, negative where it gives way against the force. Inverting the whole
    compliance would need it to be regular, which the arc's (rank 2) never is.
    """
    d = np.asarray(direction, dtype=np.float64)
    d = d / np.sqrt(d @ d)
    give = float(d @ compliance[:3, :3] @ d)
    return 1 / give if abs(give) > 1e-15 else float("inf")
