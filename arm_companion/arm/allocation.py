"""Which tensions hold a bend: tendons only pull, and more of them than needed can share the work."""

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.parameters import ArmParameters
from arm_companion.errors import LimitViolated
from arm_companion.geometry.arrays import Array, ArrayLike

_ITERATIONS = 100
_FEASIBLE = 1e-9  # of the largest moment that the tendons can make


def allocate(
    parameters: ArmParameters,
    u: ArrayLike,
    *,
    wrench: ArrayLike | None = None,
    preferred: ArrayLike | None = None,
    tension_min: float = 0.0,
    tension_max: float = np.inf,
) -> Array:
    """Tensions (n,), N, that hold the bend u under a tip wrench, as near to the preferred as limits allow.

    Solves H^T tau = (EI / L) u - J_xu^T w with tension_min <= tau <= tension_max and the least sum of
    (tau - preferred)^2. The preferred tension is the co-contraction: the least tension gives soft, idle
    motors (for opposite pairs tau_a = tau_min + max(d, 0)), the pretension gives the paper's symmetric drive.

    Args:
        parameters: the arm; any number of tendons at any angles.
        u: bend (2 m,), rad.
        wrench: at the tip (6,) [N; N m], base axes; one segment only.
        preferred: tension to stay near (n,) or one for all, N; `tension_min` when None.
        tension_min: least tension of every tendon, N.
        tension_max: greatest tension of any tendon, N.

    Raises:
        LimitViolated: when that takes more than `tension_max`; the value is the tension it would take.
    """
    b = parameters.bending * np.asarray(u, dtype=np.float64)
    if wrench is not None:
        b = b - arc.jacobian(u, parameters.L).T @ np.asarray(wrench)
    want = tension_min if preferred is None else preferred
    start = np.array(np.broadcast_to(np.asarray(want, dtype=np.float64), (parameters.n,)))
    tau = hold_moment(parameters.H, b, start, tension_min, tension_max)
    if tau is None:
        needed = hold_moment(parameters.H, b, np.full(parameters.n, tension_min), tension_min, np.inf)
        most = np.inf if needed is None else float(needed.max())
        raise LimitViolated("tendon tension", most, tension_min, tension_max)
    return tau


def hold_moment(H: Array, b: Array, preferred: Array, tension_min: float, tension_max: float) -> Array | None:
    """The tensions (n,) nearest to `preferred` inside the limits with H^T tau = b; None when there are none.

    The dual of that small quadratic programme has only as many unknowns y as b has entries, and tau =
    clip(preferred + H y): Newton on a convex function with a kink at every limit, each step as long as is best.
    """
    arm = float(np.abs(H).max())
    scale = arm * max(1.0, tension_min, float(np.abs(preferred).max())) + float(np.abs(b).max())
    free = np.array(preferred)
    for _ in range(_ITERATIONS):
        tau = np.clip(free, tension_min, tension_max)
        g = H.T @ tau - b
        if float(np.abs(g).max()) < _FEASIBLE * scale:
            return np.asarray(tau)
        inside = (free >= tension_min) & (free <= tension_max)
        step = -np.linalg.solve(H[inside].T @ H[inside] + 1e-6 * (H.T @ H), g)
        along = H @ step
        length = _best_step(free, along, float(g @ step), tension_min, tension_max)
        if length is None:
            return None
        free = free + length * along
    return None


def _best_step(free: Array, along: Array, slope: float, tension_min: float, tension_max: float) -> float | None:
    """Where the dual function, which starts with `slope` < 0, is lowest along a direction; None when it falls for ever.

    Its derivative is piecewise linear and grows: it is followed from kink to kink until it reaches zero.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        kinks = np.concatenate(((tension_min - free) / along, (tension_max - free) / along))
    kinks = np.sort(kinks[np.isfinite(kinks) & (kinks > 0)])
    at = 0.0
    for end in (*kinks, np.inf):
        middle = free + (0.5 * (at + end) if np.isfinite(end) else 2 * at + 1.0) * along
        moving = (middle > tension_min) & (middle < tension_max)
        growth = float(along[moving] @ along[moving])
        if growth > 0 and slope + growth * (end - at) >= 0:
            return at - slope / growth
        if not np.isfinite(end):
            return None
        slope += growth * (end - at)
        at = float(end)
    return None
