from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.charuco import CharucoBoard, check_board_seen, write_board

from .synthetic_rig import BOARD, board_image


def test_corners_are_found_where_they_are_drawn() -> None:
    image = cv2.copyMakeBorder(
        board_image(BOARD, 60), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255
    )
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), dtype=np.uint8)
    numbers, pixels = BOARD.find(blurred)
    np.testing.assert_array_equal(numbers, np.arange(88))
    # Column and row numbers count rightwards and downwards from the first square.
    expected = 60 * BOARD.corners[:, :2] / BOARD.square + 40 - 0.5
    np.testing.assert_allclose(pixels, expected, atol=0.02)


@pytest.mark.parametrize("visible", [0, 1])
def test_an_image_with_little_or_nothing_of_the_board(visible: int) -> None:
    image = np.full((400, 400), 200, np.uint8)
    if visible:
        image[:150, :150] = board_image(BOARD, 60)[:150, :150]
    numbers, pixels = BOARD.find(image)
    assert pixels.shape == (len(numbers), 2)
    assert len(numbers) <= 4


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"columns": 2}, "board.columns"),
        ({"square": 1.0}, "board.square"),
        ({"marker": 0.02}, "board.marker"),
        ({"dictionary": "DICT_9X9"}, "dictionary"),
        ({"dictionary": "DICT_4X4_50"}, "54 markers"),
    ],
)
def test_a_board_that_cannot_be(wrong: dict[str, object], says: str) -> None:
    with pytest.raises(UserError, match=says):
        CharucoBoard(**wrong)  # type: ignore[arg-type]


def test_the_printed_board_has_its_true_size(tmp_path: Path) -> None:
    write_board(BOARD, tmp_path / "board.png")
    image = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    numbers, pixels = BOARD.find(np.asarray(image, dtype=np.uint8))
    assert len(numbers) == 88
    # 600 dots an inch.
    np.testing.assert_allclose(np.ptp(pixels, axis=0) * 0.0254 / 600, [0.10, 0.07], rtol=5e-5)
    # Modules too are where OpenCV has them, at 56 dots a square and 6 a module.
    expected = cv2.resize(
        board_image(BOARD, 56), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    margin = round(0.01 / 0.0254 * 600)
    printed = cv2.resize(
        image[margin:-margin, margin:-margin], expected.shape[::-1], interpolation=cv2.INTER_AREA
    )
    assert np.mean(np.abs(printed.astype(float) - expected) > 127.0) < 1e-3
    write_board(BOARD, tmp_path / "board.pdf")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(UserError, match=r"\.pdf nor"):
        write_board(BOARD, tmp_path / "board.jpg")


@pytest.mark.parametrize(
    ("printed", "said", "cure"),
    [
        (CharucoBoard(rows=8, legacy=True), CharucoBoard(rows=8), "`legacy: True`"),
        (BOARD, CharucoBoard(9, 12), "`columns: 12, rows: 9`"),
        (CharucoBoard(9, 12), BOARD, "`columns: 9, rows: 12`"),
        (BOARD, CharucoBoard(11, 9), "`columns: 12`"),
        (CharucoBoard(dictionary="DICT_4X4_100"), BOARD, "`dictionary: DICT_4X4_100`"),
        (
            CharucoBoard(rows=8, legacy=True),
            CharucoBoard(8, 12),
            "`columns: 12, rows: 8, legacy: True`",
        ),
    ],
)
def test_the_board_that_the_images_show_is_named(
    printed: CharucoBoard, said: CharucoBoard, cure: str
) -> None:
    image = cv2.copyMakeBorder(
        board_image(printed, 40), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255
    )
    assert not len(said.find(np.asarray(image, dtype=np.uint8))[0])
    with pytest.raises(UserError, match=f"another one, give {cure} as its board"):
        check_board_seen([np.asarray(image, dtype=np.uint8)], said)


def test_without_markers_no_board_is_named() -> None:
    with pytest.raises(UserError, match="its markers identify no other board either"):
        check_board_seen([np.full((300, 400), 200, np.uint8)], BOARD)
