"""Blurred stroke with exact width and ends, as the image of a thin tube: pixels and coverage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from needle_sim.needle.se3 import FloatArray

_OVERLAP_PX = 0.25


@dataclass(frozen=True, eq=False)
class Stroke:
    """Pixels covered by a stroke.

    Parameters
    ----------
    row, column : ndarray of int, shape (N,)
        Pixels; a pixel may occur twice, with nearly the same values.
    sample : ndarray of int, shape (N,)
        Index of the centreline point that belongs to the pixel.
    across : ndarray, shape (N,)
        Distance from the centreline relative to the half width; 1 is the edge.
    coverage : ndarray, shape (N,)
        Share of the pixel's light that comes from the stroke, 0..1.
    """

    row: np.ndarray[tuple[int], np.dtype[np.intp]]
    column: np.ndarray[tuple[int], np.dtype[np.intp]]
    sample: np.ndarray[tuple[int], np.dtype[np.intp]]
    across: FloatArray
    coverage: FloatArray


def stroke(
    line: FloatArray,
    half_width: FloatArray,
    blur: float | FloatArray,
    image_size: tuple[int, int],
) -> Stroke:
    """Return the coverage of a line with square ends under a Gaussian blur.

    The blurred edge is exact for a straight stroke: the contour of half coverage agrees with the
    true edge and end within a few thousandths of a pixel.

    Parameters
    ----------
    line : ndarray, shape (M, 2)
        Centreline u, v, with a spacing of a few px [px].
    half_width : ndarray, shape (M,)
        Half width along it [px].
    blur : float or ndarray, shape (M,)
        Standard deviation of the blur, including the pixel's area [px].
    image_size : tuple of int
        Width and height of the image [px].

    Returns
    -------
    Stroke
        Pixels inside the image.
    """
    step = np.linalg.norm(np.diff(line, axis=0), axis=1)
    tangent = np.gradient(line, np.concatenate([[0.0], np.cumsum(step)]), axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, np.newaxis]
    # Range along its tangent in which pixels belong to a sample; it is longer at the ends.
    blurs = np.broadcast_to(np.asarray(blur, dtype=np.float64), half_width.shape)
    reach = int(np.ceil(half_width.max() + 3.5 * blurs.max() + step.max() / 2.0 + _OVERLAP_PX))
    ahead = np.append(step / 2.0 + _OVERLAP_PX, 4.0 * blurs[-1])
    behind = np.insert(step / 2.0 + _OVERLAP_PX, 0, 4.0 * blurs[0])

    nearest = np.rint(line)
    grid = np.arange(-reach, reach + 1)
    u = grid + (nearest[:, :1] - line[:, :1])
    v = grid + (nearest[:, 1:] - line[:, 1:])
    u_part = u[:, np.newaxis, :] * tangent[:, 0, np.newaxis, np.newaxis]
    v_part = v[:, :, np.newaxis] * tangent[:, 1, np.newaxis, np.newaxis]
    along = u_part + v_part
    sample, i_row, i_column = np.nonzero(
        (along <= ahead[:, np.newaxis, np.newaxis]) & (along >= -behind[:, np.newaxis, np.newaxis])
    )
    column = nearest[sample, 0].astype(np.intp) + grid[i_column]
    row = nearest[sample, 1].astype(np.intp) + grid[i_row]
    width, height = image_size
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    sample, row, column = sample[inside], row[inside], column[inside]

    across = (row - line[sample, 1]) * tangent[sample, 0]
    across -= (column - line[sample, 0]) * tangent[sample, 1]
    half = half_width[sample]
    scale = 1.0 / (np.sqrt(2.0) * blurs[sample])
    coverage = 0.5 * (erf((across + half) * scale) - erf((across - half) * scale))
    for end, outward in ((line[0], -tangent[0]), (line[-1], tangent[-1])):
        beyond = (column - end[0]) * outward[0] + (row - end[1]) * outward[1]
        near = np.hypot(column - end[0], row - end[1]) < 2.0 * reach
        coverage[near] *= 0.5 * (1.0 - erf(beyond[near] * scale[near]))
    return Stroke(row, column, sample, across / half, coverage)
