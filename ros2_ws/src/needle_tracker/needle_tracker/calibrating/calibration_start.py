"""Initial calibration from views of the board; unsuitable sets and inconsistent pairs are rejected.

The pose of the right camera relative to the left one is the same in every pair of images. A dropped
frame, which shifts the names of one side, or a board that moves in front of free-running cameras
changes this pose in the affected pairs, although each image fits by itself.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import HELD_FREELY, BoardView, Corners, Place
from needle_tracker.calibrating.rig_fit import fit
from needle_tracker.calibrating.rig_model import POSE, RigModel, board_pose, initial_board_poses
from needle_tracker.optics.calibration import (
    LEAST_BASELINE,
    SIDES,
    Camera,
    StereoCalibration,
    Window,
)

Array = NDArray[np.float64]

LEAST_CORNERS = 12
LEAST_FREE_VIEWS = 6
LEAST_TILT_DEG = 10.0
_K1_ALONE = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2
_MANY = 0.25  # share of inconsistent views above which all views are rejected
_ROUNDS = 10
# Tolerance of the error of both cameras beyond twice the error of one. In the phantom, errors of
# the surface and of a lens calibrated only in air add to it.
_SLACK_PX = 0.05
_SLACK_UNDER_PX = 1.0


def checked_views(
    views: list[BoardView], surface: Window | None, least_free: int = LEAST_FREE_VIEWS
) -> list[BoardView]:
    """Return the usable part of a set of views; reject a set that cannot determine the rig.

    Cameras with separate windows may have a small common field of view in air: a board that is held
    freely then counts for each camera that sees it.

    Parameters
    ----------
    views : list of BoardView
        Views of the board.
    surface : Window or None
        Common surface of both cameras; None if each has its own window.
    least_free : int
        Least number of boards held freely.

    Raises
    ------
    UserError
        Too few views or corners, a board that only one camera sees, or no board at a known place.
    """
    checked = [checked_view(v, alone=surface is None and v.kind == "free") for v in views]
    for side in SIDES:
        free = [v for v in checked if v.kind == "free" and len(v.corners(side).points)]
        if len(free) < least_free:
            raise UserError(
                f"{len(free)} views of the board held freely in air"
                f"{'' if surface else f' that the {side} camera sees'}, at least "
                f"{least_free} are needed (20 are good)"
            )
    if anchor_view(checked, surface) is None:
        raise UserError(
            "no view of the board at a known place in air: `rig` is undetermined (give the "
            "place of the board on the surface in the session file)"
            if surface
            else "no view of the board at a known place: `rig` is undetermined"
        )
    return checked


def checked_view(view: BoardView, *, alone: bool = False) -> BoardView:
    """Check a view; with `alone`, remove one camera that sees too few corners."""
    counts = {side: len(view.corners(side).points) for side in SIDES}
    few = [side for side in SIDES if counts[side] < LEAST_CORNERS]
    if few and not (alone and len(few) < len(SIDES)):
        raise UserError(
            f"{view.name}: the {few[0]} camera sees {counts[few[0]]} corners of the board, "
            f"{LEAST_CORNERS} are needed (left {counts['left']}, right {counts['right']})"
        )
    for side in SIDES:
        points = view.corners(side).points[:, :2]
        if side in few:
            view = view.without(side)
        elif np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) < 2:
            raise UserError(f"{view.name}: the {side} camera's corners are collinear")
    return view


def anchor_view(views: list[BoardView], surface: Window | None) -> BoardView | None:
    """Return the view that defines `rig`: preferably in air; with a common surface, only in air."""
    known = [view for view in views if view.place.is_known]
    in_air = [view for view in known if not view.place.under_surface]
    return next(iter(in_air if surface else in_air + known), None)


def calibrate_lenses(
    views: list[BoardView], sizes: dict[str, tuple[int, int]], windows: tuple[Window, Window]
) -> StereoCalibration:
    """Return the lenses of both cameras, from the views in air (Zhang's method, OpenCV).

    Parameters
    ----------
    views : list of BoardView
        From `checked_views`.
    sizes : dict of str to (int, int)
        Width and height of the images of each side [px].
    windows : pair of Window
        Windows of the left and the right camera.

    Returns
    -------
    StereoCalibration
        Both lenses, with unknown poses: both cameras are at the origin.

    Raises
    ------
    UserError
        Parallel or contradictory views.
    """
    cameras = []
    for side, window in zip(SIDES, windows, strict=True):
        in_air = [view.corners(side) for view in views if not view.place.under_surface]
        lens = _lens([corners for corners in in_air if len(corners.points)], side, sizes[side])
        cameras.append(Camera(*sizes[side], *lens, np.eye(4), window))
    return StereoCalibration(*cameras)


def are_posed(cameras: StereoCalibration) -> bool:
    """Return whether the relative pose of the cameras is known."""
    return bool(np.linalg.norm(cameras.right.centre - cameras.left.centre) >= LEAST_BASELINE)


def first_calibration(views: list[BoardView], cameras: StereoCalibration) -> StereoCalibration:
    """Return a calibration to start the adjustment from.

    A board at a known place defines `rig`; windows are ignored.

    Parameters
    ----------
    views : list of BoardView
        From `checked_views`.
    cameras : StereoCalibration
        Lenses, windows, and the relative pose of the cameras if known (`are_posed`).

    Returns
    -------
    StereoCalibration
        Initial values.

    Raises
    ------
    UserError
        The pose of a camera is behind its window.
    """
    anchor = anchor_view(views, cameras.surface)
    assert anchor is not None
    placed: list[Camera] = []
    for side, alone in cameras.cameras.items():
        board = board_pose(alone, anchor.corners(side))
        transform = board @ np.linalg.inv(anchor.place.T_rig_board)
        if placed and are_posed(cameras):
            from_left = np.linalg.inv(cameras.left.T_optical_rig)
            transform = alone.T_optical_rig @ from_left @ placed[0].T_optical_rig
        camera = dataclasses.replace(alone, T_optical_rig=transform)
        if camera.window.height(camera.centre) <= 0.0:
            raise UserError(
                f"the {side} camera is estimated below the surface, at "
                f"{np.round(camera.centre, 3).tolist()} m: "
                f"the place given for {anchor.name} is wrong"
            )
        placed.append(camera)
    return StereoCalibration(*placed)


def _lens(corners: list[Corners], side: str, size: tuple[int, int]) -> tuple[Array, Array]:
    points = [c.points.astype(np.float32) for c in corners]
    pixels = [c.pixels.astype(np.float32).reshape(-1, 1, 2) for c in corners]
    matrix, distortion, flags = np.eye(3), np.zeros(5), _K1_ALONE
    try:
        # The last round excludes outliers, such as a board in the phantom.
        for _ in range(3):
            _, matrix, distortion, turns, *_, misses = cv2.calibrateCameraExtended(
                points, pixels, size, matrix, distortion, flags=flags
            )
            if flags == cv2.CALIB_USE_INTRINSIC_GUESS:
                kept = np.flatnonzero(misses <= 2.0 * np.median(misses) + 0.05)
                points, pixels = [points[i] for i in kept], [pixels[i] for i in kept]
            flags = cv2.CALIB_USE_INTRINSIC_GUESS
    except cv2.error as error:
        raise UserError(
            f"the {side} camera cannot be calibrated from these views: are all of them parallel?"
        ) from error
    normals = np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt = float(np.rad2deg(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0).min())))
    if not tilt >= LEAST_TILT_DEG:
        raise UserError(
            f"{side} camera: the views are all parallel (tilts within {tilt:.1f} deg, at least "
            f"{LEAST_TILT_DEG:g} needed, 30 to 45 are good): tilt the board"
        )
    return np.asarray(matrix, dtype=np.float64), np.asarray(distortion).reshape(-1)[:5].copy()


class PairsApartError(UserError):
    """Error raised if left and right images do not belong together in too many views."""


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
        Inconsistent views.
    T_right_left : ndarray, shape (4, 4), or None
        Relative pose of the cameras in most views in air; None without common views.

    Raises
    ------
    PairsApartError
        Too many inconsistent views, or the others cannot determine the rig.
    """
    names, pose = _apart(views, _posed(cameras, np.eye(4)))
    kept, apart = (
        [v for v in views if (v.name in names) is is_apart] for is_apart in (False, True)
    )
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
    in_air = [
        dataclasses.replace(view, place=HELD_FREELY)
        for view in both
        if not view.place.under_surface
    ]
    if not in_air:
        return [], None
    apart, pose = _apart_in_air(cameras, in_air)
    kept = [view for view in views if view.name not in apart]
    if cameras.surface is not None and anchor_view(kept, cameras.surface) is not None:
        calibration = first_calibration(kept, _posed(cameras, pose))
        for view in (view for view in both if view.place.under_surface):
            alike = [dataclasses.replace(view, place=Place(np.eye(4), True, np.inf))]
            if _misses(calibration, alike) > 2.0 * _alone(calibration, alike) + _SLACK_UNDER_PX:
                apart.append(view.name)
    return apart, pose


def _apart_in_air(cameras: StereoCalibration, views: list[BoardView]) -> tuple[list[str], Array]:
    """Return the names of the views that contradict the others, and T_right_left of the others.

    The consistent set starts with the view whose relative pose is closest to that of a quarter of
    all views, and grows until it no longer changes.
    """
    left, right = (
        initial_board_poses(cameras, [view.without(other) for view in views])
        for other in SIDES[::-1]
    )
    limits = 2.0 * _alone(cameras, views) + _SLACK_PX
    poses = right @ np.linalg.inv(left)
    away = np.linalg.norm((poses[:, None] @ left - right)[..., :3, 3], axis=-1)
    quarter = min(max(len(views) // 4, 1), len(views) - 1)
    nearest = np.sort(away, axis=1)[:, quarter]
    best = int(np.argmin(nearest))
    pose, near = poses[best], away[best] <= 3.0 * nearest[best]
    for _ in range(_ROUNDS):
        kept = [view for view, is_near in zip(views, near, strict=True) if is_near]
        model = RigModel(_posed(cameras, pose), kept)
        names = [f"right.{name}" for name in POSE]
        parameters = fit(model, model.start, names).parameters
        pose = model.calibration(parameters).right.T_optical_rig
        was, near = near, _misses(_posed(cameras, pose), views) <= limits
        if np.array_equal(near, was) or not np.any(near):
            break
    return [view.name for view, is_near in zip(views, near, strict=True) if not is_near], pose


def _posed(cameras: StereoCalibration, pose: Array) -> StereoCalibration:
    """Return the cameras with the left one at the origin, the right one at T_right_left."""
    left = dataclasses.replace(cameras.left, T_optical_rig=np.eye(4))
    return StereoCalibration(left, dataclasses.replace(cameras.right, T_optical_rig=pose))


def _alone(calibration: StereoCalibration, views: list[BoardView]) -> Array:
    """Return the larger rms corner error of each view when fitted to one camera alone [px]."""
    misses = [_misses(calibration, [view.without(side) for view in views]) for side in SIDES]
    return np.asarray(np.max(misses, axis=0))


def _misses(calibration: StereoCalibration, views: list[BoardView]) -> Array:
    """Return the rms corner error of each view at the best-fitting pose of the board [px]."""
    model = RigModel(calibration, views)
    # With one flat board, index and height of the surface are indistinguishable.
    names = ["refractive_index"] if any(view.place.under_surface for view in views) else []
    squares = np.sum(fit(model, model.start, names).residuals ** 2, axis=-1)
    return np.sqrt(np.bincount(model.view_of, squares) / np.bincount(model.view_of))
