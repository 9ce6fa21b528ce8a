"""Calibration of the stereo rig: cameras, the windows that they look through, and its file."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_core.files.yaml_files import load_yaml, read_calibration
from needle_core.rotations import rotation_from_quaternion
from needle_core.settings.bounds import ABOVE_0, check_bounds

SIDES = ("left", "right")
LEAST_BASELINE = 1e-3  # distance between the cameras [m]
_DISTORTION_MODEL = "plumb_bob"
_INDICES = (1.0, 3.0)
_THICKEST = 0.5  # largest thickness of a layer [m]
_LEAST_ASIDE = 0.3  # component of the normal of a window perpendicular to the needle [-]


@dataclasses.dataclass(frozen=True)
class Layer:
    """A plane-parallel plate, such as a wall of acrylic.

    Attributes
    ----------
    thickness : float
        Thickness along the normal of the window [m].
    refractive_index : float
        Refractive index relative to air [-], at least 1.
    """

    thickness: float
    refractive_index: float


@dataclasses.dataclass(frozen=True)
class Window:
    """Surface at which light enters the body with the needle.

    Attributes
    ----------
    point : ndarray, shape (3,)
        Any point of the outer face in `rig` [m].
    normal : ndarray, shape (3,)
        Unit vector in `rig`, perpendicular to the faces and towards the camera.
    layers : tuple of Layer
        Layers from the outer face inwards; none for a body with a free surface.
    inside : float
        Refractive index of the body relative to air [-], at least 1.
    """

    point: NDArray[np.float64]
    normal: NDArray[np.float64]
    layers: tuple[Layer, ...]
    inside: float

    @property
    def thickness(self) -> float:
        """Thickness of all layers together [m]."""
        return sum(layer.thickness for layer in self.layers)

    def height(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of points above the outer face, towards the camera.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m].

        Returns
        -------
        ndarray, shape (...)
            Heights [m], negative behind the face.
        """
        return np.asarray((points - self.point) @ self.normal)

    def depth(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depth of points in the body, behind all layers.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m].

        Returns
        -------
        ndarray, shape (...)
            Depths [m], negative in a layer and in front of the window.
        """
        return -self.height(points) - self.thickness


def common_surface(left: Window, right: Window) -> Window | None:
    """Return the level, free surface that two windows share, if any."""
    for window in (left, right):
        if window.layers or not np.array_equal(window.normal, [1.0, 0.0, 0.0]):
            return None
    same = left.point[0] == right.point[0] and left.inside == right.inside
    return left if same else None


def surface_from_above(surface_height: float, refractive_index: float) -> Window:
    """Return the free, level surface of a body.

    Parameters
    ----------
    surface_height : float
        x of the surface in `rig` [m].
    refractive_index : float
        Refractive index of the body relative to air [-].
    """
    return Window(
        np.array([surface_height, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), (), refractive_index
    )


@dataclasses.dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera and its window.

    Attributes
    ----------
    width, height : int
        Image size [px].
    camera_matrix : ndarray, shape (3, 3)
        fx, fy, cx, cy [px].
    distortion : ndarray, shape (5,)
        k1, k2, p1, p2, k3 of plumb_bob [-].
    T_optical_rig : ndarray, shape (4, 4)
        Transforms points of `rig` to the optical frame of the camera [m].
    window : Window
        Surface through which the camera sees the body with the needle.
    """

    width: int
    height: int
    camera_matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    T_optical_rig: NDArray[np.float64]
    window: Window

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre of projection in `rig` [m], shape (3,)."""
        rotation = self.T_optical_rig[:3, :3]
        return np.asarray(-rotation.T @ self.T_optical_rig[:3, 3])


@dataclasses.dataclass(frozen=True)
class StereoCalibration:
    """Both cameras, each with its window; `text` is that of its file, if it has one."""

    left: Camera
    right: Camera
    text: str = dataclasses.field(default="", kw_only=True)

    @property
    def cameras(self) -> dict[str, Camera]:
        """Both cameras by side, left first."""
        return {"left": self.left, "right": self.right}

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height of the images of each side [px]."""
        return {side: (camera.width, camera.height) for side, camera in self.cameras.items()}

    @property
    def surface(self) -> Window | None:
        """Level surface that both cameras share; None if each has its own window."""
        return common_surface(self.left.window, self.right.window)


