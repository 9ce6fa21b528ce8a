"""Fit of the line and the end of the shaft to the maps of the network, near an expected end."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

Array = NDArray[np.float64]
Map = NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class EndFitSettings:
    """Constants of the fit; lengths are in needle widths.

    Attributes
    ----------
    line_widths : float
        Length of shaft behind the end to which the line is fitted: short enough to be straight at
        the largest curvature of a needle.
    least_line_widths : float
        Least length of a line that has a direction.
    aside_widths : float
        Margin of the map on both sides of the line.
    largest_slope : float
        Tangent of the largest angle between the fitted line and the expected direction.
    systematic_widths : float
        Standard deviation of line and end in addition to that of the maps, caused by light and
        blur: from the errors in path-traced pairs. An error that both views share is
        `FilterSettings.end_sigma`.
    lone_widths : float
        Standard deviation of an end without a visible shaft, in both directions: in 12 sightings
        of path-traced pairs all errors are inside the 95 % ellipsoid.
    around_widths : float
        Half the length within which ends count as one, since a bevel blurs the end.
    hidden_end : float
        Probability that the network misses an existing end.
    """

    line_widths: float = 8.0
    least_line_widths: float = 2.0
    aside_widths: float = 2.0
    largest_slope: float = 0.15
    systematic_widths: float = 0.1
    lone_widths: float = 0.5
    around_widths: float = 3.0
    hidden_end: float = 0.05


FIT = EndFitSettings()
_ROUNDING_PX = 1e-9  # makes np.arange include the end of a range of positions
_LEAST_MASS = 1e-9  # least sum of probabilities, to avoid a division by zero
_ONE_SIGMA = 0.5 * (1.0 + math.erf(math.sqrt(0.5)))  # share of a normal distribution below 1 sigma


@dataclasses.dataclass(frozen=True, eq=False)
class ImageEnd:
    """End of the needle in the image of one camera.

    Attributes
    ----------
    point : ndarray, shape (2,)
        End of the axis of the shaft [px].
    direction : ndarray, shape (2,)
        Unit vector along the shaft, towards the end.
    sigma_across, sigma_along : float
        Standard deviations of the end across and along the shaft [px].
    sigma_angle : float
        Standard deviation of the direction [rad].
    ends : float
        Expected number of ends near the point, from the network.
    shaft : float
        Mean probability of shaft along the fitted line.
    """

    point: Array
    direction: Array
    sigma_across: float
    sigma_along: float
    sigma_angle: float
    ends: float
    shaft: float


def fit_end(
    shaft: Map,
    ends: Map,
    point: Array,
    direction: Array,
    *,
    shaft_length: float,
    along: float,
    across: float,
    width: float,
    lone: bool = False,
) -> ImageEnd | None:
    """Fit line and end.

    Parameters
    ----------
    shaft, ends : ndarray of float32, shape (height, width)
        Maps of a window.
    point, direction : ndarray, shape (2,)
        Expected end in the window [px], and unit vector along the shaft towards it.
    shaft_length : float
        Length of visible shaft up to the end [px].
    along, across : float
        Largest distance of the end from the point, along and across the direction [px].
    width : float
        Width of the needle [px].
    lone : bool
        Whether the map shows an end at the point, which counts even if no shaft leads to it.

    Returns
    -------
    ImageEnd or None
        None if the maps show no shaft there.
    """
    back = min(shaft_length, FIT.line_widths * width)
    if back < FIT.least_line_widths * width:
        return None
    axes = Axes(point, direction)
    line = _best_line(shaft, axes, back, across, width)
    rough = _fit_line(shaft, axes, line, end=0.0, back=back, width=width)
    if rough is None:
        return _lone_end(shaft, ends, axes, back, width) if lone else None
    # The second fit is centred on the end that the first one found.
    end, _ = _end_on_line(ends, axes, rough.line, along, width)
    fitted = _fit_line(shaft, axes, rough.line, end=end, back=back, width=width)
    if fitted is None:
        return None
    line = fitted.line
    end, spread = _end_on_line(ends, axes, line, along, width)
    norm, offset = math.hypot(1.0, line.slope), float(line.at(end))
    middle = axes.point + end * axes.direction + offset * axes.across
    return ImageEnd(
        middle,
        (axes.direction + line.slope * axes.across) / norm,
        math.hypot(fitted.sigma, FIT.systematic_widths * width),
        math.hypot(spread * norm, FIT.systematic_widths * width),
        math.hypot(fitted.sigma_angle, FIT.systematic_widths / FIT.line_widths),
        _ends_about(ends, middle, width),
        fitted.certainty,
    )


def _lone_end(shaft: Map, ends: Map, axes: Axes, back: float, width: float) -> ImageEnd:
    """Return an end whose shaft is hardly visible, with the expected direction."""
    sigma = FIT.lone_widths * width
    certainty = float(axes.sample(shaft, -np.arange(back), np.zeros(1)).mean())
    number = _ends_about(ends, axes.point, width)
    return ImageEnd(axes.point, axes.direction, sigma, sigma, FIT.largest_slope, number, certainty)


def _ends_about(ends: Map, point: Array, width: float) -> float:
    """Return the expected number of ends within one needle width of a point."""
    half = max(math.ceil(width), 2)
    column, row = np.rint(point).astype(int)
    rows = slice(max(row - half, 0), max(row + half + 1, 0))
    columns = slice(max(column - half, 0), max(column + half + 1, 0))
    return float(ends[rows, columns].sum())


@dataclasses.dataclass(frozen=True, eq=False)
class Axes:
    """Expected end in a map, and the unit vector along the shaft towards it."""

    point: Array
    direction: Array

    @property
    def across(self) -> Array:
        """Unit vector across the shaft."""
        return np.array([-self.direction[1], self.direction[0]])

    def sample(self, image: Map, along: Array, across: Array) -> Array:
        """Return a map at distances along and across the shaft, which are broadcast [px].

        The values are interpolated, and 0 outside the map.
        """
        columns = self.point[0] + along * self.direction[0] - across * self.direction[1]
        rows = self.point[1] + along * self.direction[1] + across * self.direction[0]
        return np.asarray(map_coordinates(image, [rows, columns], np.float64, order=1))


class Line(NamedTuple):
    """Line of the shaft: its distance across `Axes` at the expected end [px], and its slope."""

    offset: float
    slope: float

    def at(self, along: npt.ArrayLike) -> Array:
        """Return the distances across at distances along [px]."""
        return np.asarray(self.offset + self.slope * np.asarray(along, np.float64))


class LineFit(NamedTuple):
    """Fitted line, its standard deviations at the end [px, rad], and its mean probability."""

    line: Line
    sigma: float
    sigma_angle: float
    certainty: float


def _best_line(shaft: Map, axes: Axes, back: float, across: float, width: float) -> Line:
    """Return the line with the largest sum of shaft probability."""
    pitch = 0.5 * width
    steps = math.ceil(across / pitch)
    # From one slope to the next, the far end of the line moves by at most the pitch.
    leans = math.ceil(FIT.largest_slope * back / pitch)
    offsets = pitch * np.arange(-steps, steps + 1)
    slopes = FIT.largest_slope / leans * np.arange(-leans, leans + 1)
    along = np.arange(-back, _ROUNDING_PX, pitch, dtype=np.float64)
    lines = offsets[:, None, None] + slopes[:, None] * along
    sums = axes.sample(shaft, along, lines).sum(axis=-1)
    best = np.unravel_index(sums.argmax(), sums.shape)
    return Line(float(offsets[best[0]]), float(slopes[best[1]]))


def _fit_line(
    shaft: Map, axes: Axes, line: Line, *, end: float, back: float, width: float
) -> LineFit | None:
    """Fit a line to the centre of the shaft near a line, by weighted least squares.

    None is returned for a shaft that is too short.
    """
    along = end - np.arange(int(back), dtype=np.float64)
    beside = np.arange(-width, width + _ROUNDING_PX, 0.5)
    values = axes.sample(shaft, along[:, None], line.at(along)[:, None] + beside)
    mass = values.sum(axis=1)
    weights = np.minimum(0.5 * mass / width, 1.0)
    total = float(weights.sum())
    if total < max(FIT.least_line_widths * width, 2.0):
        return None
    shares = values / np.maximum(mass, _LEAST_MASS)[:, None]
    shifts = shares @ beside
    breadth = float(weights @ (shares @ beside**2 - shifts**2)) / total
    middles = line.at(along) + shifts
    mean, middle = weights @ along / total, weights @ middles / total
    spread = weights @ (along - mean) ** 2 / total
    slope = weights @ ((along - mean) * (middles - middle)) / (total * spread)
    variance = weights @ (middles - middle - slope * (along - mean)) ** 2 / total
    # Disturbances of the centre are correlated over about the width of the needle.
    independent = max(total / width - 2.0, 1.0)
    # The variance of the probability across one shaft is width^2 / 12, with blurred edges up to
    # twice that. A broader distribution may be two lines, such as a needle beside its shadow.
    doubt = max(breadth - 2.0 * width * width / 12.0, 0.0)
    return LineFit(
        Line(float(middle - slope * mean), float(slope)),
        math.sqrt(doubt + variance / independent * (1.0 + (end - mean) ** 2 / spread)),
        math.sqrt(variance / independent / spread),
        float(axes.sample(shaft, along, line.at(along)).mean()),
    )


def _end_on_line(
    ends: Map, axes: Axes, line: Line, along: float, width: float
) -> tuple[float, float]:
    """Return the median of the position of the end along the line, and its standard deviation [px].

    The intensity of ends, summed across the line, is the density of the position. The share
    `hidden_end` is uniform over the window, so that a map without an end gives a wide spread.
    """
    count = 2 * int(along) + 1
    positions = np.arange(count, dtype=np.float64) - along
    beside = np.arange(-width, width + _ROUNDING_PX)
    lines = line.at(positions)[:, None] + beside
    density = axes.sample(ends, positions[:, None], lines).sum(axis=1)
    # A wide window may show two ends, and their median would be at neither.
    about = min(2 * int(FIT.around_widths * width) + 1, count)
    first = int(np.convolve(density, np.ones(about), "valid").argmax())
    density[:first] = density[first + about :] = 0.0
    known = density.sum()
    flat = max(FIT.hidden_end, 1.0 - known) if known < FIT.hidden_end else FIT.hidden_end
    density *= (1.0 - FIT.hidden_end) / max(known, FIT.hidden_end)
    density += flat / count
    # A sample covers the pixel around it.
    below = np.concatenate([[0.0], np.cumsum(density)]) / density.sum()
    levels = (1.0 - _ONE_SIGMA, 0.5, _ONE_SIGMA)
    early, median, late = np.interp(levels, below, np.arange(count + 1) - 0.5)
    return float(median - along), float(0.5 * (late - early))
