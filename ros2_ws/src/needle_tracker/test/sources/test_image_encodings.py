"""Brightness from each encoding, against Rec. 601 and hand-made patterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_core.messages import Image
from needle_tracker.sources.image_encodings import ENCODINGS, Frame, decoded

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


def message(rows: NDArray[np.uint8], encoding: str, width: int = 80) -> Image:
    height, step = rows.shape
    return Image(0, "", height, width, encoding, step, rows.reshape(-1).data)


def test_brightness_is_that_of_the_scene() -> None:
    y, x = np.mgrid[:60, :80] / 60.0
    channels = [90 + 80 * np.sin(2 * x), 120 + 90 * np.cos(3 * y), 60 + 50 * np.sin(x + 2 * y)]
    colour = np.asarray(np.rint(np.stack(channels, axis=-1)), np.uint8)
    for encoding in ENCODINGS:
        # Drivers pad rows to whole words.
        rows = np.pad(encoded(encoding, colour), ((0, 0), (0, 5)), constant_values=255)
        grey = decoded(message(rows, encoding), "left").pixels
        assert grey is not None
        assert grey.shape == (60, 80)
        off = np.abs(grey.astype(float) - brightness(colour))[2:-2, 2:-2]
        # Colours missing in the pattern are interpolated from the neighbours.
        assert off.max() <= (3.0 if encoding.startswith("bayer_") else 1.0), encoding
    grey_rows = encoded("mono8", colour)
    pixels = decoded(message(grey_rows, "mono8"), "left").pixels
    assert pixels is not None
    assert np.shares_memory(pixels, grey_rows)


def test_an_image_without_pixels_or_with_short_rows_is_a_problem() -> None:
    for shape, width, text in (
        ((0, 240), 80, "0 bytes in rows of 240, 0 rows of 240"),
        ((60, 0), 0, "0 bytes in rows of 0, 60 rows of 0"),
        ((60, 239), 80, "14340 bytes in rows of 239, 60 rows of 240"),
    ):
        frame = decoded(message(np.zeros(shape, np.uint8), "rgb8", width), "left")
        assert frame == Frame(None, f"left image has {text} expected")
