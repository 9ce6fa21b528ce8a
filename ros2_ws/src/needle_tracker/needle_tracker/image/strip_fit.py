"""The compiled fit of a shaft's line and end to an image strip.

The darkness summed across the needle, row by row, says where it ends; the centroids say where its
middle line is. Rows that glints, bubbles or crossing lines spoil are outvoted.
"""

# Compiled functions take plain numbers, one by one, and unroll what numpy would allocate for.
# ruff: noqa: PLR0911, PLR0912, PLR0915, PLR0917

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.image.strip import (
    LEAST_ROWS,
    LINE_WIDTHS,
    STEP_PX,
    coarse_line,
    fine_strip,
    needle_level,
    row_masses,
    straight_line,
)
from needle_tracker.image.strip_edges import dark_width, edges_middle
from needle_tracker.image.strip_end import edge_fall, find_end, taper_beyond

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_BEHIND_WIDTHS = 12.2
_AHEAD_WIDTHS = 6.5
_AGREE_PX = 0.7  # what agrees with a line [px]
_VOTE_STEP_PX = 0.3
_EDGES_APART_PX = 0.25  # from the centroid: something disturbs that
_SHIFTS, _TILTS = 9, 8
_ROWS_ALIKE = 3.0
_FEW_ROWS = 4  # one row of so many may be as narrow as the needle where something lies along it
# The needle's edges by what is a little darker than the light beside it and what is nearly as dark
# as the needle [its contrast]; how far their middles may be apart [px], and what more is worth.
_FOOT, _TOP = (0.15, 0.4), (0.5, 0.8)
_EVEN_PX, _LOPSIDED, _MOST_LOPSIDED_PX = 0.05, 0.8, 0.25
# Edges that fall over more than this are blurred: what shape the end has, and what lies beside the
# needle, then hardly shows, across and along [px]. A bevel draws the middle line aside, too.
_SHARP_PX, _BLUR_ACROSS, _BLUR_ALONG, _TAPER_ACROSS = 1.7, 0.1, 1.7, 0.025


@compiled
def vote_line(place: Array, centre: Array, length: float) -> tuple[float, float]:
    """Return offset and slope of the line that most agree with, the straight one of equals."""
    best_offset = best_slope = 0.0
    largest = -1.0
    for tilt in range(-_TILTS, _TILTS + 1):
        # The tilt turns the line about its middle.
        slope = tilt * 2.0 * _VOTE_STEP_PX / length
        for shift in range(-_SHIFTS, _SHIFTS + 1):
            offset = shift * _VOTE_STEP_PX + 0.5 * slope * length
            votes = 0.0
            for k in range(len(place)):
                miss = (centre[k] - offset - slope * place[k]) / _AGREE_PX
                votes += max(1.0 - miss * miss, 0.0)
            votes *= 1.0 - 0.002 * (abs(tilt) + abs(shift))
            if votes > largest:
                largest, best_offset, best_slope = votes, offset, slope
    return best_offset, best_slope


