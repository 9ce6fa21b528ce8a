"""Import of lenses and relative pose of two cameras from files of ROS, Kalibr or OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_core.files.yaml_files import KALIBR, OPENCV, ROS, foreign_format, read_text
from needle_tracker.optics.calibration import (
    SIDES,
    Camera,
    StereoCalibration,
    Window,
    check_camera_matrix,
    number,
    numbers,
    pose_matrix,
    value_of,
)

Array = NDArray[np.float64]

_PLUMB_BOB = "plumb_bob"
# All begin with k1, k2, p1, p2, k3; further coefficients must be 0.
_MODELS = (_PLUMB_BOB, "radtan", "rational_polynomial", "none")
_OPENCV_KEYS = (("M", "D"), ("K", "D"), ("cameraMatrix", "distCoeffs"))  # with suffix 1 and 2
_CURE = (
    "calibrate with plumb_bob (Kalibr: pinhole-radtan; OpenCV: without CALIB_RATIONAL_MODEL), or "
    "run without --lenses"
)
_LARGEST_SKEW = 1e-3  # tolerated error of a rotation's singular values: files have few digits


class _Lens(NamedTuple):
    """Camera in a file: matrix, k1, k2, p1, p2, k3, and the size of its images if given."""

    matrix: Array
    distortion: Array
    size: tuple[int, int] | None


class _Found(NamedTuple):
    """Content of one file: lenses, T_right_left, and T_stereo_camera of a ROS rectification."""

    lenses: list[_Lens]
    pose: Array | None = None
    rectified: Array | None = None


def read_lenses(
    paths: Sequence[Path], sizes: dict[str, tuple[int, int]], windows: tuple[Window, Window]
) -> StereoCalibration:
    """Read the lenses of both cameras, and their relative pose if given.

    Parameters
    ----------
    paths : sequence of Path
        A camera_info for left and one for right, a Kalibr chain (cam0 is left), or intrinsics and
        extrinsics of OpenCV in any order.
    sizes : dict of str to (int, int)
        Width and height of the images of each side [px].
    windows : pair of Window
        Windows of the left and the right camera.

    Returns
    -------
    StereoCalibration
        The left camera is at the origin; the right one too if no file gives the relative pose.

    Raises
    ------
    UserError
        An unreadable file, an unknown format, more or fewer than two cameras, images of another
        size, or a lens model other than plumb_bob.
    """
    if len(set(paths)) < len(paths):
        raise UserError(f"--lenses {' '.join(map(str, paths))}: a file is given twice")
    found = [_read(path) for path in paths]
    lenses = [lens for one in found for lens in one.lenses]
    if len(lenses) != len(SIDES):
        raise UserError(
            f"--lenses {' '.join(map(str, paths))}: found {len(lenses)} of 2 cameras: give a file "
            "for left and one for right, or one with both (OpenCV: M1, K1 or cameraMatrix1 ...)"
        )
    poses = [one.pose for one in found if one.pose is not None]
    rectified = [one.rectified for one in found if one.rectified is not None]
    if len(rectified) == len(SIDES):
        poses.append(np.linalg.inv(rectified[1]) @ rectified[0])
    cameras: list[Camera] = []
    for side, lens, window in zip(SIDES, lenses, windows, strict=True):
        if lens.size is not None and lens.size != sizes[side]:
            raise UserError(
                f"--lenses: the {side} camera is for images of {lens.size[0]}x{lens.size[1]}, the "
                f"{side} ones are {sizes[side][0]}x{sizes[side][1]}"
            )
        check_camera_matrix(f"--lenses: {side} camera", lens.matrix)
        pose = poses[0] if poses and cameras else np.eye(4)
        cameras.append(Camera(*sizes[side], lens.matrix, lens.distortion, pose, window))
    return StereoCalibration(*cameras)


def _read(path: Path) -> _Found:
    text = read_text(path)
    kind = foreign_format(text)
    try:
        if kind == OPENCV:
            return _opencv(text)
        if kind in (KALIBR, ROS):
            content = next(iter(yaml.safe_load_all(text)))
            return _kalibr(content) if kind == KALIBR else _camera_info(content)
    except yaml.YAMLError as error:
        raise UserError(f"--lenses {path} is not YAML: {' '.join(str(error).split())}") from error
    except UserError as error:
        raise UserError(f"--lenses {path}, {kind}: {error}") from error
    raise UserError(f"--lenses {path} is neither {ROS}, {KALIBR} nor {OPENCV}")


def _camera_info(content: Any) -> _Found:
    lens = _one_camera(content, str(content.get("distortion_model")))
    rotation = numbers(content, 9, "rectification_matrix", "data").reshape(3, 3)
    projection = numbers(content, 12, "projection_matrix", "data").reshape(3, 4)
    shift = np.append(projection[:2, 3] / np.maximum(np.diag(projection)[:2], 1e-9), 0.0)
    return _Found([lens], rectified=_transform(rotation, -shift))


def _kalibr(content: Any) -> _Found:
    lenses = []
    for name in sorted(content)[: len(SIDES)]:
        camera = value_of(content, name, "camera_model")
        if camera != "pinhole":
            raise UserError(f"{name}.camera_model {camera!r} is not supported: {_CURE}")
        fx, fy, cx, cy = numbers(content, 4, name, "intrinsics")
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        model = str(value_of(content, name, "distortion_model"))
        distortion = _distortion(content, model, name, "distortion_coeffs")
        width, height = map(int, numbers(content, 2, name, "resolution"))
        lenses.append(_Lens(matrix, distortion, (width, height)))
    if len(lenses) < len(SIDES):
        return _Found(lenses)
    pose = numbers(content, 16, name, "T_cn_cnm1").reshape(4, 4)
    return _Found(lenses, _transform(pose[:3, :3], pose[:3, 3]))


def _opencv(text: str) -> _Found:
    """Return the content of a file by OpenCV's sample `stereo_calib` (two files) or `calibration`.

    Other programs name the matrices after the parameters of `stereoCalibrate`.
    """
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {key: storage.getNode(key) for key in storage.root().keys()}  # noqa: SIM118
        content: dict[str, Any] = {
            key: {"data": node.mat().ravel().tolist()} if node.isMap() else node.real()
            for key, node in nodes.items()
        }
    except (AttributeError, SystemError, cv2.error) as error:
        raise UserError("it is damaged") from error
    lenses = [
        _Lens(_matrix(content, key), _distortion(content, _PLUMB_BOB, other, "data"), None)
        for suffix in "12"
        for key, other in ((m + suffix, d + suffix) for m, d in _OPENCV_KEYS)
        if key in content
    ]
    if "camera_matrix" in content:
        model = "fisheye" if content.get("fisheye_model") else _PLUMB_BOB
        lenses.append(_one_camera(content, model))
    if "R" not in content:
        return _Found(lenses)
    return _Found(lenses, _transform(_matrix(content, "R"), numbers(content, 3, "T", "data")))


def _one_camera(content: Any, model: str) -> _Lens:
    width, height = (int(number(content, f"image_{name}")) for name in ("width", "height"))
    distortion = _distortion(content, model, "distortion_coefficients", "data")
    return _Lens(_matrix(content, "camera_matrix"), distortion, (width, height))


def _matrix(content: Any, key: str) -> Array:
    return numbers(content, 9, key, "data").reshape(3, 3)


def _transform(rotation: Array, translation: Array) -> Array:
    left, scales, right = np.linalg.svd(rotation)
    if np.abs(scales - 1.0).max() > _LARGEST_SKEW or np.linalg.det(rotation) < 0.0:
        raise UserError(f"{np.round(rotation, 4).tolist()} is not a rotation")
    return pose_matrix(left @ right, translation)


def _distortion(content: Any, model: str, *keys: str) -> Array:
    """Return k1, k2, p1, p2, k3, shape (5,), under a path of keys."""
    coefficients = numbers(content, None, *keys)
    if model not in _MODELS or 0 < len(coefficients) < 4 or np.any(coefficients[5:]):
        raise UserError(
            f"distortion model {model} with {len(coefficients)} coefficients is not supported: "
            f"{_CURE}"
        )
    return np.append(coefficients, np.zeros(5))[:5]
