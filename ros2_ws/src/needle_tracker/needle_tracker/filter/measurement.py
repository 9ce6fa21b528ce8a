"""The tracker's answer to a pair of images."""

from __future__ import annotations

import dataclasses
import enum

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.stereo.triangulation import SpatialTip

Array = NDArray[np.float64]


class TrackState(enum.Enum):
    """The tracker's knowledge of the needle."""

    SEARCHING = "SEARCHING"  # nothing is known: the whole reachable region is searched
    CONFIRMING = "CONFIRMING"  # something like a needle, not believed yet
    TRACKING = "TRACKING"
    LOST = "LOST"  # was tracked and is not seen
    ENTRY = "ENTRY"  # short, and not seen: the tip follows from the insertion


class NoTip(str, enum.Enum):
    """A reason, as a person reads it."""

    def __str__(self) -> str:
        """Return the text."""
        return self.value

    NOTHING = "no needle seen"
    UNCONFIRMED = "not confirmed yet"
    UNCERTAIN = "too uncertain"
    CHANGED = "a whole view changed"


@dataclasses.dataclass(frozen=True, eq=False)
class Measurement:
    """The tracker's answer to a pair of images.

    Attributes
    ----------
    tip : SpatialTip or None
        The believed tip; None where there is none.
    state : TrackState
        State of the track after this pair.
    reason : str
        Why there is no tip; empty where there is one.
    ends : pair of (ImageEnd or None)
        What was found in the left and the right image, believed or not.
    probability : float
        Of the best track to be the needle, 0 to 1.
    stage : pair of float
        The stage's zero [m] and scale error [-], as estimated.
    """

    tip: SpatialTip | None
    state: TrackState
    reason: str
    ends: tuple[ImageEnd | None, ImageEnd | None] = (None, None)
    probability: float = 0.0
    stage: tuple[float, float] = (0.0, 0.0)
