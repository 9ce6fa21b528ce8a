"""One thing that may be the needle: where it is, and how likely it is the needle after all.

It is the needle, and moves as the stage does, or along its heading where the insertion is unknown.
Or it is another thing (an old track, a scratch, a screw), which stays where it is or ends elsewhere
by chance. Or it is the needle's shadow, which moves with the needle in another place. Or there is
no end at all.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.filter.needle_motion import (
    HEADING,
    POSITION,
    SCALE,
    ZERO,
    NeedleMotion,
    gaussian,
)
from needle_tracker.filter.settings import FilterSettings, TrackerSettings
from needle_tracker.stereo.sighting import GATE, Sighting
from needle_tracker.stereo.triangulation import SpatialTip

Array = NDArray[np.float64]

_LENGTH_SIGMA = 0.4e-3  # of a shaft's length as both views show it [m], from path-traced pairs
_ASIDE_SIGMAS = 2.5  # the widest reach, in standard deviations of where needles go
_SHADOW = 3.0  # log-odds of a needle against its own shadow or mirror image
_JUMPS = 0.1  # probability that what is no needle ends elsewhere in the next pair
_ACROSS = 1.0 / (2.0 * math.pi * (0.3e-3) ** 2)  # density of a chance end across the needle [1/m^2]


@dataclasses.dataclass(frozen=True, eq=False)
class NeedleTrack:
    """A thing that may be the needle.

    Attributes
    ----------
    motion : NeedleMotion
        Where it is, if it is the needle.
    place, place_covariance : ndarray, shape (3,) and (3, 3)
        Where it stands, if it is not [m].
    end_log_odds : float
        That there is an end.
    place_log_odds : float
        That the needle ends here, by the stage and by how far aside that is.
    motion_log_odds : float
        That it moves as the needle does, and does not stand.
    insertion : float or None
        At the last pair [m].
    way_sigma : float
        Standard deviation of the way since the pair before [m]; 0 where the stage tells it.
    misses : int
        Pairs in a row without a sighting.
    """

    motion: NeedleMotion
    place: Array
    place_covariance: Array
    end_log_odds: float
    place_log_odds: float
    motion_log_odds: float
    insertion: float | None
    way_sigma: float = 0.0
    misses: int = 0

    @staticmethod
    def begin(
        sighting: Sighting, insertion: float | None, settings: TrackerSettings
    ) -> NeedleTrack:
        """Return the track of something seen for the first time."""
        tip = sighting.tip
        motion = NeedleMotion.begin(tip, settings)
        if insertion is not None and sighting.length is not None:
            motion = motion.measured(sighting.length, insertion, _LENGTH_SIGMA)
        end = settings.filter.prior_log_odds + sighting.evidence
        place = place_log_odds(sighting, insertion, settings)
        return NeedleTrack(
            motion, tip.position, tip.covariance, end, place, 0.0, insertion
        )._bounded(settings)

    def predicted(self, insertion: float | None, settings: TrackerSettings) -> NeedleTrack:
        """Return the track at the next pair, before it is looked at."""
        numbers, curvature = settings.filter, settings.reach.curvature
        way, way_sigma = 0.0, numbers.free_step * math.sqrt(self.misses + 1.0)
        if insertion is not None and self.insertion is not None:
            way, way_sigma = insertion - self.insertion, 0.0
        return dataclasses.replace(
            self,
            motion=self.motion.advanced(way, curvature, numbers),
            way_sigma=way_sigma,
            place_covariance=self.place_covariance + numbers.drift_sigma**2 * np.eye(3),
            insertion=insertion,
        )

    def surprise(self, tip: SpatialTip, settings: TrackerSettings) -> float:
        """Return the squared distance over the covariance of a sighting that may be this track's.

        As the needle's, a way that is unknown included, or as that of what stands: the lesser.
        """
        as_needle, _ = self._motion_to(tip, settings).surprise(tip)
        as_needle += self._ways(tip) ** 2
        as_other, _ = gaussian(tip.position - self.place, self.place_covariance + tip.covariance)
        return min(as_needle, as_other)

    def fits(self, tip: SpatialTip, settings: TrackerSettings) -> bool:
        """Return whether a sighting can be this track's."""
        return self.surprise(tip, settings) < GATE

    def seen(self, sighting: Sighting, settings: TrackerSettings) -> NeedleTrack:
        """Return the predicted track after a sighting that `fits`."""
        numbers, tip = settings.filter, sighting.tip
        motion = self._motion_to(tip, settings)
        _, stood = gaussian(tip.position - self.place, self.place_covariance + tip.covariance)
        gain = self._log_density(tip, motion, stood, numbers) - _log_sum(
            math.log(1.0 - _JUMPS) + stood,
            math.log(_JUMPS * numbers.jump_density * _ACROSS),
        )
        place, covariance = _merged(self.place, self.place_covariance, tip)
        return dataclasses.replace(
            self,
            motion=motion.seen(tip),
            place=place,
            place_covariance=covariance,
            end_log_odds=self.end_log_odds + numbers.repeat_weight * sighting.evidence,
            # What once ended where the needle cannot is not the needle.
            place_log_odds=min(
                self.place_log_odds, place_log_odds(sighting, self.insertion, settings)
            ),
            motion_log_odds=self.motion_log_odds + gain,
            misses=0,
        )._bounded(settings)

    def _motion_to(self, tip: SpatialTip, settings: TrackerSettings) -> NeedleMotion:
        """Return the motion up to a sighting: by the stage, or by as far as the sighting says."""
        if self.way_sigma == 0.0:
            return self.motion
        way = self._ways(tip) * self.way_sigma
        return self.motion.advanced(way, settings.reach.curvature, settings.filter)

    def _ways(self, tip: SpatialTip) -> float:
        """Return the way to a sighting, in standard deviations; 0 where the stage tells it."""
        if self.way_sigma == 0.0:
            return 0.0
        ahead = tip.position - self.motion.mean[POSITION]
        return float(ahead @ self.motion.mean[HEADING]) / self.way_sigma

    def _log_density(
        self, tip: SpatialTip, motion: NeedleMotion, stood: float, numbers: FilterSettings
    ) -> float:
        """Return the log-density of a sighting if this is the needle [1/m^3]."""
        _, moved = motion.surprise(tip)
        if self.way_sigma == 0.0:
            return moved
        # The way was fitted: along the heading its own density counts, not that of the sighting.
        heading = motion.mean[HEADING]
        total = motion.covariance[POSITION, POSITION] + tip.covariance
        along = math.sqrt(float(heading @ total @ heading))
        moved += math.log(along / self.way_sigma) - 0.5 * self._ways(tip) ** 2
        rest = numbers.rest_probability
        return _log_sum(math.log(1.0 - rest) + moved, math.log(rest) + stood)

    def missed(self) -> NeedleTrack:
        """Return the predicted track after a pair that does not show it."""
        return dataclasses.replace(self, misses=self.misses + 1)

    @property
    def log_odds(self) -> float:
        """Return the log-odds that this is the needle.

        Else it is another thing's end or none at all, and neither goes where the needle does; or it
        is the needle's shadow or mirror image, which does so in another place.

        P(else) / P(needle) = ((1 + e^-end) e^-motion + e^-shadow) e^-place
        """
        others = _log_sum(0.0, -self.end_log_odds) - self.motion_log_odds
        return self.place_log_odds - _log_sum(others, -_SHADOW)

    def rank(self, settings: TrackerSettings) -> float:
        """Return the log-odds against other tracks: one that is not seen loses with each pair."""
        return self.log_odds - settings.filter.miss_cost * self.misses

    def _bounded(self, settings: TrackerSettings) -> NeedleTrack:
        """Return the track with log-odds within bounds: no evidence is beyond doubt."""
        bound = settings.filter.max_log_odds
        return dataclasses.replace(
            self,
            end_log_odds=min(max(self.end_log_odds, -bound), bound),
            motion_log_odds=min(max(self.motion_log_odds, -bound), bound),
        )

    @property
    def tip(self) -> tuple[Array, Array]:
        """Return the tip [m] and its covariance [m^2], a way that is unknown included."""
        return self.motion.mean[POSITION], self.motion.spread(self.way_sigma)

    @property
    def stage(self) -> tuple[float, float]:
        """Return the stage's zero [m] and scale error [-], as estimated."""
        return float(self.motion.mean[ZERO]), float(self.motion.mean[SCALE])


