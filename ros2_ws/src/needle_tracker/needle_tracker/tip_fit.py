"""Sub-pixel shaft line and end point of the needle in one image, from a coarse path.

The image is resampled along the shaft. Across it, the centroid of what is darker than both sides
gives the centre line; along it, the darkness summed across the needle falls to half its level at
the tip.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.detection import DetectionSettings, Image, Path

Array = NDArray[np.float64]

_STEP_PX = 0.5  # resampling across the needle; along it 1 px
_BEHIND_PX = 56  # resampled behind the coarse tip ...
_AHEAD_PX = 30  # ... and ahead of it
_LINE_PX = 40.0  # the shaft line is fitted to the last 6 mm
_LEAST_LINE_PX = 8.0
_ITERATIONS = 4
_PIXEL_NOISE_FLOOR = 1.0  # [grey levels]
_LINE_SYSTEMATIC_PX = 0.03  # what calibration and the needle's bend leave in the line
_END_SYSTEMATIC_PX = 0.35  # bevel, blur, light: where "half" is


@dataclasses.dataclass(frozen=True)
class ImageTip:
    """The visible end of the needle in one image.

    Attributes
    ----------
    point : ndarray, shape (2,)
        The end [px].
    direction : ndarray, shape (2,)
        Unit vector along the shaft, towards the tip.
    sigma_across, sigma_along : float
        Standard deviations of the end across and along the shaft [px].
    sigma_angle : float
        Standard deviation of the direction [rad].
    contrast : float
        Needle against its surroundings [grey levels].
    """

    point: Array
    direction: Array
    sigma_across: float
    sigma_along: float
    sigma_angle: float
    contrast: float


def fit_tip(image: Image, path: Path, settings: DetectionSettings) -> ImageTip | None:
    """Fit shaft line and end point near the end of a path.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The camera's image.
    path : Path
        Coarse path from `find_path`.
    settings : DetectionSettings
        How the needle looks.

    Returns
    -------
    ImageTip or None
        None where the image near the path's end does not look like the end of a needle.
    """
    end, direction = _coarse_line(path.pixels)
    behind = min(float(_BEHIND_PX), float(np.linalg.norm(path.pixels[0] - end)) + 2.0)
    for iteration in itertools.count(1):
        band = _Band.of(image, end, direction, behind, settings)
        tip_along = band.end()
        if tip_along is None:
            return None
        fit = band.line(tip_along)
        if fit is None:
            return None
        normal = np.array([-direction[1], direction[0]])
        moved = end + tip_along * direction + fit.offset * normal
        turned = direction + fit.slope * normal
        turned = turned / np.linalg.norm(turned)
        settled = bool(np.abs(moved - end).max() < 0.1 and abs(fit.slope) < 5e-3)
        behind = min(float(_BEHIND_PX), behind + tip_along)
        end, direction = moved, turned
        if behind < _LEAST_LINE_PX + 4.0:
            return None
        if settled or iteration == _ITERATIONS:
            return ImageTip(
                point=end,
                direction=direction,
                sigma_across=math.hypot(fit.sigma_end, _LINE_SYSTEMATIC_PX),
                sigma_along=math.hypot(band.sigma_end(), _END_SYSTEMATIC_PX),
                sigma_angle=math.hypot(fit.sigma_slope, _LINE_SYSTEMATIC_PX / _LINE_PX),
                contrast=band.level / settings.needle_width_px,
            )
    return None


def _coarse_line(pixels: Array) -> tuple[Array, Array]:
    """Return the end of a coarse path and its direction there."""
    distance = np.linalg.norm(pixels - pixels[-1], axis=1)
    last = pixels[distance <= _LINE_PX]
    centre = last.mean(axis=0)
    _, _, axes = np.linalg.svd(last - centre)
    direction = axes[0] if axes[0] @ (last[-1] - last[0]) >= 0.0 else -axes[0]
    end = centre + direction * float((pixels[-1] - centre) @ direction)
    return end, direction


@dataclasses.dataclass(frozen=True)
class _Line:
    offset: float
    slope: float
    sigma_end: float
    sigma_slope: float


class _Band:
    """The image resampled along the shaft: rows along (1 px), columns across (`_STEP_PX`)."""

    def __init__(
        self, along: Array, across: Array, darkness: Array, noise: float, width: float
    ) -> None:
        self.along = along
        self.across = across
        self.darkness = darkness
        self.noise = noise
        self.level = 0.0
        self._width = width
        self._mass = darkness[:, np.abs(across) <= 0.5 * width + 2.0].sum(axis=1) * _STEP_PX

    @classmethod
    def of(
        cls, image: Image, end: Array, direction: Array, behind: float, settings: DetectionSettings
    ) -> _Band:
        along = np.arange(-math.floor(behind), _AHEAD_PX + 1, dtype=np.float64)
        half = settings.needle_width_px
        reach = math.ceil(2.2 * half)
        across = np.arange(-reach, reach + _STEP_PX, _STEP_PX)
        normal = np.array([-direction[1], direction[0]])
        points = end + along[:, None, None] * direction + across[None, :, None] * normal
        map_xy = points.astype(np.float32)
        sampled = cv2.remap(
            image,
            np.ascontiguousarray(map_xy[..., 0]),
            np.ascontiguousarray(map_xy[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.float64)
        # The light on both sides, smoothed along the shaft, is the background in between.
        outer = 1.25 * half
        sides = [sampled[:, across <= -outer], sampled[:, across >= outer]]
        means = [_smooth(side.mean(axis=1), 9) for side in sides]
        share = np.clip((across + 1.7 * half) / (3.4 * half), 0.0, 1.0)
        background = means[0][:, None] * (1.0 - share) + means[1][:, None] * share
        darkness = background - sampled
        if settings.bright:
            darkness = -darkness
        spread = [side - mean[:, None] for side, mean in zip(sides, means, strict=True)]
        noise = 1.4826 * float(np.median(np.abs(np.concatenate(spread, axis=1))))
        return cls(along, across, darkness, max(noise, _PIXEL_NOISE_FLOOR), half)

    def end(self) -> float | None:
        """Return where along the band the needle ends [px], None where there is no such place."""
        mass = _smooth(self._mass, 3)
        inside = (self.along >= self.along[0] + 1.0) & (self.along <= -6.0)
        if np.count_nonzero(inside) < 3:
            inside = self.along <= -3.0
        level = float(np.median(mass[inside]))
        if level <= 4.0 * self.noise:
            return None
        half = 0.5 * level
        # From well inside outwards to the first crossing that stays crossed for 4 px.
        start = int(np.searchsorted(self.along, -8.0))
        below = mass < half
        for i in range(max(start, 1), len(mass) - 4):
            if below[i] and not below[i - 1] and below[i : i + 4].all():
                break
        else:
            return self._end_elsewhere(below, mass, half, level)
        self.level = level
        return self._crossing(mass, i, half)

    def _end_elsewhere(
        self, below: NDArray[np.bool_], mass: Array, half: float, level: float
    ) -> float | None:
        """Return the last crossing of the whole band, for a coarse end far from the tip."""
        crossings = np.flatnonzero(below[1:] & ~below[:-1]) + 1
        if below[0] or len(crossings) == 0:
            return None
        self.level = level
        return self._crossing(mass, int(crossings[-1]), half)

    def _crossing(self, mass: Array, i: int, half: float) -> float:
        fraction = (mass[i - 1] - half) / (mass[i - 1] - mass[i])
        return float(self.along[i - 1] + fraction)

    def sigma_end(self) -> float:
        """Return the noise of the end along the shaft [px]."""
        samples = self._width + 4.0
        return self.noise * math.sqrt(samples) / max(self.level, 1e-9) * 1.5

    def line(self, tip_along: float) -> _Line | None:
        """Return the straight line through the centroids near the tip."""
        near = np.abs(self.across) <= 0.5 * self._width + 2.0
        use = (self.along <= tip_along - 2.0) & (self.along >= tip_along - _LINE_PX)
        use &= self._mass > 0.5 * self.level
        if np.count_nonzero(use) < _LEAST_LINE_PX:
            return None
        weights = self.darkness[use][:, near]
        centres = (weights @ self.across[near]) / weights.sum(axis=1)
        # From the end backwards in units of the fitted length: offset, slope and bend at the end.
        length = float(self.along[use][-1] - self.along[use][0])
        back = (self.along[use] - tip_along) / length
        terms = np.stack([np.ones_like(back), back, back * back], axis=1)
        keep = np.ones(len(back), dtype=bool)
        for _ in range(2):
            normal = terms[keep].T @ terms[keep]
            solution = np.linalg.solve(normal, terms[keep].T @ centres[keep])
            residual = centres - terms @ solution
            scale = max(1.4826 * float(np.median(np.abs(residual[keep]))), 0.02)
            keep = np.abs(residual) <= 3.0 * scale
            if np.count_nonzero(keep) < _LEAST_LINE_PX:
                return None
        # Neighbouring rows share pixels: about every second one is new.
        spread = math.sqrt(2.0 * float(np.mean(residual[keep] ** 2)))
        covariance = spread**2 * np.linalg.inv(normal)
        return _Line(
            float(solution[0]),
            float(solution[1]) / length,
            math.sqrt(float(covariance[0, 0])),
            math.sqrt(float(covariance[1, 1])) / length,
        )


def _smooth(values: Array, width: int) -> Array:
    """Return a running mean that does not shrink at the ends."""
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
