"""One check of bounds for all numbers that people give."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

import pytest

from needle_core.errors import OutOfBoundsError, UserError
from needle_core.settings.bounds import ABOVE_0, Bounds, check_bounded_fields, check_bounds


@dataclasses.dataclass(frozen=True)
class Settings:
    """Three numbers with bounds, and a text without."""

    width: Annotated[float, Bounds(ABOVE_0, math.inf, "m")] = 1.0
    gate: Annotated[float, Bounds(ABOVE_0, math.inf, "-", unlimited=True)] = math.inf
    noise: Annotated[float | None, Bounds(0.0, 5.0, "m")] = None
    name: str = ""


def test_what_is_within_its_bounds_passes() -> None:
    check_bounded_fields(Settings())
    check_bounded_fields(Settings(width=1e9, gate=3.0, noise=5.0))
    check_bounds("width", 0.0, 0.0, 1.0, "m")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (Settings(width=0.0), r"width = 0 m is outside"),
        (Settings(gate=-1.0), r"gate = -1 is outside"),
        (Settings(noise=5.1), r"noise = 5.1 m is outside \[0, 5\] m"),
        (Settings(noise=2147483648.0), r"noise = 2147483648 m is outside"),
        (Settings(noise=1e30), r"noise = 1e\+30 m is outside"),
    ],
)
def test_what_is_not_is_told_with_its_bounds(settings: Settings, said: str) -> None:
    with pytest.raises(OutOfBoundsError, match=said):
        check_bounded_fields(settings)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(UserError, match=f"width = {value} m is not finite"):
        check_bounded_fields(Settings(width=value))


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_where_infinity_counts_nothing_else_does(value: float) -> None:
    with pytest.raises(UserError, match=r"gate = .* is not finite"):
        check_bounded_fields(Settings(gate=value))
