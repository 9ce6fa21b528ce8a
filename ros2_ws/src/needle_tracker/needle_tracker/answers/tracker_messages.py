"""Images, joint states and tips, from and to messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from needle_core.messages import (
    INSERTION_JOINT,
    Image,
    JointState,
    Point,
    Pose,
    PoseWithCovariance,
)
from needle_tracker.answers.orientation import orientation, rotation_covariance
from needle_tracker.answers.pair_answers import Frame
from needle_tracker.optics.calibration import Camera, rotation_matrix
from needle_tracker.sources.image_encodings import ENCODINGS, WANTED, bytes_per_pixel, grey_image
from needle_tracker.sources.image_files import size_problem
from needle_tracker.stereo.triangulation import SpatialTip

RIG_FRAME = "rig"
LEFT_FRAME = "left_camera_optical"
_QUOTED = 40  # characters of a text that is not known


def frame_of(message: Any, side: str, camera: Camera) -> Frame:
    """Return the image in a message, or why it is not one of this camera.

    The message is an `Image` of ours, of rclpy or of rosbags: they name their fields alike.
    """
    if message.encoding not in ENCODINGS:
        encoding = message.encoding[:_QUOTED]
        return Frame(None, f"{side} image is {encoding!r}, wants {WANTED}")
    wanted = camera.width, camera.height
    if problem := size_problem(side, (message.width, message.height), wanted):
        return Frame(None, problem)
    least = message.width * bytes_per_pixel(message.encoding)
    if message.step < least or len(message.data) != message.step * message.height:
        return Frame(
            None,
            f"{side} image has {len(message.data)} bytes in rows of {message.step}, "
            f"{message.height} rows of {least} wanted",
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    return Frame(grey_image(rows, message.width, message.encoding))


def image_geometry(message: Any) -> tuple[int, int, NDArray[np.float64]]:
    """Return width and height [px] and camera matrix, (3, 3), of a camera_info's images.

    A camera_info gives `width`, `height` and `k` of the full sensor (REP 104). The images show its
    `roi` (0x0: all of it), reduced by `binning_x` and `binning_y` (0: 1).
    """
    roi, bins = message.roi, np.maximum([message.binning_x, message.binning_y], 1)
    width, height = (roi.width or message.width, roi.height or message.height) // bins
    matrix = np.array(message.k, dtype=np.float64).reshape(3, 3)
    matrix[:2, 2] -= roi.x_offset, roi.y_offset
    matrix[:2] /= bins[:, None]
    return int(width), int(height), matrix


def camera_info_problem(message: Any, side: str, camera: Camera) -> tuple[str, bool]:
    """Return how a camera_info contradicts the calibration file, and whether in the images' size.

    The text is empty where it does not.
    """
    width, height, matrix = image_geometry(message)
    # Some drivers send zeros where they know nothing.
    if (width, height) in {(0, 0), (camera.width, camera.height)}:
        difference = float(np.abs(matrix - camera.camera_matrix).max())
        # An uncalibrated camera driver sends zeros.
        if np.any(np.asarray(message.k) != 0.0) and difference > 0.5:
            return f"{side} camera_info differs from the calibration by {difference:.1f} px", False
        return "", False
    return (
        f"{side} camera_info is for {width}x{height}, the calibration for "
        f"{camera.width}x{camera.height}"
    ), True


def insertion_of(message: JointState) -> float | None:
    """Return the insertion [m] in a joint state, None where it has none."""
    return dict(zip(message.names, message.positions, strict=False)).get(INSERTION_JOINT)


def tip_message(tip: SpatialTip, stamp_ns: int) -> Point:
    """Return a measured tip, exposed at `stamp_ns`."""
    return Point(stamp_ns, RIG_FRAME, _position(tip))


def tip_pose_message(tip: SpatialTip | None, stamp_ns: int) -> PoseWithCovariance:
    """Return the answer to a pair exposed at `stamp_ns`; infinite covariance without a tip."""
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


def rotation_of(pose: Pose | PoseWithCovariance) -> NDArray[np.float64] | None:
    """Return the axes of a pose's frame as columns, (3, 3); None where it has no orientation."""
    quaternion = np.array(pose.orientation)
    norm = float(np.linalg.norm(quaternion))
    return rotation_matrix(quaternion / norm) if 0.5 < norm < 2.0 else None


def picture_message(pixels: NDArray[np.uint8], stamp_ns: int) -> Image:
    """Return an RGB picture of what was exposed at `stamp_ns`, left view first."""
    height, width = pixels.shape[:2]
    return Image(stamp_ns, LEFT_FRAME, height, width, "rgb8", 3 * width, pixels.tobytes())


def _position(tip: SpatialTip) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in tip.position)
    return (x, y, z)
