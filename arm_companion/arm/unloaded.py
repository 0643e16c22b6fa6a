"""The arm without load and gravity, where every segment is an exact arc: what all models of it share."""

import numpy as np

from arm_companion.arm import arc, statics
from arm_companion.arm.parameters import ArmParameters
from arm_companion.errors import ConfigError
from arm_companion.geometry.arrays import Array, ArrayLike, sealed


class UnloadedArm:
    """The part of `ArmModel` that no load enters; see there for what the methods take and give."""

    def __init__(self, parameters: ArmParameters) -> None:
        self._parameters = parameters
        self._bends: dict[bytes, Array] = {}

    @property
    def parameters(self) -> ArmParameters:
        """The arm."""
        return self._parameters

    def pull_for_bend(self, bend: ArrayLike, pretension: float | None = None) -> Array:
        """See `ArmModel.pull_for_bend`."""
        return statics.pull_for_bend(self._parameters, bend, pretension)

    def pull_for_tension(self, bend: ArrayLike, tension: ArrayLike) -> Array:
        """See `ArmModel.pull_for_tension`."""
        return statics.pull_for_tension(self._parameters, bend, tension)

    def bend_for_pull(self, pull: ArrayLike) -> Array:
        """See `ArmModel.bend_for_pull`; the last answer is kept, for servos at rest tell the same again and again."""
        q = np.asarray(pull, dtype=np.float64)
        asked = q.tobytes()
        if asked not in self._bends:
            self._bends = {asked: sealed(statics.bend_for_pull(self._parameters, q))}
        return self._bends[asked]

    def bend_for_tip(self, p_tip_base: ArrayLike, tolerance: float | None = None) -> Array:
        """See `ArmModel.bend_for_tip`.

        Raises:
            ConfigError: for several segments, which reach most points in many ways.
        """
        if len(self._parameters.segments) != 1:
            raise ConfigError("the bend for a tip position is defined for one segment")
        L = self._parameters.L
        return arc.bend_for_tip(p_tip_base, L, 0.01 * L if tolerance is None else tolerance)
