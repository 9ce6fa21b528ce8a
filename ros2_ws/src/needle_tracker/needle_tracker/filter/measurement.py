"""Result of the tracker for a pair of images."""

from __future__ import annotations

import dataclasses
import enum

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.stereo.triangulation import SpatialTip

Array = NDArray[np.float64]


class TrackState(enum.Enum):
    """State of the confirmed track."""

    SEARCHING = "SEARCHING"  # no track: the whole reachable region is searched
    CONFIRMING = "CONFIRMING"  # tracks exist, but none is confirmed yet
    TRACKING = "TRACKING"
    LOST = "LOST"  # confirmed before, but no longer detected
    ENTRY = "ENTRY"  # short and not detected: the tip follows from the insertion


class NoTip(str, enum.Enum):
    """Reason for a pair without a tip."""

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
        Accepted tip, if any.
    state : TrackState
        State of the track after this pair.
    reason : str
        Reason for no tip; empty with a tip.
    ends : pair of (ImageEnd or None)
        End found in the left and the right image, accepted or not.
    probability : float
        Probability that the best track is the needle.
    stage : pair of float
        Zero [m] and scale error [-] of the stage, as estimated.
    """

    tip: SpatialTip | None
    state: TrackState
    reason: str
    ends: tuple[ImageEnd | None, ImageEnd | None] = (None, None)
    probability: float = 0.0
    stage: tuple[float, float] = (0.0, 0.0)
