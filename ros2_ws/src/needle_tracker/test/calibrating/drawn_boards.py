"""Boards as OpenCV draws them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.calibrating.charuco import CharucoBoard

SMALL = CharucoBoard(5, 4, dictionary="DICT_4X4_50")


def board_image(board: CharucoBoard, square_px: int, margin: int = 0) -> NDArray[np.uint8]:
    """The pattern with a white margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    shape = (board.columns, board.rows)
    pattern = cv2.aruco.CharucoBoard(shape, board.square, board.marker, dictionary)
    pattern.setLegacyPattern(board.legacy)
    image = pattern.generateImage((shape[0] * square_px, shape[1] * square_px))
    return np.pad(np.asarray(image, dtype=np.uint8), margin, constant_values=255)
