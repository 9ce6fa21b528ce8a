"""Fixtures of tests of the tracker: the rig and the parameters."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.files.installed import find_shared_file
from needle_tracker.optics.calibration import StereoCalibration, load_calibration
from needle_tracker.optics.refraction import RefractedCamera, stereo_views
from needle_tracker.tracker_parameters import StereoTrackerParameters

__all__ = ["calibration", "calibration_path", "settings", "views"]


@pytest.fixture(scope="session")
def calibration_path() -> Path:
    return find_shared_file("needle_tracker", "config/calibration.yaml")


@pytest.fixture(scope="session")
def calibration(calibration_path: Path) -> StereoCalibration:
    return load_calibration(calibration_path)


@pytest.fixture(scope="session")
def views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    return stereo_views(calibration)


@pytest.fixture
def settings() -> StereoTrackerParameters:
    return StereoTrackerParameters()
