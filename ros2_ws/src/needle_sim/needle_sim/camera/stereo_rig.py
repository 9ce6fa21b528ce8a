"""The simulation's own reader of the stereo rig's calibration file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from needle_common.errors import UserError
from needle_sim.camera.window import SimulatedWindow
from needle_sim.needle.se3 import FloatArray

_LARGEST_SIDE_PX = 20_000
_HALF_HEIGHT = 0.0175  # of a phantom that no window ends above [m]
_FACING = 0.75  # of a window's normal: the part along the axis that it faces
_LEAST_ACROSS = 0.3  # of a window's normal: the part across the needle


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """One calibrated camera.

    Parameters
    ----------
    image_width, image_height : int
        Size of its images [px].
    camera_matrix : ndarray, shape (3, 3)
        Pinhole matrix [px].
    distortion : ndarray, shape (5,)
        plumb_bob: k1, k2, p1, p2, k3.
    T_optical_rig : ndarray, shape (4, 4)
        Rig to optical frame (REP 103) [m].
    window : SimulatedWindow
        What it looks through.
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
    """Two cameras that look at a phantom, each through its window.

    Parameters
    ----------
    left, right : SimulatedCamera
        The pair.
    """

    left: SimulatedCamera
    right: SimulatedCamera

    @property
    def half_height(self) -> float:
        """How far the phantom reaches up and down from the needle's axis, along x [m]."""
        return self._reach(0, _HALF_HEIGHT)

    @property
    def half_width(self) -> float:
        """How far it reaches to both sides, along y [m]."""
        return self._reach(1, math.inf)

    def _reach(self, axis: int, unseen: float) -> float:
        """Return how far a window that faces this way is, or what is taken without one."""
        windows = (self.left.window, self.right.window)
        facing = [w for w in windows if abs(w.normal[axis]) >= _FACING]
        return min((w.inner / abs(float(w.normal[axis])) for w in facing), default=unseen)


def load_stereo_rig(path: Path | str) -> StereoRig:
    """Read a calibration file.

    Parameters
    ----------
    path : Path or str
        The YAML file.

    Returns
    -------
    StereoRig
        What it says.

    Raises
    ------
    UserError
        If it cannot be read or says something that cannot be, naming file, key and value.
    """
    path = Path(path)
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read calibration {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"calibration {path} is no YAML: {reason}") from error
    try:
        return _stereo_rig(document)
    except _BadEntryError as error:
        raise UserError(f"calibration {path}: {error}") from error


class _BadEntryError(Exception):
    """A key of the file and what is wrong with it."""


def _stereo_rig(document: object) -> StereoRig:
    top = _mapping(document, "the file")
    cameras = {}
    for side in ("left", "right"):
        values = _mapping(_entry(top, side, ""), side)
        camera = _camera(values, side, _window_of(top, values, side))
        before = float(camera.window.height(camera.centre)) - camera.window.outer
        if before <= 0.0:
            raise _BadEntryError(
                f"{side}.T_optical_rig puts the camera {-before:g} m behind the window's outer "
                "face, not above the surface"
            )
        cameras[side] = camera
    return StereoRig(cameras["left"], cameras["right"])


def _window_of(
    top: Mapping[object, object], values: Mapping[object, object], side: str
) -> SimulatedWindow:
    """Return what a camera looks through: its own window, or the phantom's surface."""
    if ("phantom" in top) == ("window" in values):
        what = "beside phantom" if "phantom" in top else "is missing, and so phantom is missing"
        raise _BadEntryError(
            f"{side}.window {what}: say either phantom, the surface of both, or a window for each"
        )
    if "phantom" in top:
        phantom = _mapping(top["phantom"], "phantom")
        height = _number(_entry(phantom, "surface_height", "phantom."), "phantom.surface_height")
        index = _refractive_index(phantom, "refractive_index", "phantom.")
        return SimulatedWindow(np.array([1.0, 0.0, 0.0]), height, (), (index,))
    prefix = f"{side}.window."
    window = _mapping(values["window"], f"{side}.window")
    point = _numbers(_entry(window, "point", prefix), prefix + "point", 3)
    normal = _numbers(_entry(window, "normal", prefix), prefix + "normal", 3)
    length = float(np.linalg.norm(normal))
    if abs(length - 1.0) > 0.01:
        raise _BadEntryError(f"{prefix}normal has length {length:g}, not 1")
    normal = normal / length
    if np.linalg.norm(normal[:2]) < _LEAST_ACROSS:
        raise _BadEntryError(f"{prefix}normal = {normal.tolist()} lies along the needle")
    layers = _entry(window, "layers", prefix)
    if not isinstance(layers, list):
        raise _BadEntryError(f"{prefix}layers = {layers!r} is no list")
    thicknesses, indices = [], []
    for number, layer in enumerate(layers):
        name = f"{prefix}layers[{number}]"
        values = _mapping(layer, name)
        thickness = _number(_entry(values, "thickness", f"{name}."), f"{name}.thickness")
        if thickness <= 0.0:
            raise _BadEntryError(f"{name}.thickness = {thickness:g} m is not above 0")
        thicknesses.append(thickness)
        indices.append(_refractive_index(values, "refractive_index", f"{name}."))
    inside = _refractive_index(window, "inside", prefix)
    return SimulatedWindow(normal, float(normal @ point), tuple(thicknesses), (*indices, inside))


