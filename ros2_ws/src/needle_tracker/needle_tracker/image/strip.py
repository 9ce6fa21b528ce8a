"""The compiled inner loops over an image strip along the shaft: where in it the needle runs.

Rows of the strip run along the shaft (1 px apart, from behind the expected end to ahead of it),
columns across. The coarse strip is searched by dynamic programming, with a line filter that wants
both flanks to differ from the middle (an edge of a shade or of a hand has one flank only). The fine
strip about the line found holds the needle's darkness against the light on both of its sides.
"Dark" is meant after `sign`: -1 turns a bright needle into a dark one.
"""

# Compiled functions take plain numbers, one by one, and unroll what numpy would allocate for.
# ruff: noqa: PLR0912, PLR0915, PLR0917

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

STEP_PX = 0.5  # of the fine strip's columns
# Lengths in widths of the needle: 0.7 mm wide, 6 mm, 8.5 mm and 4.5 mm.
LINE_WIDTHS = 8.7  # the middle line is fitted to so much of the shaft's end
LEAST_ROWS = 10
_SMOOTH_ROWS = 4  # either way, of the light beside the needle
_UNEVEN = 0.12  # of the light: the needle's sides do not differ by so much by themselves
_STREAK = 4.0  # of the noise: so much brighter than the darkness on both sides of it
_NOISE_FLOOR = 0.7  # [grey levels]
# So many of the rows, so close together, say how dark the needle is.
_ALIKE_SHARE, _ALIKE_SPREAD, _ALIKE_MARGIN = 0.4, 1.6, 0.2


@compiled
def sample(image: Image, u: float, v: float) -> float:
    """Return the grey level between pixels; outside of the image that of its border."""
    height, width = image.shape
    u = min(max(u, 0.0), width - 1.001)
    v = min(max(v, 0.0), height - 1.001)
    column, row = int(u), int(v)
    a, b = u - column, v - row
    above = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    below = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return float((1.0 - b) * above + b * below)


