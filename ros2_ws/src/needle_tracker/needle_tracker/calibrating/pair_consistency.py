"""Views that were not taken at once: each camera alone fits them, both together do not.

The right camera's pose relative to the left one is the same in every pair of images. A dropped
frame shifts the names of one side, and cameras that run freely see a moving board at two places: in
such a pair it comes out different, however well each image fits.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import Place
from needle_tracker.calibrating.calibration_start import (
    anchor_view,
    boards_seen,
    checked_views,
    first_calibration,
)
from needle_tracker.calibrating.rig_fit import board_parameters_free, fit
from needle_tracker.calibrating.rig_model import (
    LENS,
    BoardView,
    RigModel,
    camera_slice,
)
from needle_tracker.optics.calibration import SIDES, StereoCalibration

Array = NDArray[np.float64]

_MANY = 0.25  # of all views: with more of them apart, the rest is not relied on
_ROUNDS = 10
# Both cameras' corners may miss by twice what one camera's do, and this: in the phantom a lens that
# is known from boards in air alone, and a surface that may be elsewhere, come on top.
_SLACK_PX = 0.05
_SLACK_UNDER_PX = 1.0


class PairsApartError(UserError):
    """Left and right images do not belong together in so many views that none is used."""


def consistent_views(
    views: list[BoardView], cameras: StereoCalibration, least_free: int
) -> tuple[list[BoardView], list[BoardView], Array | None]:
    """Take out the views whose images do not belong together.

    Parameters
    ----------
    views : list of BoardView
        From `checked_views`.
    cameras : StereoCalibration
        Each camera's lens; how they stand does not count.
    least_free : int
        As for `checked_views`.

    Returns
    -------
    kept : list of BoardView
        Those that belong together.
    apart : list of BoardView
        The others.
    T_right_left : ndarray, shape (4, 4), or None
        The cameras' relative pose in most views in air; None where both see none.

    Raises
    ------
    PairsApartError
        More than a quarter of the views is apart, or the others cannot determine the rig.
    """
    names, pose = _apart(views, _posed(cameras, np.eye(4)))
    kept, apart = ([v for v in views if (v.name in names) is wanted] for wanted in (False, True))
    try:
        if len(apart) > _MANY * len(views):
            raise UserError(f"{len(apart)} of {len(views)} views")
        return checked_views(kept, cameras.surface, least_free), apart, pose
    except UserError as error:
        raise PairsApartError(f"{apart_in_words(apart)} ({error})") from error


def apart_in_words(views: list[BoardView]) -> str:
    """Return what is wrong with these views."""
    return (
        f"left and right do not show the board in the same place in "
        f"{', '.join(view.name for view in views)}, though each camera alone fits: not captured "
        "simultaneously, or file names are shifted"
    )


def _apart(views: list[BoardView], cameras: StereoCalibration) -> tuple[list[str], Array | None]:
    both = [view for view in views if all(len(view.corners(side).points) for side in SIDES)]
    in_air = [dataclasses.replace(view, place=None) for view in both if not view.under_surface]
    if not in_air:
        return [], None
    apart, pose = _apart_in_air(cameras, in_air)
    kept = [view for view in views if view.name not in apart]
    if cameras.surface is not None and anchor_view(kept, cameras.surface) is not None:
        calibration, _ = first_calibration(kept, _posed(cameras, pose))
        for view in (view for view in both if view.under_surface):
            alike = [dataclasses.replace(view, place=Place(np.eye(4), True, np.inf))]
            if _misses(calibration, alike) > 2.0 * _alone(calibration, alike) + _SLACK_UNDER_PX:
                apart.append(view.name)
    return apart, pose


def _apart_in_air(cameras: StereoCalibration, views: list[BoardView]) -> tuple[list[str], Array]:
    """Return the names of the views that contradict the others, and T_right_left of these.

    The others are as many as can be, and begin with the view whose relative pose comes nearest to
    that of a quarter of all; where there is no such quarter, to that of another view.
    """
    left, right = (
        boards_seen(cameras, [view.without(other) for view in views]) for other in SIDES[::-1]
    )
    limits = 2.0 * _alone(cameras, views) + _SLACK_PX
    poses = right @ np.linalg.inv(left)
    away = np.linalg.norm((poses[:, None] @ left - right)[..., :3, 3], axis=-1)
    for others in (max(len(views) // 4, 1), 1):
        nearest = np.sort(away, axis=1)[:, min(others, len(views) - 1)]
        best = int(np.argmin(nearest))
        pose, near = poses[best], away[best] <= 3.0 * nearest[best]
        for _ in range(_ROUNDS):
            kept = [view for view, is_near in zip(views, near, strict=True) if is_near]
            model = RigModel(_posed(cameras, pose), kept, left[near])
            free = board_parameters_free(model)
            free[camera_slice("right")][len(LENS) :] = True
            parameters = fit(model, model.start, free).parameters
            pose = model.calibration(parameters).right.T_optical_rig
            was, near = near, _misses(_posed(cameras, pose), views) <= limits
            if np.array_equal(near, was) or not np.any(near):
                break
        if np.count_nonzero(near) > min(others, len(views) - 1):
            break
    else:
        near[:] = False
    return [view.name for view, is_near in zip(views, near, strict=True) if not is_near], pose


def _posed(cameras: StereoCalibration, pose: Array) -> StereoCalibration:
    """Return the cameras with the left one at the origin, the right one at T_right_left."""
    left, right = (
        dataclasses.replace(camera, T_optical_rig=transform)
        for camera, transform in ((cameras.left, np.eye(4)), (cameras.right, pose))
    )
    return StereoCalibration(left, right)


def _alone(calibration: StereoCalibration, views: list[BoardView]) -> Array:
    """Return what the corners of each view miss by in one camera alone, the larger rms [px]."""
    misses = [_misses(calibration, [view.without(side) for view in views]) for side in SIDES]
    return np.asarray(np.max(misses, axis=0))


def _misses(calibration: StereoCalibration, views: list[BoardView]) -> Array:
    """Return what the corners of each view miss by at the board's best place, rms [px]."""
    model = RigModel(calibration, views, boards_seen(calibration, views))
    free = board_parameters_free(model)
    if any(view.under_surface for view in views):
        # One flat board does not tell the surface's height from it.
        free[model.names.index("refractive_index")] = True
    squares = np.sum(fit(model, model.start, free).residuals.reshape(-1, 2) ** 2, axis=-1)
    of_view = np.concatenate([model.view_of[side] for side in SIDES])
    return np.sqrt(np.bincount(of_view, squares) / np.bincount(of_view))
