"""Model of the rig as URDF, from calibration and limits."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_tracker.optics.calibration import StereoCalibration, pose_matrix

Array = NDArray[np.float64]

# Half width of the phantom in directions without a window, for display only [m].
_HALF_SIDE = 0.07
# A camera's body frame has x along the optical axis and z upwards in the image (REP 103).
_R_OPTICAL_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def camera_bodies(calibration: StereoCalibration) -> dict[str, Array]:
    """Return the pose of each camera's body in `rig` by side, shape (4, 4) [m]."""
    poses = {}
    for side, camera in calibration.cameras.items():
        rotation = camera.T_optical_rig[:3, :3].T @ _R_OPTICAL_BODY
        poses[side] = pose_matrix(rotation, camera.centre)
    return poses


def rig_urdf(calibration: StereoCalibration, limits: SafetyLimits, diameter: float) -> str:
    """Return the URDF of the rig.

    Parameters
    ----------
    calibration : StereoCalibration
        Cameras and windows. The phantom is drawn centred on the needle's axis.
    limits : SafetyLimits
        Range and speed of the joints.
    diameter : float
        Diameter of the needle [m].
    """
    half = np.full(2, _HALF_SIDE)
    for camera in calibration.cameras.values():
        across = int(np.argmax(np.abs(camera.window.normal[:2])))
        half[across] = abs(camera.window.point[across])
    cameras = {
        # These Euler angles are singular only for a camera that looks along the needle.
        side: (_text(pose[:3, 3]), _text(Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")))
        for side, pose in camera_bodies(calibration).items()
    }
    text = find_shared_file("needle_bags", "config/rig.urdf.jinja").read_text("utf-8")
    template = Environment(undefined=StrictUndefined).from_string(text)
    return template.render(limits=limits, diameter=diameter, half=half, cameras=cameras)


def joint_attributes(urdf: str) -> dict[str, str]:
    """Return the attributes of all joints of a URDF, such as `insertion_joint limit upper`.

    Raises
    ------
    UserError
        If it is not a URDF.
    """
    try:
        return {
            f"{joint.attrib['name']} {part.tag} {name}": text
            for joint in ElementTree.fromstring(urdf).iterfind("joint")
            for part in (joint, *joint)
            for name, text in part.items()
        }
    except (ElementTree.ParseError, KeyError) as error:
        raise UserError(f"not a URDF: {error}") from error


def _text(numbers: Array) -> str:
    return " ".join(f"{number:.12g}" for number in numbers)
