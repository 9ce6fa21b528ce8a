"""The distance of two segments, compiled."""

from __future__ import annotations

import math

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

_POINT = 1e-18
"""Square of a length below which a segment counts as a point [m^2]."""


@compiled
def segment_distance(first: Array, second: Array, third: Array, fourth: Array) -> float:
    """Return the least distance between the segments first-second and third-fourth [m].

    Parameters
    ----------
    first, second, third, fourth : ndarray, shape (>= 3,)
        Their ends, of which the first three numbers count [m].
    """
    d1x, d1y, d1z = second[0] - first[0], second[1] - first[1], second[2] - first[2]
    d2x, d2y, d2z = fourth[0] - third[0], fourth[1] - third[1], fourth[2] - third[2]
    rx, ry, rz = first[0] - third[0], first[1] - third[1], first[2] - third[2]
    a = d1x * d1x + d1y * d1y + d1z * d1z
    e = d2x * d2x + d2y * d2y + d2z * d2z
    b = d1x * d2x + d1y * d2y + d1z * d2z
    c = d1x * rx + d1y * ry + d1z * rz
    f = d2x * rx + d2y * ry + d2z * rz
    # Where the lines are nearest, then back into the segments, one after the other.
    s = 0.0
    if a > _POINT:
        determinant = a * e - b * b
        if determinant > 1e-12 * a * e:
            s = min(max((b * f - c * e) / determinant, 0.0), 1.0)
        elif e <= _POINT:
            s = min(max(-c / a, 0.0), 1.0)
    t = 0.0
    if e > _POINT:
        t = (b * s + f) / e
        clipped = min(max(t, 0.0), 1.0)
        if clipped != t or a <= _POINT:
            t = clipped
            if a > _POINT:
                s = min(max((b * t - c) / a, 0.0), 1.0)
    x, y, z = rx + d1x * s - d2x * t, ry + d1y * s - d2y * t, rz + d1z * s - d2z * t
    return math.sqrt(x * x + y * y + z * z)
