"""A second opinion on the rod: shooting from the base with SciPy, sharing no code with the package's rod.

Section by section, curvature follows from the internal moment by the constitutive law (backbone plus tendons at
their radius, chords between disks included), and force and moment from the loads. Shooting with a solution's own
base wrench and tensions must end where the solution ends, under the load it was solved for.
"""

import numpy as np
from scipy.integrate import solve_ivp

from arm_companion.arm.model import ArmSolution, Payload
from arm_companion.arm.parameters import ArmParameters, Guides


def hat(v):
    """Skew matrices (k, 3, 3) of vectors (k, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1).reshape(-1, 3, 3)


def curvature(moment, tau, offsets, EI, GJ, gap2, guess):
    """Curvature (k, 3) of sections with these internal moments (k, 3), both in section axes."""
    kappa = guess.copy()
    stiff = np.array([EI, EI, GJ])
    soften = 2 * gap2 * tau.sum() * np.array([1.0, 1.0, 0.0])
    R = hat(offsets)
    lever = -R @ R
    for _ in range(40):
        # tangent of tendon i: t + kappa x r_i
        strand = np.array([0.0, 0.0, 1.0]) + np.cross(kappa[:, None], offsets)
        length = np.sqrt((strand**2).sum(axis=2))
        # d|strand| / d kappa = (r_i x strand) / |strand|
        by = np.cross(offsets, strand) / length[..., None]
        out = (stiff - soften) * kappa + np.einsum("i,kij->kj", tau, by) - moment
        pulled = tau / length
        K = np.diag(stiff - soften) + np.einsum("ki,ijl->kjl", pulled, lever)
        K -= np.einsum("ki,kij,kil->kjl", pulled, by, by)
        step = np.linalg.solve(K, out[..., None])[..., 0]
        kappa = kappa - step
        if np.abs(step).max() < 1e-13 * (1 + np.abs(kappa).max()):
            break
    return kappa


def shoot(parameters: ArmParameters, solution: ArmSolution, payload: Payload | None = None, rtol: float = 1e-10):
    """Tip position, tip rotation, tip wrench, and path less length of every tendon, found from the base wrench."""
    P, g = parameters, np.asarray(solution.gravity)
    p, R = np.zeros(3), np.eye(3)
    n, m = np.array(solution.base_wrench[:3]), np.array(solution.base_wrench[3:])
    longer = np.zeros(P.n)
    before = 0.0
    for k, segment in enumerate(P.segments):
        length = min(segment.L, solution.arc_length - before)
        if length <= 1e-12:
            break
        here = P.runs[:, k] > 0
        tau = solution.tension[here]
        angle = P.angles[here]
        offsets = segment.r * np.column_stack((np.cos(angle), np.sin(angle), np.zeros(angle.size)))
        gap2 = (segment.L / segment.disks) ** 2 / 24 if P.guides is Guides.DISKS else 0.0
        guess = [np.zeros((1, 3))]

        def slope(s, y, tau=tau, offsets=offsets, segment=segment, gap2=gap2, guess=guess):
            R, n, m = y[3:12].reshape(3, 3), y[12:15], y[15:18]
            (kappa,) = guess[0] = curvature((R.T @ m)[None], tau, offsets, segment.EI, segment.GJ, gap2, guess[0])
            strand = np.array([0.0, 0.0, 1.0]) + np.cross(kappa, offsets)
            paths = np.sqrt((strand**2).sum(axis=1)) - 1 - gap2 * (kappa[0] ** 2 + kappa[1] ** 2)
            return np.concatenate(
                (R[:, 2], (R @ hat(kappa[None])[0]).ravel(), -segment.line_mass * g, -np.cross(R[:, 2], n), paths)
            )

        start = np.concatenate((p, R.ravel(), n, m, longer[here]))
        y = solve_ivp(slope, (0, length), start, rtol=rtol, atol=1e-12, method="DOP853").y[:, -1]
        p, R, n, m = y[:3], y[3:12].reshape(3, 3), y[12:15], y[15:18]
        longer[here] = y[18:]
        before += length
        if before < solution.arc_length - 1e-12 or solution.arc_length >= P.L - 1e-12:
            n = n - segment.end_mass * g  # what remains is exerted beyond the disk
    if payload is not None:
        n = n - payload.mass * g
        m = m - np.cross(R @ payload.offset, payload.mass * g)
    return p, R, np.concatenate((n, m)), longer
