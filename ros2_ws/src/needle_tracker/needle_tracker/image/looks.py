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

import numpy as np

from needle_tracker.image import detection, tip_fit
from needle_tracker.image.detection import DetectionSettings, Image, Path
from needle_tracker.image.end_fit import LINE_WIDTHS, fit_end
from needle_tracker.image.needle_map import NeedleMap
from needle_tracker.image.search_grid import SearchGrid
from needle_tracker.image.tip_fit import HIDDEN_END_PX, HIDDEN_FACTOR, Expected, ImageTip

Rows = tuple[int, int] | None
"""First and last row of a grid in which a path may end; None: any."""

_SURE_ENOUGH = 0.3  # of a line that may be the needle
_MAP_CONTRAST = 80.0  # the same, of 255, where paths are looked for
_CLEAR_INSIDE = 0.5
_CLEAR_WIDTHS = 1.2  # an end known worse than that, in needle widths (one sigma), is not seen
_ALLOWANCE = 2.5
_LINE_SYSTEMATIC_PX, _END_SYSTEMATIC_PX = 0.2, 0.7
_ROOM_WIDTHS = 6.0  # drawn around an end that is fitted


class Look(Protocol):
    """How one camera's images are searched for paths, and ends fitted in them."""

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
    """

    def __init__(self, needle_width_px: float) -> None:
        self._map = NeedleMap(needle_width_px)

    def find_paths(
        self,
        image: Image,
        grid: SearchGrid,
        settings: DetectionSettings,
        ends: Rows,
    ) -> list[Path]:
        """Return paths that may be the needle."""
        rows = len(grid.distances) if ends is None else min(ends[1] + 1, len(grid.distances))
        box = grid.bounds(max(rows, 1), 4.0 * settings.needle_width_px, image.shape)
        sure = dataclasses.replace(
            settings, bright=True, min_contrast=_MAP_CONTRAST, noise_factor=0.0
        )
        return detection.find_paths(self._map.coarse(image, box), grid, sure, ends=ends)

    def fit(
        self, image: Image, expected: Expected, bright: bool, settings: DetectionSettings
    ) -> ImageTip | None:
        """Fit shaft line and end where they are expected."""
        width = settings.needle_width_px
        ahead, back = _ROOM_WIDTHS * width, (LINE_WIDTHS + 1.0) * width
        corners = np.array([-back, ahead])[:, None] * expected.direction + expected.point
        low = corners.min(axis=0) - expected.search - width
        high = corners.max(axis=0) + expected.search + width
        if (
            not np.isfinite(low + high).all()
            or (high < 0.0).any()
            or (low > image.shape[::-1]).any()
        ):
            return None
        box = (int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1)
        result = np.zeros(9)
        if not fit_end(
            self._map.fine(image, box),
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
        point, along = np.array([u, v]), math.hypot(along, _END_SYSTEMATIC_PX)
        across = math.hypot(across, _LINE_SYSTEMATIC_PX)
        clear = inside > _CLEAR_INSIDE and along < _CLEAR_WIDTHS * width
        if expected.sigma_along > 0.0:
            off = abs(float((point - expected.point) @ expected.direction))
            clear = clear and off < 3.0 * math.hypot(expected.sigma_along, along)
        elif not clear:
            return None
        return ImageTip(
            point=point,
            direction=np.array([d_u, d_v]),
            sigma_across=math.hypot(across, _LINE_SYSTEMATIC_PX)
            * (1.0 if clear else HIDDEN_FACTOR),
            sigma_along=along if clear else HIDDEN_END_PX,
            sigma_angle=math.hypot(angle, _LINE_SYSTEMATIC_PX / (LINE_WIDTHS * width)),
            contrast=255.0 * sure,
            visibility=sure,
            clear=clear,
            bright=True,
            allowance=_ALLOWANCE,
        )
