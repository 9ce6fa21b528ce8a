"""Stereo rig of the simulation: its own reader of the calibration file, and the windows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from needle_core.errors import UserError
from needle_core.files.yaml_files import load_yaml, read_calibration
from needle_sim.needle.se3 import FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedWindow:
    """Window: parallel faces with a layer between each pair, and the phantom behind the last one.

    Parameters
    ----------
    normal : ndarray, shape (3,)
        Unit vector in `rig`, towards the camera.
    outer : float
        Coordinate of the outer face along the normal, from `rig`'s origin [m].
    thicknesses : tuple of float
        Thicknesses of the layers, from outside inwards [m].
    indices : tuple of float
        Refractive indices of the layers, the last one of the phantom.
    """

    normal: FloatArray
    outer: float
    thicknesses: tuple[float, ...]
    indices: tuple[float, ...]

    @property
    def inner(self) -> float:
        """Coordinate along the normal of the inner face, where the phantom begins [m]."""
        return self.outer - sum(self.thicknesses)

    def height(self, points: ArrayLike) -> FloatArray:
        """Return the coordinates (...,) along the normal of points (..., 3) in `rig` [m]."""
        return np.asarray(points, dtype=np.float64) @ self.normal

    def layer_lengths(self, height: FloatArray) -> list[FloatArray]:
        """Return the thickness of each layer, and of the phantom, above points at a height [m]."""
        left = np.maximum(self.outer - height, 0.0)
        lengths = []
        for thickness in self.thicknesses:
            lengths.append(np.minimum(left, thickness))
            left = left - lengths[-1]
        return [*lengths, left]

    @property
    def sideways(self) -> FloatArray:
        """Unit vector along the faces and across z, shape (3,)."""
        across = np.cross([0.0, 0.0, 1.0], self.normal)
        return np.asarray(across / np.linalg.norm(across))


_SIZE = ("width", "height")
_LENGTH_TOLERANCE = 0.01  # of unit vectors
_HALF_HEIGHT = 0.0175  # of a phantom without a window above [m]
_FACING = 0.75  # minimum component of a window's normal along the axis that it faces


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """Calibrated camera.

    Parameters
    ----------
    image_width, image_height : int
        Size of the images [px].
    camera_matrix : ndarray, shape (3, 3)
        Pinhole matrix [px].
    distortion : ndarray, shape (5,)
        plumb_bob: k1, k2, p1, p2, k3.
    T_optical_rig : ndarray, shape (4, 4)
        Rig to optical frame (REP 103) [m].
    window : SimulatedWindow
        Window of the camera.
    """

    image_width: int
    image_height: int
    camera_matrix: FloatArray
    distortion: FloatArray
    T_optical_rig: FloatArray
    window: SimulatedWindow

    @property
    def centre(self) -> FloatArray:
        """Centre of projection in `rig`, shape (3,) [m]."""
        pose = self.T_optical_rig
        return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two cameras that look into a phantom, each through its window.

    Parameters
    ----------
    left, right : SimulatedCamera
        Left and right camera.
    """

    left: SimulatedCamera
    right: SimulatedCamera

    @property
    def half_height(self) -> float:
        """Distance from the needle's axis to the phantom's top and bottom, along x [m]."""
        return self._reach(0, _HALF_HEIGHT)

    @property
    def half_width(self) -> float:
        """Distance from the needle's axis to the phantom's sides, along y [m]."""
        return self._reach(1, math.inf)

    def _reach(self, axis: int, default: float) -> float:
        """Return the distance of the nearest window that faces this axis, or the default."""
        windows = (self.left.window, self.right.window)
        facing = [w for w in windows if abs(w.normal[axis]) >= _FACING]
        return min((w.inner / abs(float(w.normal[axis])) for w in facing), default=default)


