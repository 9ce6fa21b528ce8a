"""Bounds of numbers: one check for parameters, settings and options."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, get_type_hints

from needle_core.errors import OutOfBoundsError, UserError

ABOVE_0 = math.nextafter(0.0, 1.0)
"""The least number that is not 0: a lower bound."""


class Bounds(NamedTuple):
    """Range of a field of a settings class: `curvature: Annotated[float, Bounds(...)]`.

    Attributes
    ----------
    lower, upper : float
        Inclusive; where `upper` is infinite, the number may still not be, unless `unlimited`.
    unit : str
        "-" for none.
    unlimited : bool
        Whether infinity is a value.
    """

    lower: float
    upper: float
    unit: str
    unlimited: bool = False


def check_bounds(
    name: str, value: float, lower: float, upper: float, unit: str, *, unlimited: bool = False
) -> None:
    """Raise what names the value and the bound unless the value is finite and within bounds.

    Raises
    ------
    UserError
        A value that is not finite.
    OutOfBoundsError
        A value out of bounds.
    """
    if not math.isfinite(value) and not (unlimited and value == math.inf):
        raise UserError(f"{name} = {value}{'' if unit == '-' else f' {unit}'} is not finite")
    if not lower <= value <= upper:
        raise OutOfBoundsError(name, value, lower, upper, unit)


def check_bounded_fields(settings: Any) -> None:
    """Check every field that is annotated with `Bounds`, unless it is None."""
    for name, bounds in _bounded_fields(settings.__class__):
        value = getattr(settings, name)
        if value is not None:
            lower, upper, unit, unlimited = bounds
            check_bounds(name, float(value), lower, upper, unit, unlimited=unlimited)


@functools.cache
def _bounded_fields(settings_class: type) -> list[tuple[str, Bounds]]:
    return [
        (name, bounds)
        for name, hint in get_type_hints(settings_class, include_extras=True).items()
        for bounds in getattr(hint, "__metadata__", ())
        if isinstance(bounds, Bounds)
    ]
