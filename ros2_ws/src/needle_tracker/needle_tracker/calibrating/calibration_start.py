"""From views of the board to a first calibration, and the refusal of sets that cannot give one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_common.errors import UserError
from needle_tracker.calibrating.rig_model import BoardView, Corners
from needle_tracker.optics.calibration import SIDES, Camera, Phantom, StereoCalibration

Array = NDArray[np.float64]

LEAST_CORNERS = 12
LEAST_FREE_VIEWS = 6
LEAST_TILT_DEG = 10.0
_FLAGS = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2


def check_views(views: list[BoardView]) -> None:
    """Refuse a set of views that cannot determine the rig.

    Raises
    ------
    UserError
        Too few views or corners, a board seen by one camera only, no board of known place in air.
    """
    for view in views:
        counts = {side: len(view.corners(side).points) for side in SIDES}
        few = [side for side in SIDES if counts[side] < LEAST_CORNERS]
        if few:
            raise UserError(
                f"{view.name}: the {few[0]} camera sees {counts[few[0]]} corners of the board, "
                f"{LEAST_CORNERS} are needed (left {counts['left']}, right {counts['right']})"
            )
        for side in SIDES:
            points = view.corners(side).points[:, :2]
            if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) < 2:
                raise UserError(f"{view.name}: the {side} camera's corners are all on one line")
    held = [view for view in views if view.place is None]
    if len(held) < LEAST_FREE_VIEWS:
        raise UserError(
            f"{len(held)} views of the board held freely in air, at least {LEAST_FREE_VIEWS} are "
            "needed (20 are good)"
        )
    if not any(view.place and not view.under_surface for view in views):
        raise UserError(
            "no view of the board at a known place in air: nothing says where `rig` is (give the "
            "place of the board on the surface in the session file)"
        )


def first_calibration(
    views: list[BoardView], sizes: dict[str, tuple[int, int]], phantom: Phantom
) -> tuple[StereoCalibration, Array]:
    """Return a calibration good enough to start the adjustment from.

    Each camera by itself from the views in air (Zhang's method, OpenCV), `rig` from a board of
    known place.

    Parameters
    ----------
    views : list of BoardView
        That `check_views` accepts.
    sizes : dict of str to (int, int)
        Width and height of each side's images [px].
    phantom : Phantom
        The given surface height and refractive index.

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
    anchor = next(i for i, v in enumerate(views) if v.place and not v.under_surface)
    place = views[anchor].place
    assert place is not None
    cameras, poses = [], []
    for side in SIDES:
        in_air = [view.corners(side) for view in views if not view.under_surface]
        matrix, distortion = _single_camera(in_air, side, sizes[side])
        own = [_board_pose(view.corners(side), matrix, distortion) for view in views]
        poses.append(own)
        transform = own[anchor] @ np.linalg.inv(place.T_rig_board)
        cameras.append(Camera(*sizes[side], matrix, distortion, transform))
    for side, camera in zip(SIDES, cameras, strict=True):
        if camera.centre[0] <= phantom.surface_height:
            raise UserError(
                f"the {side} camera comes out below the surface, at x = {camera.centre[0]:.3f} m: "
                f"the place given for {views[anchor].name} cannot be right"
            )
    rig_from_left = np.linalg.inv(cameras[0].T_optical_rig)
    boards = [
        view.place.T_rig_board if view.place is not None else rig_from_left @ poses[0][i]
        for i, view in enumerate(views)
    ]
    return StereoCalibration(phantom, cameras[0], cameras[1]), np.stack(boards)


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
