"""Errors that do not show in images of a needle show in images of a target at a known place."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_sim.camera.stereo_rig import StereoRig
from needle_tracker.calibrating.calibration_check import check, figures, report
from needle_tracker.calibrating.calibration_session import HELD_FREELY, BoardView, Place
from needle_tracker.calibrating.rig_calibration import RigCalibration
from needle_tracker.optics.calibration import StereoCalibration, load_calibration
from synthetic_rig import (
    BOX_BOARD,
    IN_BOX,
    NOISE_PX,
    PLACES,
    STANDS,
    changed,
    flat_pose,
    free_pose,
    scatter,
    turned,
    view_of,
    with_window,
)

LIMIT = 0.15e-3
TARGET = {
    "surface": Place(flat_pose([0.0185, -0.045, 0.0025]), False, 2e-5),
    "under_wedge": PLACES["under_wedge"],
}


def target(rig: StereoRig, names: tuple[str, ...] = tuple(TARGET)) -> list[BoardView]:
    rng = np.random.default_rng(0)
    return [view_of(rig, n, scatter(TARGET[n], rng), TARGET[n], rng) for n in names]


def test_a_good_calibration_passes(
    calibration: StereoCalibration, rig: StereoRig, result: RigCalibration
) -> None:
    for good in (calibration, result.calibration):
        found = check(good, target(rig), LIMIT)
        assert found.ok, found.problems
        assert found.tip_error < 0.05e-3
        assert found.corner_sigma_px == pytest.approx(NOISE_PX, rel=0.1)
    assert report(found).endswith("OK")
    assert figures(found)["problem"] is None


@pytest.mark.parametrize(("side", "axis", "degrees"), [("left", "x", 0.02), ("right", "y", 0.2)])
def test_a_turned_camera_is_found(
    calibration: StereoCalibration, rig: StereoRig, side: str, axis: str, degrees: float
) -> None:
    found = check(calibration, target(turned(rig, side, degrees, axis)), LIMIT)
    assert not found.ok
    assert found.deviations[0].cause == f"{side}_camera_turned"
    size = float(np.rad2deg(found.deviations[0].size))
    assert size == pytest.approx(degrees, abs=max(0.003, 0.01 * degrees))
    assert f"{side} camera turned by" in report(found)
    assert f"the {side} camera was turned (or moved)" in found.problems
    assert figures(found)[f"{side}_camera_turned_deg"] == pytest.approx(size)
    assert found.tip_error > LIMIT


@pytest.mark.parametrize(
    ("cause", "window", "off", "tolerance"),
    [
        ("refractive_index", {"indices": (1.31,)}, 0.01, 0.003),
        ("surface_height", {"outer": 0.0165}, -1e-3, 0.3e-3),
    ],
)
def test_another_surface_or_index_is_found(
    calibration: StereoCalibration,
    rig: StereoRig,
    cause: str,
    window: dict[str, object],
    off: float,
    tolerance: float,
) -> None:
    found = check(calibration, target(with_window(rig, **window)), LIMIT)
    assert not found.ok
    assert [deviation.cause for deviation in found.deviations] == [cause]
    assert found.deviations[0].size == pytest.approx(off, abs=tolerance)
    assert 0.1e-3 < found.tip_error < 0.5e-3
    assert f"{cause.replace('_', ' ')} is {'+' if off > 0 else '-'}" in report(found)


def test_a_target_that_cannot_detect_errors_is_never_ok(
    calibration: StereoCalibration, rig: StereoRig
) -> None:
    rng = np.random.default_rng(1)
    free = view_of(rig, "free", free_pose(rng), HELD_FREELY, rng)
    for views in (target(rig, ("surface",)), [free]):
        found = check(calibration, views, LIMIT)
        assert not found.ok
        assert "cannot show" in found.problems[-1]
        assert "cannot be seen" in report(found)
    found = check(calibration, target(rig), 0.01e-3)
    assert any("cannot show tip errors below 0.0" in problem for problem in found.problems)


def test_other_cameras_or_lenses_are_not_reported_as_a_turned_camera(
    calibration: StereoCalibration, rig: StereoRig
) -> None:
    exchanged = [dataclasses.replace(v, left=v.right, right=v.left) for v in target(rig)]
    found = check(calibration, exchanged, LIMIT)
    assert found.deviations == []
    assert "left and right exchanged" in found.problems[0]
    assert np.isnan(found.tip_error)
    refocused = changed(rig, "left", distortion=rig.left.distortion + np.array([0.3, 0, 0, 0, 0]))
    found = check(calibration, target(refocused), LIMIT)
    assert any("lens" in problem for problem in found.problems)
    with pytest.raises(UserError, match="the right camera sees 0 corners"):
        check(calibration, target(turned(rig, "right", 30.0)), LIMIT)


@pytest.mark.parametrize(("degrees", "found"), [(0.0, []), (0.02, ["right_camera_turned"])])
def test_through_windows_of_their_own_a_turned_camera_is_found(
    box_path: Path, box_rig: StereoRig, degrees: float, found: list[str]
) -> None:
    rng, true = np.random.default_rng(3), turned(box_rig, "right", degrees, "x")
    views = []
    for place, shift in ((STANDS, [0.0, 0.0, 0.0]), (IN_BOX, [0.001, -0.006, 0.008])):
        pose = STANDS.T_rig_board.copy()
        pose[:3, 3] += shift
        steady = place if place is IN_BOX else dataclasses.replace(place, sigma=2e-5)
        views.append(view_of(true, "box", pose, steady, rng, board=BOX_BOARD))
    result = check(load_calibration(box_path), views, LIMIT)
    assert [deviation.cause for deviation in result.deviations] == found
    assert result.ok is not bool(found), result.problems
