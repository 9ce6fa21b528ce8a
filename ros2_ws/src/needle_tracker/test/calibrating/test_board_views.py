"""Views of the board in both cameras, from images in folders or several exposures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import (
    HELD_FREELY,
    Place,
    Session,
    averaged_view,
    views_in_folders,
)
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.optics.calibration import SIDES
from synthetic_rig import GIVEN, SMALL, board_image, flat_pose

SESSION = Session(SMALL, GIVEN, {"top": Place(flat_pose([0.018, 0.0, 0.0]))})
IMAGE = board_image(SMALL, 24, 24)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for side in SIDES:
        (tmp_path / side).mkdir()
        for name in ("top", "free_1"):
            cv2.imwrite(str(tmp_path / side / f"{name}.png"), IMAGE)
    return tmp_path


def test_each_pair_of_images_is_a_view(folder: Path) -> None:
    cv2.imwrite(str(folder / "right" / "free_1.png"), np.full_like(IMAGE, 90))
    views, sizes = views_in_folders(folder / "left", folder / "right", SESSION)
    assert sizes == dict.fromkeys(SIDES, IMAGE.shape[::-1])
    assert [view.name for view in views] == ["free_1", "top"]
    free, top = views
    assert (free.place, top.place) == (HELD_FREELY, SESSION.places["top"])
    assert len(free.right.points) == 0
    for corners in (top.left, top.right, free.left):
        np.testing.assert_allclose(corners.points, SMALL.corners)
        expected = 24 * SMALL.corners[:, :2] / SMALL.square + 24 - 0.5
        np.testing.assert_allclose(corners.pixels, expected, atol=0.5)


def drop(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def write(name: str, image: np.ndarray) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(cv2.imencode(".png", image)[1].tobytes())


def broken(folder: Path) -> None:
    (folder / "right" / "top.png").write_bytes(b"not an image")


def no_image_of_the_place(folder: Path) -> None:
    for side in SIDES:
        (folder / side / "top.png").rename(folder / side / "other.png")


def another_board(folder: Path) -> None:
    other = board_image(CharucoBoard(6, 4, dictionary="DICT_4X4_50"), 24, 24)
    for side in SIDES:
        for name in ("top", "free_1"):
            cv2.imwrite(str(folder / side / f"{name}.png"), other)


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (drop("left/free_1.png"), "1 images without a partner: right free_1.png"),
        (write("right/top.png", np.zeros((48, 64), np.uint8)), "top.png is 64x48"),
        (broken, "cannot read .*top.png"),
        (no_image_of_the_place, "places.top has no image"),
        (another_board, "no image shows the session's board .* `legacy`"),
    ],
)
def test_unsuitable_folders_are_rejected(
    folder: Path, spoil: Callable[[Path], object], cause: str
) -> None:
    spoil(folder)
    with pytest.raises(UserError, match=cause):
        views_in_folders(folder / "left", folder / "right", SESSION)


def test_a_board_at_rest_is_averaged_over_its_exposures() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 10.0, (10, *IMAGE.shape))
    exposures = np.clip(0.6 * IMAGE + 50.0 + noise, 0.0, 255.0).astype(np.uint8)
    view = averaged_view("top", SESSION, [(image, image) for image in exposures])
    assert view.place is SESSION.places["top"]
    _, true = SMALL.find(IMAGE)
    one = SMALL.find(exposures[0])[1]
    for corners in (view.left, view.right):
        np.testing.assert_array_equal(corners.points, SMALL.corners)
        assert np.std(corners.pixels - true) < 0.5 * np.std(one - true)
    blank = np.full_like(IMAGE, 90)
    with pytest.raises(UserError, match="no image shows the session's board"):
        averaged_view("top", SESSION, [(blank, blank)])
