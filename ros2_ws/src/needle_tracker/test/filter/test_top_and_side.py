"""One camera above and one beside, each through its own wall of acrylic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from needle_sim.camera.insertions import render_insertion
from needle_sim.camera.optics import project
from needle_sim.camera.scenarios import find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views
from needle_tracker.tracker_parameters import StereoTrackerParameters


@pytest.fixture(scope="module")
def path(calibration_path: Path) -> Path:
    return calibration_path.with_name("calibration_top_and_side.yaml")


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration_top_and_side.yaml"])
def test_simulation_and_tracker_project_alike(calibration_path: Path, name: str) -> None:
    path = calibration_path.with_name(name)
    rig = load_stereo_rig(path)
    # In the gel, in the acrylic, and before it.
    points = np.random.default_rng(0).uniform([-0.03, -0.03, 0.0], [0.04, 0.05, 0.14], (2000, 3))
    for camera, view in zip(
        (rig.left, rig.right), stereo_views(load_calibration(path)), strict=True
    ):
        np.testing.assert_allclose(view.project(points), project(points, camera), atol=1e-9)


@pytest.mark.parametrize(("scenario", "most"), [("clean", 0.2e-3), ("clutter", 0.3e-3)])
def test_tips_are_accurate(path: Path, scenario: str, most: float) -> None:
    calibration = load_calibration(path)
    tracker = NeedleTracker(calibration, StereoTrackerParameters())
    errors = []
    for pair in render_insertion(
        load_stereo_rig(path), find_scenario(scenario), seed=3, frames=24, depth=0.1
    ):
        measured = tracker.process(*pair.images, pair.insertion)
        if pair.truth is not None and pair.insertion > 5e-3:
            assert measured.tip is not None, measured.reason
            errors.append(np.linalg.norm(measured.tip.position - pair.truth.tip))
    assert len(errors) >= 15
    assert np.percentile(errors, 95.0) <= most
