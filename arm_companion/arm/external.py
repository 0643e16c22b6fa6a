"""An unknown force at a free tip, estimated from tendon tensions and, where there is one, an end-disk IMU.

With motors locked a force at the tip bends the arm, and the tendons feel the bend: two numbers for three unknowns,
so one direction (about along the line from base to tip) stays dark, and servo loads are coarse. The estimate is
the most probable force given the readings and a prior, and its covariance says which part of it was seen.
"""

from dataclasses import dataclass

import numpy as np

from arm_companion.arm.model import ArmModel, ArmSolution, Payload
from arm_companion.errors import NoSolution
from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed

_ITERATIONS = 12
_TOLERANCE = 1e-4  # of the prior


@dataclass(frozen=True, eq=False)
class TipForce:
    """The estimate.

    Attributes:
        force: on the tip (3,), N, base axes.
        covariance: (3, 3), N^2; as wide as the prior along directions that the readings do not see.
        seen: share of the prior's variance that the readings took away, along each principal axis (3,), largest
            first: 1 is seen, 0 is dark.
        axes: those principal axes as rows (3, 3), base axes.
        misfit: root mean square of readings against the estimate, in sigma; far above 1 the model does not hold.
        solution: of the arm under this force.
    """

    force: Array
    covariance: Array
    seen: Array
    axes: Array
    misfit: float
    solution: ArmSolution


def estimate_tip_force(
    model: ArmModel,
    pull: ArrayLike,
    gravity: ArrayLike,
    tension: ArrayLike,
    sigma: ArrayLike,
    *,
    prior: float,
    payload: Payload | None = None,
    tip_rotation: Array | None = None,
    rotation_sigma: float = 0.02,
    start: ArmSolution | None = None,
) -> TipForce:
    """The most probable force at a free tip.

    Args:
        model: of the arm.
        pull: tendon goals (n,), m, motors locked there.
        gravity: (3,), m/s^2, base axes.
        tension: measured (n,), N.
        sigma: one sigma of each (n,), N.
        prior: one sigma of the force in every direction before anything is read, N.
        payload: what the tip is known to carry.
        tip_rotation: R_at (3, 3) by an IMU on the end disk, when there is one.
        rotation_sigma: its one sigma about every axis, rad.
        start: a neighbouring solution.

    Raises:
        NoSolution: when the model has none on the way, or the estimate does not settle.
        LimitViolated: as `ArmModel.free`.
    """
    n = model.parameters.n
    read, spread = frozen(tension, (n,), "tension"), frozen(sigma, (n,), "sigma")
    force = np.zeros(3)
    solution = start
    for _ in range(_ITERATIONS):
        load = np.concatenate((force, np.zeros(3)))
        solution = model.free(pull, gravity, load, payload, start=solution)
        d = solution.derivatives
        J = d.tension[:, :3] / spread[:, None]
        off = (read - solution.tension) / spread
        if tip_rotation is not None:
            J = np.vstack((J, d.compliance[3:, :3] / rotation_sigma))
            off = np.concatenate((off, so3.log(tip_rotation @ solution.tip_rotation.T) / rotation_sigma))
        information = J.T @ J + np.eye(3) / prior**2
        step = np.linalg.solve(information, J.T @ off - force / prior**2)
        force = force + step
        if float(np.abs(step).max()) < _TOLERANCE * prior:
            return _estimate(force, information, prior, off, solution)
    raise NoSolution(float(np.abs(step).max()) / prior, "force at the tip")


def _estimate(force: Array, information: Array, prior: float, off: Array, solution: ArmSolution) -> TipForce:
    covariance = np.asarray(np.linalg.inv(information))
    variance, axes = (np.asarray(part) for part in np.linalg.eigh(covariance))  # smallest first: the best seen
    return TipForce(
        force=sealed(force),
        covariance=sealed(covariance),
        seen=sealed(1 - variance / prior**2),
        axes=sealed(axes.T.copy()),
        misfit=float(np.sqrt(off @ off / off.size)),
        solution=solution,
    )
