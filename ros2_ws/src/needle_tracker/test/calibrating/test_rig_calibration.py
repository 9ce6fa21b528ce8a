"""Calibration of a rig that is known, from corners with noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.calibrate_stereo import save_calibration
from needle_tracker.calibrating.calibration_start import cameras_alone, first_calibration
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.rig_model import BoardView, Corners, RigModel
from needle_tracker.calibrating.tip_error import measured_points
from needle_tracker.optics.calibration import SIDES, StereoCalibration, load_calibration

from .synthetic_rig import SIZE, TrueRig, free_pose, given, take

GIVEN = given(0.0175, 1.33)
SIZES = dict.fromkeys(SIDES, SIZE)


@pytest.fixture(scope="module")
def rig(calibration_path: Path) -> TrueRig:
    return TrueRig.read(calibration_path)


@pytest.fixture(scope="module")
def result(rig: TrueRig) -> RigCalibration:
    return calibrate(take(rig, np.random.default_rng(0)), SIZES, GIVEN)


def tip_errors(rig: TrueRig, calibration: StereoCalibration) -> np.ndarray:
    """Errors of points all over the phantom, seen without noise, by the tracker's own geometry."""
    axes = (0.0175 - np.linspace(0.002, 0.033, 5), np.linspace(-0.015, 0.015, 3))
    grid = np.meshgrid(*axes, np.linspace(0.005, 0.12, 7), indexing="ij")
    points = np.stack(grid, axis=-1).reshape(-1, 3)
    left, right = (rig.project(side, points, True) for side in SIDES)
    found = measured_points(calibration, left, right)
    return np.asarray(np.linalg.norm(found - points, axis=-1))


def test_tips_are_right_to_60_micrometres(rig: TrueRig, result: RigCalibration) -> None:
    assert np.percentile(tip_errors(rig, result.calibration), 95.0) <= 60e-6
    assert result.tip_error_p95 <= 60e-6


def test_what_it_says_of_itself_is_true(rig: TrueRig, result: RigCalibration) -> None:
    assert result.fit.corner_sigma_px == pytest.approx(0.1, rel=0.05)
    for side in SIDES:
        # Two coordinates of 0.1 px each.
        assert result.reprojection_rms_px(side) == pytest.approx(0.1414, rel=0.07)
    truth = {"refractive_index": rig.index, "surface_height": rig.height}
    for side in SIDES:
        matrix, lens, _, _ = rig.camera(side)
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        values = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens[:4])
        truth |= {f"{side}.{n}": float(v) for n, v in zip(names, values, strict=True)}
    scores = {}
    for name, value in truth.items():
        found = result.parameters[name]
        assert not found.kept
        scores[name] = (found.value - value) / found.sigma
    assert max(abs(score) for score in scores.values()) < 4.0, scores
    assert result.parameters["left.k3"].kept


def test_without_a_board_under_the_surface_nothing_is_invented(rig: TrueRig) -> None:
    views = take(rig, np.random.default_rng(1), free=8, under=False)
    surface = calibrate(views, SIZES, given(0.0175, 1.37)).calibration.surface
    assert surface is not None
    assert (surface.point[0], surface.inside) == (0.0175, 1.37)


def test_one_flat_board_does_not_tell_index_from_height(rig: TrueRig) -> None:
    views = [
        view
        for view in take(rig, np.random.default_rng(2), free=8)
        if not view.under_surface or view.name == "under_deep"
    ]
    result = calibrate(views, SIZES, given(0.0175, 1.33))
    height, index = (result.parameters[n] for n in ("surface_height", "refractive_index"))
    assert height.kept
    assert height.value == 0.0175
    assert height.sigma > 0.15e-3
    assert not index.kept
    assert index.value == pytest.approx(1.3, abs=0.003)


def test_outliers_do_not_bend_it(rig: TrueRig) -> None:
    views = take(rig, np.random.default_rng(3), free=10)
    for i in range(0, len(views), 3):
        pixels = views[i].left.pixels.copy()
        pixels[::20] += 3.0
        views[i] = dataclasses.replace(views[i], left=Corners(views[i].left.points, pixels))
    errors = tip_errors(rig, calibrate(views, SIZES, GIVEN).calibration)
    assert np.percentile(errors, 95.0) <= 90e-6


def test_the_jacobian_is_that_of_the_residuals(rig: TrueRig) -> None:
    views = take(rig, np.random.default_rng(4), free=6, noise=0.0)
    cameras = cameras_alone(views, SIZES, given(0.0175, 1.3))
    start, boards = first_calibration(views, cameras)
    model = RigModel(start, views, boards)
    everything = np.ones(len(model.start), dtype=bool)
    # Boards turned and shifted from where they start.
    at = model.start.copy()
    at[model.shared :] += np.tile([0.02, -0.03, 0.05, 1e-3, -2e-3, 1e-3], len(model.views))
    jacobian = model.jacobian(at, everything)
    for column in range(len(at)):
        step = np.zeros_like(at)
        step[column] = 2e-6
        rise = model.residuals(at + step) - model.residuals(at - step)
        np.testing.assert_allclose(rise / 4e-6, jacobian[:, column], atol=1e-3)


def test_the_file_written_is_the_calibration_read(result: RigCalibration, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_calibration(path, result.calibration, ["made by a test"])
    read = load_calibration(path)
    assert read.surface is not None
    assert read.surface.inside == pytest.approx(result.calibration.left.window.inside, abs=1e-6)
    for side in SIDES:
        was, is_now = getattr(result.calibration, side), getattr(read, side)
        np.testing.assert_allclose(is_now.T_optical_rig, was.T_optical_rig, atol=1e-9)
        np.testing.assert_allclose(is_now.camera_matrix, was.camera_matrix, atol=1e-3)
        np.testing.assert_allclose(is_now.distortion, was.distortion, atol=1e-9)


def unseen_by(side: str, view: BoardView, corners: int) -> BoardView:
    seen = view.corners(side)
    few = Corners(seen.points[:corners], seen.pixels[:corners])
    return dataclasses.replace(view, **{side: few})  # type: ignore[arg-type]


def test_sets_that_cannot_determine_the_rig_are_refused(rig: TrueRig) -> None:
    rng = np.random.default_rng(5)
    views = take(rig, rng, free=6)

    def refused(views: list[BoardView], says: str) -> None:
        with pytest.raises(UserError, match=says) as caught:
            calibrate(views, SIZES, GIVEN)
        assert "\n" not in str(caught.value)

    refused(views[1:], "5 views of the board held freely")
    refused([unseen_by("right", views[0], 0), *views[1:]], "the right camera sees 0 corners")
    refused([unseen_by("left", views[0], 11), *views[1:]], "the left camera sees 11 corners")
    refused([unseen_by("left", views[0], 0 + 11), *views[1:]], "12 are needed")
    refused([v for v in views if v.place is None or v.under_surface], "nothing says where `rig` is")
    level = [rig.view(f"level_{i}", free_pose(rng, (0.0, 0.5)), None, rng, 0.1) for i in range(8)]
    refused([*level, *views[6:]], "parallel")
