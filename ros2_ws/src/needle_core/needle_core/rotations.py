"""Rotation matrices as the quaternions of messages."""

from __future__ import annotations

import math
from collections.abc import Sequence

from needle_core.messages import Quaternion


def quaternion_from_rotation(rotation: Sequence[Sequence[float]]) -> Quaternion:
    """Return the unit quaternion (x, y, z, w) of a rotation matrix, given as three rows.

    Of the four formulas the one with the largest divisor. scipy does the same, but takes a process
    that needs no more of it a quarter of a second to import.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    trace = xx + yy + zz
    _, (x, y, z, w) = max(
        (xx, (1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz)),
        (yy, (xy + yx, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx)),
        (zz, (xz + zx, yz + zy, 1.0 - trace + 2.0 * zz, yx - xy)),
        (trace, (zy - yz, xz - zx, yx - xy, 1.0 + trace)),
        key=lambda way: way[0],
    )
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / norm, y / norm, z / norm, w / norm)