def load_calibration(file: str | Path) -> StereoCalibration:
    """Read and check a calibration file.

    Parameters
    ----------
    file : str or Path
        YAML file in the format of docs/calibration.md: `left` and `right`; `phantom`, or a `window`
        under each of them. An empty text stands for the simulated bench's.

    Returns
    -------
    StereoCalibration
        Calibration with normalized rotations.

    Raises
    ------
    UserError
        Unreadable, not YAML, or a value missing, not finite, of the wrong size or out of bounds.
    """
    path = Path(file or find_shared_file("needle_tracker", "config/calibration.yaml")).expanduser()
    return calibration_from(read_calibration(path), path)


def calibration_from(text: str, path: Path) -> StereoCalibration:
    """Return the calibration in the text of a file; raises as `load_calibration`."""
    try:
        return dataclasses.replace(parse_calibration(load_yaml(text)), text=text)
    except (UserError, ValueError) as error:
        raise UserError(f"calibration {path}: {error}") from error


def parse_calibration(content: Any) -> StereoCalibration:
    """Return the calibration in the content of a file, rotations normalized.

    Raises
    ------
    UserError
        A value missing, not finite, of the wrong size or out of bounds.
    """
    left, right = (
        _camera(content, side, window)
        for side, window in zip(SIDES, parse_windows(content), strict=True)
    )
    if np.linalg.norm(left.centre - right.centre) < LEAST_BASELINE:
        raise UserError("left and right camera are in the same place: no depth can be measured")
    return StereoCalibration(left, right)


def parse_windows(content: Any) -> tuple[Window, Window]:
    """Return the windows of both cameras: their own, or the surface of the phantom.

    Parameters
    ----------
    content : mapping
        Content of a file: `phantom`, or `left` and `right` with a `window` each.

    Raises
    ------
    UserError
        Both kinds or neither, or a value missing, not finite or out of bounds.
    """
    top = content if isinstance(content, dict) else {}
    own = [f"{s}.window" for s in SIDES if isinstance(top.get(s), dict) and "window" in top[s]]
    if "phantom" in top and own:
        raise UserError(
            f"phantom and {' and '.join(own)} contradict each other: take phantom out where each "
            "camera has a window, or the windows where both look through one level surface"
        )
    if own:
        return _window(content, SIDES[0]), _window(content, SIDES[1])
    if "phantom" not in top:
        raise UserError(
            "phantom is missing, and so are left.window and right.window: give "
            "phantom for one level surface, or each camera its window"
        )
    height = number(content, "phantom", "surface_height")
    index = _index(content, "phantom", "refractive_index")
    surface = surface_from_above(height, index)
    return surface, surface


def _window(content: Any, side: str) -> Window:
    point = numbers(content, 3, side, "window", "point")
    normal = numbers(content, 3, side, "window", "normal")
    norm = float(np.linalg.norm(normal))
    check_bounds(f"length of {side}.window.normal", norm, 0.99, 1.01, "-")
    normal = normal / norm
    if math.hypot(normal[0], normal[1]) < _LEAST_ASIDE:
        raise UserError(
            f"{side}.window.normal = {normal.tolist()} lies along z, the needle's axis: a camera "
            "must view the needle from the side"
        )
    name = f"{side}.window.layers"
    layers = value_of(content, side, "window", "layers")
    if not isinstance(layers, list):
        raise UserError(f"{name} = {layers!r} is not a list (no layers: [])")
    found = []
    for i, layer in enumerate(layers):
        entry = {f"{name}[{i}]": layer}
        thickness = number(entry, *entry, "thickness")
        check_bounds(f"{name}[{i}].thickness", thickness, ABOVE_0, _THICKEST, "m")
        found.append(Layer(thickness, _index(entry, *entry, "refractive_index")))
    return Window(point, normal, tuple(found), _index(content, side, "window", "inside"))


def _index(content: Any, *keys: str) -> float:
    index = number(content, *keys)
    check_bounds(".".join(keys), index, *_INDICES, "-")
    return index


