"""Measurement from a pair of images."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.tip_fit import Expected, ImageTip
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.evidence import has_come
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.track import Track
from needle_tracker.tracking.triangulation import SpatialTip, triangulate

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Measurement:
    """Measurement from a pair of images.

    Attributes
    ----------
    tip : SpatialTip or None
        The believed tip; None where there is none.
    state : TrackState
        State of the track after this pair.
    reason : str
        Why both views together gave no believed tip; empty where they did. With it there may be a
        tip of single views.
    image_tips : pair of (ImageTip or None)
        What was found in the left and the right image, believed or not.
    contested : SpatialTip or None
        The tip that is not believed.
    regions : pair of (Expected or None)
        Where in the left and the right image was searched; None: everywhere, or not at all.
    shaft : ndarray, shape (n, 3), or None
        Points along the whole shaft in `rig`, the tip last [m]; None where only its end was seen.
    """

    tip: SpatialTip | None
    state: TrackState
    reason: str
    image_tips: tuple[ImageTip | None, ImageTip | None] = (None, None)
    contested: SpatialTip | None = None
    regions: tuple[Expected | None, Expected | None] = (None, None)
    shaft: Array | None = None


def judged(
    views: tuple[RefractedCamera, RefractedCamera],
    track: Track,
    found: tuple[ImageTip, ImageTip],
    insertion: float | None,
) -> Measurement:
    """Return the tip of two ends if the track believes it, or why it does not.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    track : Track
        What is known; it does not change.
    found : pair of ImageTip
        The needle's end in the left and right image.
    insertion : float or None
        Length of needle in the phantom at the exposure [m].
    """
    tip = triangulate(views, found)
    if tip is None:
        return Measurement(None, track.state, NoTip.NO_COMMON_POINT, found)
    refused = track.judge(tip, insertion)
    if refused is None and track.stands(tip, insertion) and not has_come(found):
        refused = NoTip.STANDS
    if refused is None:
        return Measurement(tip, track.state, "", found)
    return Measurement(None, track.state, refused, found, tip)
