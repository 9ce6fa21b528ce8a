"""Stereo rig of the simulation: its own reader of the calibration file, and the windows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from needle_core.errors import UserError
from needle_core.files.yaml_files import load_yaml, read_calibration
from needle_core.settings.bounds import ABOVE_0, check_bounds
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
        """Return the thickness of each layer, and of the phantom, above points of a height [m]."""
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


_MAX_SIDE_PX = 20_000
_INDICES = (1.0, 3.0)  # refractive
_HALF_HEIGHT = 0.0175  # of a phantom without a window above [m]
_FACING = 0.75  # minimum component of a window's normal along the axis that it faces
_MIN_ACROSS = 0.3  # minimum component of a window's normal across the needle


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
        If it cannot be read or a value is invalid; the message has file, key and value.
    """
    path = Path(path)
    text = read_calibration(path)
    try:
        document = load_yaml(text)
    except ValueError as error:
        raise UserError(f"calibration {path}: {error}") from error
    try:
        return _stereo_rig(_Entries(document))
    except UserError as error:
        raise UserError(f"calibration {path}: {error}") from error


class _Entries:
    """Entries of the file or of a part of it, whose errors contain the full key."""

    def __init__(self, value: object, name: str = "") -> None:
        if not isinstance(value, Mapping):
            raise UserError(f"{name or 'the file'} has no keys")
        self._values = value
        self._prefix = f"{name}." if name else ""

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def name(self, key: str) -> str:
        return self._prefix + key

    def get(self, key: str) -> object:
        if key not in self._values:
            raise UserError(f"{self.name(key)} is missing")
        return self._values[key]

    def part(self, key: str) -> _Entries:
        return _Entries(self.get(key), self.name(key))

    def parts(self, key: str) -> list[_Entries]:
        values, name = self.get(key), self.name(key)
        if not isinstance(values, list):
            raise UserError(f"{name} = {values!r} is not a list")
        return [_Entries(value, f"{name}[{number}]") for number, value in enumerate(values)]

    def number(
        self, key: str, lower: float = -math.inf, upper: float = math.inf, unit: str = "-"
    ) -> float:
        value = _number(self.get(key), self.name(key))
        check_bounds(self.name(key), value, lower, upper, unit)
        return value

    def pixels(self, key: str) -> int:
        value = self.number(key, 1, _MAX_SIDE_PX, "px")
        if not value.is_integer():
            raise UserError(f"{self.name(key)} = {value:g} px is not a whole number")
        return int(value)

    def numbers(self, key: str, count: int) -> FloatArray:
        values, name = self.get(key), self.name(key)
        if not isinstance(values, list) or len(values) != count:
            raise UserError(f"{name} = {values!r} is not a list of {count} numbers")
        return np.array([_number(value, name) for value in values])

    def matrix(self, key: str, rows: int, columns: int) -> FloatArray:
        own, name = self.part(key), self.name(key)
        shape = own.get("rows"), own.get("cols")
        if shape != (rows, columns):
            raise UserError(f"{name} is {shape[0]!r} x {shape[1]!r}, not {rows} x {columns}")
        return own.numbers("data", rows * columns).reshape(rows, columns)


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UserError(f"{name} = {value!r} is not a finite number")
    return float(value)


def _stereo_rig(top: _Entries) -> StereoRig:
    cameras = []
    for side in ("left", "right"):
        own = top.part(side)
        camera = _camera(own, _window_of(top, own))
        before = float(camera.window.height(camera.centre)) - camera.window.outer
        if before <= 0.0:
            raise UserError(
                f"{side}.T_optical_rig puts the camera {-before:g} m behind the window's outer "
                "face, not above the surface"
            )
        cameras.append(camera)
    return StereoRig(*cameras)


def _window_of(top: _Entries, own: _Entries) -> SimulatedWindow:
    """Return the window of a camera: its own one, or the phantom's surface."""
    if ("phantom" in top) == ("window" in own):
        what = "beside phantom" if "phantom" in top else "is missing, and so phantom is missing"
        raise UserError(
            f"{own.name('window')} {what}: give either phantom, the surface of both, or a window "
            "for each"
        )
    if "phantom" in top:
        phantom = top.part("phantom")
        height = phantom.number("surface_height")
        index = phantom.number("refractive_index", *_INDICES)
        return SimulatedWindow(np.array([1.0, 0.0, 0.0]), height, (), (index,))
    window = own.part("window")
    point, normal = window.numbers("point", 3), window.numbers("normal", 3)
    length = float(np.linalg.norm(normal))
    if abs(length - 1.0) > 0.01:
        raise UserError(f"{window.name('normal')} has length {length:g}, not 1")
    normal = normal / length
    if np.linalg.norm(normal[:2]) < _MIN_ACROSS:
        raise UserError(f"{window.name('normal')} = {normal.tolist()} is parallel to the needle")
    layers = window.parts("layers")
    thicknesses = tuple(layer.number("thickness", ABOVE_0, unit="m") for layer in layers)
    indices = [layer.number("refractive_index", *_INDICES) for layer in layers]
    inside = window.number("inside", *_INDICES)
    return SimulatedWindow(normal, float(normal @ point), thicknesses, (*indices, inside))


def _camera(own: _Entries, window: SimulatedWindow) -> SimulatedCamera:
    width, height = own.pixels("image_width"), own.pixels("image_height")
    matrix = own.matrix("camera_matrix", 3, 3)
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0) or np.any(
        matrix[[1, 2, 2, 2], [0, 0, 1, 2]] != (0.0, 0.0, 0.0, 1.0)
    ):
        name = own.name("camera_matrix")
        raise UserError(f"{name} = {matrix.ravel().tolist()} is not a pinhole matrix")
    model = own.get("distortion_model")
    if model != "plumb_bob":
        raise UserError(f"{own.name('distortion_model')} = {model!r} is not 'plumb_bob'")
    distortion = own.matrix("distortion_coefficients", 1, 5)[0]
    transform = own.part("T_optical_rig")
    pose = np.eye(4)
    pose[:3, 3] = transform.numbers("translation", 3)
    pose[:3, :3] = _rotation_matrix(transform.numbers("rotation", 4), transform.name("rotation"))
    return SimulatedCamera(width, height, matrix, distortion, pose, window)


def _rotation_matrix(quaternion: FloatArray, name: str) -> FloatArray:
    """Return the matrix of a unit quaternion x, y, z, w."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        raise UserError(f"{name} has norm {norm:g}, not 1")
    vector, scalar = quaternion[:3] / norm, quaternion[3] / norm
    cross = np.cross(np.eye(3), vector)
    return np.asarray(np.eye(3) + 2.0 * (scalar * cross + cross @ cross))
