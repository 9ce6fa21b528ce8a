"""Hypotheses from which a bank of estimates starts: torsion, and roll at the entry."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

from needle_controller.filter.records import NOISES
from needle_core.errors import UserError
from needle_core.settings.bounds import Bounds, check_bounded_fields

# Read by compiled code.
PLAY, LAG, GAIN = range(3)
"""Sizes of a torsion, of which each hypothesis estimates one."""


@dataclasses.dataclass(frozen=True)
class TorsionHypothesis:
    """One model of how the tip's roll follows the base; its size is then estimated.

    Attributes
    ----------
    play : float
        Half width of the dead band between base and tip [rad].
    lag_length : float
        Inserted length over which the tip follows [m]; 0 is none.
    size_std : float
        How well the size is known: of the lag length [m] if there is one, else of the play [rad];
        without either, of the share of the base's rotation that reaches the tip, about 1.
    weight : float
        Prior weight, relative to the others'.
    heading_drift, roll_drift : float
        Growth of the standard deviations of pitch and yaw, and of the roll, over a metre: how far
        the tip turns by itself [rad/sqrt(m)].
    """

    play: Annotated[float, Bounds(0.0, math.pi, "rad")]
    lag_length: Annotated[float, Bounds(0.0, 0.1, "m")]
    size_std: Annotated[float, Bounds(0.0, math.pi, "m or rad")]
    weight: Annotated[float, Bounds(1e-9, 1e9, "-")]
    heading_drift: Annotated[float, Bounds(0.0, 100.0, "rad/sqrt(m)")] = 0.05
    roll_drift: Annotated[float, Bounds(0.0, 100.0, "rad/sqrt(m)")] = 0.05

    def __post_init__(self) -> None:
        """Check every field; raises OutOfBoundsError."""
        check_bounded_fields(self)

    @property
    def sized(self) -> int:
        """Which size is estimated: `PLAY`, `LAG` or `GAIN`."""
        if self.lag_length > 0.0:
            return LAG
        return PLAY if self.play > 0.0 else GAIN


@dataclasses.dataclass(frozen=True)
class RollHypothesis:
    """Possible roll of the tip at the entry, against where the base's rotation puts it.

    Attributes
    ----------
    roll : float
        Its mean [rad].
    std : float
        Its standard deviation [rad].
    weight : float
        Prior weight, relative to the others'.
    """

    roll: Annotated[float, Bounds(-math.pi, math.pi, "rad")]
    std: Annotated[float, Bounds(1e-6, math.pi, "rad")]
    weight: Annotated[float, Bounds(1e-9, 1e9, "-")]

    def __post_init__(self) -> None:
        """Check every field; raises OutOfBoundsError."""
        check_bounded_fields(self)


# Read by compiled code.
NORMAL, UNIFORM, LASTING = range(3)
"""Shapes of noise: normal or uniform within a bound, the same in all coordinates and new with each
tip; or normal, of each coordinate's own size, and such that errors may last from tip to tip."""


@dataclasses.dataclass(frozen=True)
class NoiseHypothesis:
    """Possible noise of a measured coordinate, against what is claimed of it.

    Attributes
    ----------
    shape : int
        `NORMAL`, `UNIFORM` or `LASTING`.
    multiples : tuple of float
        Its bound as multiples of the claimed bound, or its standard deviation as multiples of the
        claimed one (of a bound: bound / sqrt(3)); at most 6.
    shares : tuple of float
        How likely each is; the sum is 1.
    weight : float
        Prior weight, relative to the others'.
    lasting : tuple of float
        Of `LASTING` noise, the correlation of an error with that of the tip before, for each
        multiple, in [0, 1); empty of the others.
    """

    shape: int
    multiples: tuple[float, ...]
    shares: tuple[float, ...]
    weight: Annotated[float, Bounds(1e-9, 1e9, "-")]
    lasting: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check every field; raises UserError."""
        check_bounded_fields(self)
        said = f"multiples = {self.multiples}, shares = {self.shares}"
        if not 0 < len(self.multiples) == len(self.shares) <= NOISES:
            raise UserError(f"{said}: want 1 to {NOISES} of each")
        if min(self.multiples + self.shares) <= 0.0 or abs(sum(self.shares) - 1.0) > 1e-9:
            raise UserError(f"{said}: want multiples > 0, and shares > 0 whose sum is 1")
        wanted = len(self.multiples) if self.shape == LASTING else 0
        if len(self.lasting) != wanted or not all(0.0 <= each < 1.0 for each in self.lasting):
            raise UserError(f"lasting = {self.lasting}, wants {wanted} numbers in [0, 1)")
