"""Conversion of images, joint states and tips from and to messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from needle_core.messages import (
    INSERTION_JOINT,
    Image,
    JointState,
    Point,
    PoseWithCovariance,
)
from needle_tracker.answers.pair_answers import CameraInfoProblem
from needle_tracker.optics.calibration import Camera
from needle_tracker.sources.image_encodings import Frame, decoded
from needle_tracker.sources.image_files import size_problem
from needle_tracker.stereo.triangulation import SpatialTip

RIG_FRAME = "rig"
LEFT_FRAME = "left_camera_optical"
ROLL_VARIANCE = math.pi**2
"""Variance of an unknown angle [rad^2]: finite, since an infinite one means no tip."""


def frame_of(message: Any, side: str, camera: Camera) -> Frame:
    """Return the image of a message, or the reason why it is not from this camera."""
    expected = camera.width, camera.height
    problem = size_problem(side, (message.width, message.height), expected)
    return Frame(None, problem) if problem else decoded(message, side)


def image_geometry(message: Any) -> tuple[int, int, NDArray[np.float64]]:
    """Return width and height [px] and camera matrix, (3, 3), of the images of a camera_info.

    A camera_info gives `width`, `height` and `k` of the full sensor (REP 104). The images show its
    `roi` (0x0: all of it), reduced by `binning_x` and `binning_y` (0: 1).
    """
    roi, bins = message.roi, np.maximum([message.binning_x, message.binning_y], 1)
    width, height = (roi.width or message.width, roi.height or message.height) // bins
    matrix = np.array(message.k, dtype=np.float64).reshape(3, 3)
    matrix[:2, 2] -= roi.x_offset, roi.y_offset
    matrix[:2] /= bins[:, None]
    return int(width), int(height), matrix


def camera_info_problem(message: Any, side: str, camera: Camera) -> CameraInfoProblem:
    """Return how a camera_info contradicts the calibration."""
    width, height, matrix = image_geometry(message)
    # Some drivers send zeros for an unknown size.
    if (width, height) in {(0, 0), (camera.width, camera.height)}:
        difference = float(np.abs(matrix - camera.camera_matrix).max())
        # An uncalibrated camera driver sends zeros.
        if np.any(np.asarray(message.k) != 0.0) and difference > 0.5:
            text = f"{side} camera_info differs from the calibration by {difference:.1f} px"
            return CameraInfoProblem(text)
        return CameraInfoProblem()
    expected = f"the calibration for {camera.width}x{camera.height}"
    return CameraInfoProblem(f"{side} camera_info is for {width}x{height}, {expected}", True)


def insertion_of(message: JointState) -> float | None:
    """Return the insertion [m] in a joint state, if any."""
    return dict(zip(message.names, message.positions, strict=False)).get(INSERTION_JOINT)


def tip_message(tip: SpatialTip, stamp_ns: int) -> Point:
    """Return a measured tip, exposed at `stamp_ns`."""
    return Point(stamp_ns, RIG_FRAME, _position(tip))


def tip_pose_message(tip: SpatialTip | None, stamp_ns: int) -> PoseWithCovariance:
    """Return the message for a pair exposed at `stamp_ns`; infinite covariance without a tip."""
    covariance = np.zeros((6, 6))
    if tip is None:
        np.fill_diagonal(covariance, np.inf)
        position, quaternion = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    else:
        x, y, z, w = (float(part) for part in orientation(tip.direction))
        position, quaternion = _position(tip), (x, y, z, w)
        covariance[:3, :3] = tip.covariance
        covariance[3:, 3:] = rotation_covariance(tip.direction, tip.direction_covariance)
    values = tuple(covariance.ravel().tolist())
    return PoseWithCovariance(stamp_ns, RIG_FRAME, position, quaternion, values)


def picture_message(pixels: NDArray[np.uint8], stamp_ns: int) -> Image:
    """Return the message of an RGB picture of a pair exposed at `stamp_ns`."""
    height, width = pixels.shape[:2]
    return Image(stamp_ns, LEFT_FRAME, height, width, "rgb8", 3 * width, pixels.tobytes())


def _position(tip: SpatialTip) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in tip.position)
    return (x, y, z)


Array = NDArray[np.float64]


def orientation(direction: Array) -> Array:
    """Return the quaternion of the frame whose z axis is the shaft, with roll gamma = 0.

    R = Rx(alpha) Ry(beta) with pitch beta = asin(d_x) and yaw alpha = atan2(-d_y, d_z): the roll,
    which is not visible, is zero in the coordinates of [KC09].

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Unit vector in `rig`.

    Returns
    -------
    ndarray, shape (4,)
        Unit quaternion x, y, z, w.
    """
    d_x, d_y, d_z = (float(part) for part in direction)
    half_pitch = 0.5 * math.asin(min(max(d_x, -1.0), 1.0))
    half_yaw = 0.5 * math.atan2(-d_y, d_z)
    sin_a, cos_a = math.sin(half_yaw), math.cos(half_yaw)
    sin_b, cos_b = math.sin(half_pitch), math.cos(half_pitch)
    return np.array([sin_a * cos_b, cos_a * sin_b, sin_a * sin_b, cos_a * cos_b])


def rotation_covariance(direction: Array, direction_covariance: Array) -> Array:
    """Return the covariance of rotations about the fixed x, y, z axes, roll unknown.

    A small rotation w changes d by w x d; the component of w perpendicular to d is d x (w x d), the
    component parallel to d is the roll.

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Unit vector in `rig`.
    direction_covariance : ndarray, shape (3, 3)
        Covariance of the direction [-].

    Returns
    -------
    ndarray, shape (3, 3)
        Covariance [rad^2], with `ROLL_VARIANCE` about the shaft.
    """
    cross = np.cross(direction, np.eye(3), axisb=0, axisc=0)
    across = cross @ direction_covariance @ cross.T
    return np.asarray(across + ROLL_VARIANCE * np.outer(direction, direction))
