"""Detector of the needle in the images of one camera: search, or fit near an expected end."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import FIT, ImageEnd, fit_end
from needle_tracker.detector.end_search import ShaftPath, find_paths, make_search_grid
from needle_tracker.detector.needle_net import (
    MARGIN_PX,
    MAX_WIDTH_PX,
    Image,
    Map,
    NeedleNet,
    normalized,
)
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Pixels = TypeVar("Pixels", NDArray[np.float32], NDArray[np.float64])


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
    strips : int
        Boxes that cover the reachable part of an image; with more, the network evaluates fewer
        pixels outside it.
    end_window_px : int
        Side of the square over which the ends around a cell are summed [px].
    near_widths : float
        Half the size of the region around a path that is examined at full size [needle widths].
    """

    coarse_width_px: float = 4.4
    full_size_reach: float = 20e-3
    strips: int = 3
    end_window_px: int = 5
    near_widths: float = 5.0


DETECTOR = DetectorSettings()


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
        self._grid = make_search_grid(view, settings)
        self._entry = view.project(np.zeros(3))
        self._clear_px = settings.hole_clearance * self._px_per_m
        self._backgrounds: dict[int, Map] = {}
        self._shrunk: dict[int, Image] = {}

    def set_background(self, image: Image | None) -> None:
        """Use an image as the background; None if the background is unknown."""
        self._backgrounds = {}
        if image is not None:
            for shrink in {self._shrink, self._search_shrink}:
                self._backgrounds[shrink] = normalized(_resized(image, shrink))

    def set_image(self, image: Image) -> None:
        """Use an image for the next calls."""
        self._shrunk = {1: image}

    def search(self, least: float, most: float) -> list[ShaftPath]:
        """Return paths to candidates for the end of the needle, the best first.

        Parameters
        ----------
        least, most : float
            Bounds of the distance of the end from the entry [m].
        """
        grid = self._grid
        first, last = grid.row_of(least), grid.row_of(most)
        reachable = grid.reachable[: last + 1]
        near = np.arange(last + 1)[:, None] < grid.row_of(DETECTOR.full_size_reach)
        maps = [
            self._sampled(reachable & part, shrink)
            for part, shrink in ((near, self._shrink), (~near, self._search_shrink))
            if (reachable & part).any()
        ]
        if not maps:
            return []
        shaft, ends = (np.add.reduce(each) for each in zip(*maps, strict=True))
        return find_paths(grid, shaft, ends, first, last)

    def trace(self, path: ShaftPath, end: ImageEnd) -> ShaftPath:
        """Return the path to an end at full size, near a path that `search` found."""
        grid, rows = self._grid, len(path.pixels)
        off = np.linalg.norm(grid.pixels[:rows] - path.pixels[:, None], axis=-1)
        near = grid.reachable[:rows] & (off < DETECTOR.near_widths * self.width_px)
        if not near.any():
            return path
        shaft, ends = self._sampled(near, self._shrink)
        away = np.where(near, np.linalg.norm(grid.pixels[:rows] - end.point, axis=-1), np.inf)
        row, column = np.unravel_index(int(away.argmin()), away.shape)
        ends[:] = 0.0
        ends[row, column] = 1.0
        corridor = dataclasses.replace(grid, reachable=near)
        found = find_paths(corridor, shaft, ends, int(row), int(row))
        return found[0] if found else path

    def _sampled(self, cells: NDArray[np.bool_], shrink: int) -> tuple[Map, Map]:
        """Return the maps at given cells of the first rows of the grid, 0 at all others."""
        pixels = _shrunk_px(self._grid.pixels[: len(cells)], np.float32(shrink))
        height, width = self._at(shrink).shape
        shaft, ends = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
        for box in _strips(pixels[cells]):
            seen_shaft, seen_ends, (x0, y0) = self._evidence(shrink, box)
            rows, columns = seen_shaft.shape
            shaft[y0 : y0 + rows, x0 : x0 + columns] = seen_shaft
            ends[y0 : y0 + rows, x0 : x0 + columns] = seen_ends
        ends = cv2.boxFilter(ends, -1, (DETECTOR.end_window_px,) * 2, normalize=False)
        # The pitch of the cells may exceed the width of a thin needle.
        shaft = cv2.dilate(shaft, np.ones((3, 3), np.uint8))
        sampled = [
            np.where(cells, cv2.remap(each, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR), 0.0)
            for each in (shaft, ends)
        ]
        return sampled[0], sampled[1]

    def ends_near(self, path: ShaftPath, *, hidden: bool) -> list[ImageEnd]:
        """Return the ends near the end of a path, at full size.

        Two lines, such as a needle and its shadow, may merge at half size.

        Parameters
        ----------
        path : ShaftPath
            Path from `search`.
        hidden : bool
            Whether to return the line of the shaft alone if no end is found.
        """
        shrink, width = self._shrink, self.width_px
        half = DETECTOR.near_widths * width
        box = self._box(path.end, path.direction, (-FIT.line_widths * width - half, half), half)
        if box is None:
            return []
        shaft, ends, corner = self._evidence(shrink, box)
        size = 2 * round(width / shrink) + 1
        mass = cv2.boxFilter(ends, -1, (size, size), normalize=False)
        peaks = (mass >= cv2.dilate(mass, np.ones((size, size), np.uint8))) & (
            mass > FIT.hidden_end
        )
        found = []
        for row, column in np.argwhere(peaks):
            pixel = np.array([column, row], np.float64)
            off = _full_px(pixel + corner, shrink) - path.end
            if math.hypot(*off) > half:
                continue
            end = self._fitted((shaft, ends, corner), pixel, path.direction, width, 0.5 * width)
            if end is not None:
                found.append(end)
        if hidden and not found:
            # The end is hidden, but the shaft determines its lateral position.
            pixel = _shrunk_px(path.end, shrink) - corner
            end = self._fitted((shaft, ends, corner), pixel, path.direction, half, 0.5 * width)
            found = [] if end is None else [end]
        return found

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
        shrink, width = self._shrink, self.width_px
        back, ahead = FIT.line_widths * width + along, along + FIT.aside_widths * width
        box = self._box(point, direction, (-back, ahead), across)
        if box is None:
            return None
        maps = self._evidence(shrink, box)
        pixel = _shrunk_px(point, shrink) - maps[2]
        return self._fitted(maps, pixel, direction, along, across)

    def _fitted(
        self,
        maps: tuple[Map, Map, tuple[int, int]],
        pixel: Array,
        direction: Array,
        along: float,
        across: float,
    ) -> ImageEnd | None:
        """Fit line and end near a pixel of the maps; the result is in pixels of the image."""
        shaft, ends, corner = maps
        shrink, width = self._shrink, self.width_px
        point = _full_px(pixel + corner, shrink)
        found = fit_end(
            shaft,
            ends,
            pixel,
            direction,
            shaft_length=(math.dist(point, self._entry) - self._clear_px) / shrink,
            along=along / shrink,
            across=across / shrink,
            width=width / shrink,
        )
        if found is None:
            return None
        return dataclasses.replace(
            found,
            point=_full_px(found.point + corner, shrink),
            sigma_across=found.sigma_across * shrink,
            sigma_along=found.sigma_along * shrink,
        )

    def _box(
        self, point: Array, direction: Array, along: tuple[float, float], across: float
    ) -> tuple[int, ...] | None:
        """Return the box around a strip, in the shrunk image; None outside the image."""
        corners = np.array(along)[:, None] * direction + point
        beside = across + FIT.aside_widths * self.width_px
        low, high = corners.min(axis=0) - beside, corners.max(axis=0) + beside
        height, width = self._shrunk[1].shape
        if not np.isfinite(low + high).all() or (high < 0).any() or (low > (width, height)).any():
            return None
        first = np.floor(low / self._shrink).astype(int)
        last = np.ceil(high / self._shrink).astype(int) + 1
        return (*first.tolist(), *last.tolist())

    def _at(self, shrink: int) -> Image:
        if shrink not in self._shrunk:
            self._shrunk[shrink] = _resized(self._shrunk[1], shrink)
        return self._shrunk[shrink]

    def _evidence(self, shrink: int, box: tuple[int, ...]) -> tuple[Map, Map, tuple[int, int]]:
        """Return the maps of a box (first column and row, end column and row), and its corner."""
        image = self._at(shrink)
        height, width = image.shape
        x0, y0 = max(box[0] - MARGIN_PX, 0), max(box[1] - MARGIN_PX, 0)
        x1, y1 = min(box[2] + MARGIN_PX, width), min(box[3] + MARGIN_PX, height)
        background = self._backgrounds.get(shrink)
        if background is not None:
            background = background[y0:y1, x0:x1]
        shaft, ends = self._net.evidence(normalized(image[y0:y1, x0:x1]), background)
        return shaft, ends, (x0, y0)


