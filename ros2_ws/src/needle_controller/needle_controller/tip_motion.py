"""One insertion on SE(3) with what it does to an estimate's covariance; compiled.

The tip moves by T <- T exp((V1 dl + V2 dtheta)^), [KC09] (2). Errors are ordered as in `ERROR`:
position and a rotation vector, both along the axes of `target_plane` (the true rotation is
exp(error) R), then the curvature and the size of the torsion. In these axes the transition differs
from the identity in a 3 x 3 block and three columns only, which `propagate` makes use of.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

from needle_common.compiled import compiled
from needle_controller.arrays import Array

POSITION, ORIENTATION, CURVATURE, TORSION = 0, 3, 6, 7
"""Where the parts of the error begin."""
ERROR = 8
"""Length of the error."""
_SERIES_BELOW = 0.5


@compiled
def rotation_factors(squared: float) -> tuple[float, float, float]:
    """Return sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 of a^2: Rodrigues' formula's factors."""
    if squared < _SERIES_BELOW:
        q = squared
        first = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0)))
        second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (1.0 - q / 90.0))))
        third = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (1.0 - q / 110.0)))) / 6.0
        return first, second, third
    angle = math.sqrt(squared)
    first = math.sin(angle) / angle
    return first, (1.0 - math.cos(angle)) / squared, (1.0 - first) / squared


@compiled
def rotate(rotation: Array, x: float, y: float, z: float) -> None:
    """Turn an orientation in place: R <- exp((x, y, z)^) R, the axes being `target_plane`'s."""
    a, b, _ = rotation_factors(x * x + y * y + z * z)
    e00, e01, e02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    e10, e11, e12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    e20, e21, e22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for j in range(3):
        r0, r1, r2 = rotation[0, j], rotation[1, j], rotation[2, j]
        rotation[0, j] = e00 * r0 + e01 * r1 + e02 * r2
        rotation[1, j] = e10 * r0 + e11 * r1 + e12 * r2
        rotation[2, j] = e20 * r0 + e21 * r1 + e22 * r2


@compiled
def move(
    position: Array,
    rotation: Array,
    curvature: float,
    length: float,
    turn: float,
    sensitivity: Array,
) -> None:
    """Move a tip in place, exactly, and say how the result depends on what went in.

    Parameters
    ----------
    position : ndarray, shape (3,)
        The tip [m].
    rotation : ndarray, shape (3, 3)
        Its orientation.
    curvature : float
        kappa [1/m].
    length, turn : float
        Inserted length [m] and rotation of the tip about its axis over it [rad].
    sensitivity : ndarray, shape (9,), written
        The mean heading d: the position moves by length d, and one more radian of turn turns the
        tip by d; then the changes of orientation and of position with the curvature. Their error is
        of the order of (kappa length)^2.
    """
    x = curvature * length
    z = turn
    a, b, c = rotation_factors(x * x + z * z)
    d0, d1, d2 = c * x * z, -b * x, 1.0 - c * x * x
    o0, o1, o2 = length * (1.0 - c * z * z), length * b * z, length * c * x * z
    squared = length * length
    p0, p1, p2 = squared * c * z, -squared * b, -2.0 * squared * c * x
    # exp((x, 0, z)^).
    e00, e01, e02 = 1.0 - b * z * z, -a * z, b * x * z
    e10, e11, e12 = a * z, 1.0 - b * (x * x + z * z), -a * x
    e20, e21, e22 = b * x * z, a * x, 1.0 - b * x * x
    for i in range(3):
        r0, r1, r2 = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        heading = r0 * d0 + r1 * d1 + r2 * d2
        sensitivity[i] = heading
        sensitivity[3 + i] = r0 * o0 + r1 * o1 + r2 * o2
        sensitivity[6 + i] = r0 * p0 + r1 * p1 + r2 * p2
        position[i] += length * heading
        rotation[i, 0] = r0 * e00 + r1 * e10 + r2 * e20
        rotation[i, 1] = r0 * e01 + r1 * e11 + r2 * e21
        rotation[i, 2] = r0 * e02 + r1 * e12 + r2 * e22


@compiled
def propagate(
    covariance: Array,
    sensitivity: Array,
    length: float,
    turn_per_torsion: float,
    orientation_noise: float,
    curvature_noise: float,
) -> None:
    """Carry a covariance over a `move`, in place: P <- F P F^T + Q.

    Parameters
    ----------
    covariance : ndarray, shape (8, 8)
        Covariance of the error, symmetric.
    sensitivity : ndarray, shape (9,)
        As `move` left it.
    length : float
        Inserted length [m].
    turn_per_torsion : float
        Change of the tip's turn with the torsion's size: [rad/rad] for play, [rad/m] for lag.
    orientation_noise, curvature_noise : float
        Variances added over this length [rad^2], [1/m^2].
    """
    p = covariance
    s0, s1, s2 = length * sensitivity[0], length * sensitivity[1], length * sensitivity[2]
    a0, a1, a2 = sensitivity[3], sensitivity[4], sensitivity[5]
    g0, g1, g2 = sensitivity[6], sensitivity[7], sensitivity[8]
    b0, b1, b2 = (
        turn_per_torsion * sensitivity[0],
        turn_per_torsion * sensitivity[1],
        turn_per_torsion * sensitivity[2],
    )
    # Rows: position (which takes the old orientation), then orientation; then the same of columns.
    # A turn w of the tip moves the end of the step by w x s.
    for j in range(8):
        o0, o1, o2, k, t = p[3, j], p[4, j], p[5, j], p[6, j], p[7, j]
        p[0, j] += o1 * s2 - o2 * s1 + g0 * k
        p[1, j] += o2 * s0 - o0 * s2 + g1 * k
        p[2, j] += o0 * s1 - o1 * s0 + g2 * k
        p[3, j] = o0 + a0 * k + b0 * t
        p[4, j] = o1 + a1 * k + b1 * t
        p[5, j] = o2 + a2 * k + b2 * t
    for i in range(8):
        o0, o1, o2, k, t = p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7]
        p[i, 0] += o1 * s2 - o2 * s1 + g0 * k
        p[i, 1] += o2 * s0 - o0 * s2 + g1 * k
        p[i, 2] += o0 * s1 - o1 * s0 + g2 * k
        p[i, 3] = o0 + a0 * k + b0 * t
        p[i, 4] = o1 + a1 * k + b1 * t
        p[i, 5] = o2 + a2 * k + b2 * t
    p[3, 3] += orientation_noise
    p[4, 4] += orientation_noise
    p[5, 5] += orientation_noise
    p[6, 6] += curvature_noise
