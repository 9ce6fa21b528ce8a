"""Images, joint states and tips, from and to messages."""

from __future__ import annotations

import array
import math

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Point, PointStamped, Pose, PoseWithCovarianceStamped, Quaternion
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, JointState

from needle_common.ros.conversions import to_stamp
from needle_tracker.answers.orientation import orientation, rotation_covariance
from needle_tracker.answers.pair_answers import Frame
from needle_tracker.optics.calibration import Camera, rotation_matrix
from needle_tracker.sources.image_encodings import ENCODINGS, WANTED, bytes_per_pixel, grey_image
from needle_tracker.tracking.triangulation import SpatialTip

RIG_FRAME = "rig"
LEFT_FRAME = "left_camera_optical"
INSERTION_JOINT = "insertion_joint"
_QUOTED = 40  # characters of a text that is not known


def to_frame(message: Image, side: str, camera: Camera) -> Frame:
    """Return the image in a message, or why it is not one of this camera."""
    if message.encoding not in ENCODINGS:
        encoding = message.encoding[:_QUOTED]
        return Frame(None, f"{side} image is {encoding!r}, wants {WANTED}")
    if (message.width, message.height) != (camera.width, camera.height):
        return Frame(
            None,
            f"{side} image is {message.width}x{message.height}, the calibration is for "
            f"{camera.width}x{camera.height}",
        )
    least = message.width * bytes_per_pixel(message.encoding)
    if message.step < least or len(message.data) != message.step * message.height:
        return Frame(
            None,
            f"{side} image has {len(message.data)} bytes in rows of {message.step}, "
            f"{message.height} rows of {least} wanted",
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    return Frame(grey_image(rows, message.width, message.encoding))


def image_geometry(message: CameraInfo) -> tuple[int, int, NDArray[np.float64]]:
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


def camera_info_problem(message: CameraInfo, side: str, camera: Camera) -> tuple[str, bool]:
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
    of_sensor, roi = "", message.roi
    if (width, height) != (message.width, message.height):
        of_sensor = (
            f" (sensor {message.width}x{message.height}, roi {roi.width}x{roi.height} at "
            f"{roi.x_offset},{roi.y_offset}, binning "
            f"{max(message.binning_x, 1)}x{max(message.binning_y, 1)})"
        )
    return (
        f"{side} camera_info is for {width}x{height}{of_sensor}, the calibration for "
        f"{camera.width}x{camera.height}"
    ), True


def insertion_of(message: JointState) -> float | None:
    """Return the insertion [m] in a joint state, None where it has none."""
    names = list(message.name)
    if INSERTION_JOINT not in names:
        return None
    index = names.index(INSERTION_JOINT)
    return float(message.position[index]) if index < len(message.position) else None


def to_tip(tip: SpatialTip, stamp: int) -> PointStamped:
    """Return the message of a tip exposed at `stamp` [ns]."""
    message = PointStamped()
    message.header.stamp = to_stamp(stamp)
    message.header.frame_id = RIG_FRAME
    message.point = _point(tip)
    return message


def to_tip_pose(tip: SpatialTip | None, stamp: int) -> PoseWithCovarianceStamped:
    """Return the answer to a pair exposed at `stamp` [ns]; infinite covariance without a tip."""
    message = PoseWithCovarianceStamped()
    message.header.stamp = to_stamp(stamp)
    message.header.frame_id = RIG_FRAME
    covariance = np.zeros((6, 6))
    if tip is None:
        np.fill_diagonal(covariance, np.inf)
        message.pose.pose.orientation.w = 1.0
    else:
        message.pose.pose.position = _point(tip)
        x, y, z, w = (float(part) for part in orientation(tip.direction))
        message.pose.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
        covariance[:3, :3] = tip.covariance
        covariance[3:, 3:] = rotation_covariance(tip.direction, tip.direction_covariance)
    message.pose.covariance = covariance.reshape(-1)
    return message


def rotation_of(pose: Pose) -> NDArray[np.float64] | None:
    """Return the axes of a pose's frame as columns, (3, 3); None where it has no orientation."""
    q = pose.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    norm = float(np.linalg.norm(quaternion))
    return rotation_matrix(quaternion / norm) if 0.5 < norm < 2.0 else None


def roll_sigma_of(covariance: npt.ArrayLike, axis: NDArray[np.float64]) -> float:
    """Return the standard deviation of the rotation about an axis, from a pose's covariance."""
    rotations = np.reshape(np.asarray(covariance, dtype=np.float64), (6, 6))[3:, 3:]
    variance = float(axis @ rotations @ axis)
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def to_image(pixels: NDArray[np.uint8], stamp: int) -> Image:
    """Return the message of an RGB picture of what was exposed at `stamp` [ns], left view first."""
    message = Image()
    message.header.stamp = to_stamp(stamp)
    message.header.frame_id = LEFT_FRAME
    message.height, message.width = pixels.shape[:2]
    message.encoding, message.step = "rgb8", 3 * pixels.shape[1]
    message.data = array.array("B", pixels.tobytes())
    return message


def _point(tip: SpatialTip) -> Point:
    # Python floats: a numpy scalar of another width would go out as garbage.
    x, y, z = (float(part) for part in tip.position)
    return Point(x=x, y=y, z=z)
