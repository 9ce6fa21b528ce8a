"""Pairs of images that were not taken at once are named, and never bend the calibration."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_tracker.calibrating.calibrate_stereo import calibrate_stereo
from needle_tracker.calibrating.calibration_outliers import doubts, square_error
from needle_tracker.calibrating.pair_consistency import PairsApartError
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.rig_model import BoardView, Corners

from .session import record
from .synthetic_rig import SIDES, SIZE, TrueRig, given, surface_places, take, under_places

FREE = 12
NOISE_PX = 0.03


@pytest.fixture(scope="module")
def rig(calibration_path: Path) -> TrueRig:
    return TrueRig.read(calibration_path)


@pytest.fixture(scope="module")
def views(rig: TrueRig) -> list[BoardView]:
    return take(rig, np.random.default_rng(0), free=FREE, noise=NOISE_PX)


def exchanged(views: list[BoardView], partner: dict[int, int]) -> list[BoardView]:
    """Views whose right images are those of others."""
    result = list(views)
    for number, other in partner.items():
        result[number] = dataclasses.replace(views[number], right=views[other].right)
    return result


def moved(rig: TrueRig, views: list[BoardView], numbers: list[int], by: float) -> list[BoardView]:
    """Views whose board moved between the left image and the right one [m]."""
    rng, result = np.random.default_rng(1), list(views)
    matrix, lens, _, _ = rig.camera("right")
    for number in numbers:
        seen = views[number].right
        _, turn, shift = cv2.solvePnP(seen.points, seen.pixels, matrix, lens)
        step = rng.normal(size=(3, 1))
        pixels, _ = cv2.projectPoints(
            seen.points, turn, shift + by * step / np.linalg.norm(step), matrix, lens
        )
        noisy = pixels.reshape(-1, 2) + rng.normal(0.0, NOISE_PX, seen.pixels.shape)
        result[number] = dataclasses.replace(views[number], right=Corners(seen.points, noisy))
    return result


def calibrated(views: list[BoardView]) -> RigCalibration:
    return calibrate(views, dict.fromkeys(SIDES, SIZE), given(0.0175, 1.33))


@pytest.mark.parametrize(
    ("partner", "apart"),
    [({}, []), ({4: 5}, [4]), ({3: 7, 7: 3}, [3, 7])],
    ids=["none", "one repeats a frame", "two exchanged"],
)
def test_few_of_them_are_left_out(
    rig: TrueRig, views: list[BoardView], partner: dict[int, int], apart: list[int]
) -> None:
    result = calibrated(exchanged(views, partner))
    assert [view.name for view in result.apart] == [f"free_{number:02d}" for number in apart]
    assert result.parameters["refractive_index"].value == pytest.approx(rig.index, abs=0.003)
    assert result.reprojection_rms_px("right") < 0.06
    assert doubts(result, square_error(result)) == []


def test_a_board_that_moved_in_some_pairs_is_left_out(rig: TrueRig, views: list[BoardView]) -> None:
    result = calibrated(moved(rig, views, [1, 5, 9], 0.3e-3))
    assert [view.name for view in result.apart] == ["free_01", "free_05", "free_09"]


def test_a_board_that_moved_in_all_pairs_is_the_reason_told(
    rig: TrueRig, views: list[BoardView]
) -> None:
    with pytest.raises(PairsApartError, match=r"free_00, .*not captured simultaneously"):
        calibrated(moved(rig, views, list(range(FREE)), 0.3e-3))


def test_a_place_that_only_one_image_shows_is_not_ok(views: list[BoardView]) -> None:
    result = calibrated(exchanged(views, {FREE: FREE + 1}))
    assert [view.name for view in result.apart] == ["surface_a"]
    assert "in surface_a, though" in doubts(result, square_error(result))[0]


def test_names_shifted_by_one_image(
    rig: TrueRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path, rig, surface_places(0.0175) | under_places(0.0175), free=6)
    names = [tmp_path / "right" / f"free_{number}.png" for number in range(6)]
    images = [path.read_bytes() for path in names]
    for number, path in enumerate(names):
        path.write_bytes(images[(number + 1) % 6])
    output = tmp_path / "rig.yaml"
    words = [word for side in SIDES for word in (f"--{side}", str(tmp_path / side))]
    words += ["--session", str(tmp_path / "session.yaml"), "--output", str(output)]
    assert calibrate_stereo(words) == 1
    said = capsys.readouterr().out
    assert said.startswith("NOT OK: left and right do not show the board in the same place in ")
    for number in range(6):
        assert f"free_{number}" in said
    assert "file names are shifted" in said
    assert "surface" not in said
    assert not output.exists()
