"""Detection of views whose images were not exposed at once.

The pose of the right camera relative to the left one is the same in every pair of images. After a
dropped frame, which shifts the names of one side, or with a moving board before free-running
cameras, the pose differs in such a pair, although each image fits by itself.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import BoardView, Place
from needle_tracker.calibrating.calibration_start import (
    anchor_view,
    boards_seen,
    checked_views,
    first_calibration,
)
from needle_tracker.calibrating.rig_fit import board_parameters_free, fit
from needle_tracker.calibrating.rig_model import LENS, RigModel, camera_slice
from needle_tracker.optics.calibration import SIDES, StereoCalibration

Array = NDArray[np.float64]

_MANY = 0.25  # share of inconsistent views above which all views are rejected
_ROUNDS = 10
# Tolerance of the error of both cameras beyond twice the error of one: in the phantom, the errors
# of a lens known only from boards in air, and of the surface, are added.
_SLACK_PX = 0.05
_SLACK_UNDER_PX = 1.0


class PairsApartError(UserError):
    """Left and right images do not belong together in too many views."""


def consistent_views(
    views: list[BoardView], cameras: StereoCalibration, least_free: int
) -> tuple[list[BoardView], list[BoardView], Array | None]:
    """Separate the views whose images do not belong together.

    Parameters
    ----------
    views : list of BoardView
        From `checked_views`.
    cameras : StereoCalibration
        Lenses; the poses are ignored.
    least_free : int
        As for `checked_views`.

    Returns
    -------
    kept : list of BoardView
        Consistent views.
    apart : list of BoardView
        Other views.
    T_right_left : ndarray, shape (4, 4), or None
        Relative pose of the cameras in most views in air; None without common views.

    Raises
    ------
    PairsApartError
        Too many inconsistent views, or the others cannot determine the rig.
    """
    names, pose = _apart(views, _posed(cameras, np.eye(4)))
    kept, apart = ([v for v in views if (v.name in names) is wanted] for wanted in (False, True))
    try:
        if len(apart) > _MANY * len(views):
            raise UserError(f"{len(apart)} of {len(views)} views")
        return checked_views(kept, cameras.surface, least_free), apart, pose
    except UserError as error:
        raise PairsApartError(f"{describe_apart(apart)} ({error})") from error


def describe_apart(views: list[BoardView]) -> str:
    """Return the message about inconsistent views."""
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
    """Return the names of the views that contradict the others, and T_right_left of the others.

    The consistent set starts with the view whose relative pose is closest to that of a quarter of
    all views, or else of one other view, and grows until it does not change.
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
    """Return the error of the corners of each view in one camera alone, the larger rms [px]."""
    misses = [_misses(calibration, [view.without(side) for view in views]) for side in SIDES]
    return np.asarray(np.max(misses, axis=0))


def _misses(calibration: StereoCalibration, views: list[BoardView]) -> Array:
    """Return the error of the corners of each view at the best place of the board, rms [px]."""
    model = RigModel(calibration, views, boards_seen(calibration, views))
    free = board_parameters_free(model)
    if any(view.under_surface for view in views):
        # With one flat board, index and height of the surface are indistinguishable.
        free[model.names.index("refractive_index")] = True
    squares = np.sum(fit(model, model.start, free).residuals.reshape(-1, 2) ** 2, axis=-1)
    of_view = np.concatenate([model.view_of[side] for side in SIDES])
    return np.sqrt(np.bincount(of_view, squares) / np.bincount(of_view))
