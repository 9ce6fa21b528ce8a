"""Two ways to look at an image: at lines that are darker or brighter, or at a map of the needle.

A line's edges are good to a few hundredths of a pixel where the needle is plain: all dark or all
bright, before a floor without lines of its own. A needle map sees needles that mirror lamps, change
from bright to dark, or lie over graph paper, and knows an end that a ground face hides; it is good
to some tenths of a pixel.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.image import detection, tip_fit
from needle_tracker.image.background import LEAST_NEW, SURE, Background
from needle_tracker.image.detection import DetectionSettings, Image, Path
from needle_tracker.image.end_fit import ASIDE_WIDTHS, LINE_WIDTHS, fit_end, hidden_sigma
from needle_tracker.image.needle_map import TILE, Box, Mask, NeedleMap, tile_counts
from needle_tracker.image.search_grid import SearchGrid
from needle_tracker.image.tip_fit import HIDDEN_END_PX, HIDDEN_FACTOR, Expected, ImageTip

Array = NDArray[np.float64]
Rows = tuple[int, int] | None
"""First and last row of a grid in which a path may end; None: any."""

_SURE_ENOUGH = 0.3  # of a line that may be the needle
_MAP_CONTRAST = 80.0  # the same, of 255, where paths are looked for
# A needle is in the phantom: that is so many times likelier than the net was taught. Over texture
# it says less of all of the needle alike.
_ODDS = 8.0
_CHANCE = np.arange(256) / 255.0
_LIKELIER = np.rint(255.0 * _ODDS * _CHANCE / (1.0 + (_ODDS - 1.0) * _CHANCE)).astype(np.uint8)
_CLEAR_INSIDE = 0.5
CLEAR_WIDTHS = 1.2
"""Standard deviation along the shaft of an end that a map shows [needle widths]."""
_ALLOWANCE = 0.54  # for each pixel of the needle's width
# In needle widths: what shape and light leave in line and end.
_LINE_SYSTEMATIC, _END_SYSTEMATIC = 0.06, 0.15
# Likewise: beyond such a gap may be another thing, and beyond such a one there is.
_GAP_WIDTHS, _HIDDEN_WIDTHS = 1.5, 8.0
_ROOM_WIDTHS = 6.0  # drawn around an end that is fitted
_SEARCH_WIDTHS = 4.0  # and beside where it is searched for


class Look(Protocol):
    """Search of one camera's images for paths, and fits of the ends in them."""

    def find_paths(
        self,
        image: Image,
        grid: SearchGrid,
        settings: DetectionSettings,
        ends: Rows,
    ) -> list[Path]:
        """Return paths that may be the needle, as `detection.find_paths`."""
        ...

    def fit(
        self, image: Image, expected: Expected, bright: bool, settings: DetectionSettings
    ) -> ImageTip | None:
        """Fit shaft line and end where they are expected, as `tip_fit.fit_expected`."""
        ...


class LineLook:
    """Looks at lines in the image itself."""

    def find_paths(
        self,
        image: Image,
        grid: SearchGrid,
        settings: DetectionSettings,
        ends: Rows,
    ) -> list[Path]:
        """Return paths that may be the needle."""
        return detection.find_paths(image, grid, settings, ends=ends)

    def fit(
        self, image: Image, expected: Expected, bright: bool, settings: DetectionSettings
    ) -> ImageTip | None:
        """Fit shaft line and end where they are expected."""
        return tip_fit.fit_expected(image, expected, bright, settings)


LINE_LOOKS: tuple[Look, Look] = (LineLook(), LineLook())


