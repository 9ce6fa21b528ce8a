"""Lenses of a webcam or an endoscope: k3 is fitted, and what the model lacks is NOT OK."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_tracker.calibrating.calibration_outliers import doubts, ring_patterns, square_error
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.tip_error import measured_points

from . import synthetic_rig
from .synthetic_rig import SIDES, TrueRig, given, take

Array = NDArray[np.float64]

SIZE = (640, 480)
FOCAL = 420.0  # [px]: 75 deg
DISTANCE, BASELINE = 0.14, 0.06  # of the cameras from the surface, and between them [m]
RATIONAL = [2.5, 1.2, 0.0003, -0.0002, 0.05, 2.85, 2.0, 0.25]


def wide_rig(path: Path, lens: list[float]) -> TrueRig:
    """Two cameras close to the phantom that look at the middle of the needle's way."""
    content = yaml.safe_load(path.read_text())
    middle = np.array([0.0, 0.0, 0.0625])
    for side, sign in zip(SIDES, (-1.0, 1.0), strict=True):
        centre = np.array([0.0175 + DISTANCE, sign * BASELINE / 2.0, 0.0625])
        z = (middle - centre) / np.linalg.norm(middle - centre)
        x = np.array([0.0, 0.0, 1.0])
        x = (x - z * (x @ z)) / np.linalg.norm(x - z * (x @ z))
        rotation = np.stack([x, np.cross(z, x), z])
        content[side]["camera_matrix"]["data"] = [
            *(FOCAL, 0.0, SIZE[0] / 2.0 + 3.2),
            *(0.0, FOCAL, SIZE[1] / 2.0 - 4.1),
            *(0.0, 0.0, 1.0),
        ]
        content[side]["distortion_coefficients"] = {"data": lens}
        content[side]["T_optical_rig"] = {
            "rotation": Rotation.from_matrix(rotation).as_quat().tolist(),
            "translation": (-rotation @ centre).tolist(),
        }
    return TrueRig(content)


def calibrated(rig: TrueRig, monkeypatch: pytest.MonkeyPatch, seed: int = 0) -> RigCalibration:
    monkeypatch.setattr(synthetic_rig, "SIZE", SIZE)
    views = take(rig, np.random.default_rng(seed))
    return calibrate(views, dict.fromkeys(SIDES, SIZE), given(0.0175, 1.33))


def tip_error(rig: TrueRig, result: RigCalibration) -> float:
    """95 % of tips in the phantom are off by less [m]."""
    axes = (0.0175 - np.linspace(0.002, 0.033, 5), np.linspace(-0.015, 0.015, 3))
    grid = np.meshgrid(*axes, np.linspace(0.005, 0.12, 7), indexing="ij")
    points = np.stack(grid, axis=-1).reshape(-1, 3)
    left, right = (rig.project(side, points, True) for side in SIDES)
    found = measured_points(result.calibration, left, right)
    return float(np.percentile(np.linalg.norm(found - points, axis=-1), 95.0))


@pytest.mark.parametrize(
    "lens",
    [
        [-0.35, 0.15, 0.0, 0.0, 0.0],
        [-0.40, 0.22, 0.0004, -0.0003, -0.07],
        [-0.30, 0.10, 0.003, -0.002, 0.05],
    ],
    ids=["k3 is 0", "k3 negative", "k3 positive, tangential"],
)
def test_k3_is_fitted_where_it_shows(
    calibration_path: Path, monkeypatch: pytest.MonkeyPatch, lens: list[float]
) -> None:
    rig = wide_rig(calibration_path, lens)
    result = calibrated(rig, monkeypatch)
    for side in SIDES:
        found = result.parameters[f"{side}.k3"]
        assert not found.kept
        assert abs(found.value - lens[4]) < 4.0 * found.sigma
        assert found.sigma < 0.02
    assert doubts(result, square_error(result)) == []
    assert tip_error(rig, result) < result.tip_error_p95 < 0.07e-3


def test_a_lens_that_plumb_bob_does_not_describe_is_not_ok(
    calibration_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = calibrated(wide_rig(calibration_path, RATIONAL), monkeypatch)
    assert 0.03 < max(ring_patterns(result).values()) < 0.1
    said = doubts(result, square_error(result))
    assert len(said) == 1
    assert "px in a pattern of rings: its lens has more distortion than k1, k2, k3" in said[0]
