"""Detector of the needle in the images of one camera: search, or fit near an expected end."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.detector.end_fit import FIT, ImageEnd, fit_end
from needle_tracker.detector.needle_net import (
    MARGIN_PX,
    MAX_WIDTH_PX,
    Image,
    Map,
    NeedleNet,
    normalized,
)
from needle_tracker.detector.search_grid import GridView, SearchGrid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class DetectorSettings:
    """Constants of the detector.

    Attributes
    ----------
    coarse_width_px : float
        Least width of a needle that is searched for at half size [px]: it is then 2.2 px wide, the
        least width in the training.
    full_size_reach : float
        Distance from the entry up to which the search uses the full size, which shows more of a
        short needle [m].
    end_window_px : int
        Side of the square over which the ends around a cell are summed [px].
    shaft_prior, ends_prior : float
        Share of shaft pixels in the training images, and number of ends in the window of a cell:
        the network's probabilities divided by these are likelihood ratios.
    row_weight : float
        Weight of the shaft in one row, less than 1 since neighbouring rows are correlated.
    row_limit : float
        Largest absolute log-likelihood ratio of the shaft in one row.
    near_widths : float
        Half the size of the region around a path that is examined at full size [needle widths].
    """

    coarse_width_px: float = 4.4
    full_size_reach: float = 20e-3
    end_window_px: int = 5
    shaft_prior: float = 0.04
    ends_prior: float = 1.5e-3
    row_weight: float = 0.5
    row_limit: float = 2.0
    near_widths: float = 3.0


DETECTOR = DetectorSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """Maps of the network for a part of an image.

    Attributes
    ----------
    shaft, ends : ndarray of float32, shape (height, width)
        Probability of shaft, and expected number of ends, in each pixel.
    corner : (int, int)
        First column and row in the shrunk image.
    shrink : int
        Reduction of the image.
    """

    shaft: Map
    ends: Map
    corner: tuple[int, int]
    shrink: int

    def pixel(self, point: Array) -> Array:
        """Return the pixel of the window at a point of the image [px]."""
        return _shrunk_px(point, self.shrink) - self.corner

    def point(self, pixel: Array) -> Array:
        """Return the point of the image at a pixel of the window [px]."""
        return np.asarray((pixel + self.corner + 0.5) * self.shrink - 0.5)

    def part(self, box: tuple[int, ...]) -> Window | None:
        """Return the part in a box of the shrunk image; None if the window does not cover it."""
        x0, y0, x1, y1 = np.subtract(box, self.corner * 2).tolist()
        height, width = self.shaft.shape
        if min(x0, y0) < 0 or x1 > width or y1 > height:
            return None
        part = slice(y0, y1), slice(x0, x1)
        return Window(self.shaft[part], self.ends[part], (box[0], box[1]), self.shrink)


class NeedleDetector:
    """Detector of the needle in the images of one camera.

    Parameters
    ----------
    view : RefractedCamera
        The camera.
    settings : StereoTrackerParameters
        Width and reach of the needle.
    net : NeedleNet
        The network.

    Attributes
    ----------
    width_px : float
        Width of the needle in the image [px].
    scales : int
        Number of scales at which the needle can be searched for.
    """

    def __init__(
        self, view: RefractedCamera, settings: StereoTrackerParameters, net: NeedleNet
    ) -> None:
        self._net = net
        middle = np.array([0.0, 0.0, 0.5 * settings.max_insertion])
        facing = np.stack([view.sideways, [0.0, 0.0, 1.0]], axis=-1)
        self._px_per_m = float(np.linalg.norm(view.jacobian(middle) @ facing, axis=0).mean())
        self.width_px = settings.needle_width * self._px_per_m
        self._shrink = 1 if self.width_px <= MAX_WIDTH_PX else 2
        self._search_shrink = self._shrink
        if self.width_px >= DETECTOR.coarse_width_px * self._shrink:
            self._search_shrink *= 2
        self.scales = 1 if self._search_shrink == self._shrink else 2
        self._entry = view.project(np.zeros(3))
        self._clear_px = settings.hole_clearance * self._px_per_m
        self._backgrounds: dict[int, Map] = {}
        self._shrunk: dict[int, Image] = {}
        # Maps of the last search at full size, which cover the regions that are examined after it.
        self._searched: Window | None = None

    def set_background(self, image: Image | None) -> None:
        """Use an image as the background; None if the background is unknown."""
        self._backgrounds = {}
        if image is not None:
            for shrink in {self._shrink, self._search_shrink}:
                self._backgrounds[shrink] = normalized(_resized(image, shrink))

    def set_image(self, image: Image) -> None:
        """Use an image for the next calls."""
        self._shrunk, self._searched = {1: image}, None

    def scores(
        self, grid: SearchGrid, seen: GridView, last_row: int, *, full_size: bool
    ) -> tuple[Map, Map]:
        """Return the log-likelihood ratios of shaft and of an end in the cells of the first rows.

        Parameters
        ----------
        grid : SearchGrid
            Grid of the rig.
        seen : GridView
            Its cells in the image of this camera.
        last_row : int
            Last row to be searched.
        full_size : bool
            Whether to use the full size for all rows, not only near the entry.

        Returns
        -------
        pair of ndarray of float32, shape (n,)
            For the cells up to the last row.
        """
        rows = last_row + 1
        near = rows if full_size else min(grid.row_of(DETECTOR.full_size_reach), rows)
        cells = int(grid.starts[rows])
        shaft, ends = np.empty(cells, np.float32), np.empty(cells, np.float32)
        for first, last, shrink in ((0, near, self._shrink), (near, rows, self._search_shrink)):
            inside = slice(grid.starts[first], grid.starts[last])
            if inside.start == inside.stop:
                continue
            boxes = _shrunk_px(seen.boxes[first:last], shrink)
            low = np.floor(boxes[:, :2].min(axis=0)).astype(int)
            high = np.ceil(boxes[:, 2:].max(axis=0)).astype(int) + 1
            window = self._evidence(shrink, (*low, *high))
            self._searched = window if full_size else None
            for ratios, values in zip(_log_ratios(window), (shaft, ends), strict=True):
                _read_nearest(ratios, seen.pixels[inside], window.corner, shrink, values[inside])
        return shaft, ends

    def ends_near(self, point: Array, direction: Array, *, hidden: bool) -> list[ImageEnd]:
        """Return the ends near the end of a shaft that the search found, at full size.

        Two lines, such as a needle and its shadow, may merge at half size.

        Parameters
        ----------
        point, direction : ndarray, shape (2,)
            Expected end [px], and unit vector along the shaft towards it.
        hidden : bool
            Whether to return the line of the shaft alone if no end is found.
        """
        width = self.width_px
        half = DETECTOR.near_widths * width
        back = FIT.line_widths * width + half
        window = self._window(point, direction, (-back, half), half)
        if window is None:
            return []
        size = 2 * round(width / window.shrink) + 1
        mass = cv2.boxFilter(window.ends, -1, (size, size), normalize=False)
        peaks = (mass >= cv2.dilate(mass, np.ones((size, size), np.uint8))) & (
            mass > FIT.hidden_end
        )
        candidates = [window.point(peak) for peak in np.argwhere(peaks)[:, ::-1].astype(float)]
        ends = [
            self._fitted(window, candidate, direction, width, 0.5 * width, lone=True)
            for candidate in candidates
            if math.dist(candidate, point) <= half
        ]
        if hidden and not any(ends):
            # The end is hidden, but the shaft determines its lateral position.
            ends = [self._fitted(window, point, direction, half, 0.5 * width)]
        return [end for end in ends if end is not None]

    def fit(
        self, point: Array, direction: Array, *, along: float, across: float
    ) -> ImageEnd | None:
        """Fit line and end near an expected end.

        Parameters
        ----------
        point, direction : ndarray, shape (2,)
            Expected end [px], and unit vector along the shaft towards it.
        along, across : float
            Largest distance of the end from the point, along and across the direction [px].

        Returns
        -------
        ImageEnd or None
            None if the maps show no shaft.
        """
        width = self.width_px
        back, ahead = FIT.line_widths * width + along, along + FIT.aside_widths * width
        window = self._window(point, direction, (-back, ahead), across)
        return None if window is None else self._fitted(window, point, direction, along, across)

    def _fitted(
        self,
        window: Window,
        point: Array,
        direction: Array,
        along: float,
        across: float,
        *,
        lone: bool = False,
    ) -> ImageEnd | None:
        """Fit line and end near a point of the image; `lone` is that of `fit_end`."""
        shrink = window.shrink
        found = fit_end(
            window.shaft,
            window.ends,
            window.pixel(point),
            direction,
            shaft_length=(math.dist(point, self._entry) - self._clear_px) / shrink,
            along=along / shrink,
            across=across / shrink,
            width=self.width_px / shrink,
            lone=lone,
        )
        if found is None:
            return None
        return dataclasses.replace(
            found,
            point=window.point(found.point),
            sigma_across=found.sigma_across * shrink,
            sigma_along=found.sigma_along * shrink,
        )

    def _window(
        self, point: Array, direction: Array, along: tuple[float, float], across: float
    ) -> Window | None:
        """Return the maps around a strip; None outside the image."""
        corners = np.array(along)[:, None] * direction + point
        beside = across + FIT.aside_widths * self.width_px
        low, high = corners.min(axis=0) - beside, corners.max(axis=0) + beside
        height, width = self._shrunk[1].shape
        if not np.isfinite(low + high).all() or (high < 0).any() or (low > (width, height)).any():
            return None
        first = np.floor(low / self._shrink).astype(int)
        last = np.ceil(high / self._shrink).astype(int) + 1
        box = (*first.tolist(), *last.tolist())
        covered = self._searched and self._searched.part(box)
        return covered or self._evidence(self._shrink, box)

    def _at(self, shrink: int) -> Image:
        if shrink not in self._shrunk:
            self._shrunk[shrink] = _resized(self._shrunk[1], shrink)
        return self._shrunk[shrink]

    def _evidence(self, shrink: int, box: tuple[int, ...]) -> Window:
        """Return the maps of a box with its margin.

        Parameters
        ----------
        shrink : int
            Factor by which the image is shrunk.
        box : tuple of int
            First column and row, and the column and row after the last, in the shrunk image.
        """
        image = self._at(shrink)
        height, width = image.shape
        x0, y0 = max(box[0] - MARGIN_PX, 0), max(box[1] - MARGIN_PX, 0)
        x1, y1 = min(box[2] + MARGIN_PX, width), min(box[3] + MARGIN_PX, height)
        background = self._backgrounds.get(shrink)
        if background is not None:
            background = background[y0:y1, x0:x1]
        shaft, ends = self._net.evidence(normalized(image[y0:y1, x0:x1]), background)
        return Window(shaft, ends, (x0, y0), shrink)


def _log_ratios(window: Window) -> tuple[Map, Map]:
    """Return the log-likelihood ratios of shaft and of an end around each pixel of a window."""
    ends = cv2.boxFilter(window.ends, -1, (DETECTOR.end_window_px,) * 2, normalize=False)
    # The pitch of the cells may exceed the width of a thin needle.
    shaft = cv2.dilate(window.shaft, np.ones((3, 3), np.uint8))
    prior, limit = DETECTOR.shaft_prior, DETECTOR.row_limit
    with np.errstate(divide="ignore"):
        ratio = np.log(shaft / (1.0 - shaft)) - math.log(prior / (1.0 - prior))
    weighted = DETECTOR.row_weight * np.clip(ratio, -limit, limit)
    return weighted, np.log(ends / DETECTOR.ends_prior + FIT.hidden_end)


@compiled
def _read_nearest(
    image: Map, pixels: Map, corner: tuple[int, int], shrink: int, values: Map
) -> None:
    """Write the values of a window of a shrunk image at the nearest pixels, shape (n, 2)."""
    for i in range(len(pixels)):
        column = round((pixels[i, 0] + 0.5) / shrink - 0.5) - corner[0]
        row = round((pixels[i, 1] + 0.5) / shrink - 0.5) - corner[1]
        values[i] = image[row, column]


def _shrunk_px(pixels: Array, shrink: int) -> Array:
    """Return the coordinates of pixels in the shrunk image.

    Pixel i at half size covers the pixels 2 i and 2 i + 1.
    """
    return np.asarray((pixels + 0.5) / shrink - 0.5)


def _resized(image: Image, shrink: int) -> Image:
    if shrink == 1:
        return image
    size = (image.shape[1] // shrink, image.shape[0] // shrink)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
