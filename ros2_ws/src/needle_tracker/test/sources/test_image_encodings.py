"""Brightness from each encoding, against the rule of Rec. 601 and patterns laid out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from needle_tracker.sources.image_encodings import ENCODINGS, bytes_per_pixel, grey_image

RED, GREEN, BLUE = 0, 1, 2
# The pattern's first row, then its second.
BAYER = {
    "bayer_rggb8": ((RED, GREEN), (GREEN, BLUE)),
    "bayer_bggr8": ((BLUE, GREEN), (GREEN, RED)),
    "bayer_gbrg8": ((GREEN, BLUE), (RED, GREEN)),
    "bayer_grbg8": ((GREEN, RED), (BLUE, GREEN)),
}


def scene() -> NDArray[np.uint8]:
    """Return a smooth colour image, (60, 80, 3), red first."""
    y, x = np.mgrid[:60, :80] / 60.0
    channels = [90 + 80 * np.sin(2 * x), 120 + 90 * np.cos(3 * y), 60 + 50 * np.sin(x + 2 * y)]
    return np.asarray(np.rint(np.stack(channels, axis=-1)), np.uint8)


def brightness(colour: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray(colour @ np.array([0.299, 0.587, 0.114]))


def encoded(encoding: str, colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the rows of bytes that a camera sends of a scene."""
    height, width, _ = colour.shape
    grey = np.rint(brightness(colour)).astype(np.uint8)
    if encoding in BAYER:
        rows = np.empty((height, width), np.uint8)
        for i in range(2):
            for j in range(2):
                rows[i::2, j::2] = colour[i::2, j::2, BAYER[encoding][i][j]]
        return rows
    if encoding in ("yuyv", "yuv422_yuy2", "uyvy", "yuv422"):
        first = 0 if encoding.startswith(("yuyv", "yuv422_yuy2")) else 1
        rows = np.full((height, 2 * width), 128, np.uint8)
        rows[:, first::2] = grey
        return rows
    if encoding in ("mono8", "8UC1"):
        return grey
    ordered = colour[..., ::-1] if encoding.startswith("bgr") else colour
    if encoding.endswith("a8"):
        ordered = np.concatenate([ordered, np.full((height, width, 1), 7, np.uint8)], axis=2)
    return ordered.reshape(height, -1)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_brightness_is_that_of_the_scene(encoding: str) -> None:
    colour = scene()
    rows = encoded(encoding, colour)
    assert rows.shape[1] == 80 * bytes_per_pixel(encoding)
    # Drivers pad rows to whole words.
    padded = np.pad(rows, ((0, 0), (0, 5)), constant_values=255)
    grey = grey_image(padded, 80, encoding)
    assert grey.shape == (60, 80)
    inner = (slice(2, -2), slice(2, -2))
    off = np.abs(grey.astype(float) - brightness(colour))[inner]
    # Neighbours fill in what a pattern leaves out.
    assert off.max() <= (3.0 if encoding in BAYER else 1.0)


def test_grey_images_are_not_copied() -> None:
    rows = np.zeros((4, 8), np.uint8)
    assert np.shares_memory(grey_image(rows, 6, "mono8"), rows)
