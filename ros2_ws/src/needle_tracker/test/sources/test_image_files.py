"""Images of two cameras by the names that other tools give them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.sources.image_files import open_pairs

LEFT, RIGHT = 10, 200  # grey values


def save(folder: Path, names: list[str], grey: int) -> Path:
    """Save images that are a little brighter one after the other."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((16, 16), grey + number, np.uint8))
    return folder


def assert_paired(left: Path, right: Path, count: int, first: str) -> None:
    """Each name has the left and the right image of one moment."""
    pairs = open_pairs(left, right)
    assert pairs.unpaired == []
    assert pairs.names[0] == first
    images = [(pair.left, pair.right) for pair in pairs]
    assert len(images) == count
    for number, (a, b) in enumerate(images):
        assert a is not None
        assert b is not None
        assert (a[0, 0], b[0, 0]) == (LEFT + number, RIGHT + number)


NAMES = [
    ("left-%04d.png", "right-%04d.png", "0000.png"),
    ("left%02d.png", "right%02d.png", "00.png"),
    ("img_l_%d.png", "img_r_%d.png", "img_0.png"),
    ("%d_L.png", "%d_R.png", "0.png"),
    ("cam0_%03d.png", "cam1_%03d.png", "cam_000.png"),
    ("cam1_%03d.png", "cam2_%03d.png", "cam_000.png"),
    ("Left_%d.bmp", "Right_%d.bmp", "0.bmp"),
]


@pytest.mark.parametrize(("left", "right", "first"), NAMES)
@pytest.mark.parametrize("folders", [("left", "right"), ("both", "both")])
def test_names_that_differ_in_the_side_are_pairs(
    tmp_path: Path, left: str, right: str, first: str, folders: tuple[str, str]
) -> None:
    # 11 images: 10 comes after 9, not after 1.
    names = [[pattern % number for number in range(11)] for pattern in (left, right)]
    a, b = tmp_path / folders[0], tmp_path / folders[1]
    save(a, names[0], LEFT)
    save(b, names[1], RIGHT)
    assert_paired(a, b, 11, first)


def test_folders_of_kalibr_and_euroc(tmp_path: Path) -> None:
    names = [f"14036371{number:02d}.png" for number in range(3)]
    left, right = tmp_path / "cam0", tmp_path / "cam1"
    save(left / "data", names, LEFT)
    save(right / "data", names, RIGHT)
    assert_paired(left, right, 3, names[0])


def test_one_folder_given_twice_without_sides_in_the_names_is_refused(tmp_path: Path) -> None:
    folder = save(tmp_path / "all", ["a.png", "b.png"], LEFT)
    with pytest.raises(UserError, match="has a partner in --right the same folder"):
        open_pairs(folder, folder)


def test_an_image_without_its_partner_is_named(tmp_path: Path) -> None:
    folder = save(tmp_path / "all", ["left1.png", "left2.png", "right2.png"], LEFT)
    assert open_pairs(folder, folder).unpaired == ["left left1.png"]


def test_equal_names_stay_pairs_though_they_hold_a_side(tmp_path: Path) -> None:
    names = ["left_wall_1.png", "left_wall_2.png", "right_wall_1.png", "right_wall_2.png"]
    left, right = save(tmp_path / "a", names, LEFT), save(tmp_path / "b", names, RIGHT)
    assert_paired(left, right, 4, names[0])
