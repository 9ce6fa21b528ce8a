"""Evidence of one view alone on a followed needle that both together do not show.

A needle that one camera does not see for a while is not lost: the other says where it is but for
the depth, and that hardly changes on its way. As long as the prediction knows that well, there is a
tip; and when both see the needle again it is found at once.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_tracker.image.detection import Image
from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.optics.compiled_projection import point_jacobian, project_point
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.evidence import VisibilityAverage
from needle_tracker.tracking.following import SLACK, Follower, is_sound, misfit
from needle_tracker.tracking.gates import GateSettings
from needle_tracker.tracking.tip_prediction import Anchor, TipMotion, across
from needle_tracker.tracking.triangulation import SpatialTip

# Standard deviations: what is farther from the prediction is something else. A prediction that is
# not known so well [px] says too little of what is seen.
_BORNE_OUT, _KNOWN_PX = 2.0, 2.5

Seen = tuple[ImageTip | None, ImageTip | None]


def kept_up(
    follower: Follower,
    images: tuple[Image, Image],
    predicted: Anchor,
    last: tuple[ImageTip, ImageTip],
    usual: VisibilityAverage,
) -> tuple[TipMotion, Seen] | None:
    """Return the prediction with what single views bear out of it taken in, and what they see.

    Parameters
    ----------
    follower : Follower
        Looks for the needle.
    images : pair of ndarray of uint8
        Left and right.
    predicted : Anchor
        Where the tip must be now.
    last : pair of ImageTip
        How it was seen last.
    usual : VisibilityAverage
        How much it stands out.

    Returns
    -------
    motion : TipMotion
        In `rig`.
    seen : pair of (ImageTip or None)
        Of the left and the right view, where it bears the prediction out.
    """
    motion = predicted.motion
    seen: list[ImageTip | None] = [None, None]
    for i, view in enumerate(follower.views):
        looked = follower.look_in(i, images[i], predicted, last[i])
        if looked is None:
            continue
        tip, _ = looked
        if is_sound(tip) and usual.is_like_in(i, tip) and _is_borne_out(view, tip, predicted):
            motion, seen[i] = taken_in(view, tip, motion), tip
    if motion is predicted.motion:
        return None
    return motion, (seen[0], seen[1])


def seen_alone(
    predicted: Anchor, motion: TipMotion, believed: SpatialTip, settings: GateSettings
) -> SpatialTip | None:
    """Return the tip of a needle that one view keeps up with.

    Parameters
    ----------
    predicted : Anchor
        Where the tip must be now.
    motion : TipMotion
        The same with what is seen taken in.
    believed : SpatialTip
        The last tip that both views showed.
    settings : GateSettings
        How well a tip must be known, be it seen by one view or by both, and how the needle bends.

    Returns
    -------
    SpatialTip or None
        Its direction is the last that was seen, the less known the farther the needle went since;
        None where the tip is not known well enough.
    """
    if max(predicted.motion.sigma, motion.sigma) > settings.max_depth_sigma:
        return None
    turned = (settings.reach.curvature * predicted.unseen) ** 2 * across(believed.direction)
    return dataclasses.replace(
        believed,
        position=motion.position,
        covariance=motion.covariance[:3, :3].copy(),
        direction_covariance=believed.direction_covariance + turned,
        disagreement=0.0,
        disagreement_across=0.0,
    )


def _is_borne_out(view: RefractedCamera, tip: ImageTip, predicted: Anchor) -> bool:
    """Return whether a tip is where it must be, and that is known well enough to tell."""
    off = misfit(view, tip, predicted.motion)
    along = math.hypot(off.sigma_along, off.sigma_predicted, SLACK)
    return (
        off.sigma_across**2 - tip.sigma_across**2 < _KNOWN_PX**2
        and abs(off.across) < _BORNE_OUT * off.sigma_across
        and abs(off.along) < _BORNE_OUT * along
    )


def taken_in(view: RefractedCamera, tip: ImageTip, motion: TipMotion) -> TipMotion:
    """Return a state with what one view says taken in, across and along the shaft.

    Parameters
    ----------
    view : RefractedCamera
        Which one.
    tip : ImageTip
        What it shows.
    motion : TipMotion
        What was known, in `rig`.
    """
    pixel, jacobian = np.empty(2), np.empty((2, 3))
    project_point(view.packed, motion.position, pixel)
    point_jacobian(view.packed, motion.position, jacobian)
    axes = np.array([[-tip.direction[1], tip.direction[0]], tip.direction])
    return motion.taken_in(
        axes @ (tip.point - pixel),
        axes @ jacobian,
        np.diag([tip.sigma_across**2, tip.sigma_along**2]),
    )
