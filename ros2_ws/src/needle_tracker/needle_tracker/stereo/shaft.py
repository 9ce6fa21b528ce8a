"""The whole shaft in space, from its paths in both images: what only looks like a needle shows.

A shadow on the floor, a cable above the surface or two different lines in the two images end where
a needle could; but on their way from the entry they lie too deep, too high, or nowhere.
"""

# Compiled functions take plain numbers, one by one.

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.detector.end_search import ShaftPath
from needle_tracker.detector.reach import Reach
from needle_tracker.optics.compiled_projection import pixel_ray
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.optics.vectors import cross, dot

Array = NDArray[np.float64]

_SMOOTH_CELLS = 7  # of a path together: cells make steps
_TOLERANCE = 3e-3  # of a point, beyond what the needle can reach [m]
_PASSES, _POINT_SIGMA = 4, 0.5e-3  # of the fit of a curve; of one point [m]
_LEAST_ANGLE = 1e-4  # of two rays [rad]
_LEAST_STEP = 1e-5  # of the rays' distance from one point of a path to the next [m]


def shaft_points(
    views: tuple[RefractedCamera, RefractedCamera], paths: tuple[ShaftPath, ShaftPath], tip: Array
) -> Array:
    """Return points along the shaft, from the entry's side to the tip.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    paths : pair of ShaftPath
        The shaft in the left and the right image.
    tip : ndarray, shape (3,)
        The tip in `rig` [m], taken as the last point.

    Returns
    -------
    ndarray, shape (n, 3)
        In `rig` [m]; few or none where the shaft runs along the cameras' baseline.
    """
    stations, others = (_smooth(path.pixels) for path in paths)
    points = np.empty((len(stations), 3))
    count = _meeting_points((views[0].packed, views[1].packed), stations[:-1], others, points)
    points[count] = tip
    return points[: count + 1]


@compiled
def _meeting_points(
    cameras: tuple[Array, Array],
    stations: Array,
    others: Array,
    points: Array,
) -> int:
    """Write where the rays of one image's stations meet the surface of the other image's rays.

    Parameters
    ----------
    cameras : pair of ndarray
        From `pack_camera`.
    stations, others : ndarray, shape (m, 2) and (n, 2)
        Pixels of the one image, and of the other in the order of its path.
    points : ndarray, shape (m + 1, 3)
        Takes the points, in `rig` [m].

    Returns
    -------
    int
        How many there are.
    """
    origins, directions = np.empty((len(others), 3)), np.empty((len(others), 3))
    for i in range(len(others)):
        pixel_ray(cameras[1], others[i], origins[i], directions[i])
    origin, direction, between, across = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    miss = np.empty(len(others))
    alike = len(others) / (len(stations) + 1)
    count = 0
    for k in range(len(stations)):
        pixel_ray(cameras[0], stations[k], origin, direction)
        chosen, least = -1, math.inf
        for i in range(len(others)):
            # Signed distance of the station's ray from each of the other image's.
            between[:] = origins[i] - origin
            cross(direction, directions[i], across)
            miss[i] = dot(between, across) / math.sqrt(dot(across, across))
            # Of several crossings the one about as far along the path.
            away = abs(i - 1 - alike * k)
            if i and miss[i] * miss[i - 1] < 0.0 and away < least:
                chosen, least = i - 1, away
        if chosen < 0 or abs(miss[chosen + 1] - miss[chosen]) < _LEAST_STEP / alike:
            continue
        share = miss[chosen] / (miss[chosen] - miss[chosen + 1])
        other = (1.0 - share) * directions[chosen] + share * directions[chosen + 1]
        between[:] = (1.0 - share) * origins[chosen] + share * origins[chosen + 1] - origin
        cross(direction, other, across)
        square = dot(across, across)
        if square < _LEAST_ANGLE**2:
            continue
        moment = np.empty(3)
        cross(between, other, moment)
        points[count] = origin + dot(moment, across) / square * direction
        count += 1
    return count


def is_reachable(points: Array, reach: Reach) -> bool:
    """Return whether points along a shaft lie where the needle can be.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        From `shaft_points`.
    reach : Reach
        What the needle can do.
    """
    distance = np.linalg.norm(points, axis=1)
    sideways = np.linalg.norm(points[:, :2], axis=1)
    allowed = distance * np.sin(np.minimum(reach.chord_angle(distance), math.pi / 2)) + _TOLERANCE
    return bool(np.count_nonzero(sideways > allowed) <= len(points) // 4)


def shaft_length(points: Array) -> float:
    """Return the length of a smooth curve from the origin through points to the last of them [m].

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Outwards along the shaft, in `rig` [m].
    """
    tip = points[-1]
    s = np.linalg.norm(points, axis=1) / float(np.linalg.norm(tip))
    terms = np.stack([s**2 - s, s**3 - s], axis=1)  # both ends of the curve are given
    bent = points - s[:, None] * tip
    solution, weight = np.zeros((2, 3)), np.ones((len(s), 1))
    # Reweighted least squares: where clutter leads a path astray, its points count for little.
    for _ in range(_PASSES):
        solution, *_ = np.linalg.lstsq(terms * weight, bent * weight, rcond=None)
        off = np.linalg.norm(bent - terms @ solution, axis=1)
        weight = 1.0 / (1.0 + (off[:, None] / _POINT_SIGMA) ** 2)
    ends = np.concatenate([[0.0], np.sort(s), [1.0]])
    curve = np.outer(ends, tip) + np.stack([ends**2 - ends, ends**3 - ends], axis=1) @ solution
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


@compiled
def _smooth(pixels: Array) -> Array:
    """Return the path without its cells' steps."""
    smooth = np.empty((len(pixels), 2))
    for i in range(len(pixels)):
        half = min(_SMOOTH_CELLS // 2, i, len(pixels) - 1 - i)
        smooth[i, 0] = np.mean(pixels[i - half : i + half + 1, 0])
        smooth[i, 1] = np.mean(pixels[i - half : i + half + 1, 1])
    return smooth
