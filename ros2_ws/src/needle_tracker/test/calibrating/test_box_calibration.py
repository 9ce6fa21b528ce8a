"""A camera above and one beside a box of acrylic, calibrated from a board in air and in it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_sim.camera.insertions import render_insertion
from needle_sim.camera.scenarios import CLEAN
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_tracker.answers.tracker_parameters import default_settings
from needle_tracker.calibrating.calibrate_stereo import main, save_calibration
from needle_tracker.calibrating.calibration_check import check
from needle_tracker.calibrating.calibration_session import load_session, parse_session
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.rig_model import BoardView, RigModel
from needle_tracker.calibrating.tip_error import measured_points, needle_points
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.tracking.tip_tracker import TipTracker

from .box_session import (
    GIVEN,
    IN_BOX,
    PLACE,
    SMALL_BOARD,
    box_content,
    pose_in_box,
    record_box,
    take_in_box,
)
from .synthetic_rig import SIDES, SIZE, TrueRig

SIZES = dict.fromkeys(SIDES, SIZE)


@pytest.fixture(scope="module")
def path(calibration_path: Path) -> Path:
    return calibration_path.with_name("calibration_top_and_side.yaml")


@pytest.fixture(scope="module")
def rig(path: Path) -> TrueRig:
    return TrueRig.read(path, SMALL_BOARD)


@pytest.fixture(scope="module")
def views(rig: TrueRig) -> list[BoardView]:
    return take_in_box(rig, air=20, box=6, seed=0)


@pytest.fixture(scope="module")
def result(views: list[BoardView]) -> RigCalibration:
    return calibrate(views, SIZES, GIVEN)


def test_tips_are_right_to_60_micrometres(path: Path, rig: TrueRig, result: RigCalibration) -> None:
    points = needle_points(load_calibration(path))
    left, right = (rig.project(side, points, True) for side in SIDES)
    errors = np.linalg.norm(measured_points(result.calibration, left, right) - points, axis=1)
    assert np.percentile(errors, 95.0) <= 60e-6
    # What it says of itself.
    assert np.percentile(errors, 95.0) <= 1.5 * result.tip_error_p95 <= 120e-6
    assert result.fit.corner_sigma_px == pytest.approx(0.1, rel=0.1)


def test_windows_come_out_as_they_are_as_far_as_they_show(
    rig: TrueRig, result: RigCalibration
) -> None:
    for side, given in zip(SIDES, GIVEN, strict=True):
        window = getattr(result.calibration, side).window
        _, normal, _, _ = rig.window(side)
        # Given level or plumb, 0.3 deg off.
        assert np.linalg.norm(given.normal - normal) > 4e-3
        tilt = [float(result.parameters[f"{side}.window_tilt_{i}"].sigma) for i in (1, 2)]
        assert np.linalg.norm(window.normal - normal) < 3.5 * math.hypot(*tilt)
        assert min(tilt) < 2e-3
        assert (window.layers, window.inside) == (given.layers, given.inside)


def test_the_jacobian_is_that_of_the_residuals(path: Path, rig: TrueRig) -> None:
    views = take_in_box(rig, air=12, box=2, seed=1, noise=0.0)
    in_box = [view for view in views if view.place is not None]
    model = RigModel(load_calibration(path), in_box, np.stack([PLACE.T_rig_board] * len(in_box)))
    everything = np.ones(len(model.start), dtype=bool)
    # Boards turned and shifted from where they start.
    at = model.start.copy()
    at[model.shared :] += np.tile([0.02, -0.03, 0.05, 1e-3, -2e-3, 1e-3], len(model.views))
    jacobian = model.jacobian(at, everything)
    for column in range(len(at)):
        step = np.zeros_like(at)
        step[column] = 2e-6
        rise = model.residuals(at + step) - model.residuals(at - step)
        np.testing.assert_allclose(rise / 4e-6, jacobian[:, column], rtol=1e-4, atol=1e-2)


def test_the_file_written_is_the_calibration_read(result: RigCalibration, tmp_path: Path) -> None:
    save_calibration(tmp_path / "rig.yaml", result.calibration, ["made by a test"])
    read = load_calibration(tmp_path / "rig.yaml")
    for side in SIDES:
        was, is_now = getattr(result.calibration, side).window, getattr(read, side).window
        np.testing.assert_allclose(is_now.point, was.point, atol=1e-9)
        np.testing.assert_allclose(is_now.normal, was.normal, atol=1e-9)
        assert (is_now.layers, is_now.inside) == (was.layers, was.inside)


def test_a_board_in_air_counts_for_the_camera_that_sees_it(views: list[BoardView]) -> None:
    alone = [v for v in views if v.place is None and not len(v.left.points)]
    assert len(alone) >= 6
    with pytest.raises(UserError, match="views of the board held freely in air that the right"):
        calibrate([v for v in views if v not in alone], SIZES, GIVEN)


def test_sets_that_cannot_determine_the_rig_are_refused(views: list[BoardView]) -> None:
    with pytest.raises(UserError, match="at a known place: nothing says where `rig` is"):
        calibrate([v for v in views if v.place is not PLACE], SIZES, GIVEN)
    hidden = [v.without("right") if v.name == "box_01" else v for v in views]
    with pytest.raises(UserError, match="box_01: the right camera sees 0 corners"):
        calibrate(hidden, SIZES, GIVEN)


def test_a_camera_that_was_turned_is_found(path: Path, rig: TrueRig) -> None:
    rng = np.random.default_rng(3)
    turned = rig.turned("right", 0.02, "x")
    steady = dataclasses.replace(PLACE, sigma=2e-5)
    for true, cause in ((rig, None), (turned, "right_camera_turned")):
        seen = [true.view("stand", PLACE.T_rig_board, steady, rng)]
        seen += [true.view(f"box_{i}", pose_in_box(rng), IN_BOX, rng) for i in range(2)]
        found = check(load_calibration(path), seen, 0.15e-3)
        assert [d.cause for d in found.deviations] == ([cause] if cause else [])
        assert found.ok is (cause is None), found.problems


def test_a_session_says_windows_and_what_is_held_in_the_box() -> None:
    session = parse_session(box_content())
    assert [w.normal.tolist() for w in session.windows] == [[1, 0, 0], [0, 1, 0]]
    held, stands = session.place_of("box_07"), session.place_of("stand")
    assert held is not None
    assert stands is not None
    assert (held.under_surface, held.is_known) == (True, False)
    assert (stands.under_surface, stands.is_known, stands.sigma) == (True, True, 0.0)


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ({"under_surface": True, "sigma": 1e-4}, "places.a.origin"),
        ({"under_surface": False}, "places.a.origin"),
        # Level, its print up: the camera beside sees its edge.
        ({"origin": [0.0, -0.04, 0.01], "under_surface": True}, "away from the camera"),
        (
            {"origin": [0.03, -0.01, 0.01], "rows": [-1, 1, 0], "under_surface": True},
            "above the surface",
        ),
    ],
)
def test_a_wrong_place_is_named(place: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        parse_session(box_content() | {"places": {"a": place}})


@pytest.mark.timeout(300)
def test_from_images_of_the_board_to_tips(path: Path, rig: TrueRig, tmp_path: Path) -> None:
    """All of it: boards drawn, found and calibrated with; a needle rendered and tracked."""
    session = record_box(tmp_path, rig, air=16, box=4)
    assert load_session(session).board == SMALL_BOARD
    folders = ["--left", str(tmp_path / "left"), "--right", str(tmp_path / "right")]
    output = tmp_path / "rig.yaml"
    assert main([*folders, "--session", str(session), "--output", str(output)]) == 0
    calibration = load_calibration(output)
    tracker = TipTracker(calibration, default_settings(calibration))
    errors = []
    for pair in render_insertion(load_stereo_rig(path), CLEAN, seed=2, frames=20):
        tip = tracker.process(*pair.images, pair.insertion).tip
        if pair.truth is not None and pair.insertion > 5e-3:
            assert tip is not None
            errors.append(np.linalg.norm(tip.position - pair.truth.tip))
    assert np.percentile(errors, 95.0) <= 0.25e-3
