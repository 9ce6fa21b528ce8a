"""Squares and places given wrong: what hardly shows in the reprojection errors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_outliers import doubts, square_error
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.rig_model import BoardView, Corners

from .synthetic_rig import SIDES, SIZE, TrueRig, given, take


@pytest.fixture(scope="module")
def views(calibration_path: Path) -> list[BoardView]:
    return take(TrueRig.read(calibration_path), np.random.default_rng(3), free=8)


def calibrated(views: list[BoardView]) -> RigCalibration:
    return calibrate(views, dict.fromkeys(SIDES, SIZE), given(0.0175, 1.3))


def said_larger(view: BoardView, share: float) -> BoardView:
    """A view of a board whose squares are said to be larger than they are."""
    left, right = (
        Corners((1.0 + share) * corners.points, corners.pixels)
        for corners in (view.left, view.right)
    )
    return dataclasses.replace(view, left=left, right=right)


def test_nothing_is_wrong_with_a_good_session(views: list[BoardView]) -> None:
    result = calibrated(views)
    error, sigma = square_error(result)
    assert doubts(result, (error, sigma)) == []
    assert abs(error) < 4.0 * sigma < 0.002


def test_wrong_squares_are_found_by_their_size(views: list[BoardView]) -> None:
    """0.3 % is 0.4 mm at the tip, and 0.01 px more reprojection error."""
    result = calibrated([said_larger(view, 0.003) for view in views])
    error, sigma = square_error(result)
    assert error == pytest.approx(-0.003, abs=4.0 * sigma)
    assert "smaller than the session says" in doubts(result, (error, sigma))[0]


def test_one_place_does_not_tell_the_size_of_the_squares(views: list[BoardView]) -> None:
    kept = [view for view in views if view.place is None or view.name == "surface_a"]
    result = calibrated([said_larger(view, 0.01) for view in kept])
    size = square_error(result)
    assert not size[1] < 0.1
    assert doubts(result, size) == []


def test_a_wrong_place_under_the_surface_is_found(views: list[BoardView]) -> None:
    """1 mm of height: the index and the surface take most of it, and tips are wrong by as much."""
    deep = next(view for view in views if view.name == "under_deep")
    assert deep.place is not None
    pose = deep.place.T_rig_board.copy()
    pose[0, 3] += 1e-3
    place = dataclasses.replace(deep.place, T_rig_board=pose)
    moved = dataclasses.replace(deep, place=place)
    wrong = [moved if view is deep else view for view in views]
    result = calibrated(wrong)
    found = doubts(result, square_error(result))
    assert any(one.startswith("under_deep comes out 0.") for one in found)


def test_both_cameras_in_one_place_are_refused(views: list[BoardView]) -> None:
    twice = [dataclasses.replace(view, right=view.left) for view in views]
    with pytest.raises(UserError, match="are left and right the same images"):
        calibrated(twice)
