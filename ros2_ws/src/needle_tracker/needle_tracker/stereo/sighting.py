"""Pairing of the ends in both views: which pairs can be the needle, and the evidence for each.

A shadow on the floor, a cable above the surface or two different lines in the two images may end
where a needle could, but between the entry and that end they are too deep, too high, or do not
meet. Therefore, the whole shaft is reconstructed from its paths in both images.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.end_search import SEARCH, ShaftPath
from needle_tracker.detector.needle_detector import NeedleDetector
from needle_tracker.optics.refraction import RefractedCamera, cross, dot, pixel_ray
from needle_tracker.stereo.triangulation import SpatialTip, triangulate
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]
Ends = tuple[ImageEnd | None, ImageEnd | None]


@dataclasses.dataclass(frozen=True)
class PairingSettings:
    """Constants of the pairing; those without an origin are bounds that hardly matter.

    Attributes
    ----------
    gate : float
        Squared Mahalanobis distance above which two observations differ: 5 sigma.
    sigmas : float
        Half width of a search region, in standard deviations.
    path_across_px, path_along_px : float
        Standard deviations of the end of a path [px]: two lines may merge at half size.
    same_px : float
        Distance below which two ends in one view count as one [px].
    least_chance : float
        Lower limit of the network's probabilities; the upper limit is 1 minus this.
    pre_bend : float
        Largest length of the pre-bend [m].
    tolerance : float
        Margin of the reach for a point along the shaft [m].
    point_sigma : float
        Standard deviation of a point along the shaft [m].
    passes : int
        Iterations of the fit of the shaft.
    least_step : float
        Least change of the distance between the rays, from one point of a path to the next [m]: a
        shaft along the baseline of the cameras has no depth.
    """

    gate: float = 25.0
    sigmas: float = 3.0
    path_across_px: float = 4.0
    path_along_px: float = 10.0
    same_px: float = 2.0
    least_chance: float = 0.02
    pre_bend: float = 10e-3
    tolerance: float = 3e-3
    point_sigma: float = 0.5e-3
    passes: int = 4
    least_step: float = 1e-5


PAIRING = PairingSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """A pair of ends that may be those of the needle.

    Attributes
    ----------
    tip : SpatialTip
        Triangulated tip.
    ends : pair of ImageEnd
        Left and right.
    evidence : float
        Log-odds that both views show the end of a needle, from the network.
    length : float or None
        Length of the shaft from the entry to the tip [m]; None if only the end was examined.
    """

    tip: SpatialTip
    ends: tuple[ImageEnd, ImageEnd]
    evidence: float
    length: float | None = None


@dataclasses.dataclass(frozen=True)
class StereoSearch:
    """Search of a stereo pair for the needle.

    Attributes
    ----------
    views : pair of RefractedCamera
        Left and right.
    detectors : pair of NeedleDetector
        Left and right.
    settings : StereoTrackerParameters
        Reach of the needle.
    """

    views: tuple[RefractedCamera, RefractedCamera]
    detectors: tuple[NeedleDetector, NeedleDetector]
    settings: StereoTrackerParameters

    def search(self, least: float, most: float) -> tuple[list[Sighting], Ends]:
        """Return the pairs of ends that may be those of the needle, and the best end of each view.

        Parameters
        ----------
        least, most : float
            Bounds of the distance of the tip from the entry [m].

        Returns
        -------
        list of Sighting
            Sightings, most likely first.
        pair of (ImageEnd or None)
            The clearest end in the left and the right image, whether or not they meet.
        """
        found = [each.search(least, most) for each in self.detectors]
        meeting = self._paths_that_meet(found)
        # The first tip of a short needle may come from the end in one view and the shaft in both.
        hidden = most < 2.0 * self.settings.entry_zone
        left, right = (
            [(end, path) for path in own for end in detector.ends_near(path, hidden=hidden)]
            for detector, own in zip(self.detectors, meeting, strict=True)
        )
        sightings = [
            self._sighting((one[0], other[0]), (one[1], other[1]), least, most)
            for one, other in itertools.product(_distinct(left), _distinct(right))
        ]
        sorted_sightings = sorted(filter(None, sightings), key=lambda sighting: -sighting.evidence)
        if sorted_sightings:
            return sorted_sightings, sorted_sightings[0].ends
        alone = (
            [end for path in own[:1] for end in detector.ends_near(path, hidden=True)]
            for detector, own in zip(self.detectors, found, strict=True)
        )
        one, other = (max(ends, key=lambda end: end.ends, default=None) for ends in alone)
        return [], (one, other)

    def _paths_that_meet(
        self, paths: list[list[ShaftPath]]
    ) -> tuple[list[ShaftPath], list[ShaftPath]]:
        """Return the paths of each view in the best pairs whose ends meet."""
        pairs = []
        for pair in itertools.product(*paths):
            tip = triangulate(self.views, (_coarse_end(pair[0]), _coarse_end(pair[1])))
            if tip is not None and tip.misfit < PAIRING.gate:
                pairs.append((pair[0].score + pair[1].score - 0.5 * tip.misfit, pair))
        pairs.sort(key=lambda scored: -scored[0])
        # Fit the ends of only half as many pairs as there are candidates at full size.
        best = [pair for _, pair in pairs[: SEARCH.candidates // 2]]
        left, right = (list({id(pair[i]): pair[i] for pair in best}.values()) for i in range(2))
        return left, right

    def _sighting(
        self,
        ends: tuple[ImageEnd, ImageEnd],
        paths: tuple[ShaftPath, ShaftPath],
        least: float,
        most: float,
    ) -> Sighting | None:
        """Return the sighting of two ends; None if they cannot be those of the needle."""
        tip = triangulate(self.views, ends)
        if tip is None or tip.misfit > PAIRING.gate or not self.is_possible(tip, least, most):
            return None
        # At half size, a needle and its shadow may merge into one line.
        left, right = (
            detector.trace(path, end)
            for detector, path, end in zip(self.detectors, paths, ends, strict=True)
        )
        shaft = shaft_points(self.views, (left, right), tip.position)
        if not is_reachable(shaft, self.settings):
            return None
        return Sighting(tip, ends, evidence(ends, tip), shaft_length(shaft))

    def is_possible(self, tip: SpatialTip, least: float, most: float) -> bool:
        """Return whether position and direction of a tip are possible for the needle."""
        distance = float(np.linalg.norm(tip.position))
        return (
            least <= distance <= most
            and all(view.camera.window.depth(tip.position) >= 0.0 for view in self.views)
            and math.acos(tip.position[2] / distance)
            <= float(self.settings.chord_angle(np.array(distance)))
            and self._comes_from_entry(tip, distance)
        )

    def _comes_from_entry(self, tip: SpatialTip, distance: float) -> bool:
        """Return whether the tangent at the tip passes the entry as closely as that of a needle.

        Over a length L, an arc of the largest curvature deviates from its tangent by kappa L^2 / 2;
        the visible end may lean over the length of its pre-bend. A shadow on the floor runs beside
        the needle over its whole length: its tangent misses the entry by more.
        """
        ahead = float(tip.position @ tip.direction)
        miss = float(np.linalg.norm(tip.position - ahead * tip.direction))
        bend = 0.5 * self.settings.max_curvature * distance**2
        lean = math.sin(self.settings.tip_lean) * min(distance, PAIRING.pre_bend)
        sigma = math.sqrt(float(np.trace(tip.direction_covariance)))
        loose = self.settings.hole_tolerance + PAIRING.sigmas * sigma * distance
        return ahead > 0.0 and miss <= bend + lean + loose


def evidence(ends: tuple[ImageEnd, ImageEnd], tip: SpatialTip) -> float:
    """Return the log-odds that two ends are the same one, from the network and the misfit."""
    return sum(_log_odds(end.ends) for end in ends) - 0.5 * tip.misfit


def _log_odds(chance: float) -> float:
    chance = min(max(chance, PAIRING.least_chance), 1.0 - PAIRING.least_chance)
    return math.log(chance / (1.0 - chance))


def _coarse_end(path: ShaftPath) -> ImageEnd:
    """Return the end of a path with a coarse uncertainty, for pairing by position."""
    across, along = PAIRING.path_across_px, PAIRING.path_along_px
    return ImageEnd(path.end, path.direction, across, along, 0.0, 0.0, path.shaft)


def _distinct(ends: list[tuple[ImageEnd, ShaftPath]]) -> list[tuple[ImageEnd, ShaftPath]]:
    """Return each end once, although several paths may lead to it."""
    kept: list[tuple[ImageEnd, ShaftPath]] = []
    for end, path in ends:
        if all(math.dist(end.point, other.point) > PAIRING.same_px for other, _ in kept):
            kept.append((end, path))
    return kept


def shaft_points(
    views: tuple[RefractedCamera, RefractedCamera], paths: tuple[ShaftPath, ShaftPath], tip: Array
) -> Array:
    """Return points along the shaft, from the entry to the tip.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    paths : pair of ShaftPath
        The shaft in the left and the right image.
    tip : ndarray, shape (3,)
        The tip in `rig` [m], which becomes the last point.

    Returns
    -------
    ndarray, shape (n, 3)
        Points in `rig` [m]; few or none if the shaft runs along the baseline of the cameras.
    """
    stations, others = (_smooth(path.pixels) for path in paths)
    points = np.empty((len(stations), 3))
    count = _meeting_points(
        (views[0].packed, views[1].packed), stations[:-1], others, PAIRING.least_step, points
    )
    points[count] = tip
    return points[: count + 1]


@compiled
def _meeting_points(
    cameras: tuple[Array, Array], stations: Array, others: Array, least_step: float, points: Array
) -> int:
    """Write the points where the rays of the stations meet the surface of the other rays.

    Parameters
    ----------
    cameras : pair of ndarray
        Packed cameras, from `pack_camera`.
    stations, others : ndarray, shape (m, 2) and (n, 2)
        Pixels of one image, and of the other in the order of its path.
    least_step : float
        As in `PairingSettings` [m].
    points : ndarray, shape (m + 1, 3)
        Output: the points, in `rig` [m].

    Returns
    -------
    int
        Number of points.
    """
    origins, directions = np.empty((len(others), 3)), np.empty((len(others), 3))
    for i in range(len(others)):
        pixel_ray(cameras[1], others[i], origins[i], directions[i])
    origin, direction, between, across = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    moment, miss = np.empty(3), np.empty(len(others))
    alike = len(others) / (len(stations) + 1)
    count = 0
    for k in range(len(stations)):
        pixel_ray(cameras[0], stations[k], origin, direction)
        chosen, least = -1, math.inf
        for i in range(len(others)):
            # Signed distance between the ray of the station and each ray of the other image.
            between[:] = origins[i] - origin
            cross(direction, directions[i], across)
            miss[i] = dot(between, across) / math.sqrt(dot(across, across))
            # Among several crossings, choose the one at about the same share of the path.
            away = abs(i - 1 - alike * k)
            if i and miss[i] * miss[i - 1] < 0.0 and away < least:
                chosen, least = i - 1, away
        if chosen < 0 or abs(miss[chosen + 1] - miss[chosen]) < least_step / alike:
            continue
        share = miss[chosen] / (miss[chosen] - miss[chosen + 1])
        other = (1.0 - share) * directions[chosen] + share * directions[chosen + 1]
        between[:] = (1.0 - share) * origins[chosen] + share * origins[chosen + 1] - origin
        cross(direction, other, across)
        cross(between, other, moment)
        points[count] = origin + dot(moment, across) / dot(across, across) * direction
        count += 1
    return count


def is_reachable(points: Array, needle: StereoTrackerParameters) -> bool:
    """Return whether most points along a shaft are within reach.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points from `shaft_points`.
    needle : StereoTrackerParameters
        Reach of the needle.
    """
    distance = np.linalg.norm(points, axis=1)
    sideways = np.linalg.norm(points[:, :2], axis=1)
    angle = np.minimum(needle.chord_angle(distance), math.pi / 2)
    allowed = distance * np.sin(angle) + PAIRING.tolerance
    return bool(np.median(sideways - allowed) <= 0.0)


def shaft_length(points: Array) -> float:
    """Return the length of a smooth curve from the origin through points to the last of them [m].

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points outwards along the shaft, in `rig` [m].
    """
    tip = points[-1]
    s = np.linalg.norm(points, axis=1) / float(np.linalg.norm(tip))
    bent = points - s[:, None] * tip
    terms, solution, weight = _bends(s), np.zeros((2, 3)), np.ones((len(s), 1))
    # Reweighted least squares: points where clutter deflects the path have a low weight.
    for _ in range(PAIRING.passes):
        solution, *_ = np.linalg.lstsq(terms * weight, bent * weight, rcond=None)
        off = np.linalg.norm(bent - terms @ solution, axis=1)
        weight = 1.0 / (1.0 + (off[:, None] / PAIRING.point_sigma) ** 2)
    s = np.concatenate([[0.0], np.sort(s), [1.0]])
    curve = np.outer(s, tip) + _bends(s) @ solution
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def _bends(s: Array) -> Array:
    """Return a quadratic and a cubic that are 0 at both ends of the curve, shape (n, 2)."""
    return np.stack([s**2 - s, s**3 - s], axis=1)


def _smooth(pixels: Array) -> Array:
    """Smooth the steps of the cells out of a path: a moving average, shorter at the ends."""
    row = np.arange(len(pixels))
    half = np.minimum(SEARCH.smooth_rows // 2, np.minimum(row, row[::-1]))
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(pixels, axis=0)])
    return np.asarray((sums[row + half + 1] - sums[row - half]) / (2 * half + 1)[:, None])
