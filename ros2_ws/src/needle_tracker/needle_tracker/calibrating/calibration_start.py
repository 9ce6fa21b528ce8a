"""From views of the board to a first calibration, and the refusal of sets that cannot give one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_common.errors import UserError
from needle_tracker.calibrating.rig_model import BoardView, Corners
from needle_tracker.optics.calibration import SIDES, Camera, StereoCalibration
from needle_tracker.optics.window import Window, common_surface

Array = NDArray[np.float64]

LEAST_CORNERS = 12
LEAST_FREE_VIEWS = 6
LEAST_TILT_DEG = 10.0
_FLAGS = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2


def checked_views(views: list[BoardView], windows: tuple[Window, Window]) -> list[BoardView]:
    """Refuse a set of views that cannot determine the rig; return what of it counts.

    Cameras with windows of their own may see hardly anything in common but through these: a board
    that is held freely in air then counts for the camera that sees it.

    Parameters
    ----------
    views : list of BoardView
        What was seen.
    windows : pair of Window
        Of the left and the right camera.

    Raises
    ------
    UserError
        Too few views or corners, a board seen by one camera only, no board of known place.
    """
    surface = common_surface(*windows)
    checked = [_checked(view, alone=surface is None and view.place is None) for view in views]
    for side in SIDES:
        held = [v for v in checked if v.place is None and len(v.corners(side).points)]
        if len(held) < LEAST_FREE_VIEWS:
            raise UserError(
                f"{len(held)} views of the board held freely in air"
                f"{'' if surface else f' that the {side} camera sees'}, at least "
                f"{LEAST_FREE_VIEWS} are needed (20 are good)"
            )
    if _anchor(checked, surface) is None:
        raise UserError(
            "no view of the board at a known place in air: nothing says where `rig` is (give the "
            "place of the board on the surface in the session file)"
            if surface
            else "no view of the board at a known place: nothing says where `rig` is"
        )
    return checked


def _checked(view: BoardView, *, alone: bool) -> BoardView:
    """Return a view without the camera that sees too little, if the other one may see it alone."""
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
            raise UserError(f"{view.name}: the {side} camera's corners are all on one line")
    return view


def _anchor(views: list[BoardView], surface: Window | None) -> int | None:
    """Return the view that says where `rig` is: in air if possible, and always under a surface."""
    known = [i for i, view in enumerate(views) if view.place and view.place.is_known]
    in_air = [i for i in known if not views[i].under_surface]
    return next(iter(in_air if surface else in_air + known), None)


def first_calibration(
    views: list[BoardView], sizes: dict[str, tuple[int, int]], windows: tuple[Window, Window]
) -> tuple[StereoCalibration, Array]:
    """Return a calibration good enough to start the adjustment from.

    Each camera by itself from the views in air (Zhang's method, OpenCV), `rig` from a board of
    known place, all of it as if there were no windows.

    Parameters
    ----------
    views : list of BoardView
        From `checked_views`.
    sizes : dict of str to (int, int)
        Width and height of each side's images [px].
    windows : pair of Window
        Of the left and the right camera, as given.

    Returns
    -------
    calibration : StereoCalibration
        Start values.
    boards : ndarray, shape (len(views), 4, 4)
        T_rig_board of each view.

    Raises
    ------
    UserError
        Views that do not determine the cameras: all parallel, or contradictory.
    """
    anchor = _anchor(views, common_surface(*windows))
    assert anchor is not None
    place = views[anchor].place
    assert place is not None
    cameras = []
    boards = [
        view.place.T_rig_board if view.place is not None and view.place.is_known else None
        for view in views
    ]
    for side, window in zip(SIDES, windows, strict=True):
        seen = [view.corners(side) for view in views]
        in_air = [
            corners
            for view, corners in zip(views, seen, strict=True)
            if not view.under_surface and len(corners.points)
        ]
        matrix, distortion = _single_camera(in_air, side, sizes[side])
        transform = _board_pose(seen[anchor], matrix, distortion) @ np.linalg.inv(place.T_rig_board)
        camera = Camera(*sizes[side], matrix, distortion, transform, window)
        if window.height(camera.centre) <= 0.0:
            raise UserError(
                f"the {side} camera comes out below the surface, at "
                f"{np.round(camera.centre, 3).tolist()} m: "
                f"the place given for {views[anchor].name} cannot be right"
            )
        cameras.append(camera)
        for i, corners in enumerate(seen):
            if boards[i] is None and len(corners.points):
                own = _board_pose(corners, matrix, distortion)
                boards[i] = np.linalg.inv(transform) @ own
    poses = [board for board in boards if board is not None]
    return StereoCalibration(cameras[0], cameras[1]), np.stack(poses)


def _single_camera(corners: list[Corners], side: str, size: tuple[int, int]) -> tuple[Array, Array]:
    points = [c.points.astype(np.float32) for c in corners]
    pixels = [c.pixels.astype(np.float32).reshape(-1, 1, 2) for c in corners]
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            points, pixels, size, np.eye(3), np.zeros(5), flags=_FLAGS
        )
    except cv2.error as error:
        raise UserError(
            f"the {side} camera cannot be calibrated from these views: are all of them parallel?"
        ) from error
    tilt = _tilt_range_deg(corners, matrix)
    if not tilt >= LEAST_TILT_DEG:
        raise UserError(
            f"{side} camera: the views are all parallel (tilts within {tilt:.1f} deg, at least "
            f"{LEAST_TILT_DEG:g} needed, 30 to 45 are good): tilt the board"
        )
    return np.asarray(matrix, dtype=np.float64), np.asarray(distortion).reshape(-1)[:5].copy()


def _tilt_range_deg(corners: list[Corners], matrix: Array) -> float:
    """Return the largest angle between two boards, from the vanishing lines of their planes."""
    normals = []
    for seen in corners:
        homography, _ = cv2.findHomography(seen.points[:, :2], seen.pixels)
        if homography is None:
            continue
        # The plane's horizon l gives its normal: K^T l.
        normal = matrix.T @ np.linalg.inv(homography).T @ np.array([0.0, 0.0, 1.0])
        normals.append(normal / np.linalg.norm(normal))
    if not normals:
        return 0.0
    stacked = np.stack(normals)
    cosines = np.abs(np.clip(stacked @ stacked.T, -1.0, 1.0))
    return float(np.rad2deg(np.arccos(cosines.min())))


def _board_pose(corners: Corners, matrix: Array, distortion: Array) -> Array:
    _, rotation, translation = cv2.solvePnP(
        corners.points, corners.pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.asarray(rotation).reshape(3))[0]
    pose[:3, 3] = np.asarray(translation).reshape(3)
    return pose
