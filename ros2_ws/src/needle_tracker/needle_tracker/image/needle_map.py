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
Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

_WIDTH_PX = 4.0
"""Width of a needle in what the net sees: of 3.5 to 5.5 it sees long bevels whole, of 6 not."""
_LIKE = (0.85, 1.2)  # widths so near to that, as a ratio, are not scaled
_MARGIN_PX = 24  # what is seen around a box, in what the net sees: farther off matters little
TILE = 16
"""Side of the squares that are drawn or not [px of the image]."""
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

    def draw(self, image: Image, box: Box, tiles: Mask | None = None) -> Image:
        """Return the map, as large as the image, that holds at least in the box.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
            The camera's image; what was drawn of the same array before is kept.
        box : tuple of int
            First column and row, and those after the last.
        tiles : ndarray of bool, shape (height / 16, width / 16), rounded up, optional
            Which squares of 16 x 16 px of the image matter; all by default.
        """
        height, width = image.shape
        if image is not self._image:
            self._image = image
            self._map = np.zeros_like(image)
            self._drawn = np.zeros(tile_counts(image), np.bool_)
        x0, y0, x1, y1 = box
        rows = slice(max(y0, 0) // TILE, -(-min(y1, height) // TILE))
        columns = slice(max(x0, 0) // TILE, -(-min(x1, width) // TILE))
        missing = ~self._drawn[rows, columns]
        if tiles is not None:
            missing &= tiles[rows, columns]
        margin = _MARGIN_PX / self._scale / TILE
        longest = max(int(_PART_PX / self._scale / TILE), 1)
        _, parts = _cover(missing, (columns.start, rows.start), margin, longest)
        for left, top, right, bottom in parts:
            part = (
                left * TILE,
                top * TILE,
                min(right * TILE, width),
                min(bottom * TILE, height),
            )
            self._map[part[1] : part[3], part[0] : part[2]] = self._look(image, part)
            self._drawn[top:bottom, left:right] = True
        return self._map

    @property
    def drawn(self) -> tuple[slice, slice]:
        """Rows and columns of the map that hold all that is drawn of the latest image."""
        rows, columns = (np.flatnonzero(self._drawn.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return slice(0, 0), slice(0, 0)
        return (
            slice(int(rows[0]) * TILE, (int(rows[-1]) + 1) * TILE),
            slice(int(columns[0]) * TILE, (int(columns[-1]) + 1) * TILE),
        )

    def _look(self, image: Image, box: Box) -> Image:
        """Return the map of a box."""
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


def tile_counts(image: Image) -> tuple[int, int]:
    """Return how many rows and columns of tiles an image has."""
    return -(-image.shape[0] // TILE), -(-image.shape[1] // TILE)


def _cover(
    missing: Mask, corner: tuple[int, int], margin: float, longest: int
) -> tuple[float, list[Box]]:
    """Return boxes that hold all missing tiles, and what they cost: their area with margins.

    Parameters
    ----------
    missing : ndarray of bool, shape (rows, columns)
        Tiles.
    corner : tuple of int
        Column and row of the first.
    margin : float
        What is looked at around each box [tiles].
    longest : int
        Largest side of a box [tiles]: the net's memory grows with what it sees.
    """
    rows, columns = np.flatnonzero(missing.any(axis=1)), np.flatnonzero(missing.any(axis=0))
    if not len(rows):
        return 0.0, []
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    missing = missing[top:bottom, left:right]
    x0, y0 = corner[0] + int(left), corner[1] + int(top)
    height, width = missing.shape
    cost = (height + 2.0 * margin) * (width + 2.0 * margin)
    whole: tuple[float, list[Box]] = (cost, [(x0, y0, x0 + width, y0 + height)])
    fits = max(height, width) <= longest
    if max(height, width) == 1 or (fits and missing.all()):
        return whole
    if height > width:
        half = height // 2
        first, second = missing[:half], missing[half:]
        second_corner = x0, y0 + half
    else:
        half = width // 2
        first, second = missing[:, :half], missing[:, half:]
        second_corner = x0 + half, y0
    one, some = _cover(first, (x0, y0), margin, longest)
    other, more = _cover(second, second_corner, margin, longest)
    return whole if fits and cost <= one + other else (one + other, some + more)


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
