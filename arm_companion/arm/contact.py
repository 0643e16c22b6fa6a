"""Reasoning about contact: where what holds the arm is now, what the arm should exert, and whether it does.

A held tip makes the tendons nearly blind (a base move of a centimetre changes tension by a billionth of a newton
while the base feels several newtons), so the wrench of an anchored arm comes from how far the vehicle has moved
since contact, and what is measured serves to find contact and to doubt the prediction.
"""

import math
from dataclasses import dataclass

import numpy as np

from arm_companion.arm.model import ArmModel, ArmSolution, Hold
from arm_companion.arm.parameters import ArmParameters
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed
from arm_companion.geometry.se3 import Pose


@dataclass(frozen=True, eq=False)
class Contact:
    """Something of the world that holds the arm, and where the base was when it took hold.

    Attributes:
        hold: in the base axes of that moment.
        T_wa: base in the world at that moment.
    """

    hold: Hold
    T_wa: Pose

    def seen_from(self, T_wa: Pose) -> Hold:
        """The hold in the axes of a base that is now at `T_wa` in the world."""
        return self.hold.seen_from(T_wa.inverse() @ self.T_wa)

    def solve(
        self, model: ArmModel, pull: ArrayLike, T_wa: Pose, field_w: ArrayLike, start: ArmSolution | None = None
    ) -> ArmSolution:
        """The arm between a base that is now at `T_wa` and what holds it.

        Args:
            model: of the arm.
            pull: tendon goals (n,), m.
            T_wa: base in the world now.
            field_w: gravity less the vehicle's acceleration, world axes (3,), m/s^2.
            start: the solution of the cycle before.

        Raises:
            NoSolution: when there is no equilibrium.
            LimitViolated: when the base is farther away than the arm reaches.
        """
        field = T_wa.rotation.T @ np.asarray(field_w, dtype=np.float64)
        return model.held(pull, self.seen_from(T_wa), field, start=start)


@dataclass(frozen=True, eq=False)
class Residual:
    """Measured minus predicted.

    Attributes:
        value: (k,).
        sigma: one sigma of each entry (k,).
    """

    value: Array
    sigma: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", frozen(self.value, (-1,), "value"))
        object.__setattr__(self, "sigma", frozen(self.sigma, (-1,), "sigma"))

    @property
    def norm(self) -> float:
        """Length of the value."""
        return math.sqrt(float(self.value @ self.value))

    @property
    def significance(self) -> float:
        """How many sigma the whole is from zero: root of the mean of the squared ratios."""
        ratio = self.value / np.maximum(self.sigma, 1e-12)
        return math.sqrt(float(ratio @ ratio) / ratio.size)


def tendon_residual(
    parameters: ArmParameters, measured: ArrayLike, sigma: ArrayLike, predicted: ArmSolution
) -> Residual:
    """Bending moment (2,), N m, that the tendons report beyond what the model expects: H^T (tau - tau_model).

    Co-contraction drops out of it, and with it the common error of all load readings. For a free arm it tells of
    contact; for a clamped tip it stays near zero whatever the load.

    Args:
        parameters: the arm, one segment.
        measured: tension (n,), N.
        sigma: one sigma of each (n,), N.
        predicted: what the model expects without the contact in question.
    """
    H = parameters.H
    off = np.asarray(measured, dtype=np.float64) - predicted.tension
    spread = np.sqrt((H * H).T @ np.asarray(sigma, dtype=np.float64) ** 2)
    return Residual(H.T @ off, spread)


def airframe_force(mass: float, specific_force: ArrayLike, thrust: ArrayLike) -> Array:
    """Force (3,), N, body axes, that something besides rotors and gravity exerts on the airframe.

    Newton's law in the accelerometer's terms: F = m f - T, gravity being in neither.

    Args:
        mass: of the airframe without the arm, kg.
        specific_force: accelerometer reading, body axes (3,), m/s^2.
        thrust: of the rotors, body axes (3,), N.
    """
    return sealed(mass * np.asarray(specific_force, dtype=np.float64) - np.asarray(thrust, dtype=np.float64))


def force_residual(
    measured: ArrayLike, measured_sigma: ArrayLike, predicted: ArrayLike, predicted_sigma: ArrayLike
) -> Residual:
    """Force on the airframe (3,), N, as measured less as predicted, same axes; independent errors."""
    off = np.asarray(measured, dtype=np.float64) - np.asarray(predicted, dtype=np.float64)
    a, b = np.asarray(measured_sigma, dtype=np.float64), np.asarray(predicted_sigma, dtype=np.float64)
    return Residual(off, np.sqrt(a * a + b * b))
