"""What a bank of estimates starts from: hypotheses of torsion and of the roll at the entry."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from needle_common.errors import OutOfBoundsError, UserError


@dataclasses.dataclass(frozen=True)
class TorsionHypothesis:
    """How the shaft's torsion may be; its size is then estimated: the lag length, or the play.

    Attributes
    ----------
    play : float
        Half width of the dead band between base and tip [rad].
    lag_length : float
        Inserted length over which the tip follows [m]; 0 is none.
    size_std : float
        How well the size is known: of the lag length [m] if there is one, else of the play [rad].
    weight : float
        Prior weight, relative to the others'.
    """

    play: float
    lag_length: float
    size_std: float
    weight: float

    def __post_init__(self) -> None:
        """Check every field; raises OutOfBoundsError."""
        check_bounds("play", self.play, 0.0, math.pi, "rad")
        check_bounds("lag_length", self.lag_length, 0.0, 0.1, "m")
        check_bounds("size_std", self.size_std, 0.0, math.pi, "m or rad")
        check_bounds("weight", self.weight, 1e-9, 1e9, "-")


@dataclasses.dataclass(frozen=True)
class RollHypothesis:
    """How the tip may be turned at the entry, against where the base's rotation puts it.

    Attributes
    ----------
    roll : float
        Its mean [rad].
    std : float
        Its standard deviation [rad].
    weight : float
        Prior weight, relative to the others'.
    """

    roll: float
    std: float
    weight: float

    def __post_init__(self) -> None:
        """Check every field; raises OutOfBoundsError."""
        check_bounds("roll", self.roll, -math.pi, math.pi, "rad")
        check_bounds("std", self.std, 1e-6, math.pi, "rad")
        check_bounds("weight", self.weight, 1e-9, 1e9, "-")


def check_bounds(name: str, value: float, lower: float, upper: float, unit: str) -> None:
    """Raise what names the value and the bound unless lower <= value <= upper.

    Raises
    ------
    UserError
        A value that is not finite.
    OutOfBoundsError
        A value out of bounds.
    """
    if not math.isfinite(value):
        raise UserError(f"{name} = {value} {unit} is not finite")
    if not lower <= value <= upper:
        raise OutOfBoundsError(name, value, lower, upper, unit)


def bounded(default: Any, lower: float, upper: float, unit: str) -> Any:
    """Declare a number of a settings dataclass with its bounds, for `check_bounded_fields`."""
    return dataclasses.field(default=default, metadata={"bounds": (lower, upper, unit)})


def check_bounded_fields(settings: Any) -> None:
    """Check every field declared with `bounded`; raises as `check_bounds` does."""
    for field in dataclasses.fields(settings):
        if "bounds" in field.metadata:
            check_bounds(field.name, getattr(settings, field.name), *field.metadata["bounds"])
