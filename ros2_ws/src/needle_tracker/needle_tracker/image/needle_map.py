"""Needle maps: of each pixel, how surely it is needle, by a small net that has seen many needles.

The net (`config/needle_map.onnx`, trained by `scripts/train_needle_map`) knows needles of about one
width in pixels; an image is scaled to that. It looks at 80 pixels around each pixel, and at
brightness against the surroundings alone, so that light and floor matter little.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Box = tuple[int, int, int, int]

_WIDTH_PX = 4.5
"""Width of a needle in what the net sees: of 3.5 to 5.5 it sees long bevels whole, of 6 not."""
_LIKE = (0.85, 1.2)  # widths so near to that, as a ratio, are not scaled
_MARGIN_PX = 24  # what is seen around a box, in what the net sees: farther off matters little
_TILE = 64
_PART_PX = 384  # what the net sees at once
_SURROUNDINGS_PX, _DARK_NOISE, _CLIP = 10.0, 2.0, 4.0


def normalized(image: Image) -> NDArray[np.float32]:
    """Return brightness against the surroundings, in units of how much that varies there."""
    values = image.astype(np.float32)
    values -= _blurred(values)
    spread = np.sqrt(_blurred(values * values))
    normal: NDArray[np.float32] = np.clip(values / (spread + _DARK_NOISE), -_CLIP, _CLIP)
    return normal


def _blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
    blurred = cv2.GaussianBlur(values, (0, 0), _SURROUNDINGS_PX, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, np.float32)


class NeedleMap:
    """The map of one camera's images, drawn where it is asked for.

    Parameters
    ----------
    needle_width_px : float
        Width of the needle in the image [px].
    """

    def __init__(self, needle_width_px: float) -> None:
        self._net = _net()
        factor = _WIDTH_PX / needle_width_px
        self._scale = 1.0 if _LIKE[0] < factor < _LIKE[1] else factor
        self._image: Image | None = None
        self._map = np.empty((0, 0), np.uint8)
        self._drawn = np.empty((0, 0), np.bool_)

    def draw(self, image: Image, box: Box) -> Image:
        """Return the map, as large as the image, that holds at least in the box.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
            The camera's image; what was drawn of the same array before is kept.
        box : tuple of int
            First column and row, and those after the last.
        """
        height, width = image.shape
        if image is not self._image:
            self._image = image
            self._map = np.zeros_like(image)
            self._drawn = np.zeros((-(-height // _TILE), -(-width // _TILE)), np.bool_)
        x0, y0, x1, y1 = box
        rows = slice(max(y0, 0) // _TILE, -(-min(y1, height) // _TILE))
        columns = slice(max(x0, 0) // _TILE, -(-min(x1, width) // _TILE))
        missing_rows, missing_columns = np.nonzero(~self._drawn[rows, columns])
        if len(missing_rows):
            tiles = (
                int(missing_columns.min() + columns.start) * _TILE,
                int(missing_rows.min() + rows.start) * _TILE,
                min(int(missing_columns.max() + columns.start + 1) * _TILE, width),
                min(int(missing_rows.max() + rows.start + 1) * _TILE, height),
            )
            drawn = self._look(image, tiles)
            self._map[tiles[1] : tiles[3], tiles[0] : tiles[2]] = drawn
            self._drawn[rows, columns] = True
        return self._map

    def _look(self, image: Image, box: Box) -> Image:
        """Return the map of a box, part by part: the net's memory grows with what it sees."""
        x0, y0, x1, y1 = box
        size = max(int(_PART_PX / self._scale), 2) // 2 * 2
        drawn = np.zeros((y1 - y0, x1 - x0), np.uint8)
        for top in range(y0, y1, size):
            for left in range(x0, x1, size):
                part = (left, top, min(left + size, x1), min(top + size, y1))
                drawn[top - y0 : part[3] - y0, left - x0 : part[2] - x0] = self._look_at_part(
                    image, part
                )
        return drawn

    def _look_at_part(self, image: Image, box: Box) -> Image:
        scale = self._scale
        height, width = image.shape
        margin = int(_MARGIN_PX / scale) + 1
        # An even number of pixels from an even one on: the net halves what it sees.
        x0, y0 = (max(low - margin, 0) // 2 * 2 for low in box[:2])
        x1, y1 = (
            min(high + margin + 1, size) // 2 * 2
            for high, size in zip(box[2:], (width, height), strict=True)
        )
        cut = image[y0:y1, x0:x1]
        seen_size = tuple(2 * max(round(0.5 * scale * n), 1) for n in (x1 - x0, y1 - y0))
        shrink = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        seen = (
            cut
            if seen_size == (x1 - x0, y1 - y0)
            else cv2.resize(cut, seen_size, interpolation=shrink)
        )
        self._net.setInput(normalized(seen)[None, None])
        sure = self._net.forward()[0, 0]
        if seen is not cut:
            sure = cv2.resize(sure, (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR)
        drawn = np.zeros((box[3] - box[1], box[2] - box[0]), np.uint8)
        inner = sure[box[1] - y0 : box[3] - y0, box[0] - x0 : box[2] - x0]
        # Of an odd image the last line is left out.
        drawn[: inner.shape[0], : inner.shape[1]] = np.rint(255.0 * inner)
        return drawn


@cache
def _net() -> cv2.dnn.Net:
    """Return the net, for all maps; it has looked once, and so has all the memory that it takes."""
    net = cv2.dnn.readNetFromONNX(_weights())
    size = _PART_PX + 2 * (_MARGIN_PX + 2)
    net.setInput(np.zeros((1, 1, size, size), np.float32))
    net.forward()
    return net


def _weights() -> NDArray[np.uint8]:
    content = (files("needle_tracker") / "image" / "needle_map.onnx").read_bytes()
    return np.frombuffer(content, np.uint8)
