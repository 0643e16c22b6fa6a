"""Poses: where one frame stands in another."""

from dataclasses import dataclass
from typing import overload

import numpy as np

from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, ArrayLike, frozen, sealed

_ORTHOGONAL = 1e-6  # allowed departure of R^T R from the identity


@dataclass(frozen=True, eq=False)
class Pose:
    """T_ab: frame b as seen from frame a; `T_ab @ p_b` is p_a, `T_ab @ T_bc` is T_ac.

    Attributes:
        rotation: R_ab (3, 3), proper orthogonal; its columns are the axes of b in a.
        position: origin of b in a (3,), m.

    Raises:
        ValueError: when `rotation` is not a rotation.
    """

    rotation: Array
    position: Array

    def __post_init__(self) -> None:
        R = frozen(self.rotation, (3, 3), "rotation")
        if not so3.is_rotation(R, _ORTHOGONAL):
            raise ValueError(f"not a rotation: {R.tolist()}")
        object.__setattr__(self, "rotation", R)
        object.__setattr__(self, "position", frozen(self.position, (3,), "position"))

    @classmethod
    def identity(cls) -> "Pose":
        """Frame b on frame a."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def of_quaternion(cls, quaternion: ArrayLike, position: ArrayLike) -> "Pose":
        """From (w, x, y, z), which turns a's axes into b's, and b's origin in a."""
        return cls(so3.from_quaternion(quaternion), np.asarray(position, dtype=np.float64))

    @overload
    def __matmul__(self, other: "Pose") -> "Pose": ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other: "Pose | Array") -> "Pose | Array":
        """T_ab @ T_bc -> T_ac; T_ab @ points in b (..., 3) -> points in a (..., 3)."""
        if isinstance(other, Pose):
            return _sound(self.rotation @ other.rotation, self.rotation @ other.position + self.position)
        return np.asarray(other @ self.rotation.T + self.position)

    def inverse(self) -> "Pose":
        """T_ba."""
        return _sound(self.rotation.T, -self.rotation.T @ self.position)

    def matrix(self) -> Array:
        """Homogeneous matrix (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.rotation
        T[:3, 3] = self.position
        return T

    def moved(self, twist: ArrayLike) -> "Pose":
        """The pose after b moved by a small twist [m; rad] (6,) in a's axes, turning about b's own origin."""
        xi = np.asarray(twist, dtype=np.float64)
        return Pose(so3.exp(xi[3:]) @ self.rotation, self.position + xi[:3])

    def difference(self, other: "Pose") -> Array:
        """The twist (6,) that `moved` would need to bring this pose to `other`."""
        return np.concatenate((other.position - self.position, so3.log(other.rotation @ self.rotation.T)))


def _sound(rotation: Array, position: Array) -> Pose:
    """A pose that follows from poses, and so needs no check; the arrays become its own."""
    pose = object.__new__(Pose)
    object.__setattr__(pose, "rotation", sealed(rotation))
    object.__setattr__(pose, "position", sealed(position))
    return pose