def place_log_odds(sighting: Sighting, insertion: float | None, settings: TrackerSettings) -> float:
    """Return the log-odds that the needle ends in a place, and not something else.

    A needle that ends far aside has bent outwards all the way, so its tangent at the tip passes the
    entry on the other side; a shadow beside it runs parallel. And a needle is as long as the stage
    says, where other things end at any distance. An end that is followed by the stage says nothing
    new of it: infinite.
    """
    if insertion is not None and sighting.length is None:
        return math.inf
    position, ahead = sighting.tip.position, sighting.tip.direction
    distance = float(np.linalg.norm(position))
    widest = distance * math.sin(float(settings.reach.chord_angle(np.array(distance))))
    outwards = position[:2] / max(float(np.linalg.norm(position[:2])), 1e-9)
    # Where the tangent passes the entry, outwards.
    passes = float((position[:2] - position[2] / max(ahead[2], 0.1) * ahead[:2]) @ outwards)
    aside = _ASIDE_SIGMAS * max(passes, 0.0) / widest
    log_odds = -0.5 * aside * aside
    if insertion is not None and sighting.length is not None:
        sigma = math.hypot(
            settings.stage_zero_sigma, settings.stage_scale_sigma * insertion, _LENGTH_SIGMA
        )
        off = (sighting.length - insertion) / sigma
        density = math.exp(-0.5 * off * off) / (math.sqrt(2.0 * math.pi) * sigma)
        log_odds += math.log(max(density * settings.reach.length, 1e-9))
    return log_odds


def _merged(place: Array, covariance: Array, tip: SpatialTip) -> tuple[Array, Array]:
    """Return the mean of two places by their covariances; a place far off is the new one."""
    total = covariance + tip.covariance
    off = tip.position - place
    if float(off @ np.linalg.solve(total, off)) > GATE:
        return tip.position, tip.covariance
    gain = np.linalg.solve(total, covariance).T
    return place + gain @ off, covariance - gain @ covariance


def _log_sum(one: float, other: float) -> float:
    return float(np.logaddexp(one, other))
