"""Wrong squares and places, and pairs not captured at once, which hardly change the residuals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_sim.camera.stereo_rig import StereoRig
from needle_tracker.calibrating.calibrate_stereo import report
from needle_tracker.calibrating.calibration_outliers import (
    contradictions,
    misfits,
    ring_patterns,
)
from needle_tracker.calibrating.calibration_session import HELD_FREELY, BoardView, Corners
from needle_tracker.calibrating.calibration_start import PairsApartError, consistent_views
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.optics.calibration import StereoCalibration
from synthetic_rig import GIVEN, PLACES, SIZES, free_pose, lenses_of, take, view_of


def with_larger_squares(views: list[BoardView], share: float) -> list[BoardView]:
    """Return views of a board whose squares are stated larger than they are."""
    return [
        dataclasses.replace(
            view,
            left=Corners((1.0 + share) * view.left.points, view.left.pixels),
            right=Corners((1.0 + share) * view.right.points, view.right.pixels),
        )
        for view in views
    ]


def test_wrong_squares_are_found_by_their_size(
    views: list[BoardView], calibration: StereoCalibration
) -> None:
    """An error of 0.3 % is 0.4 mm at the tip, but only 0.01 px more reprojection error."""
    result = calibrate(with_larger_squares(views[4:], 0.003), SIZES, GIVEN, lenses_of(calibration))
    error, sigma = result.square_error
    assert error == pytest.approx(-0.003, abs=max(4.0 * sigma, 3e-4))
    assert "smaller than in the session" in contradictions(result)[0]


def test_one_place_does_not_determine_the_size_of_the_squares(
    views: list[BoardView], calibration: StereoCalibration
) -> None:
    found = with_larger_squares(views[2:7], 0.01)
    result = calibrate(found, SIZES, GIVEN, lenses_of(calibration))
    assert not result.square_error[1] < 0.1
    assert contradictions(result) == []
    assert "not determined by these views" in "\n".join(report(result, 0.06))


@pytest.mark.parametrize(
    ("name", "shift", "text"),
    [
        # Index and surface absorb most of the error, so tips are equally wrong.
        ("under_deep", [1e-3, 0.0, 0.0], "under_deep is 0."),
        ("surface_b", [0.0, 0.0, 2e-3], "check its place"),
    ],
)
def test_a_wrong_place_is_found(
    views: list[BoardView], calibration: StereoCalibration, name: str, shift: list[float], text: str
) -> None:
    number = next(i for i, view in enumerate(views) if view.name == name)
    place = views[number].place
    pose = place.T_rig_board.copy()
    pose[:3, 3] += shift
    wrong = dataclasses.replace(views[number], place=dataclasses.replace(place, T_rig_board=pose))
    found = [*views[5:number], wrong, *views[number + 1 :]]
    result = calibrate(found, SIZES, GIVEN, lenses_of(calibration))
    assert any(text in one for one in contradictions(result))


def test_a_board_that_is_not_flat_is_found_although_one_camera_sees_others_alone(
    box_result: RigCalibration,
) -> None:
    residuals, model = box_result.fit.residuals.copy(), box_result.model
    assert misfits(box_result) == []
    number = next(number for number, view in enumerate(model.views) if view.name == "box_00")
    residuals[(model.view_of == number) & model.seen_by["right"]] += 1.0
    bent = dataclasses.replace(box_result.fit, residuals=residuals)
    ((view, text),) = misfits(dataclasses.replace(box_result, fit=bent))
    assert view is model.views[number]
    assert text.startswith("box_00, right camera: 1.4")


def test_a_lens_that_plumb_bob_does_not_describe_is_not_ok(result: RigCalibration) -> None:
    residuals = result.fit.residuals.copy()
    own = result.model.seen_by["right"]
    out = result.model.pixels[own] - result.calibration.right.camera_matrix[:2, 2]
    away = np.linalg.norm(out, axis=1)[:, None]
    residuals[own] += 0.05 * np.sin(away / 50.0) * out / away
    bent = dataclasses.replace(result, fit=dataclasses.replace(result.fit, residuals=residuals))
    assert 0.03 < ring_patterns(bent)["right"] < 0.06
    (text,) = contradictions(bent)
    assert "right camera: corners are off by up to 0.0" in text
    assert "in a pattern of rings: its lens has more" in text


FREE = 6


@pytest.fixture(scope="module")
def many(rig: StereoRig) -> list[BoardView]:
    places = {name: PLACES[name] for name in ("surface_a", "under_deep", "under_wedge")}
    return take(rig, free=FREE, places=places)


def swapped(views: list[BoardView], partner: dict[int, int]) -> list[BoardView]:
    """Return views whose right images are those of other views."""
    return [
        dataclasses.replace(view, right=views[partner.get(number, number)].right)
        for number, view in enumerate(views)
    ]


def moved(rig: StereoRig, views: list[BoardView], numbers: set[int]) -> list[BoardView]:
    """Return views whose board moved by 0.3 mm between the left and the right image."""
    rng, result = np.random.default_rng(0), list(views)
    for number in range(FREE):
        pose, step = free_pose(rng), np.random.default_rng(number).normal(size=3)
        pose[:3, 3] += 0.3e-3 * step / np.linalg.norm(step)
        if number in numbers:
            right = view_of(rig, "", pose, HELD_FREELY, np.random.default_rng(number)).right
            result[number] = dataclasses.replace(views[number], right=right)
    return result


@pytest.mark.parametrize(
    ("partner", "moves", "apart"),
    [
        ({}, set(), []),
        ({3: 5}, set(), ["free_03"]),
        ({}, {1, 5}, ["free_01", "free_05"]),
        ({7: 8}, set(), ["under_deep"]),
    ],
)
def test_few_inconsistent_pairs_are_left_out(
    rig: StereoRig,
    many: list[BoardView],
    calibration: StereoCalibration,
    partner: dict[int, int],
    moves: set[int],
    apart: list[str],
) -> None:
    found = swapped(moved(rig, many, moves), partner)
    kept, left_out, pose = consistent_views(found, calibration, 4)
    assert [view.name for view in left_out] == apart
    assert len(kept) + len(left_out) == len(many)
    assert pose is not None
    expected = calibration.right.T_optical_rig @ np.linalg.inv(calibration.left.T_optical_rig)
    np.testing.assert_allclose(pose, expected, atol=1e-3)


@pytest.mark.parametrize("count", [FREE, 3])
def test_many_inconsistent_pairs_are_rejected(
    rig: StereoRig, many: list[BoardView], calibration: StereoCalibration, count: int
) -> None:
    views = moved(rig, many, set(range(count)))[: FREE + 2]
    with pytest.raises(PairsApartError, match=r"free_00, .*not captured simultaneously"):
        consistent_views(views, calibration, 3)


def test_a_place_in_only_one_image_is_not_ok(result: RigCalibration) -> None:
    place = next(view for view in result.model.views if view.name == "surface_a")
    apart = dataclasses.replace(result, apart=[place])
    assert "in surface_a, though" in contradictions(apart)[0]
    assert "WARNING: left and right do not show" in "\n".join(report(apart, 0.06))
