"""The study of what corner noise does to tips by way of the calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ament_index_python.packages import get_package_share_directory

from needle_core.errors import UserError
from needle_verification.tracking.calibration_study import calibrated_tip_errors


@pytest.fixture(scope="module")
def calibration() -> Path:
    return Path(get_package_share_directory("needle_tracker"), "config", "calibration.yaml")


def test_corners_of_a_tenth_of_a_pixel_do_for_60_micrometres(calibration: Path) -> None:
    errors = calibrated_tip_errors(calibration, 1, 0.1)
    assert 1e-6 < np.percentile(errors, 95) <= 60e-6


def test_worse_corners_make_a_worse_calibration(calibration: Path) -> None:
    fine, coarse = (calibrated_tip_errors(calibration, 2, sigma) for sigma in (0.02, 0.2))
    # The places under the surface are as they are: ten times the noise is not ten times the error.
    assert np.percentile(coarse, 95) > 1.3 * np.percentile(fine, 95)
    with pytest.raises(UserError, match="only"):
        calibrated_tip_errors(calibration, 2, 0.4)
