"""Messages of sim_rig."""

from __future__ import annotations

import array
from collections.abc import Mapping

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from needle_core.ros.conversions import to_quaternion
from needle_sim.camera.stereo_rig import SimulatedCamera
from needle_sim.needle.se3 import FloatArray

RIG_FRAME = "rig"
# A tip alone says nothing about the heading [rad^2].
_UNKNOWN_ORIENTATION = 1e6
# A variance of 0 would read as "not known" [m^2].
_LEAST_POSITION_VARIANCE = 1e-12


def to_truth(T_rig_tip: FloatArray, stamp: Time) -> PoseStamped:  # noqa: N803
    """Return the true pose of the tip, shape (4, 4), as a message."""
    message = PoseStamped(header=Header(stamp=stamp, frame_id=RIG_FRAME))
    position = message.pose.position
    position.x, position.y, position.z = map(float, T_rig_tip[:3, 3])
    message.pose.orientation = to_quaternion(T_rig_tip[:3, :3].tolist())
    return message


def to_tip(tip: FloatArray, stamp: Time) -> PointStamped:
    """Return a measured tip in `rig`, shape (3,), as a message."""
    message = PointStamped(header=Header(stamp=stamp, frame_id=RIG_FRAME))
    message.point.x, message.point.y, message.point.z = map(float, tip)
    return message


def to_tip_pose(tip: FloatArray, noise: float, stamp: Time) -> PoseWithCovarianceStamped:
    """Return a measured tip with uniform noise of +-`noise` [m] and no known orientation."""
    message = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=RIG_FRAME))
    position = message.pose.pose.position
    position.x, position.y, position.z = map(float, tip)
    variance = max(noise**2 / 3.0, _LEAST_POSITION_VARIANCE)
    message.pose.covariance = np.diag([variance] * 3 + [_UNKNOWN_ORIENTATION] * 3).ravel()
    return message


def to_image(image: NDArray[np.uint8], frame: str, stamp: Time) -> Image:
    """Return a grey image as a message."""
    height, width = image.shape
    message = Image(height=height, width=width, encoding="mono8", step=width)
    message.header = Header(stamp=stamp, frame_id=frame)
    # Anything but an array of bytes is copied element by element.
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(image).data)
    message.data = data
    return message


def to_camera_info(camera: SimulatedCamera, frame: str, stamp: Time) -> CameraInfo:
    """Return a camera's calibration as a message; the images are not rectified."""
    return CameraInfo(
        header=Header(stamp=stamp, frame_id=frame),
        height=camera.image_height,
        width=camera.image_width,
        distortion_model="plumb_bob",
        d=[float(value) for value in camera.distortion],
        k=camera.camera_matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([camera.camera_matrix, np.zeros((3, 1))]).ravel(),
    )


def stamp_in(values: Mapping[str, str], key: str) -> int:
    """Return the stamp that a status has under a key [ns]; -1 where it has none."""
    try:
        return int(values.get(key) or -1)
    except ValueError:
        return -1
