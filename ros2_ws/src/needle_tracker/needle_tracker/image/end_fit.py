"""Shaft line and end of the needle in a needle map, from about where they are.

The map says of each pixel how surely it is needle. Along the shaft's axis that is the chance that
the needle reaches at least so far: its sum is where the end is expected to be, and its shape says
how well that is known. Where a face cannot be seen the chance falls slowly, and the end is as
uncertain as that.
"""

# Compiled functions take plain numbers, one by one; numba's floor and ceil are floats.
# ruff: noqa: PLR0917, RUF046

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LINE_WIDTHS = 8.0
"""The line is fitted to so much shaft behind the end, in needle widths: less than it bends in."""
_BACK_WIDTHS, _AHEAD_WIDTHS = 4.0, 4.0  # the end is looked for so far about where it should be
_SLOPES = 7  # directions that are tried, so far to either side [-]
_SLOPE = 0.15
_CORE = 0.3  # of the width, to either side: the end is where it reaches farthest there
_PASSES = 3
_WHOLE = 0.8  # of the width: a map shows that much of a needle that it sees whole
ASIDE_WIDTHS = 2.0
"""What a map shows so far beside the line may be the needle, too [needle widths]."""
_EARLY = 0.841  # the chance to reach one standard deviation less than the middle
_GAP_WIDTHS, _UNLIKELY = 1.5, 0.3  # where needle is less likely for so long, it has ended
_LEAST_STEP = 0.2  # of the map from shaft to floor: less is no end


@compiled
def fit_end(
    needle_map: Image,
    point: Array,
    direction: Array,
    room: float,
    search: float,
    width: float,
    result: Array,
) -> bool:
    """Fit line and end.

    Parameters
    ----------
    needle_map : ndarray of uint8, shape (height, width)
        255 where a pixel is surely needle.
    point, direction : ndarray, shape (2,)
        Where the end should be [px], and the unit vector along the shaft towards it.
    room : float
        Shaft behind the end [px].
    search : float
        How far beside that the needle may be [px].
    width : float
        Of the needle [px].
    result : ndarray, shape (9,)
        Takes the end (u, v) [px], the direction (u, v), the line's standard deviation across
        at the end [px], the end's along the line [px], the direction's [rad], the mean certainty
        along the line (0 to 1), and how far the end is inside the window [px].

    Returns
    -------
    bool
        Whether there is a line.
    """
    back = min(room, LINE_WIDTHS * width)
    if back < 2.0 * width:
        return False
    offset, slope = _best_line(needle_map, point, direction, back, search, width)
    end = 0.0
    sums = np.empty(6)
    for _ in range(_PASSES):
        _centre_line(needle_map, point, direction, offset, slope, end, back, width, sums)
        if sums[0] < 2.0 * width:
            return False
        offset, slope = sums[1], sums[2]
        end, spread, inside = _end_along(
            needle_map, point, direction, offset, slope, end, back, width
        )
    norm = math.sqrt(1.0 + slope * slope)
    result[2] = (direction[0] - slope * direction[1]) / norm
    result[3] = (direction[1] + slope * direction[0]) / norm
    across = offset + slope * end
    result[0] = point[0] + end * direction[0] - across * direction[1]
    result[1] = point[1] + end * direction[1] + across * direction[0]
    result[4], result[6] = sums[3], sums[4]
    result[5] = spread * norm
    result[7] = sums[5]
    result[8] = inside
    return True


def hidden_sigma(sigma: float, face: float) -> float:
    """Return by how much a hidden face makes an end uncertain, if its length is known.

    The end that is seen lies anywhere on the face: that is one more thing known of it, with the
    variance of a uniform distribution. Where in it says nothing, so the end is not moved.

    Parameters
    ----------
    sigma : float
        Standard deviation along the shaft, of a face of any length [px or m].
    face : float
        The face's length along the shaft, in the same unit; 0 where unknown.
    """
    return sigma if face <= 0.0 else sigma / math.sqrt(1.0 + 12.0 * (sigma / face) ** 2)


@inlined
def _at(image: Image, x: float, y: float) -> float:
    """Return the map at a place, 0 to 1; 0 outside."""
    column, row = int(math.floor(x)), int(math.floor(y))
    if column < 0 or row < 0 or column + 1 >= image.shape[1] or row + 1 >= image.shape[0]:
        return 0.0
    a, b = x - column, y - row
    above = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    below = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    value: float = ((1.0 - b) * above + b * below) / 255.0
    return value


@inlined
def _seen(image: Image, point: Array, direction: Array, along: float, across: float) -> float:
    x = point[0] + along * direction[0] - across * direction[1]
    y = point[1] + along * direction[1] + across * direction[0]
    return _at(image, x, y)


@compiled
def _best_line(
    image: Image, point: Array, direction: Array, back: float, search: float, width: float
) -> tuple[float, float]:
    """Return offset and slope of the line on which the most needle lies; the nearest of equals."""
    best, offset, slope = -1.0, 0.0, 0.0
    pitch = 0.5 * width
    steps = int(math.ceil(search / pitch))
    for j in range(-steps, steps + 1):
        for k in range(_SLOPES):
            lean = _SLOPE * (2.0 * k / (_SLOPES - 1) - 1.0)
            total = 0.0
            s = -back
            while s <= 0.0:
                total += _seen(image, point, direction, s, j * pitch + lean * s)
                s += 0.4 * width
            total *= 1.0 - 0.02 * abs(j) - 0.1 * abs(lean)
            if total > best:
                best, offset, slope = total, j * pitch, lean
    return offset, slope


