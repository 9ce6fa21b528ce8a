"""Unit quaternions, as in ROS messages, and rotation matrices.

Importing scipy for them would cost each process a quarter of a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from needle_core.messages import Quaternion


def rotation_from_quaternion(quaternion: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the (3, 3) rotation matrix of a unit quaternion (x, y, z, w)."""
    x, y, z, w = np.asarray(quaternion, dtype=float)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def received_rotation(quaternion: Quaternion) -> npt.NDArray[np.float64] | None:
    """Return the (3, 3) rotation matrix of a received orientation.

    A norm between 0.5 and 2 is corrected to 1; others give None, such as 0 of an unset orientation.
    """
    # Unlike numpy.linalg.norm, it does not overflow.
    norm = math.hypot(*quaternion)
    return rotation_from_quaternion(np.asarray(quaternion) / norm) if 0.5 < norm < 2.0 else None


def quaternion_from_rotation(rotation: Sequence[Sequence[float]]) -> Quaternion:
    """Return the unit quaternion (x, y, z, w) of a rotation matrix, given as three rows.

    Like scipy, it uses the one of four formulas with the largest divisor.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    trace = xx + yy + zz
    _, (x, y, z, w) = max(
        (xx, (1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz)),
        (yy, (xy + yx, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx)),
        (zz, (xz + zx, yz + zy, 1.0 - trace + 2.0 * zz, yx - xy)),
        (trace, (zy - yz, xz - zx, yx - xy, 1.0 + trace)),
        key=lambda candidate: candidate[0],
    )
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / norm, y / norm, z / norm, w / norm)
