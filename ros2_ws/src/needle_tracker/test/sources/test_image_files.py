"""Images of two cameras, with the file names of other tools."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.sources.image_files import open_pairs

# Left, right and the name of the first pair, in one folder or two.
NAMES = [
    ("left-%04d.png", "right-%04d.png", "0000.png"),
    ("left%02d.png", "right%02d.png", "00.png"),
    ("img_l_%d.png", "img_r_%d.png", "img_0.png"),
    ("%d_L.png", "%d_R.png", "0.png"),
    ("cam0_%03d.png", "cam1_%03d.png", "cam_000.png"),
    ("cam1_%03d.png", "cam2_%03d.png", "cam_000.png"),
    ("Left_%d.bmp", "Right_%d.bmp", "0.bmp"),
]


def save(folder: Path, names: list[str], grey: int) -> Path:
    """Save images of increasing brightness."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((4, 4), grey + number, np.uint8))
    return folder


def assert_paired(left: Path, right: Path, count: int, first: str) -> None:
    """Check that each name has the left and the right image of one moment."""
    pairs = open_pairs(left, right)
    assert pairs.unpaired == []
    assert pairs.names[0] == first
    levels = [(int(p.left[0, 0]), int(p.right[0, 0])) for p in pairs]  # type: ignore[index]
    assert levels == [(10 + number, 200 + number) for number in range(count)]


def test_names_that_differ_in_the_side_are_pairs(tmp_path: Path) -> None:
    for number, (left, right, first) in enumerate(NAMES):
        for folders in (("left", "right"), ("both", "both")):
            # Of 11 images, 10 comes after 9, not after 1.
            a, b = (tmp_path / str(number) / folder for folder in folders)
            save(a, [left % image for image in range(11)], 10)
            save(b, [right % image for image in range(11)], 200)
            assert_paired(a, b, 11, first)


def test_equal_names_are_pairs_even_if_they_contain_a_side(tmp_path: Path) -> None:
    names = ["left_wall_1.png", "left_wall_2.png", "right_wall_1.png", "right_wall_2.png"]
    left, right = tmp_path / "cam0", tmp_path / "cam1"
    save(left, names, 10)
    save(right, names, 200)
    assert_paired(left, right, 4, names[0])


def test_images_without_partners_are_named_or_refused(tmp_path: Path) -> None:
    folder = save(tmp_path / "all", ["left1.png", "left2.png", "right2.png"], 10)
    assert open_pairs(folder, folder).unpaired == ["left left1.png"]
    folder = save(tmp_path / "none", ["a.png", "b.png"], 10)
    with pytest.raises(UserError, match="has a partner in --right the same folder"):
        open_pairs(folder, folder)
    with pytest.raises(UserError, match="one is a folder, the other is not"):
        open_pairs(folder, folder / "a.png")
    (folder / "text.avi").write_text("no video")
    with pytest.raises(UserError, match="not a folder or a readable video"):
        open_pairs(folder / "text.avi", folder / "text.avi")
