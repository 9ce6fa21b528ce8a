"""Errors of tips measured with a calibration from a board's noisy corners."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.calibrating.rig_calibration import calibrate
from needle_tracker.calibrating.rig_model import needle_points, tip_errors
from needle_tracker.optics.calibration import load_calibration
from synthetic_rig import GIVEN, SIZES, take

_FREE = 20


def calibrated_tip_errors(calibration: Path, seed: int, corner_sigma: float) -> NDArray[np.float64]:
    """Return the errors of noise-free tips with a calibration from noisy corners.

    The set is the one that `docs/calibration.md` requires. The corners come from the simulation's
    own projection.

    Parameters
    ----------
    calibration : Path
        Calibration file of the true rig.
    seed : int
        Seed of the corner noise, the hand-held poses and the errors of the places.
    corner_sigma : float
        Standard deviation of each coordinate of a corner [px].

    Returns
    -------
    ndarray, shape (n,)
        Distances [m] at points throughout the needle's workspace.
    """
    rig = load_stereo_rig(calibration)
    views = take(rig, seed, _FREE, noise=corner_sigma, board=CharucoBoard())
    found = calibrate(views, SIZES, GIVEN).calibration
    points = needle_points(load_calibration(calibration))
    left, right = (project(points, camera) for camera in (rig.left, rig.right))
    return np.asarray(np.linalg.norm(tip_errors(found, points, left, right), axis=1))