def load_stereo_rig(path: Path | str) -> StereoRig:
    """Read a calibration file.

    Parameters
    ----------
    path : Path or str
        The YAML file.

    Returns
    -------
    StereoRig
        Content of the file.

    Raises
    ------
    UserError
        If it cannot be read or a value is invalid; the message names file and key.
    """
    path = Path(path)
    text = read_calibration(path)
    try:
        document = load_yaml(text)
        return StereoRig(*(_camera(document, side) for side in ("left", "right")))
    except ValueError as error:
        raise UserError(f"calibration {path}: {error}") from error


def _entry(document: Any, key: str) -> Any:
    """Return an entry by its key, such as `left.window.layers.0.thickness`.

    Raises
    ------
    ValueError
        If it is missing.
    """
    value = document
    for part in key.split("."):
        try:
            value = value[int(part) if part.isdigit() else part]
        except (KeyError, IndexError, TypeError):
            raise ValueError(f"{key} is missing") from None
    return value


def _numbers(document: Any, key: str, *shape: int) -> FloatArray:
    """Return the finite numbers of an entry; raise a ValueError if it does not have that shape."""
    value = _entry(document, key)
    try:
        numbers = np.array(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not np.all(np.isfinite(numbers)):
        raise ValueError(f"{key} = {value!r} is not {math.prod(shape)} finite numbers")
    return numbers


def _number(document: Any, key: str, lower: float = -math.inf) -> float:
    """Return a number; raise a ValueError if it is below a bound."""
    value = float(_numbers(document, key))
    if value < lower:
        raise ValueError(f"{key} = {value:g} is below {lower:g}")
    return value


def _unit_vector(document: Any, key: str, size: int) -> FloatArray:
    """Return a vector, normalized to exactly length 1."""
    vector = _numbers(document, key, size)
    length = float(np.linalg.norm(vector))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise ValueError(f"{key} has length {length:g}, not 1")
    return np.asarray(vector / length)


def _window(document: Any, side: str) -> SimulatedWindow:
    """Return the window of a camera: its own, or the phantom's surface."""
    if "window" not in _entry(document, side):
        height = _number(document, "phantom.surface_height")
        index = _number(document, "phantom.refractive_index", 1.0)
        return SimulatedWindow(np.array([1.0, 0.0, 0.0]), height, (), (index,))
    window = f"{side}.window"
    layers = [f"{window}.layers.{k}" for k in range(len(_entry(document, f"{window}.layers")))]
    normal = _unit_vector(document, f"{window}.normal", 3)
    thicknesses = tuple(_number(document, f"{layer}.thickness", 0.0) for layer in layers)
    indices = [_number(document, f"{layer}.refractive_index", 1.0) for layer in layers]
    inside = _number(document, f"{window}.inside", 1.0)
    outer = float(normal @ _numbers(document, f"{window}.point", 3))
    return SimulatedWindow(normal, outer, thicknesses, (*indices, inside))


def _camera(document: Any, side: str) -> SimulatedCamera:
    width, height = (int(_number(document, f"{side}.image_{name}", 1)) for name in _SIZE)
    matrix = _numbers(document, f"{side}.camera_matrix.data", 3, 3)
    model = _entry(document, f"{side}.distortion_model")
    if model != "plumb_bob":
        raise ValueError(f"{side}.distortion_model = {model!r} is not 'plumb_bob'")
    distortion = _numbers(document, f"{side}.distortion_coefficients.data", 5)
    pose = np.eye(4)
    pose[:3, 3] = _numbers(document, f"{side}.T_optical_rig.translation", 3)
    pose[:3, :3] = _rotation_matrix(_unit_vector(document, f"{side}.T_optical_rig.rotation", 4))
    window = _window(document, side)
    camera = SimulatedCamera(width, height, matrix, distortion, pose, window)
    if float(window.height(camera.centre)) <= window.outer:
        raise ValueError(f"{side}.T_optical_rig puts the camera behind its window")
    return camera


def _rotation_matrix(quaternion: FloatArray) -> FloatArray:
    """Return the matrix of a unit quaternion x, y, z, w."""
    vector, scalar = quaternion[:3], quaternion[3]
    cross = np.cross(np.eye(3), vector)
    return np.asarray(np.eye(3) + 2.0 * (scalar * cross + cross @ cross))