@compiled
def coarse_line(
    image: Image,
    end: Array,
    direction: Array,
    behind: int,
    ahead: int,
    search: int,
    width: float,
    sign: float,
    least_ridge: float,
) -> tuple[Array, Array]:
    """Find the needle in a strip: its offset from the strip's middle, and the evidence, row by row.

    Parameters
    ----------
    image : ndarray of uint8
        The camera's image.
    end, direction : ndarray, shape (2,)
        The expected end [px] and the unit vector along the shaft towards it.
    behind, ahead : int
        How far the strip goes either way [px].
    search : int
        How far beside the middle the needle may be [px].
    width : float
        Of the needle [px].
    sign : float
        1 for a dark needle, -1 for a bright one.
    least_ridge : float
        Least contrast [grey levels].

    Returns
    -------
    offset : ndarray, shape (behind + ahead + 1,)
        [px], to the side of (-direction_v, direction_u).
    evidence : ndarray, same shape
        Between -1 (nothing) and 2 (needle).
    """
    rows = behind + ahead + 1
    flank_near, flank_far = round(0.95 * width), round(1.9 * width)
    half = max(round(0.4 * width), 1)
    reach = search + flank_far
    columns = 2 * reach + 1
    cells = 2 * search + 1
    line = np.empty(columns + 1)
    ridge = np.empty((rows, cells))
    for i in range(rows):
        along = i - behind
        line[0] = 0.0
        for j in range(columns):
            across = j - reach
            level = sample(
                image,
                end[0] + along * direction[0] - across * direction[1],
                end[1] + along * direction[1] + across * direction[0],
            )
            line[j + 1] = line[j] + sign * level
        for j in range(cells):
            centre = j + flank_far
            middle = (line[centre + half + 1] - line[centre - half]) / (2 * half + 1)
            size = flank_far - flank_near + 1
            low = (line[centre - flank_near + 1] - line[centre - flank_far]) / size
            high = (line[centre + flank_far + 1] - line[centre + flank_near]) / size
            ridge[i, j] = min(low, high) - middle
    # Three rows together: less noise, no less needle.
    smooth = np.empty((rows, cells))
    for i in range(rows):
        first, last = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(cells):
            total = 0.0
            for k in range(first, last + 1):
                total += ridge[k, j]
            smooth[i, j] = total / (last - first + 1)
    spread = np.sort(np.abs(smooth).ravel())[rows * cells // 2]
    threshold = max(2.5 * spread, least_ridge)
    total_evidence = np.empty((rows, cells))
    for i in range(rows):
        for j in range(cells):
            value = min(max(smooth[i, j] / threshold - 1.0, -1.0), 2.0)
            far = (j - search) / (search + 1.0)
            value -= 0.15 * far * far
            best = 0.0
            if i:
                best = total_evidence[i - 1, j]
                if j > 0:
                    best = max(best, total_evidence[i - 1, j - 1] - 0.02)
                if j < cells - 1:
                    best = max(best, total_evidence[i - 1, j + 1] - 0.02)
            total_evidence[i, j] = best + value
    # From the row where the sum is largest back to the first; beyond it straight on.
    end_row, column = rows - 1, search
    largest = -1e30
    for i in range(min(behind // 2, rows - 1), rows):
        for j in range(cells):
            if total_evidence[i, j] > largest:
                largest = total_evidence[i, j]
                end_row, column = i, j
    offset = np.empty(rows)
    evidence = np.full(rows, -1.0)
    for i in range(end_row + 1, rows):
        offset[i] = column - search
        evidence[i] = min(max(smooth[i, column] / threshold - 1.0, -1.0), 2.0)
    for i in range(end_row, -1, -1):
        offset[i] = column - search
        evidence[i] = min(max(smooth[i, column] / threshold - 1.0, -1.0), 2.0)
        if i:
            best, chosen = total_evidence[i - 1, column], column
            for other in (column - 1, column + 1):
                if 0 <= other < cells and total_evidence[i - 1, other] - 0.02 > best:
                    best, chosen = total_evidence[i - 1, other] - 0.02, other
            column = chosen
    return offset, evidence


@compiled
def straight_line(
    offset: Array, evidence: Array, behind: int, first: int, last: int
) -> tuple[float, float, int]:
    """Fit offset = a + b * along to the rows with evidence between two places along the strip.

    Returns
    -------
    a, b : float
        Offset at 0 [px], and slope.
    count : int
        Rows that took part.
    """
    a, b = 0.0, 0.0
    count = 0
    limit = 1e9
    for _ in range(3):
        n = sx = sy = sxx = sxy = 0.0
        for i in range(max(first + behind, 0), min(last + behind, len(offset) - 1) + 1):
            if evidence[i] <= 0.0:
                continue
            x, y = float(i - behind), offset[i]
            if abs(y - a - b * x) > limit:
                continue
            n += 1.0
            sx += x
            sy += y
            sxx += x * x
            sxy += x * y
        count = int(n)
        determinant = n * sxx - sx * sx
        if count < LEAST_ROWS or determinant <= 0.0:
            return a, b, 0
        b = (n * sxy - sx * sy) / determinant
        a = (sy - b * sx) / n
        limit = 2.0
    return a, b, count


@compiled
def fine_strip(
    image: Image,
    end: Array,
    direction: Array,
    behind: int,
    ahead: int,
    width: float,
    sign: float,
) -> tuple[Array, float, float]:
    """Return the needle's darkness in a fine strip about its line.

    Returns
    -------
    darkness : ndarray, shape (behind + ahead + 1, columns)
        Columns are `STEP_PX` apart, about the middle [grey levels]. Neither a shadow along one side
        of the needle nor a streak of light along its middle takes from it.
    noise : float
        Of a pixel [grey levels].
    light : float
        How bright it is beside the needle [grey levels].
    """
    rows = behind + ahead + 1
    reach = math.ceil(2.2 * width / STEP_PX)
    columns = 2 * reach + 1
    outer = 1.25 * width
    side = 0
    for j in range(columns):
        if (j - reach) * STEP_PX <= -outer:
            side += 1
    darkness = np.empty((rows, columns))
    level = np.empty((rows, 2))
    flank = np.empty(rows)
    ordered = np.empty(side)
    for i in range(rows):
        along = i - behind
        for j in range(columns):
            across = (j - reach) * STEP_PX
            darkness[i, j] = sign * sample(
                image,
                end[0] + along * direction[0] - across * direction[1],
                end[1] + along * direction[1] + across * direction[0],
            )
        flank[i] = 0.0
        for k in range(2):
            start = 0 if k == 0 else columns - side
            ordered[:] = darkness[i, start : start + side]
            ordered.sort()
            level[i, k] = _middle_mean(ordered)
            for j in range(side):
                flank[i] += abs(ordered[j] - level[i, k]) / (2 * side)
    noise = max(1.25 * np.sort(flank)[rows // 2], _NOISE_FLOOR)
    beside = _undisturbed(_smoothed(level))
    for i in range(rows):
        for j in range(columns):
            across = (j - reach) * STEP_PX
            share = min(max((across + 1.7 * width) / (3.4 * width), 0.0), 1.0)
            darkness[i, j] = (1.0 - share) * beside[i, 0] + share * beside[i, 1] - darkness[i, j]
    _fill_streaks(darkness, width, noise)
    return darkness, noise, sign * float(beside[: behind + 1].mean())


@compiled
def _middle_mean(ordered: Array) -> float:
    """Return the mean of the middle half: nearly as little noise as the mean, and no glint."""
    quarter = len(ordered) // 4
    total = 0.0
    for m in range(quarter, len(ordered) - quarter):
        total += ordered[m]
    return total / (len(ordered) - 2 * quarter)


@compiled
def _smoothed(level: Array) -> Array:
    """Return levels on both sides, shape (rows, 2), without what is short along the needle."""
    rows = len(level)
    smooth = np.empty((rows, 2))
    for i in range(rows):
        first, last = max(i - _SMOOTH_ROWS, 0), min(i + _SMOOTH_ROWS, rows - 1)
        for k in range(2):
            smooth[i, k] = _middle_mean(np.sort(level[first : last + 1, k]))
    return smooth


@compiled
def _undisturbed(beside: Array) -> Array:
    """Return the light on both sides, shape (rows, 2), as if nothing lay along one of them.

    Where they differ something does, such as the needle's shadow, and says nothing of the light
    about the needle; the other side is as bright as most of the strip.
    """
    usual = np.sort(beside.ravel())[len(beside)]
    free: Array = beside.copy()
    for i in range(len(beside)):
        if abs(beside[i, 0] - beside[i, 1]) > _UNEVEN * abs(usual):
            k = 0 if abs(beside[i, 0] - usual) < abs(beside[i, 1] - usual) else 1
            free[i, 1 - k] = beside[i, k]
    return free


@compiled
def _fill_streaks(darkness: Array, width: float, noise: float) -> None:
    """Make what is brighter than the needle on both sides of it as dark as the brighter of them.

    A round needle shines along its middle where the light falls so; its edges stay dark.
    """
    reach = darkness.shape[1] // 2
    half = int(0.5 * width / STEP_PX) + 1
    beyond = np.empty(2 * half + 1)
    for i in range(len(darkness)):
        row = darkness[i, reach - half : reach + half + 1]
        darkest = -np.inf
        for j in range(len(row) - 1, -1, -1):
            darkest = max(darkest, row[j])
            beyond[j] = darkest
        darkest = -np.inf
        for j in range(len(row)):
            darkest = max(darkest, row[j])
            edge = min(darkest, beyond[j])
            if edge - max(row[j], 0.0) > _STREAK * noise:
                row[j] = edge


@compiled
def needle_level(
    darkness: Array, behind: int, width: float, noise: float, prior: float, hint: float
) -> float:
    """Return the needle's mass (darkness summed across it) behind the expected end.

    Parameters
    ----------
    darkness : ndarray, shape (rows, columns)
        From `fine_strip`.
    behind : int
        Row of the strip's middle.
    width, noise : float
        Of the needle [px], of a pixel [grey levels].
    prior : float
        Expected end [px from the middle].
    hint : float
        Level so far; 0: none. Light changes slowly, what crosses the needle does not.

    Returns
    -------
    float
        [grey levels times px]; 0 where nothing stands out of the noise.
    """
    rows, columns = darkness.shape
    reach = columns // 2
    near = int((0.5 * width + 2.0) / STEP_PX)
    inside = min(max(behind + int(prior) - 4, 4), rows - 6)
    first = max(inside - int(LINE_WIDTHS * width), 0)
    part = np.zeros(inside - first)
    for i in range(first, inside):
        for j in range(reach - near, reach + near + 1):
            part[i - first] += STEP_PX * darkness[i, j]
    part.sort()
    # Many rows agree where the needle is plain to see; of two such levels the darker, since glints
    # take more away than shadows add.
    size = max(int(_ALIKE_SHARE * len(part)), 1)
    least = part[-1] - part[0]
    for i in range(len(part) - size + 1):
        least = min(least, part[i + size - 1] - part[i])
    start = 0
    for i in range(len(part) - size + 1):
        if part[i + size - 1] - part[i] <= _ALIKE_SPREAD * least:
            start = i
    middle = part[start + size // 2]
    level, count = 0.0, 0
    for i in range(len(part)):
        if abs(part[i] - middle) <= _ALIKE_MARGIN * abs(middle):
            level += part[i]
            count += 1
    level /= max(count, 1)
    if hint > 0.0:
        level = min(max(level, 0.7 * hint), 1.3 * hint)
    return level if level > 4.0 * noise * math.sqrt(width) else 0.0


@compiled
def row_masses(darkness: Array, width: float, level: float) -> Array:
    """Return each row's mass over the needle's level; no pixel counts for more than a needle's."""
    rows, columns = darkness.shape
    reach = columns // 2
    near = int((0.5 * width + 2.0) / STEP_PX)
    contrast = level / width
    mass = np.zeros(rows)
    for i in range(rows):
        for j in range(reach - near, reach + near + 1):
            mass[i] += min(max(darkness[i, j], -0.4 * contrast), 1.5 * contrast)
        mass[i] *= STEP_PX / level
    return mass
