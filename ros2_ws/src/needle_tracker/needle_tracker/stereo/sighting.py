"""Pairs of ends in both views: which can be those of the needle, and the evidence for each."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.needle_detector import NeedleDetector
from needle_tracker.detector.search_grid import SearchGrid, make_search_grid
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.shaft_search import Shaft, find_shafts
from needle_tracker.stereo.triangulation import SpatialTip, squared_distance, triangulate
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
    shaft_weight : float
        Weight of the log-odds of the shaft next to those of its end, with which they are
        correlated: from 730 sightings in path-traced pairs and pairs of the quick renderer.
    least_chance : float
        Lower limit of the network's probabilities; the upper limit is 1 minus this.
    least_evidence : float
        Log-odds of a sighting below which it is none. In 105 new path-traced scenes this loses few
        needles, while tracks that begin with less keep a poor mean evidence.
    pre_bend : float
        Largest length of the pre-bend [m].
    point_sigma : float
        Standard deviation of a point along the shaft [m].
    passes : int
        Iterations of the fit of the shaft.
    direction_rows : int
        Number of rows of the search grid that determine the direction of a shaft at its end.
    """

    gate: float = 25.0
    sigmas: float = 3.0
    shaft_weight: float = 0.5
    least_chance: float = 0.02
    least_evidence: float = -2.0
    pre_bend: float = 10e-3
    point_sigma: float = 0.5e-3
    passes: int = 4
    direction_rows: int = 12


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
        grid = make_search_grid(self.views, self.settings)
        shafts: list[Shaft] = []
        # Over a pattern or dull metal, some needles are visible at one of the scales only.
        for full_size in (False, True)[: max(d.scales for d in self.detectors)]:
            shafts = find_shafts(grid, self.detectors, least, most, full_size=full_size) or shafts
            sightings = _distinct(
                each for shaft in shafts for each in self._sightings(grid, shaft, least, most)
            )
            if sightings:
                return sightings, sightings[0].ends
        if not shafts:
            return [], (None, None)
        one, other = (
            max(self._ends(side, grid, shafts[0], hidden=True), key=lambda e: e.ends, default=None)
            for side in range(2)
        )
        return [], (one, other)

    def _ends(self, side: int, grid: SearchGrid, shaft: Shaft, *, hidden: bool) -> list[ImageEnd]:
        """Return the ends near the end of a shaft, in the left (0) or the right (1) image."""
        cells = shaft.cells[-PAIRING.direction_rows :]
        pixels = grid.views[side].pixels[cells].astype(np.float64)
        # Means of both halves smooth the steps of the cells.
        early, late = np.array_split(pixels, 2)
        ahead = late.mean(axis=0) - early.mean(axis=0)
        direction = ahead / np.linalg.norm(ahead)
        return self.detectors[side].ends_near(pixels[-1], direction, hidden=hidden)

    def _sightings(
        self, grid: SearchGrid, shaft: Shaft, least: float, most: float
    ) -> Iterator[Sighting]:
        """Yield the pairs of ends, near the end of a shaft, that are possible for the needle."""
        # The first tip of a short needle may come from the end in one view and the shaft in both.
        hidden = most < 2.0 * self.settings.entry_zone
        left = self._ends(0, grid, shaft, hidden=hidden)
        # Most shafts that are not the needle's have no end in the left image at full size.
        right = self._ends(1, grid, shaft, hidden=hidden) if left else []
        points = grid.points(shaft.cells)
        for ends in itertools.product(left, right):
            # One view may hide the shaft, but not both.
            if max(end.shaft for end in ends) < 0.5:
                continue
            tip = triangulate(self.views, ends, points[-1])
            if tip is None or tip.misfit > PAIRING.gate or not self.is_possible(tip, least, most):
                continue
            log_odds = evidence(ends, tip)
            if log_odds < PAIRING.least_evidence:
                continue
            before = np.linalg.norm(points, axis=1) < np.linalg.norm(tip.position)
            length = shaft_length(np.vstack([points[before], tip.position]))
            yield Sighting(tip, ends, log_odds, length)

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
    """Return the log-odds that two ends are of one shaft, from the network and the misfit."""
    seen = sum(_log_odds(end.ends) + PAIRING.shaft_weight * _log_odds(end.shaft) for end in ends)
    return seen - 0.5 * tip.misfit


def _distinct(sightings: Iterable[Sighting]) -> list[Sighting]:
    """Return one sighting of each end, the first given, sorted by decreasing evidence."""
    kept: list[Sighting] = []
    for each in sightings:
        if all(_is_other(each.tip, one.tip) for one in kept):
            kept.append(each)
    return sorted(kept, key=lambda sighting: -sighting.evidence)


def _is_other(tip: SpatialTip, other: SpatialTip) -> bool:
    off = tip.position - other.position
    return squared_distance(off, tip.covariance + other.covariance) > PAIRING.gate


def _log_odds(chance: float) -> float:
    chance = min(max(chance, PAIRING.least_chance), 1.0 - PAIRING.least_chance)
    return math.log(chance / (1.0 - chance))


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
