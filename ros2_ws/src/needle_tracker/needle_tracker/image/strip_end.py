"""End of the needle along a fitted shaft, and its taper beyond half its mass.

The darkness summed across the needle, row by row, falls from its level to nothing. A flat end falls
as fast as the image's blur lets the shaft's own edges fall; a bevelled one falls over its length,
and its extreme point lies half of that beyond the middle of the fall.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0912, PLR0915

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.image.strip import LEAST_ROWS, STEP_PX

Array = NDArray[np.float64]

_NEEDLE_MASS = 0.62  # what a shadow on the floor does not have
_FAINT_DOUBT = 0.4
_CLEAR_OF = 0.6
_TAIL = 0.2  # of the mass: there the tail ends
_LONGEST_FALL = 12  # [px]
_GAP = 2  # rows between what is darker and what is brighter than beside it
# Three rows together blur an end more than the shaft's edges [px^2]; where the blur is wide, what
# is left of that is that edges close to each other look sharper than they are.
_ROWS_SQUARE = 1.75
_END_OVER_EDGE = 1.42
_SHIFT = 1.1  # of the extreme point, over the taper's share of the fall
_DOUBT, _TAIL_DOUBT = 0.4, 0.5
# A flat end's tail over its fall, and what noise adds to it [px].
_FLAT_TAIL, _FEIGNED_TAIL = 0.68, 0.4
_UNKNOWN_EDGE = 1.6  # [px]
_KNEE, _FEIGNED = 0.5, 8.0  # [px^2], of the end's standard deviation
_EDGE_ROWS = 24
_WIDENED = 2.5  # one edge's fall over the other's
_WHOLE = 0.93
# From the profile of a box under a Gaussian: quarter width of an edge over the full width at half.
_BLUNT_FROM, _BLUNT, _BLUNTEST = 0.275, 3.2, 0.4


@compiled
def find_end(
    mass: Array, behind: int, prior: float, prior_sigma: float
) -> tuple[float, float, float, float, float]:
    """Return where the mass falls to half its level for good.

    Every row votes for "needle" or "beyond its end" by how far its mass is from half the level;
    a prediction votes as well. A stretch that a glint or a bubble hides is bridged.

    Parameters
    ----------
    mass : ndarray, shape (rows,)
        From `row_masses`.
    behind : int
        Row of the strip's middle.
    prior, prior_sigma : float
        Predicted end [px from the middle]; `prior_sigma` 0: none.

    Returns
    -------
    along : float
        The end [px from the middle]; NaN where there is none.
    before, after : float
        Mean mass just inside and just outside the end: 1 and 0 for a clear end. What is faint and
        even beyond the end counts for little.
    fall : float
        Length over which the mass falls from three quarters to one quarter [px]; 0: not known.
    tail : float
        How far beyond the end some of the mass goes on [px]; 0: not known.
    """
    rows = len(mass)
    nothing = (np.nan, 0.0, 0.0, 0.0, 0.0)
    smooth = np.empty(rows)
    for i in range(rows):
        first, last = max(i - 1, 0), min(i + 1, rows - 1)
        total = 0.0
        for k in range(first, last + 1):
            total += mass[k]
        smooth[i] = total / (last - first + 1)
    best, largest, votes = -1, -1e30, 0.0
    for i in range(rows - 1):
        votes += min(max(smooth[i] - _NEEDLE_MASS, -0.5), 0.5)
        value = votes
        if prior_sigma > 0.0:
            far = (i + 0.5 - behind - prior) / prior_sigma
            value -= 0.5 * far * far
        if value > largest and smooth[i] >= _NEEDLE_MASS > smooth[i + 1]:
            best, largest = i, value
    if best < LEAST_ROWS - 2:
        return nothing
    # The level next to the end: light and focus may differ along the shaft.
    part = np.sort(mass[max(best - 16, 0) : max(best - 2, 1)])
    level = part[len(part) // 2]
    if not 0.75 < level < 1.35:
        level = 1.0
    # Beyond the end there may be something fainter, such as the needle's own shadow, or more light
    # than beside it, where a shadow lies there.
    part = np.sort(mass[min(best + 4, rows - 4) : min(best + 11, rows)])
    beyond = min(max(part[len(part) // 2], -_NEEDLE_MASS), _NEEDLE_MASS)
    half = 0.5 * (level + beyond)
    i = best
    while i > 0 and smooth[i] < half:
        i -= 1
    while i < rows - 2 and smooth[i + 1] >= half:
        i += 1
    if smooth[i] <= smooth[i + 1]:
        return nothing
    along = i - behind + (smooth[i] - half) / (smooth[i] - smooth[i + 1])
    quarter = 0.5 * (level - half)
    inner = outer = seen_to = 0.0
    for k in range(i, max(i - _LONGEST_FALL, 0), -1):
        if smooth[k] >= half + quarter > smooth[k + 1]:
            inner = k + (smooth[k] - half - quarter) / (smooth[k] - smooth[k + 1])
            break
    for k in range(i, min(i + _LONGEST_FALL, rows - 1)):
        if smooth[k] >= half - quarter > smooth[k + 1]:
            outer = k + (smooth[k] - half + quarter) / (smooth[k] - smooth[k + 1])
            break
    # What is left of the needle there, a bevel's face, is not what is beyond it.
    part = np.sort(mass[min(best + 14, rows - 4) : min(best + 23, rows)])
    rest = part[len(part) // 2]
    if abs(rest) > abs(beyond):
        rest = beyond
    little = _TAIL * (level - rest)
    gap = 0
    for k in range(i, min(i + _LONGEST_FALL, rows - 1)):
        # A face that mirrors a light is brighter than what is beside it.
        there, beside = abs(smooth[k] - rest), abs(smooth[k + 1] - rest)
        if there >= little > beside:
            seen_to = k + (there - little) / (there - beside)
        gap = 0 if there >= little else gap + 1
        if gap > _GAP:
            break
    tail = max(seen_to - behind - along, 0.0) if seen_to > 0.0 else 0.0
    fall = outer - inner if inner > 0.0 and outer > 0.0 else 0.0
    # Clear of the fall.
    aside = round(_CLEAR_OF * fall)
    before = after = 0.0
    size = 4
    for k in range(size):
        before += mass[max(i - 1 - aside - k, 0)] / level / size
        after += mass[min(i + 3 + aside + k, rows - 1)] / level / size
    if abs(beyond) < _NEEDLE_MASS:
        after = max(abs(after - beyond / level), _FAINT_DOUBT * abs(beyond) / level)
    return along, before, after, fall, tail


@compiled
def edge_fall(darkness: Array, behind: int, end: float, line: float, slope: float) -> float:
    """Return over which width the shaft's edges fall from three quarters to one quarter [px].

    Parameters
    ----------
    darkness : ndarray, shape (rows, columns)
        From `fine_strip`.
    behind : int
        Row of the strip's middle.
    end : float
        Where the needle ends [px from the middle].
    line, slope : float
        Offset of its middle line there [px], and slope.

    Returns
    -------
    float
        Mean of both edges, as sharp as they would be if the needle were wide; of the sharper one
        where they differ much; 0: not known.
    """
    rows, columns = darkness.shape
    last = min(int(end) + behind - 5, rows - 1)
    first = max(last - _EDGE_ROWS, 0)
    profile = np.zeros(columns)
    for i in range(first, last + 1):
        moved = (line + slope * (i - behind - end)) / STEP_PX
        for j in range(columns):
            place = min(max(j + moved, 0.0), columns - 1.001)
            k = int(place)
            share = place - k
            profile[j] += (1.0 - share) * darkness[i, k] + share * darkness[i, k + 1]
    largest = profile.max()
    middle = columns // 2
    # A bright middle makes edges of its own.
    if not profile[middle] >= _WHOLE * largest > 0.0:
        return 0.0
    falls, halves = np.full(2, np.inf), np.zeros(2)
    for n in range(2):
        side = 2 * n - 1
        places = np.full(3, -1.0)
        for k in range(middle, 0, -1):
            here, beyond = profile[middle + side * (k - 1)], profile[middle + side * k]
            for m in range(3):
                level = 0.25 * (m + 1) * largest
                if places[m] < 0.0 and here >= level > beyond:
                    places[m] = STEP_PX * (k - 1 + (here - level) / (here - beyond))
        if places.min() >= 0.0:
            falls[n], halves[n] = places[0] - places[2], places[1]
    # A shadow beside one edge makes its fall a wide one, or none; blur does so to both.
    for n in range(2):
        if falls[n] > _WIDENED * falls[1 - n]:
            falls[n], halves[n] = falls[1 - n], halves[1 - n]
    fall, width = 0.5 * (falls[0] + falls[1]), halves[0] + halves[1]
    if not fall < np.inf:
        return 0.0
    # Where the blur is as wide as the needle the profile's top is lower than the needle is dark.
    return float(fall * (1.0 + min(_BLUNT * max(fall / width - _BLUNT_FROM, 0.0), _BLUNTEST)))


@compiled
def taper_beyond(fall: float, tail: float, edge: float, sigma: float) -> tuple[float, float]:
    """Return how far the extreme point lies beyond half the mass, and how uncertain that is [px].

    Parameters
    ----------
    fall, tail : float
        From `find_end`.
    edge : float
        From `edge_fall`.
    sigma : float
        Standard deviation of an end, from the image's noise [px].
    """
    if fall <= 0.0:
        return 0.0, _TAIL_DOUBT * tail
    known = edge if edge > 0.0 else _UNKNOWN_EDGE
    flat = max(known * known + _ROWS_SQUARE, (_END_OVER_EDGE * known) ** 2)
    taper = math.sqrt(max(fall * fall - flat, 0.0))
    # What the noise can feign is no taper.
    knee = math.hypot(_KNEE, _FEIGNED * fall * sigma)
    share = taper**4 / (taper**4 + knee * knee)
    beyond, doubt = _SHIFT * taper * share, _DOUBT * taper * share
    if edge <= 0.0:
        # A taper, or more blur than was thought.
        beyond, doubt = 0.5 * beyond, 0.5 * taper * share
    # A bevel's face may be nearly as dark as the needle or nearly as bright as what is beside it:
    # the tail then tells of another end than the fall does.
    reach = tail - _FLAT_TAIL * math.sqrt(flat)
    apart = max(abs(reach - beyond) - _FEIGNED_TAIL - 2.0 * sigma, 0.0)
    return beyond, math.hypot(doubt, _TAIL_DOUBT * apart)
