"""Brightness from each encoding, against Rec. 601 and hand-made patterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.sources.image_encodings import ENCODINGS, bytes_per_pixel, grey_image

# First row of the pattern, then its second: red, green and blue.
BAYER = {"rggb": "0112", "bggr": "2110", "gbrg": "1201", "grbg": "1021"}


def brightness(colour: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray(colour @ np.array([0.299, 0.587, 0.114]))


def encoded(encoding: str, colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the rows of bytes that a camera sends for a scene."""
    height, width, _ = colour.shape
    grey = np.rint(brightness(colour)).astype(np.uint8)
    if encoding.startswith("bayer_"):
        rows = np.empty((height, width), np.uint8)
        for number, channel in enumerate(BAYER[encoding[6:10]]):
            i, j = divmod(number, 2)
            rows[i::2, j::2] = colour[i::2, j::2, int(channel)]
        return rows
    if encoding in ("yuyv", "yuv422_yuy2", "uyvy", "yuv422"):
        rows = np.full((height, 2 * width), 128, np.uint8)
        rows[:, int(encoding in ("uyvy", "yuv422")) :: 2] = grey
        return rows
    if encoding in ("mono8", "8UC1"):
        return grey
    ordered = colour[..., ::-1] if encoding.startswith("bgr") else colour
    if encoding.endswith("a8"):
        ordered = np.concatenate([ordered, np.full((height, width, 1), 7, np.uint8)], axis=2)
    return ordered.reshape(height, -1)


def test_brightness_is_that_of_the_scene() -> None:
    y, x = np.mgrid[:60, :80] / 60.0
    channels = [90 + 80 * np.sin(2 * x), 120 + 90 * np.cos(3 * y), 60 + 50 * np.sin(x + 2 * y)]
    colour = np.asarray(np.rint(np.stack(channels, axis=-1)), np.uint8)
    for encoding in ENCODINGS:
        rows = encoded(encoding, colour)
        assert rows.shape[1] == 80 * bytes_per_pixel(encoding)
        # Drivers pad rows to whole words.
        grey = grey_image(np.pad(rows, ((0, 0), (0, 5)), constant_values=255), 80, encoding)
        assert grey.shape == (60, 80)
        off = np.abs(grey.astype(float) - brightness(colour))[2:-2, 2:-2]
        # Colours missing in the pattern are interpolated from the neighbours.
        assert off.max() <= (3.0 if encoding.startswith("bayer_") else 1.0), encoding
    grey_rows = encoded("mono8", colour)
    assert np.shares_memory(grey_image(grey_rows, 60, "mono8"), grey_rows)
