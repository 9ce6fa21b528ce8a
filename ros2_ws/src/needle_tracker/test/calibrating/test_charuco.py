"""The board: detected where it is drawn, and printed at its size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.charuco import CharucoBoard, write_board
from synthetic_rig import SMALL, board_image


def test_corners_are_found_where_they_are_drawn() -> None:
    board = CharucoBoard(6, 5)
    blurred = np.asarray(cv2.GaussianBlur(board_image(board, 60, 40), (0, 0), 1.0), dtype=np.uint8)
    numbers, pixels = board.find(blurred)
    np.testing.assert_array_equal(numbers, np.arange(20))
    # Column and row numbers count rightwards and downwards from the first square.
    expected = 60 * board.corners[:, :2] / board.square + 40 - 0.5
    np.testing.assert_allclose(pixels, expected, atol=0.02)
    # A partly visible board gives its visible corners; no board gives none.
    hidden = np.full_like(blurred, 200)
    numbers, pixels = board.find(hidden)
    assert (len(numbers), pixels.shape) == (0, (0, 2))
    hidden[:200, :200] = blurred[:200, :200]
    numbers, pixels = board.find(hidden)
    assert set(numbers) <= {0, 1, 5, 6}
    np.testing.assert_allclose(pixels, expected[numbers], atol=0.5)


def test_an_impossible_board_is_rejected() -> None:
    wrong: dict[str, Any]
    for wrong, cause in (
        ({"columns": 2}, "board.columns"),
        ({"square": 1.0}, "board.square"),
        ({"marker": 0.02}, "board.marker"),
        ({"dictionary": "DICT_9X9"}, "dictionary"),
        ({"dictionary": "DICT_4X4_50"}, "54 markers"),
    ):
        with pytest.raises(UserError, match=cause):
            CharucoBoard(**wrong)


def test_the_printed_board_has_its_true_size(tmp_path: Path) -> None:
    write_board(SMALL, tmp_path / "board.png")
    image = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    numbers, pixels = SMALL.find(np.asarray(image, dtype=np.uint8))
    assert len(numbers) == 12
    # 600 dots per inch.
    np.testing.assert_allclose(np.ptp(pixels, axis=0) * 0.0254 / 600, [0.03, 0.02], atol=8e-6)
    # The modules are also where OpenCV has them.
    expected = cv2.resize(board_image(SMALL, 60), None, fx=0.4, fy=0.4)
    margin = round(0.01 / 0.0254 * 600)
    printed = cv2.resize(image[margin:-margin, margin:-margin], expected.shape[::-1])
    assert np.mean(np.abs(printed.astype(float) - expected) > 127.0) < 0.03
    write_board(SMALL, tmp_path / "board.pdf")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(UserError, match="must end in"):
        write_board(SMALL, tmp_path / "board.jpg")
    with pytest.raises(UserError, match="cannot write"):
        write_board(SMALL, tmp_path / "none" / "board.png")
