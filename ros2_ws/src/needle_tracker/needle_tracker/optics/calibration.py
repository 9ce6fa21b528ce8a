"""The calibration file of the stereo rig: read, checked, typed."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from needle_common.errors import OutOfBoundsError, UserError

SIDES = ("left", "right")
LEAST_BASELINE = 1e-3  # between the cameras [m]
_DISTORTION_MODEL = "plumb_bob"


@dataclasses.dataclass(frozen=True)
class Camera:
    """One calibrated pinhole camera.

    Attributes
    ----------
    width, height : int
        Image size [px].
    camera_matrix : ndarray, shape (3, 3)
        fx, fy, cx, cy [px].
    distortion : ndarray, shape (5,)
        plumb_bob's k1, k2, p1, p2, k3 [-].
    T_optical_rig : ndarray, shape (4, 4)
        Takes points of `rig` to the camera's optical frame [m].
    """

    width: int
    height: int
    camera_matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    T_optical_rig: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre of projection in `rig` [m], shape (3,)."""
        rotation = self.T_optical_rig[:3, :3]
        return np.asarray(-rotation.T @ self.T_optical_rig[:3, 3])


@dataclasses.dataclass(frozen=True)
class Phantom:
    """The refracting body that the needle is in.

    Attributes
    ----------
    surface_height : float
        x of the flat top surface in `rig` [m].
    refractive_index : float
        Of the phantom against air [-], at least 1.
    """

    surface_height: float
    refractive_index: float


@dataclasses.dataclass(frozen=True)
class StereoCalibration:
    """Both cameras and the surface they look through."""

    phantom: Phantom
    left: Camera
    right: Camera


def load_calibration(path: Path) -> StereoCalibration:
    """Read and check a calibration file.

    Parameters
    ----------
    path : Path
        YAML file in the format of docs: `phantom`, `left`, `right`.

    Returns
    -------
    StereoCalibration
        With rotations normalised.

    Raises
    ------
    UserError
        Unreadable, not YAML, or a value missing, not finite, of the wrong size or out of bounds;
        the message says which.
    """
    return calibration_from(read_calibration(path), path)


def read_calibration(path: Path) -> str:
    """Return the text of a calibration file; a `UserError` says why it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise UserError(f"cannot read calibration {path}: {reason}") from error


def calibration_from(text: str, path: Path) -> StereoCalibration:
    """Return what the text of a calibration file says; raises as `load_calibration`."""
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UserError(f"calibration {path} is not YAML: {yaml_problem(error)}") from error
    try:
        return parse_calibration(content)
    except UserError as error:
        raise UserError(f"calibration {path}: {error}") from error


def parse_calibration(content: Any) -> StereoCalibration:
    """Check the content of a calibration file, as `yaml.safe_load` returns it.

    Parameters
    ----------
    content : mapping
        The file's content.

    Returns
    -------
    StereoCalibration
        With rotations normalised.

    Raises
    ------
    UserError
        A value missing, not finite, of the wrong size or out of bounds.
    """
    surface_height = _number(content, "phantom", "surface_height")
    refractive_index = _number(content, "phantom", "refractive_index")
    if not 1.0 <= refractive_index <= 3.0:
        raise OutOfBoundsError("phantom.refractive_index", refractive_index, 1.0, 3.0, "-")
    cameras = [_camera(content, side) for side in SIDES]
    for side, camera in zip(SIDES, cameras, strict=True):
        if camera.centre[0] <= surface_height:
            raise UserError(
                f"{side} camera is at x = {camera.centre[0]:g} m, not above the surface at "
                f"{surface_height:g} m"
            )
    if np.linalg.norm(cameras[0].centre - cameras[1].centre) < LEAST_BASELINE:
        raise UserError("left and right camera are in the same place: no depth can be measured")
    return StereoCalibration(Phantom(surface_height, refractive_index), cameras[0], cameras[1])


def yaml_problem(error: yaml.YAMLError) -> str:
    """Return in one line what a file is no YAML for, and where."""
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error).splitlines()[0]
    return problem if mark is None else f"line {mark.line + 1}: {problem}"


def _camera(content: Any, side: str) -> Camera:
    width, height = (_size(content, side, key) for key in ("image_width", "image_height"))
    matrix = _numbers(content, 9, side, "camera_matrix", "data").reshape(3, 3)
    fx, fy = matrix[0, 0], matrix[1, 1]
    if not (fx > 0.0 and fy > 0.0):
        raise UserError(f"{side}.camera_matrix: focal lengths {fx:g}, {fy:g} px are not positive")
    if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]] != 0.0) or matrix[2, 2] != 1.0:
        raise UserError(f"{side}.camera_matrix is not [fx 0 cx; 0 fy cy; 0 0 1]")
    model = _value(content, side, "distortion_model")
    if model != _DISTORTION_MODEL:
        raise UserError(f"{side}.distortion_model = {model!r}, wants {_DISTORTION_MODEL!r}")
    distortion = _numbers(content, 5, side, "distortion_coefficients", "data")
    translation = _numbers(content, 3, side, "T_optical_rig", "translation")
    quaternion = _numbers(content, 4, side, "T_optical_rig", "rotation")
    norm = float(np.linalg.norm(quaternion))
    if not 0.99 <= norm <= 1.01:
        raise OutOfBoundsError(f"norm of {side}.T_optical_rig.rotation", norm, 0.99, 1.01, "-")
    transform = np.eye(4)
    transform[:3, :3] = rotation_matrix(quaternion / norm)
    transform[:3, 3] = translation
    return Camera(width, height, matrix, distortion, transform)


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) rotation of a unit quaternion in the order x, y, z, w."""
    x, y, z, w = (float(part) for part in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _value(content: Any, *keys: str) -> Any:
    value = content
    for key in keys:
        if not isinstance(value, dict) or key not in value:
            raise UserError(f"{'.'.join(keys)} is missing")
        value = value[key]
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _number(content: Any, *keys: str) -> float:
    value = _value(content, *keys)
    if not _is_number(value) or not math.isfinite(value):
        raise UserError(f"{'.'.join(keys)} = {value!r} is not a finite number")
    return float(value)


def _numbers(content: Any, count: int, *keys: str) -> NDArray[np.float64]:
    value = _value(content, *keys)
    name = ".".join(keys)
    if not isinstance(value, list) or len(value) != count:
        got = f"{len(value)} values" if isinstance(value, list) else repr(value)
        raise UserError(f"{name} wants {count} numbers, has {got}")
    if not all(_is_number(item) and math.isfinite(item) for item in value):
        raise UserError(f"{name} = {value} has a value that is not a finite number")
    return np.array(value, dtype=np.float64)


def _size(content: Any, *keys: str) -> int:
    value = _value(content, *keys)
    if not isinstance(value, int) or isinstance(value, bool) or not 16 <= value <= 16384:
        raise UserError(f"{'.'.join(keys)} = {value!r} is not a size in [16, 16384] px")
    return value
