"""Runs through the renderer's scenarios, a sample of the full-size checks of `scripts/verify C`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from needle_sim.camera.insertions import render_insertion
from needle_sim.camera.optics import project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_tracker.filter.measurement import TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration, load_calibration
from needle_tracker.optics.refraction import stereo_views
from needle_tracker.tracker_parameters import StereoTrackerParameters

Exposure = tuple[float, np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture
def tracker(calibration: StereoCalibration) -> NeedleTracker:
    return NeedleTracker(calibration, StereoTrackerParameters())


def insertion(
    path: Path, scenario: str, seed: int, first_mm: int, last_mm: int
) -> Iterator[Exposure]:
    renderer = StereoRenderer(load_stereo_rig(path), seed, scenario=find_scenario(scenario))
    plant = NeedlePlant(initial_pose(math.radians(1.0), 0.5 * seed), curvature=8.2)
    for mm in range(1, last_mm + 1):
        plant.advance(1e-3, 0.06)
        if mm >= first_mm:
            pose = np.asarray(plant.T_rig_tip)
            left, right = renderer.render(pose, plant.centreline(5e-4), mm)
            yield 1e-3 * mm, pose[:3, 3], left, right


@pytest.mark.parametrize(
    ("scenario", "bound", "least"), [("clutter", 0.5e-3, 13), ("heavy_clutter", 1.5e-3, 8)]
)
def test_reported_tips_are_right(
    tracker: NeedleTracker, calibration_path: Path, scenario: str, bound: float, least: int
) -> None:
    found = 0
    for length, truth, left, right in insertion(calibration_path, scenario, 3, 44, 58):
        measured = tracker.process(left, right, length)
        assert measured.state is not TrackState.LOST
        if measured.tip is not None:
            found += 1
            assert np.linalg.norm(measured.tip.position - truth) < bound
    assert found >= least


def test_clutter_without_a_needle_is_rejected(
    tracker: NeedleTracker, calibration_path: Path
) -> None:
    for length, _, left, right in insertion(calibration_path, "absent", 2, 35, 50):
        assert tracker.process(left, right, length).tip is None


def test_a_needle_may_be_dark_or_bright(
    calibration: StereoCalibration, calibration_path: Path
) -> None:
    for length, truth, left, right in insertion(calibration_path, "clean", 1, 60, 62):
        for picture in ((left, right), (255 - left, 255 - right)):
            tracker = NeedleTracker(calibration, StereoTrackerParameters())
            measured = tracker.process(*picture, length)
            assert measured.tip is not None
            assert np.linalg.norm(measured.tip.position - truth) < 0.25e-3


@pytest.fixture(scope="module")
def path(calibration_path: Path) -> Path:
    return calibration_path.with_name("calibration_top_and_side.yaml")


def test_simulation_and_tracker_project_alike(calibration_path: Path, tmp_path: Path) -> None:
    windows = calibration_path.with_name("calibration_top_and_side.yaml").read_text()
    layered = windows.replace("layers: [", "layers: [{thickness: 0.003, refractive_index: 1.1}, ")
    # In the gel, in the layers, and before them.
    points = np.random.default_rng(0).uniform([-0.2, -0.2, -0.2], [0.04, 0.05, 0.3], (2000, 3))
    path = tmp_path / "rig.yaml"
    for text in (calibration_path.read_text(), windows, layered):
        path.write_text(text)
        rig = load_stereo_rig(path)
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