def _refractive_index(values: Mapping[object, object], key: str, prefix: str) -> float:
    index = _number(_entry(values, key, prefix), prefix + key)
    if not 1.0 <= index <= 3.0:
        raise _BadEntryError(f"{prefix}{key} = {index:g} is outside [1, 3]")
    return index


def _camera(values: Mapping[object, object], side: str, window: SimulatedWindow) -> SimulatedCamera:
    prefix = f"{side}."
    width, height = (
        _number(_entry(values, key, prefix), prefix + key)
        for key in ("image_width", "image_height")
    )
    for key, size in (("image_width", width), ("image_height", height)):
        if not (size.is_integer() and 1 <= size <= _LARGEST_SIDE_PX):
            raise _BadEntryError(
                f"{prefix}{key} = {size:g} px is outside [1, {_LARGEST_SIDE_PX}] px"
            )
    matrix = _matrix(_entry(values, "camera_matrix", prefix), prefix + "camera_matrix", (3, 3))
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0) or np.any(
        matrix[[1, 2, 2, 2], [0, 0, 1, 2]] != (0.0, 0.0, 0.0, 1.0)
    ):
        raise _BadEntryError(
            f"{prefix}camera_matrix = {matrix.ravel().tolist()} is no pinhole matrix"
        )
    model = _entry(values, "distortion_model", prefix)
    if model != "plumb_bob":
        raise _BadEntryError(f"{prefix}distortion_model = {model!r} is not 'plumb_bob'")
    key = "distortion_coefficients"
    distortion = _matrix(_entry(values, key, prefix), prefix + key, (1, 5))[0]
    transform = _mapping(_entry(values, "T_optical_rig", prefix), prefix + "T_optical_rig")
    prefix += "T_optical_rig."
    pose = np.eye(4)
    pose[:3, 3] = _numbers(_entry(transform, "translation", prefix), prefix + "translation", 3)
    quaternion = _numbers(_entry(transform, "rotation", prefix), prefix + "rotation", 4)
    pose[:3, :3] = _rotation_matrix(quaternion, prefix + "rotation")
    return SimulatedCamera(int(width), int(height), matrix, distortion, pose, window)


def _rotation_matrix(quaternion: FloatArray, name: str) -> FloatArray:
    """Return the matrix of a unit quaternion x, y, z, w."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        raise _BadEntryError(f"{name} has norm {norm:g}, not 1")
    vector, scalar = quaternion[:3] / norm, quaternion[3] / norm
    cross = np.cross(np.eye(3), vector)
    return np.asarray(np.eye(3) + 2.0 * (scalar * cross + cross @ cross))


def _mapping(value: object, name: str) -> Mapping[object, object]:
    if not isinstance(value, Mapping):
        raise _BadEntryError(f"{name} has no keys")
    return value


def _entry(values: Mapping[object, object], key: str, prefix: str) -> object:
    if key not in values:
        raise _BadEntryError(f"{prefix}{key} is missing")
    return values[key]


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise _BadEntryError(f"{name} = {value!r} is no finite number")
    return float(value)


def _numbers(value: object, name: str, count: int) -> FloatArray:
    if not isinstance(value, list) or len(value) != count:
        raise _BadEntryError(f"{name} = {value!r} is no list of {count} numbers")
    return np.array([_number(item, name) for item in value])


def _matrix(value: object, name: str, shape: tuple[int, int]) -> FloatArray:
    values = _mapping(value, name)
    seen = (_entry(values, "rows", f"{name}."), _entry(values, "cols", f"{name}."))
    if seen != shape:
        raise _BadEntryError(f"{name} is {seen[0]!r} x {seen[1]!r}, not {shape[0]} x {shape[1]}")
    data = _numbers(_entry(values, "data", f"{name}."), f"{name}.data", shape[0] * shape[1])
    return data.reshape(shape)
