"""Bounds of numbers: one check for parameters, settings and command-line options."""

from __future__ import annotations

import math

from needle_core.errors import OutOfBoundsError, UserError

ABOVE_0 = math.nextafter(0.0, 1.0)
"""Smallest positive number, used to exclude 0 itself from a range."""


def check_bounds(
    name: str, value: float, lower: float, upper: float, unit: str, *, unlimited: bool = False
) -> None:
    """Check that a value is finite and within its bounds.

    Raises
    ------
    UserError
        If the value is not finite.
    OutOfBoundsError
        If the value is out of bounds.
    """
    if not math.isfinite(value) and not (unlimited and value == math.inf):
        raise UserError(f"{name} = {value}{'' if unit == '-' else f' {unit}'} is not finite")
    if not lower <= value <= upper:
        raise OutOfBoundsError(name, value, lower, upper, unit)
