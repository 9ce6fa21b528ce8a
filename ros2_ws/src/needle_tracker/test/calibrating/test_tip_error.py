from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.calibrating.rig_model import RigModel
from needle_tracker.calibrating.tip_error import tip_error_p95, tip_shifts
from needle_tracker.optics.calibration import StereoCalibration


@pytest.mark.parametrize(
    ("name", "step"),
    [("refractive_index", 1e-3), ("surface_height", 1e-4), ("left.rx", 2e-5), ("right.fx", 1.0)],
)
def test_the_expected_error_is_that_of_tips_triangulated_with_it(
    calibration: StereoCalibration, name: str, step: float
) -> None:
    model = RigModel(calibration, [], np.zeros((0, 4, 4)))
    column = model.names.index(name)
    parameters = model.start.copy()
    parameters[column] += step
    shifts = np.linalg.norm(tip_shifts(model.calibration(parameters), calibration), axis=-1)
    covariance = np.zeros((model.shared, model.shared))
    covariance[column, column] = step**2
    normal = np.abs(np.random.default_rng(1).standard_normal((4000, 1)))
    expected = np.percentile(normal * shifts, 95.0)
    assert tip_error_p95(calibration, covariance) == pytest.approx(expected, rel=0.15)