def _strips(pixels: Map) -> list[tuple[int, ...]]:
    """Return boxes that cover pixels, shape (n, 2).

    The boxes divide the longer side into strips, each only as wide as its pixels, since the reach
    of a needle is a cone.
    """
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    axis = int((high - low).argmax())
    edges = np.linspace(low[axis], high[axis], DETECTOR.strips + 1)
    boxes: list[tuple[int, ...]] = []
    for begin, end in itertools.pairwise(edges):
        inside = pixels[(pixels[:, axis] >= begin) & (pixels[:, axis] <= end)]
        if len(inside):
            (x0, y0), (x1, y1) = np.floor(inside.min(axis=0)), np.ceil(inside.max(axis=0)) + 1.0
            boxes.append((int(x0), int(y0), int(x1), int(y1)))
    return boxes


def _shrunk_px(pixels: Pixels, shrink: float) -> Pixels:
    """Return the coordinates of pixels in the shrunk image.

    Pixel i at half size covers the pixels 2 i and 2 i + 1.
    """
    half = pixels.dtype.type(0.5)
    shrunk: Pixels = (pixels + half) / shrink - half
    return shrunk


def _full_px(pixels: Array, shrink: float) -> Array:
    """Return the coordinates in the full image of pixels of the shrunk image."""
    return np.asarray((pixels + 0.5) * shrink - 0.5)


def _resized(image: Image, shrink: int) -> Image:
    if shrink == 1:
        return image
    size = (image.shape[1] // shrink, image.shape[0] // shrink)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
