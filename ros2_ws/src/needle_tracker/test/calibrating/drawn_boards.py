"""Boards as OpenCV draws them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.calibrating.charuco import CharucoBoard

SMALL = CharucoBoard(5, 4, dictionary="DICT_4X4_50")


def board_image(board: CharucoBoard, square_px: int, margin: int = 0) -> NDArray[np.uint8]:
    """The pattern with a white margin."""
    return np.pad(board.drawing(square_px), margin, constant_values=255)