@compiled
def middle_line(
    darkness: Array, mass: Array, behind: int, width: float, end: float, level: float
) -> tuple[float, float, float, float, int]:
    """Fit a parabola to the middles of the rows near the end, robustly.

    A row's middle is its centroid, or that of its edges where the two differ. In the centroid only
    what is about as dark as the needle has weight, and no pixel more than another: neither a
    shadow beside the needle nor the light on its middle draws the centroid aside.

    Returns
    -------
    offset, slope : float
        At the end: [px], [-].
    sigma_offset, sigma_slope : float
        Their standard deviations.
    count : int
        Rows that took part; 0 where there are too few.
    """
    columns = darkness.shape[1]
    reach = columns // 2
    near = int((0.5 * width + 2.0) / STEP_PX)
    contrast = level / width
    first = max(math.ceil(end) - int(LINE_WIDTHS * width) + behind, 0)
    last = min(math.floor(end - 2.0) + behind, len(mass) - 1)
    centre = np.empty(max(last - first + 1, 0))
    place = np.empty(len(centre))
    lean = np.empty(len(centre))
    excess = np.empty(len(centre))
    profile, steep = np.empty(columns), np.empty(columns)
    rows = 0
    for i in range(first, last + 1):
        if not 0.25 < mass[i] < 1.5:
            continue
        total = moment = foot = foot_moment = top = top_moment = 0.0
        for j in range(reach - near, reach + near + 1):
            dark, across = darkness[i, j] / contrast, (j - reach) * STEP_PX
            weight = min(max(dark - 0.3, 0.0), 0.4)
            total += weight
            moment += weight * across
            weight = min(max(dark - _FOOT[0], 0.0), _FOOT[1] - _FOOT[0])
            foot += weight
            foot_moment += weight * across
            weight = min(max(dark - _TOP[0], 0.0), _TOP[1] - _TOP[0])
            top += weight
            top_moment += weight * across
        if total < 0.3:
            continue
        centre[rows] = moment / total
        # Both agree on a needle that nothing disturbs; the centroid has less noise.
        edges = edges_middle(darkness, i, last, width, contrast, profile, steep)
        if abs(edges - centre[rows]) > _EDGES_APART_PX:
            centre[rows] = edges
        excess[rows] = max(dark_width(darkness, i, centre[rows]) - width, 0.0)
        lean[rows] = top_moment / top - foot_moment / foot if top > 0.0 < foot else 0.0
        place[rows] = i - behind - end
        rows += 1
    if rows < LEAST_ROWS:
        return 0.0, 0.0, 0.0, 0.0, 0
    length = max(place[rows - 1] - place[0], 1.0)
    keep = np.ones(rows, dtype=np.bool_)
    residual = np.empty(rows)
    # The line that most rows agree with, to begin with: what crosses the needle must not tilt it.
    chosen_offset, chosen_slope = vote_line(place[:rows], centre[:rows], length)
    for k in range(rows):
        keep[k] = abs(centre[k] - chosen_offset - chosen_slope * place[k]) < _AGREE_PX
    offset = slope = lopsided = 0.0
    inverse: Array = np.zeros((3, 3))
    spread = 0.0
    count = 0
    for _ in range(4):
        normal = np.zeros((3, 3))
        right = np.zeros(3)
        count = 0
        for k in range(rows):
            if not keep[k]:
                continue
            count += 1
            x = place[k] / length
            terms = (1.0, x, x * x)
            for a in range(3):
                right[a] += terms[a] * centre[k]
                for b in range(3):
                    normal[a, b] += terms[a] * terms[b]
        if count < LEAST_ROWS:
            return 0.0, 0.0, 0.0, 0.0, 0
        # A weak wish for straightness, for where few rows are left.
        normal[2, 2] += 0.02
        inverse[:] = np.linalg.inv(normal)
        solution = inverse @ right
        total = lopsided = 0.0
        for k in range(rows):
            x = place[k] / length
            residual[k] = abs(centre[k] - solution[0] - solution[1] * x - solution[2] * x * x)
            if keep[k]:
                total += residual[k] * residual[k]
                lopsided += lean[k] / count
        spread = math.sqrt(total / max(count - 3, 1))
        scale = max(1.4826 * np.sort(residual)[rows // 2], 0.03)
        for k in range(rows):
            keep[k] = residual[k] <= 3.0 * scale
        offset, slope = solution[0], solution[1] / length
    # What disturbs one row disturbs its neighbours; and the more rows disagree, the less do the
    # others say.
    spread *= math.sqrt(_ROWS_ALIKE) * (rows / count) ** 2
    sigma_offset = spread * math.sqrt(inverse[0, 0])
    sigma_slope = spread * math.sqrt(inverse[1, 1]) / length
    # A needle is as dark on its one side as on the other; with a shadow, a glint or a bubble along
    # it where its middle is depends on what one takes for its edge.
    doubt = min(_LOPSIDED * max(abs(lopsided) - _EVEN_PX, 0.0), _MOST_LOPSIDED_PX)
    # What is wider than the needle nearly all along is the needle and something else, on either
    # side; what crosses it makes fewer rows wider.
    wider = np.sort(excess[:rows])[rows // _FEW_ROWS]
    doubt = math.hypot(doubt, 0.5 * wider)
    sigma_offset = math.hypot(sigma_offset, doubt)
    sigma_slope = math.hypot(sigma_slope, doubt / length)
    return offset, slope, sigma_offset, sigma_slope, count


@compiled
def fit_strip(
    image: Image,
    point: Array,
    heading: Array,
    room: int,
    search: int,
    width: float,
    sign: float,
    least_ridge: float,
    prior_sigma: float,
    hint: float,
    result: Array,
) -> int:
    """Fit line and end of a shaft about an expected end.

    Parameters
    ----------
    image : ndarray of uint8
        The camera's image.
    point, heading : ndarray, shape (2,)
        Expected end [px], and unit vector along the shaft towards it.
    room : int
        Visible shaft behind the end [px].
    search : int
        How far beside the expected line the needle may be [px]; 0: hardly, it is looked for on it.
    width, sign, least_ridge : float
        As for `coarse_line`.
    prior_sigma : float
        Of the expected end along the shaft [px]; 0: not known.
    hint : float
        The needle's contrast so far [grey levels]; 0: not known.
    result : ndarray, shape (12,)
        Takes end u, v; direction u, v; sigma across, along, of the angle; contrast; mass before
        and after the end over the level; end along the shaft from the expected one; how bright it
        is beside the needle.

    Returns
    -------
    int
        1 found, 0 no room, -1 no end, -2 nothing darker, -3 no middle line, -4 no line at all.
    """
    longest, ahead = int(_BEHIND_WIDTHS * width), int(_AHEAD_WIDTHS * width)
    behind = min(longest, room)
    if behind < 14:
        return 0
    end, direction = point.copy(), heading.copy()
    b, stop, shift = 0.0, 0.0, 0.0
    if search > 0:
        offset, evidence = coarse_line(
            image, end, direction, behind, ahead, search, width, sign, least_ridge
        )
        votes, largest, last = 0.0, -1e30, 0
        for i in range(len(evidence)):
            votes += min(evidence[i], 1.0)
            value = votes
            if prior_sigma > 0.0:
                far = (i - behind) / (prior_sigma + 2.0)
                value -= 0.5 * far * far
            if value > largest:
                largest, last = value, i - behind
        a, b, count = straight_line(offset, evidence, behind, last - int(LINE_WIDTHS * width), last)
        if count == 0 or abs(b) > 0.6:
            return -4
        stop = float(last)
        shift = a + b * stop
    prior = 0.0
    along = line = slope = sigma_line = sigma_slope = level = noise = before = after = fall = 0.0
    doubt = sigma_end = light = edge = beyond = 0.0
    count = 0
    for _ in range(3):
        scale = math.sqrt(1.0 + b * b)
        # The strip's middle goes to where the end is thought to be.
        moved_u = end[0] + stop * direction[0] - shift * direction[1]
        moved_v = end[1] + stop * direction[1] + shift * direction[0]
        turned_u = (direction[0] - b * direction[1]) / scale
        turned_v = (direction[1] + b * direction[0]) / scale
        end[0], end[1], direction[0], direction[1] = moved_u, moved_v, turned_u, turned_v
        along_point = (end[0] - point[0]) * heading[0] + (end[1] - point[1]) * heading[1]
        behind = min(longest, int(room + along_point))
        if behind < 14:
            return 0
        prior = (point[0] - end[0]) * direction[0] + (point[1] - end[1]) * direction[1]
        darkness, noise, light = fine_strip(image, end, direction, behind, ahead, width, sign)
        expected = prior if prior_sigma > 0.0 else 0.0
        level = needle_level(darkness, behind, width, noise, expected, hint * width)
        if level <= 0.0:
            return -2
        mass = row_masses(darkness, width, level)
        along, before, after, fall, tail = find_end(mass, behind, prior, prior_sigma)
        if prior_sigma > 0.0 and not abs(along - prior) <= 3.0 * prior_sigma:
            # No end where it must be: hidden. The line is good for something all the same.
            along, before, after, fall, tail = prior, 0.0, 1.0, 0.0, 0.0
        if not math.isfinite(along):
            return -1
        line, slope, sigma_line, sigma_slope, count = middle_line(
            darkness, mass, behind, width, along, level
        )
        if count == 0:
            return -3
        sigma_end = 2.3 * noise * math.sqrt(width + 4.0) / level
        edge = edge_fall(darkness, behind, along, line, slope)
        beyond, doubt = taper_beyond(fall, tail, edge, sigma_end)
        stop, shift, b = along + beyond, line + slope * beyond, slope
        if abs(along) < 3.0 and abs(line) < 0.5 and abs(slope) < 0.02:
            break
    scale = math.sqrt(1.0 + b * b)
    result[0] = end[0] + stop * direction[0] - shift * direction[1]
    result[1] = end[1] + stop * direction[1] + shift * direction[0]
    result[2] = (direction[0] - b * direction[1]) / scale
    result[3] = (direction[1] + b * direction[0]) / scale
    blur = max(edge - _SHARP_PX, 0.0)
    aside = math.hypot(_BLUR_ACROSS * blur, _TAPER_ACROSS * beyond)
    result[4] = math.hypot(sigma_line, aside)
    result[5] = math.hypot(math.hypot(sigma_end, doubt), _BLUR_ALONG * blur)
    result[6] = sigma_slope
    result[7] = level / width
    result[8] = before
    result[9] = after
    result[10] = stop - prior
    result[11] = light
    return 1