def _camera(content: Any, side: str, window: Window) -> Camera:
    width, height = (size_of(content, side, key) for key in ("image_width", "image_height"))
    matrix = numbers(content, 9, side, "camera_matrix", "data").reshape(3, 3)
    check_camera_matrix(f"{side}.camera_matrix", matrix)
    model = value_of(content, side, "distortion_model")
    if model != _DISTORTION_MODEL:
        raise UserError(f"{side}.distortion_model = {model!r}, expected {_DISTORTION_MODEL!r}")
    distortion = numbers(content, 5, side, "distortion_coefficients", "data")
    transform = transform_of(content, side, "T_optical_rig")
    camera = Camera(width, height, matrix, distortion, transform, window)
    above = float(window.height(camera.centre))
    if above <= 0.0:
        raise UserError(
            f"{side} camera is not above the surface that it looks through, but "
            f"{-1e3 * above:.1f} mm beneath: the window's normal must point to the camera"
        )
    return camera


def transform_of(content: Any, *keys: str) -> NDArray[np.float64]:
    """Return the transform, (4, 4), under a path of keys: `translation` [m] and `rotation`.

    The rotation is a unit quaternion x, y, z, w; anything else raises a `UserError`.
    """
    translation = numbers(content, 3, *keys, "translation")
    quaternion = numbers(content, 4, *keys, "rotation")
    norm = float(np.linalg.norm(quaternion))
    check_bounds(f"norm of {'.'.join((*keys, 'rotation'))}", norm, 0.99, 1.01, "-")
    return pose_matrix(rotation_from_quaternion(quaternion / norm), translation)


def check_camera_matrix(name: str, matrix: NDArray[np.float64]) -> None:
    """Reject a camera matrix, (3, 3), with skew or without focal lengths."""
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        raise UserError(f"{name}: focal lengths {matrix[0, 0]:g}, {matrix[1, 1]:g} px not positive")
    if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]] != 0.0) or matrix[2, 2] != 1.0:
        raise UserError(f"{name} is not [fx 0 cx; 0 fy cy; 0 0 1]")


def pose_matrix(rotation: NDArray[np.float64], position: npt.ArrayLike) -> NDArray[np.float64]:
    """Return the transform, (4, 4), with a rotation, (3, 3), and a position, (3,) [m]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def value_of(content: Any, *keys: str) -> Any:
    """Return the value under a path of keys; a missing one raises a `UserError` with the path."""
    value = content
    for key in keys:
        if not isinstance(value, dict) or key not in value:
            raise UserError(f"{'.'.join(keys)} is missing")
        value = value[key]
    return value


def number(content: Any, *keys: str) -> float:
    """Return the number under a path of keys; raises a `UserError` unless it is finite."""
    value = value_of(content, *keys)
    if not _is_number(value) or not math.isfinite(value):
        raise UserError(f"{'.'.join(keys)} = {value!r} is not a finite number")
    return float(value)


def numbers(content: Any, count: int | None, *keys: str) -> NDArray[np.float64]:
    """Return the list of finite numbers under a path of keys, shape (count,); None: any count.

    Rows of a matrix are joined. Anything else raises a `UserError`.
    """
    value, name = value_of(content, *keys), ".".join(keys)
    if isinstance(value, list):
        rows = (item if isinstance(item, list) else [item] for item in value)
        value = list(itertools.chain.from_iterable(rows))
    if not isinstance(value, list) or len(value) != (len(value) if count is None else count):
        got = f"{len(value)} values" if isinstance(value, list) else repr(value)
        raise UserError(f"{name} needs {count} numbers, has {got}")
    if not all(_is_number(item) and math.isfinite(item) for item in value):
        raise UserError(f"{name} = {value} has a value that is not a finite number")
    return np.array(value, dtype=np.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def size_of(content: Any, *keys: str) -> int:
    """Return the size of an image under a path of keys [px]; raises a `UserError` unless valid."""
    value = value_of(content, *keys)
    if not isinstance(value, int) or isinstance(value, bool) or not 16 <= value <= 16384:
        raise UserError(f"{'.'.join(keys)} = {value!r} is not a size in [16, 16384] px")
    return value
