"""The whole shaft in space, from its paths in both images: what only looks like a needle shows.

A shadow on the floor, a cable above the surface or two different lines in the two images end where
a needle could; but on their way from the entry they lie too deep, too high, or nowhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detection import Path
from needle_tracker.refraction import RefractedCamera
from needle_tracker.search_grid import Reach

Array = NDArray[np.float64]

_STATIONS = 10
_OTHER_POINTS = 40
_SMOOTH_CELLS = 7
_LEAST_STATIONS = 4
_TOLERANCE = 3e-3  # of a station, beyond what the needle can reach [m]
_MISS = 1.5e-3  # of the two rays [m]
_LEAST_SINE = 0.02  # between the epipolar plane and the shaft


def shaft_points(
    views: tuple[RefractedCamera, RefractedCamera], paths: tuple[Path, Path], tip: Array
) -> Array:
    """Return points along the shaft, from the entry's side to the tip.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    paths : pair of Path
        The shaft in the left and the right image.
    tip : ndarray, shape (3,)
        The tip in `rig` [m], taken as the last point.

    Returns
    -------
    ndarray, shape (n, 3)
        In `rig` [m]; few or none where the shaft runs along the cameras' baseline.
    """
    pixels = [_smooth(path.pixels) for path in paths]
    pixels[1] = pixels[1][:: max(len(pixels[1]) // _OTHER_POINTS, 1)]
    alike = len(pixels[1]) / len(pixels[0])
    chosen = np.unique(np.linspace(0, len(pixels[0]) - 1, _STATIONS + 1).astype(int))[:-1]
    origins, directions = views[0].rays(pixels[0][chosen])
    other_origins, other_directions = views[1].rays(pixels[1])
    # Signed distance of each station's ray from each of the other image's.
    across = np.cross(directions[:, None], other_directions[None])
    length = np.linalg.norm(across, axis=-1)
    between = other_origins[None] - origins[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        miss = np.sum(between * across, axis=-1) / length
    points = []
    for k in range(len(chosen)):
        row = miss[k]
        crossings = np.flatnonzero(np.sign(row[1:]) * np.sign(row[:-1]) < 0.0)
        if not len(crossings):
            continue
        # Of several the one about as far along the path.
        i = int(crossings[np.argmin(np.abs(crossings - alike * chosen[k]))])
        if abs(row[i + 1] - row[i]) < _LEAST_SINE * 5e-4 / alike:
            continue
        share = row[i] / (row[i] - row[i + 1])
        origin = (1.0 - share) * other_origins[i] + share * other_origins[i + 1]
        direction = (1.0 - share) * other_directions[i] + share * other_directions[i + 1]
        normal = np.cross(directions[k], direction)
        square = float(normal @ normal)
        if square < 1e-8:
            continue
        along = float(np.cross(origin - origins[k], direction) @ normal) / square
        points.append(origins[k] + along * directions[k])
    return np.array([*points, tip])


def shaft_problem(
    points: Array, reach: Reach, insertion: float | None, insertion_margin: float
) -> str | None:
    """Return why points along a shaft cannot be the needle's, None where they can.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        From `shaft_points`.
    reach : Reach
        What the needle can do.
    insertion : float or None
        Length of needle in the phantom [m], None where unknown.
    insertion_margin : float
        Tolerance between the shaft's length and the insertion [m].

    Returns
    -------
    str or None
        Short reason, the same for the same check (it is counted by).
    """
    if len(points) < _LEAST_STATIONS:
        return None
    distance = np.linalg.norm(points, axis=1)
    sideways = np.linalg.norm(points[:, :2], axis=1)
    allowed = distance * np.sin(np.minimum(reach.chord_angle(distance), 1.5)) + _TOLERANCE
    if np.count_nonzero(sideways > allowed) > len(points) // 4:
        return "the shaft lies where the needle cannot"
    if insertion is not None:
        length = _length(points, distance)
        if abs(length - insertion) > insertion_margin:
            return "the shaft's length is not the insertion"
    return None


def _length(points: Array, distance: Array) -> float:
    """Return the length of a smooth curve from the origin through the points to the last."""
    span = float(distance[-1])
    s = distance / span
    terms = np.stack([s, s**2, s**3], axis=1)
    weight = np.ones(len(s))
    weight[-1] = 10.0
    solution, *_ = np.linalg.lstsq(terms * weight[:, None], points * weight[:, None], rcond=None)
    grid = np.linspace(0.0, 1.0, 40)
    curve = np.stack([grid, grid**2, grid**3], axis=1) @ solution
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def _smooth(pixels: Array) -> Array:
    """Return the path without its cells' steps."""
    size = min(_SMOOTH_CELLS, 2 * ((len(pixels) - 1) // 2) + 1)
    padded = np.pad(pixels, ((size // 2, size // 2), (0, 0)), mode="reflect", reflect_type="odd")
    sums = np.cumsum(np.concatenate([np.zeros((1, 2)), padded]), axis=0)
    return np.asarray((sums[size:] - sums[:-size]) / size)
