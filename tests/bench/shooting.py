"""A clamped arm by shooting, as one would write it with SciPy: the peer of the rod's warm solve.

Unknowns are force and moment at the base and the tendons' tensions; solve_ivp integrates the section from base to
tip, root makes it end in the clamp and the tensions follow from the paths. Parallel tendons at continuous guides;
twist to first order, which planar cases do not notice.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

from arm_companion.arm.model import ArmSolution
from arm_companion.arm.parameters import ArmParameters


class ShootingSolver:
    """Keeps its last answer to start from, as every solver here does."""

    def __init__(self, parameters: ArmParameters, pull: np.ndarray, gravity: np.ndarray, first: ArmSolution) -> None:
        self.P, self.s = parameters, parameters.segments[0]
        self.pull, self.gravity = pull, gravity
        self.c, self.d = np.cos(parameters.angles), np.sin(parameters.angles)
        self.x = np.concatenate((first.base_wrench, first.tension))
        self.scale = np.concatenate((np.full(3, 0.3), np.full(3, 0.08), np.full(parameters.n, 1.0)))

    def _section(self, _s: float, y: np.ndarray, tau: np.ndarray, twist: float) -> np.ndarray:
        s = self.s
        R, n, m = y[3:12].reshape(3, 3), y[12:15], y[15:18]
        mx, my, mz = R.T @ m
        # A tendon at r (cos, sin) bends the backbone towards itself.
        ux = (my + s.r * (tau @ self.c)) / s.EI
        uy = (-mx + s.r * (tau @ self.d)) / s.EI
        uz = mz / twist
        K = np.array(((0.0, -uz, ux), (uz, 0.0, uy), (-ux, -uy, 0.0)))
        t = R[:, 2]
        force = -s.line_mass * self.gravity
        turn = (t[2] * n[1] - t[1] * n[2], t[0] * n[2] - t[2] * n[0], t[1] * n[0] - t[0] * n[1])
        paths = -s.r * (self.c * ux + self.d * uy)
        return np.concatenate((t, (R @ K).ravel(), force, turn, paths))

    def _miss(self, z: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        x = z * self.scale
        tau = np.maximum(x[6:], 0.0)
        y = np.concatenate((np.zeros(3), np.eye(3).ravel(), x[:6], np.zeros(self.P.n)))
        twist = self.s.GJ + self.s.r**2 * tau.sum()
        end = solve_ivp(self._section, (0, self.s.L), y, args=(tau, twist), method="DOP853", rtol=1e-6, atol=1e-9).y[
            :, -1
        ]
        E = end[3:12].reshape(3, 3) @ rotation.T
        turn = 0.5 * np.array((E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]))
        stretch = (x[6:] - self.P.T0) / self.P.k_T - self.pull - end[18:]
        return np.concatenate(((end[:3] - position) / self.s.L, turn, stretch / self.s.r))

    def solve(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Wrench (6,) on the carrier at the base point with the tip clamped there."""
        found = root(self._miss, self.x / self.scale, args=(position, rotation), method="hybr", tol=1e-6)
        if not found.success:
            raise RuntimeError(found.message)
        self.x = found.x * self.scale
        return self.x[:6]
