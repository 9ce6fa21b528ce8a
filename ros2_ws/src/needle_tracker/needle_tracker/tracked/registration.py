"""Registration of a tracker to the rig: the file of `register_tracker`, and its local error."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_core.files.yaml_files import read_yaml, write_yaml
from needle_core.settings.bounds import ABOVE_0, check_bounds
from needle_tracker.optics.calibration import number, numbers, transform_of

Array = NDArray[np.float64]

LARGEST_STD = 5e-3
"""Largest standard deviation of a coordinate at the entry point that is usable [m]."""
_FARTHEST, _LONGEST_TOOL = 10.0, 0.5  # [m]


@dataclasses.dataclass(frozen=True)
class Registration:
    """Pose of the tracker in `rig`, its error, and the tip in the sensor's frame.

    Attributes
    ----------
    T_rig_tracker : ndarray, shape (4, 4)
        Transforms points of the tracker to `rig` [m].
    centroid : ndarray, shape (3,)
        Centroid of the registration's points in `rig` [m].
    covariance : ndarray, shape (6, 6)
        Covariance of the translation at the centroid [m] and the rotation about the axes of `rig`
        [rad].
    tip_offset : ndarray, shape (3,)
        The needle's tip in the sensor's frame [m].
    sensor_std : float
        Standard deviation of a measured coordinate at rest [m].
    """

    T_rig_tracker: Array
    centroid: Array
    covariance: Array
    tip_offset: Array
    sensor_std: float

    def covariance_at(self, position: Array) -> Array:
        """Return the covariance of the registration's error at a place, shape (3, 3) [m^2].

        A small translation t and rotation w at the centroid c move p by t + w x (p - c). With the
        covariance of equal and independent errors of N points, its trace is the squared target
        registration error of Fitzpatrick, West and Maurer (1998).

        Parameters
        ----------
        position : ndarray, shape (3,)
            Place in `rig` [m].
        """
        jacobian = np.hstack([np.eye(3), np.cross(np.eye(3), position - self.centroid).T])
        return np.asarray(jacobian @ self.covariance @ jacobian.T)

    def std_at(self, position: Array) -> float:
        """Return the root mean square of the standard deviations of x, y and z at a place [m]."""
        return float(np.sqrt(np.trace(self.covariance_at(position)) / 3.0))


def read_registration(path: Path) -> Registration:
    """Return the registration in a file.

    Raises
    ------
    UserError
        Unreadable, or a value missing, not finite, of the wrong size or out of bounds.
    """
    content = read_yaml(path)
    try:
        found = Registration(
            transform_of(content, "T_rig_tracker"),
            numbers(content, 3, "centroid"),
            numbers(content, 36, "covariance", "data").reshape(6, 6),
            numbers(content, 3, "tip_offset"),
            number(content, "sensor_std"),
        )
        _check(found)
    except UserError as error:
        raise UserError(f"registration {path}: {error}") from error
    return found


def _check(found: Registration) -> None:
    """Raise a `UserError` if a registration is unusable."""
    far, tool = (float(np.linalg.norm(v)) for v in (found.T_rig_tracker[:3, 3], found.tip_offset))
    check_bounds("length of T_rig_tracker.translation", far, 0.0, _FARTHEST, "m")
    check_bounds("length of tip_offset", tool, 0.0, _LONGEST_TOOL, "m")
    check_bounds("sensor_std", found.sensor_std, ABOVE_0, LARGEST_STD, "m")
    lack = float(np.max(np.abs(found.covariance - found.covariance.T)))
    if lack > 1e-12 or np.linalg.eigvalsh(found.covariance)[0] < -1e-12:
        raise UserError("covariance is not symmetric and positive")
    std = found.std_at(np.zeros(3))
    check_bounds("standard deviation at the entry point", std, 0.0, LARGEST_STD, "m")


def write_registration(path: Path, found: Registration, comments: list[str]) -> None:
    """Write a registration file; raises a `UserError` if the file or registration is unusable."""
    _check(found)
    pose = found.T_rig_tracker
    content = {
        "T_rig_tracker": {
            "translation": pose[:3, 3].tolist(),
            "rotation": Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(),
        },
        "centroid": found.centroid.tolist(),
        "covariance": {"rows": 6, "cols": 6, "data": found.covariance.ravel().tolist()},
        "tip_offset": found.tip_offset.tolist(),
        "sensor_std": found.sensor_std,
    }
    write_yaml(path, content, comments)