@compiled
def _centre_line(
    image: Image,
    point: Array,
    direction: Array,
    offset: float,
    slope: float,
    end: float,
    back: float,
    width: float,
    sums: Array,
) -> None:
    """Fit the line to the middles of the needle; write (mass, offset, slope, sigmas, certainty)."""
    count = int(back)
    places, middles, weights = np.empty(count), np.empty(count), np.empty(count)
    spreads = np.empty(count)
    certainty = apparent = 0.0
    for i in range(count):
        s = end - i
        line = offset + slope * s
        mass = moment = all_mass = all_moment = square = 0.0
        t = -ASIDE_WIDTHS * width
        while t <= ASIDE_WIDTHS * width:
            value = _seen(image, point, direction, s, line + t)
            all_mass += value
            all_moment += value * t
            square += value * t * t
            if abs(t) <= 0.9 * width:
                mass += value
                moment += value * t
            t += 0.5
        places[i], weights[i] = s, min(0.5 * mass / width, 1.0)
        middles[i] = line + (moment / mass if mass > 0.0 else 0.0)
        spreads[i] = square / all_mass - (all_moment / all_mass) ** 2 if all_mass > 0.0 else 0.0
        certainty += _seen(image, point, direction, s, line)
        apparent += 0.5 * mass / width
    total = weights.sum()
    sums[0] = total
    if total < 2.0:
        return
    mean = (weights * places).sum() / total
    middle = (weights * middles).sum() / total
    spread = (weights * (places - mean) ** 2).sum()
    lean = (weights * (places - mean) * (middles - middle)).sum() / max(spread, 1e-9)
    off = middles - middle - lean * (places - mean)
    variance = (weights * off * off).sum() / total
    # What disturbs a line does so over about a width.
    independent = max(total / width, 2.0)
    across = variance / (independent - 1.0) * (1.0 + (end - mean) ** 2 / max(spread / total, 1e-9))
    sums[1], sums[2] = middle - lean * mean, lean
    # Where the map shows less than the needle's width, what is missing lies on one side of it.
    missing = 0.5 * width * max(_WHOLE - apparent / count, 0.0)
    # What it shows of more, such as a shadow alongside, may be the needle: the chance of that is
    # spread wider than the needle, and a pixel, is.
    wider = max(np.median(spreads) - (width + 1.0) ** 2 / 12.0, 0.0)
    sums[3] = math.sqrt(across + missing * missing + wider)
    sums[4] = math.sqrt(variance / (independent - 1.0) / max(spread / total, 1e-9))
    sums[5] = certainty / count


@compiled
def _end_along(
    image: Image,
    point: Array,
    direction: Array,
    offset: float,
    slope: float,
    end: float,
    back: float,
    width: float,
) -> tuple[float, float, float]:
    """Return where the needle is expected to end along the line, the standard deviation of that.

    And the least of how surely there is needle where the window begins, and none where it ends.
    """
    begin = end - min(_BACK_WIDTHS * width, back)
    count = int(end + _AHEAD_WIDTHS * width - begin) + 1
    chance = np.empty(count)
    for i in range(count):
        s = begin + i
        most = 0.0
        for j in range(-2, 3):
            across = offset + slope * s + 0.5 * j * _CORE * width
            most = max(most, _seen(image, point, direction, s, across))
        chance[i] = most
    _make_survival(chance, int(math.ceil(_GAP_WIDTHS * width)))
    sure, left = chance[0], chance[count - 1]
    if sure - left < _LEAST_STEP:
        return end, _AHEAD_WIDTHS * width, 0.0
    # On the shaft it is sure that the needle is longer, and at the end of the window that it is
    # not. Quantiles, since what is faint and far does not count.
    early = _place_of(chance, left + _EARLY * (sure - left))
    middle = _place_of(chance, left + 0.5 * (sure - left))
    late = _place_of(chance, left + (1.0 - _EARLY) * (sure - left))
    return begin + middle, 0.5 * (late - early), min(sure, 1.0 - left)


@inlined
def _place_of(falling: Array, level: float) -> float:
    """Return where falling values pass a level, between the first and the last of them."""
    for i in range(1, len(falling)):
        if falling[i] < level:
            place: float = i - 1 + (falling[i - 1] - level) / (falling[i - 1] - falling[i])
            return place
    return len(falling) - 1.0


@inlined
def _make_survival(chance: Array, gap: int) -> None:
    """Replace the chance to be needle by that to reach so far: no less than what is joined to it.

    Beyond a gap so long, in places, is another thing.
    """
    missing = 0
    for i in range(len(chance)):
        missing = missing + 1 if chance[i] < _UNLIKELY else 0
        if missing >= gap:
            chance[i:] = 0.0
            break
    for i in range(len(chance) - 2, -1, -1):
        chance[i] = max(chance[i], chance[i + 1])
