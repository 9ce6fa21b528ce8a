"""Pair the ends that both views show, and judge each pair by one likelihood."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.detector.end_search import ShaftPath
from needle_tracker.detector.needle_detector import NeedleDetector
from needle_tracker.detector.reach import Reach
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.optics.window import Window
from needle_tracker.stereo.shaft import is_reachable, shaft_length, shaft_points
from needle_tracker.stereo.triangulation import SpatialTip, triangulate

Array = NDArray[np.float64]
Ends = tuple[ImageEnd | None, ImageEnd | None]

GATE = 25.0
"""Squared distance over its covariance from which on two things are not one: 5 sigma."""
SIGMAS = 3.0
"""Of what is known, that a place may lie off."""
_CLOSER_LOOKS = 5  # pairs of paths whose ends are fitted at full size
# Of a path's end [px] and direction [rad]: what half the size shows as one line may be two.
_PATH_ACROSS_PX, _PATH_ALONG_PX, _PATH_ANGLE = 4.0, 10.0, 0.1
_YOUNG = 15e-3  # of a shorter needle one view's end will do: a loop waits for its first tip [m]
_SAME_PX = 2.0  # ends so near are one [px]
_LEAST_CHANCE = 0.02  # the network is not surer than that
_PRE_BEND = 10e-3  # longest part of the needle that is bent beforehand [m]


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """A pair of ends that may be the needle's.

    Attributes
    ----------
    tip : SpatialTip
        Where they meet.
    ends : pair of ImageEnd
        Left and right.
    evidence : float
        Log-odds that both views show a needle's end, from the network.
    length : float or None
        Of the shaft from the entry to the tip [m]; None where only the end was looked at.
    """

    tip: SpatialTip
    ends: tuple[ImageEnd, ImageEnd]
    evidence: float
    length: float | None = None


@dataclasses.dataclass(frozen=True)
class StereoSearch:
    """Searches both views of a pair for the needle.

    Attributes
    ----------
    views : pair of RefractedCamera
        Left and right.
    detectors : pair of NeedleDetector
        Likewise.
    reach : Reach
        What the needle can do.
    windows : tuple of Window
        What the cameras look through: the needle is behind each of them.
    tip_lean : float
        Largest angle between the visible end and the path [rad].
    """

    views: tuple[RefractedCamera, RefractedCamera]
    detectors: tuple[NeedleDetector, NeedleDetector]
    reach: Reach
    windows: tuple[Window, ...]
    tip_lean: float

    def search(self, least: float, most: float) -> tuple[list[Sighting], Ends]:
        """Return the pairs of ends that may be the needle's, and what each view shows by itself.

        Parameters
        ----------
        least, most : float
            Distance of the tip from the entry [m].

        Returns
        -------
        list of Sighting
            The most likely first.
        pair of (ImageEnd or None)
            The clearest end in the left and the right image, whether or not they meet.
        """
        found = [each.search(least, most) for each in self.detectors]
        meeting = self._paths_that_meet(found)
        young = most < _YOUNG
        left, right = (
            [(end, path) for path in own for end in detector.ends_near(path, hidden=young)]
            for detector, own in zip(self.detectors, meeting, strict=True)
        )
        sightings = [
            self._sighting((one[0], other[0]), (one[1], other[1]), least, most)
            for one, other in itertools.product(_apart(left), _apart(right))
        ]
        seen = sorted(filter(None, sightings), key=lambda sighting: -sighting.evidence)
        if seen:
            return seen, seen[0].ends
        alone = (
            [end for path in own[:1] for end in detector.ends_near(path, hidden=True)]
            for detector, own in zip(self.detectors, found, strict=True)
        )
        one, other = (max(ends, key=lambda end: end.ends, default=None) for ends in alone)
        return [], (one, other)

    def _paths_that_meet(
        self, paths: list[list[ShaftPath]]
    ) -> tuple[list[ShaftPath], list[ShaftPath]]:
        """Return the paths of each view that the other view bears out, those of the best pairs."""
        pairs = []
        for pair in itertools.product(*paths):
            tip = triangulate(self.views, (_coarse_end(pair[0]), _coarse_end(pair[1])))
            if tip is not None and tip.misfit < GATE:
                pairs.append((pair[0].score + pair[1].score - 0.5 * tip.misfit, pair))
        pairs.sort(key=lambda scored: -scored[0])
        best = [pair for _, pair in pairs[:_CLOSER_LOOKS]]
        left, right = (list({id(pair[i]): pair[i] for pair in best}.values()) for i in range(2))
        return left, right

    def _sighting(
        self,
        ends: tuple[ImageEnd, ImageEnd],
        paths: tuple[ShaftPath, ShaftPath],
        least: float,
        most: float,
    ) -> Sighting | None:
        """Return what two ends are together; None if that cannot be the needle."""
        tip = triangulate(self.views, ends)
        if tip is None or tip.misfit > GATE or not self.is_possible(tip, least, most):
            return None
        # At half the size a needle and its shadow may be one line.
        left, right = (
            detector.trace(path, end)
            for detector, path, end in zip(self.detectors, paths, ends, strict=True)
        )
        shaft = shaft_points(self.views, (left, right), tip.position)
        if not is_reachable(shaft, self.reach):
            return None
        return Sighting(tip, ends, evidence(ends, tip), shaft_length(shaft))

    def is_possible(self, tip: SpatialTip, least: float, most: float) -> bool:
        """Return whether a tip is in the body, within reach, and points where it can."""
        distance = max(float(np.linalg.norm(tip.position)), 1e-9)
        chord = float(self.reach.chord_angle(np.array(distance)))
        return (
            least <= distance <= most
            and all(window.depth(tip.position) >= 0.0 for window in self.windows)
            and math.acos(tip.position[2] / distance) <= chord
            and self._comes_from_entry(tip, distance)
        )

    def _comes_from_entry(self, tip: SpatialTip, distance: float) -> bool:
        """Return whether a needle from the entry can end here and point there.

        Backwards from the tip, an arc of the largest curvature leaves the tangent by kappa L^2 / 2;
        the visible end itself may lean over the length of its pre-bend. A shadow on the floor runs
        beside the needle all the way: its tangent misses the entry by more.
        """
        ahead = float(tip.position @ tip.direction)
        miss = float(np.linalg.norm(tip.position - ahead * tip.direction))
        bend = 0.5 * self.reach.curvature * distance**2
        lean = math.sin(self.tip_lean) * min(distance, _PRE_BEND)
        sigma = math.sqrt(float(np.trace(tip.direction_covariance)))
        loose = self.reach.hole_tolerance + SIGMAS * sigma * distance
        return ahead > 0.0 and miss <= bend + lean + loose


def evidence(ends: tuple[ImageEnd, ImageEnd], tip: SpatialTip) -> float:
    """Return the log-odds that two ends are one: what each view says, and how they meet."""
    return sum(_log_odds(end.ends) for end in ends) - 0.5 * tip.misfit


def _log_odds(chance: float) -> float:
    chance = min(max(chance, _LEAST_CHANCE), 1.0 - _LEAST_CHANCE)
    return math.log(chance / (1.0 - chance))


def _coarse_end(path: ShaftPath) -> ImageEnd:
    return ImageEnd(
        path.end, path.direction, _PATH_ACROSS_PX, _PATH_ALONG_PX, _PATH_ANGLE, 0.0, path.shaft
    )


def _apart(ends: list[tuple[ImageEnd, ShaftPath]]) -> list[tuple[ImageEnd, ShaftPath]]:
    """Return the ends without those that several paths lead to."""
    kept: list[tuple[ImageEnd, ShaftPath]] = []
    for end, path in ends:
        if all(float(np.linalg.norm(end.point - other.point)) > _SAME_PX for other, _ in kept):
            kept.append((end, path))
    return kept
