"""Look in one view where the end must be that the other shows: along that one's line of sight.

What crosses the needle in one view, such as a cable, leads the search along its path astray. The
other view's end and the needle's way leave a short stretch of places; in the spoilt view they lie
beside each other, and at one of them the needle's end is seen.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from needle_tracker.image.detection import Image
from needle_tracker.image.search_grid import Reach
from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.tracking.following import SOUND_PX, Follower, shows_end
from needle_tracker.tracking.gates import tip_at_entry
from needle_tracker.tracking.single_view import Seen, taken_in
from needle_tracker.tracking.tip_prediction import Anchor, TipMotion

_SPACING = 1e-3  # of the places along the line of sight: about half a needle apart in the image [m]
# The needle's way, and where the other view's end is found, say better than a view how far it goes.
_LEADS_ALONG_PX = 4.0
_SIGMAS, _FARTHEST = 2.5, 5e-3  # so far from the likeliest [-, m]


def predicted_from_entry(reach: Reach, insertion: float) -> Anchor:
    """Return where the tip of a needle is that was not seen yet.

    Parameters
    ----------
    reach : Reach
        How far the needle can get to.
    insertion : float
        Length of needle beyond the entry point [m].

    Returns
    -------
    Anchor
        Straight ahead of the entry, in `rig`.
    """
    tip = tip_at_entry(insertion, reach.hole_tolerance, reach.entry_angle)
    return Anchor(TipMotion.start(tip), insertion, known=True)


def leads(tip: ImageTip) -> bool:
    """Return whether a view shows the needle's end well enough to look for it in the other."""
    return shows_end(tip, SOUND_PX, _LEADS_ALONG_PX)


def guided_pairs(
    follower: Follower,
    images: tuple[Image, Image],
    predicted: Anchor,
    seen: Seen,
    last: tuple[ImageTip, ImageTip] | None,
) -> Iterator[tuple[ImageTip, ImageTip]]:
    """Yield both views' ends, one of them as seen and the other where that leads to.

    Parameters
    ----------
    follower : Follower
        Looks for the needle.
    images : pair of ndarray of uint8
        Left and right.
    predicted : Anchor
        Where the tip should be now.
    seen : pair of (ImageTip or None)
        What a search found in the left and the right image; not every end leads to the other.
    last : pair of ImageTip or None
        How the needle was seen last.

    Yields
    ------
    pair of ImageTip
        The likeliest place first.
    """
    for i, tip in enumerate(seen):
        if tip is None or not leads(tip):
            continue
        other = 1 - i
        motion = taken_in(follower.views[i], tip, predicted.motion)
        if last is None:
            along = follower.views[other].jacobian(motion.position) @ motion.heading
            along /= np.linalg.norm(along)
            alike = dataclasses.replace(tip, direction=along, contrast=0.0)
        else:
            alike = last[other]
        variances, axes = np.linalg.eigh(motion.covariance[:3, :3])
        farthest = min(_SIGMAS * math.sqrt(float(variances[-1])), _FARTHEST)
        steps = int(farthest / _SPACING)
        for step in sorted(range(-steps, steps + 1), key=abs):
            place = motion.position + step * _SPACING * axes[:, -1]
            there = dataclasses.replace(
                predicted, motion=dataclasses.replace(motion, position=place), ahead=0.0
            )
            looked = follower.look_in(other, images[other], there, alike)
            if looked is not None and looked[0].clear:
                yield (tip, looked[0]) if i == 0 else (looked[0], tip)