class MapLook:
    """Looks at a needle map.

    Parameters
    ----------
    needle_width_px : float
        Width of the needle in the image [px].
    bevel_length_px : float
        Length of its ground face there, seen from the side [px]; 0 where unknown.

    Attributes
    ----------
    background : Background or None
        What stands behind the needle, where that is known.
    earlier : MapLook or None
        What looks before the background of this recording; None: this does.
    """

    def __init__(self, needle_width_px: float, bevel_length_px: float) -> None:
        self._map = NeedleMap(needle_width_px)
        self._map_of_difference = NeedleMap(needle_width_px)
        self._map_before = NeedleMap(needle_width_px)
        self._bevel_length_px = bevel_length_px
        self.background: Background | None = None
        self.earlier: MapLook | None = None

    def _draw(self, image: Image, box: Box, tiles: Mask | None = None) -> Image:
        """Return the map; before lines that were there before the needle, of what is new."""
        background = self.background
        difference = None if background is None else background.difference(image)
        if background is None or difference is None:
            return self._map.draw(image, box, tiles)
        new = self._map_of_difference.draw(difference, box, tiles)
        if background.is_empty:
            return new
        within = self._map_of_difference.drawn
        rows, columns = np.nonzero(new[within] > SURE)
        there = np.zeros(tile_counts(image), np.bool_)
        there[(rows + within[0].start) // TILE, (columns + within[1].start) // TILE] = True
        before = self._map_before.draw(background.before, box, there)
        return background.joined(self._map.draw(image, box, tiles), new, before, within)

    def _beyond_seam(self, image: Image, point: Array) -> float:
        """Return how far a point is beyond where the map is put together [px]."""
        background = self.background
        if background is None or background.difference(image) is None:
            return -math.inf
        return background.beyond_seam(point)

    def _has_come(self, image: Image, point: Array, direction: Array, width: float) -> bool:
        """Return whether there was nothing like the needle's end in an earlier image.

        What else is new, elsewhere in the image, does not matter.
        """
        background = self.background
        if background is None:
            return False
        difference = background.difference(image)
        if difference is not None and background.is_empty:
            return True
        begin = point - LEAST_NEW * width * direction
        low, high = np.minimum(begin, point) - width, np.maximum(begin, point) + width + 1.0
        box = (int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1)
        before = self._map_before.draw(background.before, box)
        if difference is None:
            there = before[max(box[1], 0) : box[3], max(box[0], 0) : box[2]]
            return bool(there.max(initial=0) < 255.0 * _SURE_ENOUGH)
        # Up to a width before the end, where it may fade.
        ways = np.arange(width, LEAST_NEW * width + 1.0)[:, None]
        columns, rows = np.rint(point - ways * direction).astype(np.int64).T
        last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
        shaft = np.clip(rows, 0, last_row), np.clip(columns, 0, last_column)
        new = self._map_of_difference.draw(difference, box)[shaft].mean()
        # What the image before showed better is a needle that has gone.
        now = self._map.draw(image, box)[shaft].mean()
        return bool(new > SURE and now > before[shaft].mean())

    def find_paths(
        self,
        image: Image,
        grid: SearchGrid,
        settings: DetectionSettings,
        ends: Rows,
    ) -> list[Path]:
        """Return paths that may be the needle."""
        rows = len(grid.distances) if ends is None else min(ends[1] + 1, len(grid.distances))
        margin = _SEARCH_WIDTHS * settings.needle_width_px
        box = grid.bounds(max(rows, 1), margin, image.shape)
        sure = dataclasses.replace(
            settings,
            bright=True,
            min_contrast=_MAP_CONTRAST,
            noise_factor=0.0,
            min_coverage=0.0,
        )
        drawn = self._draw(image, box, grid.tiles(rows, margin, tile_counts(image), TILE))
        drawn = _likelier(drawn)
        least = max(int(sure.min_length / grid.row_pitch), 2, 0 if ends is None else ends[0])
        # What follows a gap may be another thing, and then the way to it leaves the needle early:
        # so first without gaps.
        paths = [
            part
            for gap in (_GAP_WIDTHS, _HIDDEN_WIDTHS)
            for path in detection.find_paths(
                drawn, grid, dataclasses.replace(sure, longest_gap=gap), ends=ends
            )
            for part in _parts(drawn, path, least, settings.needle_width_px)
        ]
        return sorted(paths, key=lambda path: -path.evidence)

    def fit(
        self, image: Image, expected: Expected, bright: bool, settings: DetectionSettings
    ) -> ImageTip | None:
        """Fit shaft line and end where they are expected."""
        width = settings.needle_width_px
        ahead, back = _ROOM_WIDTHS * width, (LINE_WIDTHS + 1.0) * width
        corners = np.array([-back, ahead])[:, None] * expected.direction + expected.point
        beside = max(expected.search, ASIDE_WIDTHS * width) + width
        low, high = corners.min(axis=0) - beside, corners.max(axis=0) + beside
        if (
            not np.isfinite(low + high).all()
            or (high < 0.0).any()
            or (low > image.shape[::-1]).any()
        ):
            return None
        box = (int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1)
        drawn = self._draw(image, box)
        tip = self._fit_in(drawn, image, expected, width)
        if tip is not None and tip.clear:
            return tip
        likely = self._fit_in(_likelier(drawn), image, expected, width)
        return likely if tip is None or (likely is not None and likely.clear) else tip

    def _fit_in(
        self, drawn: Image, image: Image, expected: Expected, width: float
    ) -> ImageTip | None:
        result = np.zeros(9)
        if not fit_end(
            drawn,
            np.ascontiguousarray(expected.point, dtype=np.float64),
            np.ascontiguousarray(expected.direction, dtype=np.float64),
            float(expected.room),
            float(expected.search),
            width,
            result,
        ):
            return None
        u, v, d_u, d_v, across, along, angle, sure, inside = result.tolist()
        height, wide = image.shape
        if sure < _SURE_ENOUGH or not (2.0 <= u <= wide - 3.0 and 2.0 <= v <= height - 3.0):
            return None
        point, direction = np.array([u, v]), np.array([d_u, d_v])
        hidden = hidden_sigma(along, self._bevel_length_px)
        along = math.hypot(along, _END_SYSTEMATIC * width)
        across = math.hypot(across, _LINE_SYSTEMATIC * width)
        clear = inside > _CLEAR_INSIDE and along < CLEAR_WIDTHS * width
        beyond = self._beyond_seam(image, point)
        clear = clear and abs(beyond) > width
        if expected.sigma_along > 0.0:
            off = abs(float((point - expected.point) @ expected.direction))
            clear = clear and off < 3.0 * math.hypot(expected.sigma_along, along)
        elif not clear:
            return None
        end = (point, direction, width)
        empty = self.background is not None and self.background.is_empty
        return ImageTip(
            point=point,
            direction=direction,
            sigma_across=across * (1.0 if clear else HIDDEN_FACTOR),
            sigma_along=math.hypot(hidden, _END_SYSTEMATIC * width) if clear else HIDDEN_END_PX,
            sigma_angle=math.hypot(angle, _LINE_SYSTEMATIC / LINE_WIDTHS),
            contrast=255.0 * sure,
            # How sure a map is depends on what lies behind the needle, in each view another thing.
            visibility=1.0,
            clear=clear,
            bright=True,
            allowance=_ALLOWANCE * width,
            come=(self.earlier or self)._has_come(image, *end),
            all_new=empty and self._has_come(image, *end),
        )


def _likelier(drawn: Image) -> Image:
    """Return a map at the odds of a needle that is there."""
    return np.asarray(cv2.LUT(drawn, _LIKELIER), np.uint8)


def _parts(drawn: Image, path: Path, least: int, width: float) -> list[Path]:
    """Return the parts of a path, from its begin, that may be a needle.

    It ends where it does, or where a gap begins: what follows may be another thing. What follows a
    long gap is one.
    """
    columns, rows = np.rint(path.pixels).astype(np.int64).T
    inside = (columns >= 0) & (rows >= 0) & (columns < drawn.shape[1]) & (rows < drawn.shape[0])
    there = np.zeros(len(rows), np.bool_)
    there[inside] = drawn[rows[inside], columns[inside]] > 255.0 * _SURE_ENOUGH
    seen = np.flatnonzero(there)
    if not len(seen):
        return []
    pitch = max(float(np.linalg.norm(np.diff(path.pixels, axis=0), axis=1).mean()), 1e-6)
    gaps = np.diff(seen, prepend=seen[0]) * pitch / width
    too_long = np.flatnonzero(gaps > _HIDDEN_WIDTHS)
    reached = too_long[0] if len(too_long) else len(seen)
    lasts = [*(np.flatnonzero(gaps[:reached] > _GAP_WIDTHS) - 1), reached - 1]
    # Where it enters, a box's edge may hide more of it, as long as most of it is seen.
    whole = 0 if seen[0] * pitch <= _HIDDEN_WIDTHS * width else 2 * seen[0]
    return [
        dataclasses.replace(
            path,
            rows=path.rows[:count],
            columns=path.columns[:count],
            pixels=path.pixels[:count],
            coverage=(i + 1) / count,
            evidence=path.evidence * (i + 1) / len(seen),
        )
        for i in lasts
        if (count := int(seen[i]) + 1) > max(least, whole)
    ]
