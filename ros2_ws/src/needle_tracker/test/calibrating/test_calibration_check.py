"""What is silent in the images of a needle is loud in those of a target of known place."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_check import CheckResult, check
from needle_tracker.calibrating.calibration_session import Place
from needle_tracker.calibrating.rig_calibration import calibrate
from needle_tracker.calibrating.rig_model import BoardView
from needle_tracker.optics.calibration import SIDES, load_calibration

from .synthetic_rig import SIZE, TrueRig, flat_pose, free_pose, given, scatter, take

LIMIT = 0.15e-3
SIGMA = 2e-5
PLACES = {
    "surface": Place(flat_pose([0.0185, -0.045, 0.0025]), False, SIGMA),
    "under_wedge": Place(flat_pose([-0.0125, -0.045, 0.004], pitch_deg=12.0), True, SIGMA),
}


@pytest.fixture(scope="module")
def rig(calibration_path: Path) -> TrueRig:
    return TrueRig.read(calibration_path)


def target(rig: TrueRig, seed: int = 0, names: tuple[str, ...] = tuple(PLACES)) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    return [
        rig.view(name, scatter(PLACES[name].T_rig_board, SIGMA, rng), PLACES[name], rng)
        for name in names
    ]


def checked(path: Path, rig: TrueRig, seed: int = 0) -> CheckResult:
    return check(load_calibration(path), target(rig, seed), LIMIT)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_good_calibration_passes(calibration_path: Path, rig: TrueRig, seed: int) -> None:
    result = checked(calibration_path, rig, seed)
    assert result.ok, result.problems
    assert result.tip_error < 0.05e-3
    assert result.corner_sigma_px == pytest.approx(0.1, rel=0.1)


def test_a_calibration_from_images_passes(rig: TrueRig) -> None:
    views = take(rig, np.random.default_rng(7))
    calibration = calibrate(views, dict.fromkeys(SIDES, SIZE), given(0.0175, 1.33)).calibration
    result = check(calibration, target(rig, 8), LIMIT)
    assert result.ok, result.problems


@pytest.mark.parametrize(
    ("side", "axis", "degrees"),
    [("left", "x", 0.02), ("left", "y", -0.02), ("right", "x", -0.02), ("right", "y", 0.02)],
)
def test_a_camera_turned_by_a_fiftieth_of_a_degree(
    calibration_path: Path, rig: TrueRig, side: str, axis: str, degrees: float
) -> None:
    result = checked(calibration_path, rig.turned(side, degrees, axis))
    assert not result.ok
    found = result.deviations[0]
    assert found.cause == f"{side}_camera_turned"
    assert np.rad2deg(found.size) == pytest.approx(0.02, abs=0.003)


def test_a_turn_across_the_needle_moves_tips_by_most_of_a_millimetre(
    calibration_path: Path, rig: TrueRig
) -> None:
    result = checked(calibration_path, rig.turned("left", 0.02, "x"))
    assert 0.5e-3 < result.tip_error < 0.8e-3


@pytest.mark.parametrize("off", [0.01, -0.01])
def test_an_index_off_by_a_hundredth(calibration_path: Path, rig: TrueRig, off: float) -> None:
    result = checked(calibration_path, rig.with_phantom(refractive_index=1.3 + off))
    assert not result.ok
    assert [d.cause for d in result.deviations] == ["refractive_index"]
    found = result.deviations[0]
    assert found.size == pytest.approx(off, abs=4.0 * found.sigma)
    assert found.sigma < 0.002
    assert 0.1e-3 < result.tip_error < 0.4e-3


def test_a_surface_that_sank_by_a_millimetre(calibration_path: Path, rig: TrueRig) -> None:
    result = checked(calibration_path, rig.with_phantom(surface_height=0.0165))
    assert not result.ok
    assert [d.cause for d in result.deviations] == ["surface_height"]
    assert result.deviations[0].size == pytest.approx(-1e-3, abs=0.3e-3)


def test_a_camera_that_fell_over(calibration_path: Path, rig: TrueRig) -> None:
    result = checked(calibration_path, rig.turned("right", 1.0))
    assert not result.ok
    assert result.deviations[0].cause == "right_camera_turned"
    assert np.rad2deg(result.deviations[0].size) == pytest.approx(1.0, abs=0.01)


def test_a_target_that_cannot_show_it_is_never_ok(calibration_path: Path, rig: TrueRig) -> None:
    calibration = load_calibration(calibration_path)
    for views in (
        target(rig, names=("surface",)),
        [rig.view("free", free_pose(np.random.default_rng(1)), None, np.random.default_rng(1))],
    ):
        result = check(calibration, views, LIMIT)
        assert not result.ok
        assert "cannot show" in result.problems[-1]


def test_left_and_right_exchanged_is_no_turned_camera(calibration_path: Path, rig: TrueRig) -> None:
    views = [dataclasses.replace(v, left=v.right, right=v.left) for v in target(rig)]
    result = check(load_calibration(calibration_path), views, LIMIT)
    assert result.deviations == []
    assert "left and right exchanged" in result.problems[0]


def test_another_lens_setting_is_no_turned_camera(calibration_path: Path, rig: TrueRig) -> None:
    rig = rig.turned("left", 0.0)
    rig.content["left"]["distortion_coefficients"]["data"][0] += 0.3
    result = checked(calibration_path, rig)
    assert any("lens" in problem for problem in result.problems)


def test_a_target_that_one_camera_does_not_see(calibration_path: Path, rig: TrueRig) -> None:
    away = rig.turned("right", 30.0)
    with pytest.raises(UserError, match="the right camera sees 0 corners"):
        check(load_calibration(calibration_path), target(away), LIMIT)
