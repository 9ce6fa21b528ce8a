"""A tracker of the calibrated cameras, and a needle for it."""

from __future__ import annotations

import pytest

from needle_tracker.answers.tracker_parameters import default_settings
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.tracker import StereoTracker

from .shown_needle import Arc, Drawer, Image


@pytest.fixture
def tracker(calibration: StereoCalibration) -> StereoTracker:
    return StereoTracker(calibration, default_settings(calibration))


@pytest.fixture(scope="module")
def shown(draw_pair: Drawer, make_arc: Arc) -> list[tuple[Image, Image]]:
    """Return pairs of a needle from 40 to 52 mm."""
    return [draw_pair(make_arc(mm * 1e-3, 6.0, 1.0)) for mm in range(40, 53)]
