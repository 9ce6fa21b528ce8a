"""One insertion on SE(3) with what it does to an estimate's covariance; compiled.

The tip moves by T <- T exp((V1 dl + V2 dtheta)^), [KC09] (2). Blocks and the order of the error are
those of `hypothesis_lanes`. In its axes the transition differs from the identity in a 3 x 3 block
and three columns only, which `propagate` makes use of.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

from needle_common.compiled import compiled, inlined
from needle_controller.bank.hypothesis_lanes import (
    BEHIND_PLAY,
    KAPPA,
    LAG,
    LANES,
    P00,
    P10,
    P11,
    P20,
    P21,
    P22,
    P30,
    P31,
    P32,
    P33,
    P40,
    P41,
    P42,
    P43,
    P44,
    P50,
    P51,
    P52,
    P53,
    P54,
    P55,
    P60,
    P61,
    P62,
    P63,
    P64,
    P65,
    P66,
    P70,
    P71,
    P72,
    P73,
    P74,
    P75,
    P76,
    P77,
    PER_SIZE,
    PLAY,
    R00,
    R01,
    R02,
    R10,
    R11,
    R12,
    R20,
    R21,
    R22,
    TIP_ANGLE,
    X,
    Y,
    Z,
)
from needle_controller.bank.torsion_model import turn_tip
from needle_controller.model.arrays import Array

Vector = tuple[float, float, float]
LARGEST_TURN = 1.0
"""Most that an advance may turn the base at once [rad]; larger ones are to be divided."""


@inlined
def rotation_factors(squared: float) -> tuple[float, float, float]:
    """Return sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 of a^2: Rodrigues' formula's factors.

    Series, right to 5e-8 of themselves up to a = 2.
    """
    q = squared
    first = 1.0 - q / 72.0 * (1.0 - q / 110.0 * (1.0 - q / 156.0))
    first = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * first))
    second = 1.0 - q / 90.0 * (1.0 - q / 132.0 * (1.0 - q / 182.0))
    second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * second)))
    third = 1.0 - q / 110.0 * (1.0 - q / 156.0 * (1.0 - q / 210.0))
    third = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * third))) / 6.0
    return first, second, third


@inlined
def _dot(a: float, b: float, c: float, x: float, y: float, z: float) -> float:
    return a * x + b * y + c * z


@inlined
def _across(first: float, second: float, a: float, b: float, by_curvature: float) -> float:
    return first * a - second * b + by_curvature


@compiled
def move(
    block: Array,
    base: float,
    turn: float,
    length: float,
    orientation_noise: float,
    curvature_noise: float,
    play_noise: float,
    lag_noise: float,
) -> None:
    """Move a block's tips by what the base did, and their covariances: P <- F P F^T + Q.

    The poses move exactly; how they depend on the curvature is right up to (kappa length)^2.

    Parameters
    ----------
    block : ndarray, shape (BLOCK,), changed
        Eight estimates.
    base, turn : float
        Angle of the base before, and how far it turns [rad], at most `LARGEST_TURN`.
    length : float
        Inserted length [m].
    orientation_noise, curvature_noise : float
        Variances added over this length [rad^2], [1/m^2].
    play_noise, lag_noise : float
        Variances added to sizes of torsions that are not known exactly [rad^2], [m^2].
    """
    for h in range(LANES):
        tip, behind, per_size = turn_tip(
            block[TIP_ANGLE + h],
            block[BEHIND_PLAY + h],
            block[PER_SIZE + h],
            base,
            turn,
            length,
            block[PLAY + h],
            block[LAG + h],
        )
        heading, by_kappa, shift_by_kappa = _move_pose(block, h, length, tip - block[TIP_ANGLE + h])
        _propagate_position(block, h, length, heading, shift_by_kappa)
        _propagate_orientation(block, h, per_size - block[PER_SIZE + h], heading, by_kappa)
        block[P33 + h] += orientation_noise
        block[P44 + h] += orientation_noise
        block[P55 + h] += orientation_noise
        block[P66 + h] += curvature_noise
        size_noise = lag_noise if block[LAG + h] > 0.0 else play_noise
        block[P77 + h] += size_noise if block[P77 + h] > 0.0 else 0.0
        block[TIP_ANGLE + h] = tip
        block[BEHIND_PLAY + h] = behind
        block[PER_SIZE + h] = per_size


@inlined
def _move_pose(p: Array, h: int, length: float, turn: float) -> tuple[Vector, Vector, Vector]:
    """Move one pose; return the mean heading, and what orientation and position change with kappa.

    The position moves by length times the mean heading, and one more radian of turn turns the tip
    by it.
    """
    squared = length * length
    x, z = p[KAPPA + h] * length, turn
    a, b, c = rotation_factors(x * x + z * z)
    # In the tip's axes.
    d0, d1, d2 = c * x * z, -b * x, 1.0 - c * x * x
    o0, o1, o2 = length * (1.0 - c * z * z), length * b * z, length * c * x * z
    q0, q1, q2 = squared * c * z, -squared * b, -2.0 * squared * c * x
    # exp((x, 0, z)^).
    e00, e01, e02 = 1.0 - b * z * z, -a * z, b * x * z
    e10, e11, e12 = a * z, 1.0 - b * (x * x + z * z), -a * x
    e20, e21, e22 = b * x * z, a * x, 1.0 - b * x * x
    r0, r1, r2 = p[R00 + h], p[R01 + h], p[R02 + h]
    heading_x, by_kappa_x = _dot(r0, r1, r2, d0, d1, d2), _dot(r0, r1, r2, o0, o1, o2)
    shift_x = _dot(r0, r1, r2, q0, q1, q2)
    p[R00 + h] = _dot(r0, r1, r2, e00, e10, e20)
    p[R01 + h] = _dot(r0, r1, r2, e01, e11, e21)
    p[R02 + h] = _dot(r0, r1, r2, e02, e12, e22)
    r0, r1, r2 = p[R10 + h], p[R11 + h], p[R12 + h]
    heading_y, by_kappa_y = _dot(r0, r1, r2, d0, d1, d2), _dot(r0, r1, r2, o0, o1, o2)
    shift_y = _dot(r0, r1, r2, q0, q1, q2)
    p[R10 + h] = _dot(r0, r1, r2, e00, e10, e20)
    p[R11 + h] = _dot(r0, r1, r2, e01, e11, e21)
    p[R12 + h] = _dot(r0, r1, r2, e02, e12, e22)
    r0, r1, r2 = p[R20 + h], p[R21 + h], p[R22 + h]
    heading_z, by_kappa_z = _dot(r0, r1, r2, d0, d1, d2), _dot(r0, r1, r2, o0, o1, o2)
    shift_z = _dot(r0, r1, r2, q0, q1, q2)
    p[R20 + h] = _dot(r0, r1, r2, e00, e10, e20)
    p[R21 + h] = _dot(r0, r1, r2, e01, e11, e21)
    p[R22 + h] = _dot(r0, r1, r2, e02, e12, e22)
    p[X + h] += length * heading_x
    p[Y + h] += length * heading_y
    p[Z + h] += length * heading_z
    heading = heading_x, heading_y, heading_z
    return heading, (by_kappa_x, by_kappa_y, by_kappa_z), (shift_x, shift_y, shift_z)


@inlined
def _propagate_position(
    p: Array, h: int, length: float, heading: Vector, shift_by_kappa: Vector
) -> None:
    """Carry the rows and columns of position: a turn w of the start moves the end by w x s."""
    s0, s1, s2 = length * heading[0], length * heading[1], length * heading[2]
    g0, g1, g2 = shift_by_kappa
    p33, p43, p44 = p[P33 + h], p[P43 + h], p[P44 + h]
    p53, p54, p55 = p[P53 + h], p[P54 + h], p[P55 + h]
    p63, p64, p65, p66 = p[P63 + h], p[P64 + h], p[P65 + h], p[P66 + h]
    p73, p74, p75, p76 = p[P73 + h], p[P74 + h], p[P75 + h], p[P76 + h]
    p30, p40, p50, p60 = p[P30 + h], p[P40 + h], p[P50 + h], p[P60 + h]
    p31, p41, p51, p61 = p[P31 + h], p[P41 + h], p[P51 + h], p[P61 + h]
    p32, p42, p52, p62 = p[P32 + h], p[P42 + h], p[P52 + h], p[P62 + h]
    # With columns of orientation, curvature and torsion: by what these have with each other.
    n30 = p30 + _across(p43, p53, s2, s1, g0 * p63)
    n40 = p40 + _across(p44, p54, s2, s1, g0 * p64)
    n50 = p50 + _across(p54, p55, s2, s1, g0 * p65)
    n60 = p60 + _across(p64, p65, s2, s1, g0 * p66)
    n31 = p31 + _across(p53, p33, s0, s2, g1 * p63)
    n41 = p41 + _across(p54, p43, s0, s2, g1 * p64)
    n51 = p51 + _across(p55, p53, s0, s2, g1 * p65)
    n61 = p61 + _across(p65, p63, s0, s2, g1 * p66)
    n32 = p32 + _across(p33, p43, s1, s0, g2 * p63)
    n42 = p42 + _across(p43, p44, s1, s0, g2 * p64)
    n52 = p52 + _across(p53, p54, s1, s0, g2 * p65)
    n62 = p62 + _across(p63, p64, s1, s0, g2 * p66)
    p[P00 + h] += _across(p40 + n40, p50 + n50, s2, s1, g0 * (p60 + n60))
    p[P10 + h] += _across(p50, p30, s0, s2, g1 * p60) + _across(n41, n51, s2, s1, g0 * n61)
    p[P11 + h] += _across(p51 + n51, p31 + n31, s0, s2, g1 * (p61 + n61))
    p[P20 + h] += _across(p30, p40, s1, s0, g2 * p60) + _across(n42, n52, s2, s1, g0 * n62)
    p[P21 + h] += _across(p31, p41, s1, s0, g2 * p61) + _across(n52, n32, s0, s2, g1 * n62)
    p[P22 + h] += _across(p32 + n32, p42 + n42, s1, s0, g2 * (p62 + n62))
    p[P30 + h], p[P40 + h], p[P50 + h], p[P60 + h] = n30, n40, n50, n60
    p[P31 + h], p[P41 + h], p[P51 + h], p[P61 + h] = n31, n41, n51, n61
    p[P32 + h], p[P42 + h], p[P52 + h], p[P62 + h] = n32, n42, n52, n62
    p[P70 + h] += _across(p74, p75, s2, s1, g0 * p76)
    p[P71 + h] += _across(p75, p73, s0, s2, g1 * p76)
    p[P72 + h] += _across(p73, p74, s1, s0, g2 * p76)


@inlined
def _propagate_orientation(
    p: Array, h: int, turn_per_size: float, heading: Vector, by_kappa: Vector
) -> None:
    """Carry those of orientation: by the curvature, and about the heading by the torsion's size."""
    a0, a1, a2 = by_kappa
    b0, b1, b2 = turn_per_size * heading[0], turn_per_size * heading[1], turn_per_size * heading[2]
    p60, p61, p62 = p[P60 + h], p[P61 + h], p[P62 + h]
    p70, p71, p72 = p[P70 + h], p[P71 + h], p[P72 + h]
    p[P30 + h] += a0 * p60 + b0 * p70
    p[P40 + h] += a1 * p60 + b1 * p70
    p[P50 + h] += a2 * p60 + b2 * p70
    p[P31 + h] += a0 * p61 + b0 * p71
    p[P41 + h] += a1 * p61 + b1 * p71
    p[P51 + h] += a2 * p61 + b2 * p71
    p[P32 + h] += a0 * p62 + b0 * p72
    p[P42 + h] += a1 * p62 + b1 * p72
    p[P52 + h] += a2 * p62 + b2 * p72
    p63, p64, p65, p66 = p[P63 + h], p[P64 + h], p[P65 + h], p[P66 + h]
    p73, p74, p75, p76 = p[P73 + h], p[P74 + h], p[P75 + h], p[P76 + h]
    n63, n73 = p63 + a0 * p66 + b0 * p76, p73 + a0 * p76 + b0 * p[P77 + h]
    n64, n74 = p64 + a1 * p66 + b1 * p76, p74 + a1 * p76 + b1 * p[P77 + h]
    n65, n75 = p65 + a2 * p66 + b2 * p76, p75 + a2 * p76 + b2 * p[P77 + h]
    p[P33 + h] += a0 * (p63 + n63) + b0 * (p73 + n73)
    p[P43 + h] += a0 * p64 + b0 * p74 + a1 * n63 + b1 * n73
    p[P44 + h] += a1 * (p64 + n64) + b1 * (p74 + n74)
    p[P53 + h] += a0 * p65 + b0 * p75 + a2 * n63 + b2 * n73
    p[P54 + h] += a1 * p65 + b1 * p75 + a2 * n64 + b2 * n74
    p[P55 + h] += a2 * (p65 + n65) + b2 * (p75 + n75)
    p[P63 + h], p[P64 + h], p[P65 + h] = n63, n64, n65
    p[P73 + h], p[P74 + h], p[P75 + h] = n73, n74, n75
