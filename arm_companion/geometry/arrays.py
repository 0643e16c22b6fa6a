"""The array type of the mechanics, and arrays that a frozen dataclass may hold."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
"""Double-precision array; docstrings give shape, frame and unit."""

ArrayLike: TypeAlias = Array | Sequence[float] | Sequence[Sequence[float]]
"""What a caller may pass where an array is meant."""


def frozen(values: ArrayLike, shape: tuple[int, ...], name: str = "array") -> Array:
    """A read-only copy of `values`.

    Args:
        values: what to copy.
        shape: the shape it must have; -1 stands for any length.
        name: for the message.

    Raises:
        ValueError: for another shape, or an entry that is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.shape != shape:
        fits = len(shape) == array.ndim and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not all(map(math.isfinite, array.ravel().tolist())):
        raise ValueError(f"{name} has entries that are not finite: {array.tolist()}")
    array.flags.writeable = False
    return array


def sealed(array: Array) -> Array:
    """The same array, read-only from now on; for results that nobody else holds."""
    array.flags.writeable = False
    return array
