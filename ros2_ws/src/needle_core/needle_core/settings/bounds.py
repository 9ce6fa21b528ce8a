"""Bounds of numbers: one check for parameters, settings and command-line options."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, get_type_hints

from needle_core.errors import OutOfBoundsError, UserError

ABOVE_0 = math.nextafter(0.0, 1.0)
"""Smallest positive number, used to exclude 0 itself from a range."""


class Bounds(NamedTuple):
    """Range of a field of a settings class: `curvature: Annotated[float, Bounds(...)]`.

    Attributes
    ----------
    lower, upper : float
        Inclusive bounds; an infinite value is rejected even if `upper` is infinite.
    unit : str
        Unit of the field, "-" for none.
    """

    lower: float
    upper: float
    unit: str


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


def check_bounded_fields(settings: Any) -> None:
    """Check every field annotated with `Bounds`, unless it is None."""
    for name, bounds in _bounded_fields(settings.__class__):
        value = getattr(settings, name)
        if value is not None:
            check_bounds(name, float(value), *bounds)


@functools.cache
def _bounded_fields(settings_class: type) -> list[tuple[str, Bounds]]:
    return [
        (name, bounds)
        for name, hint in get_type_hints(settings_class, include_extras=True).items()
        for bounds in getattr(hint, "__metadata__", ())
        if isinstance(bounds, Bounds)
    ]
