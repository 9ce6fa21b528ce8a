"""Products of two vectors in space, inlined into compiled loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import inlined

Array = NDArray[np.float64]


@inlined
def cross(one: Array, other: Array, result: Array) -> None:
    """Write the cross product of two vectors, shape (3,)."""
    result[0] = one[1] * other[2] - one[2] * other[1]
    result[1] = one[2] * other[0] - one[0] * other[2]
    result[2] = one[0] * other[1] - one[1] * other[0]


@inlined
def dot(one: Array, other: Array) -> float:
    """Return the scalar product of two vectors, shape (3,)."""
    product: float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product
