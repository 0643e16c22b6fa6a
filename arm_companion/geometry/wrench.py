"""Wrenches [force; torque] and twists [linear; angular], (6,) each, and how they change point and frame."""

import functools

import numpy as np

from arm_companion.geometry import so3
from arm_companion.geometry.arrays import Array, ArrayLike, sealed
from arm_companion.geometry.se3 import Pose


def at_point(wrench: ArrayLike, offset: ArrayLike) -> Array:
    """The same wrench (6,) with its torque about another point.

    Args:
        wrench: [N; N m] about point A.
        offset: (3,) from the new point to A, m, same axes.
    """
    w = np.array(wrench, dtype=np.float64)
    w[3:] += so3.cross(offset, w[:3])
    return w


def rotated(wrench: ArrayLike, R_ab: Array) -> Array:
    """Components in axes a of a wrench or twist (6,) given in axes b; the point stays."""
    w = np.asarray(wrench, dtype=np.float64)
    return np.concatenate((R_ab @ w[:3], R_ab @ w[3:]))


def transformed(wrench: ArrayLike, T_ab: Pose) -> Array:
    """The wrench (6,) about a's origin in a's axes, from the wrench about b's origin in b's axes."""
    return at_point(rotated(wrench, T_ab.rotation), T_ab.position)


@functools.lru_cache(maxsize=4)  # a mount never moves
def transform_matrix(T_ab: Pose) -> Array:
    """X (6, 6) with X @ w_b = transformed(w_b, T_ab); its transpose maps twists of a to twists of b."""
    X = np.zeros((6, 6))
    R = T_ab.rotation
    X[:3, :3] = R
    X[3:, 3:] = R
    X[3:, :3] = so3.hat(T_ab.position) @ R
    return sealed(X)


@functools.lru_cache(maxsize=4)
def rotation_matrix(T_ab: Pose) -> Array:
    """X (6, 6) with X @ w_b = rotated(w_b, R_ab), of wrenches and of twists."""
    return sealed(np.asarray(np.kron(np.eye(2), T_ab.rotation), dtype=np.float64))
