"""Track of an object that may be the needle: its state, and the odds that it is the needle.

The tip of the needle advances along its heading by the travel of the stage, or by an unknown
distance if the insertion is unknown; the heading turns by at most the curvature of the needle. The
zero and the scale of the stage are part of the state, so that a stage position that is wrong by 1
mm does not move the tip. Anything else (an old track, a scratch, a screw) is at rest, or its end
moves at random.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.filter.settings import FILTER
from needle_tracker.stereo.sighting import PAIRING, Sighting
from needle_tracker.stereo.triangulation import SpatialTip, squared_distance
from needle_tracker.tracker_parameters import StereoTrackerParameters

Array = NDArray[np.float64]

POSITION, HEADING, ZERO, SCALE = slice(0, 3), slice(3, 6), 6, 7
"""Indices of the state: tip [m] and heading in `rig`, zero [m] and scale error [-] of the stage."""
SIZE = 8


@dataclasses.dataclass(frozen=True, eq=False)
class NeedleMotion:
    """Gaussian state of tip, heading and stage.

    Attributes
    ----------
    mean : ndarray, shape (8,)
        Tip, heading, zero and scale error.
    covariance : ndarray, shape (8, 8)
        Covariance of the state.
    """

    mean: Array
    covariance: Array

    @staticmethod
    def begin(tip: SpatialTip, settings: StereoTrackerParameters) -> NeedleMotion:
        """Return the state after a first sighting.

        The heading of the path is that of the visible end, with half the lean as its uncertainty.
        """
        mean = np.zeros(SIZE)
        mean[POSITION], mean[HEADING] = tip.position, tip.direction
        covariance = np.zeros((SIZE, SIZE))
        covariance[POSITION, POSITION] = tip.covariance
        lean = (0.5 * settings.tip_lean) ** 2 * _across(tip.direction)
        covariance[HEADING, HEADING] = tip.direction_covariance + lean
        covariance[ZERO, ZERO] = settings.stage_zero_sigma**2
        covariance[SCALE, SCALE] = settings.stage_scale_sigma**2
        return NeedleMotion(mean, covariance)

    def advanced(self, displacement: float, curvature: float) -> NeedleMotion:
        """Return the state after a displacement of the needle's base.

        p_{k+1} = p_k + (1 + scale) d h_k,  h_{k+1} = h_k + turn across h_k

        Parameters
        ----------
        displacement : float
            Displacement d of the base, negative for a retraction [m].
        curvature : float
            Largest curvature of the path [1/m].
        """
        heading = self.mean[HEADING] / np.linalg.norm(self.mean[HEADING])
        mean, transition = self.mean.copy(), np.eye(SIZE)
        travel = (1.0 + mean[SCALE]) * displacement
        mean[POSITION] += travel * heading
        mean[HEADING] = heading
        transition[POSITION, HEADING] = travel * np.eye(3)
        transition[POSITION, SCALE] = displacement * heading
        turn = curvature * displacement
        noise = np.zeros((SIZE, SIZE))
        noise[POSITION, POSITION] = (
            (FILTER.slip_sigma * displacement) ** 2 * np.outer(heading, heading)
            + (0.5 * turn * displacement) ** 2 * _across(heading)
            + FILTER.drift_sigma**2 * np.eye(3)
        )
        noise[HEADING, HEADING] = turn**2 * _across(heading)
        return NeedleMotion(mean, transition @ self.covariance @ transition.T + noise)

    def spread(self, displacement_sigma: float) -> Array:
        """Return the tip's covariance after a further, unknown displacement of zero mean [m^2].

        Cov(p + d h) = Cov(p) + sigma_d^2 (h h^T + Cov(h))
        """
        heading = self.mean[HEADING]
        directions = np.outer(heading, heading) + self.covariance[HEADING, HEADING]
        spread = displacement_sigma**2 * directions
        return np.asarray(self.covariance[POSITION, POSITION] + spread)

    def surprise(self, tip: SpatialTip) -> tuple[float, float]:
        """Return the squared Mahalanobis distance of a sighting, and its log-density."""
        return gaussian(
            tip.position - self.mean[POSITION],
            self.covariance[POSITION, POSITION] + tip.covariance,
        )

    def corrected(self, rows: Array, residuals: Array, variances: Array) -> NeedleMotion:
        """Return the state after independent linear measurements (Kalman update).

        Parameters
        ----------
        rows : ndarray, shape (n, 8)
            Derivatives of the measurements with respect to the state.
        residuals, variances : ndarray, shape (n,)
            Measured minus expected values, and the variances of the measurements.
        """
        spread = self.covariance @ rows.T
        gain = np.linalg.solve(rows @ spread + np.diag(variances), spread.T).T
        mean = self.mean + gain @ residuals
        # The Joseph form keeps the covariance symmetric and positive.
        left = np.eye(SIZE) - gain @ rows
        covariance = left @ self.covariance @ left.T + (gain * variances) @ gain.T
        return NeedleMotion(mean, covariance)

    def corrected_by_tip(self, tip: SpatialTip) -> NeedleMotion:
        """Return the state after a sighting of the tip."""
        values, axes = np.linalg.eigh(tip.covariance)
        rows = np.zeros((3, SIZE))
        rows[:, POSITION] = axes.T
        return self.corrected(rows, axes.T @ (tip.position - self.mean[POSITION]), values)

    def corrected_by_length(self, length: float, insertion: float, sigma: float) -> NeedleMotion:
        """Return the state after a comparison of the shaft's length with the insertion.

        length = (1 + scale) insertion + zero; a tip that is farther ahead makes the shaft longer.
        """
        rows = np.zeros((1, SIZE))
        rows[0, POSITION] = -self.mean[HEADING]
        rows[0, ZERO], rows[0, SCALE] = 1.0, insertion
        expected = self.mean[ZERO] + (1.0 + self.mean[SCALE]) * insertion
        return self.corrected(rows, np.array([length - expected]), np.array([sigma**2]))


def gaussian(off: Array, covariance: Array) -> tuple[float, float]:
    """Return the squared Mahalanobis distance, and the log-density."""
    square = squared_distance(off, covariance)
    _, log_determinant = np.linalg.slogdet(2.0 * math.pi * covariance)
    return square, -0.5 * (square + float(log_determinant))


def _across(unit: Array) -> Array:
    return np.asarray(np.eye(3) - np.outer(unit, unit))


@dataclasses.dataclass(frozen=True, eq=False)
class NeedleTrack:
    """Track of an object that may be the needle.

    Attributes
    ----------
    motion : NeedleMotion
        State if it is the needle.
    rest_position, rest_covariance : ndarray, shape (3,) and (3, 3)
        Position if it is at rest [m], and its covariance [m^2].
    recent_evidence : float
        Mean log-odds that it is an end, from the sightings of about the last
        `FilterSettings.evidence_length`.
    earlier_evidence : float
        Log-odds that it is an end, from earlier sightings.
    length_log_odds : float
        Mean log-odds that the needle ends here, from the insertion and the length of the shaft.
    motion_log_odds : float
        Log-odds that it moves like the needle rather than standing still.
    insertion : float or None
        Insertion of the last pair [m].
    sightings : int
        Number of sightings.
    travel : float or None
        Travel of the stage since the last sighting [m]; None if the insertion is unknown.
    travel_sigma : float
        Standard deviation of the travel since the previous pair [m]; 0 if the insertion is known.
    misses : int
        Consecutive pairs without a sighting.
    """

    motion: NeedleMotion
    rest_position: Array
    rest_covariance: Array
    recent_evidence: float
    earlier_evidence: float
    length_log_odds: float
    motion_log_odds: float
    insertion: float | None
    sightings: int = 1
    travel: float | None = 0.0
    travel_sigma: float = 0.0
    misses: int = 0

    @staticmethod
    def begin(
        sighting: Sighting, insertion: float | None, settings: StereoTrackerParameters
    ) -> NeedleTrack:
        """Return the track of a first sighting."""
        tip = sighting.tip
        motion = NeedleMotion.begin(tip, settings)
        if insertion is not None and sighting.length is not None:
            motion = motion.corrected_by_length(sighting.length, insertion, FILTER.length_sigma)
        length = length_log_odds(sighting.length, insertion, settings)
        return NeedleTrack(
            motion, tip.position, tip.covariance, sighting.evidence, 0.0, length, 0.0, insertion
        )

    def predicted(self, insertion: float | None, settings: StereoTrackerParameters) -> NeedleTrack:
        """Return the track at the next pair, before any sighting in it."""
        step, travel, travel_sigma = 0.0, None, FILTER.free_step * math.sqrt(self.misses + 1.0)
        if insertion is not None and self.insertion is not None:
            step, travel_sigma = insertion - self.insertion, 0.0
            travel = None if self.travel is None else self.travel + step
        return dataclasses.replace(
            self,
            motion=self.motion.advanced(step, settings.max_curvature),
            travel=travel,
            travel_sigma=travel_sigma,
            rest_covariance=self.rest_covariance + FILTER.drift_sigma**2 * np.eye(3),
            insertion=insertion,
        )

    def surprise(self, tip: SpatialTip, settings: StereoTrackerParameters) -> float:
        """Return the squared Mahalanobis distance of a sighting from this track.

        This is the smaller of the distances from the needle, including an unknown travel, and from
        the position at rest.
        """
        as_needle, _ = self._motion_to(tip, settings).surprise(tip)
        as_needle += self._travel_in_sigmas(tip) ** 2
        as_other, _ = self._surprise_at_rest(tip)
        return min(as_needle, as_other)

    def fits(self, tip: SpatialTip, settings: StereoTrackerParameters) -> bool:
        """Return whether a sighting may belong to this track."""
        return self.surprise(tip, settings) < PAIRING.gate

    def updated(self, sighting: Sighting, settings: StereoTrackerParameters) -> NeedleTrack:
        """Return the predicted track after a sighting that `fits`."""
        tip = sighting.tip
        motion = self._motion_to(tip, settings)
        _, at_rest = self._surprise_at_rest(tip)
        elsewhere = math.log(FILTER.chance_density)
        gain = self._log_density(tip, motion, at_rest) - _log_sum(at_rest, elsewhere)
        rest_position, rest_covariance = _merged(self.rest_position, self.rest_covariance, tip)
        travel = self.travel
        if travel is None:
            travel = math.dist(tip.position, self.rest_position)
        independent = min(abs(travel) / FILTER.evidence_length, 1.0)
        # Images of nearly the same needle repeat the same evidence: use their mean.
        weight = max(1.0 / (self.sightings + 1), independent)
        length = self.length_log_odds
        if sighting.length is not None:
            length = length_log_odds(sighting.length, self.insertion, settings)
        # The end after a gap may be that of another object, such as the shadow of the needle.
        before = self.motion_log_odds
        before = max(before - FILTER.miss_cost * self.misses, min(before, 0.0))
        return dataclasses.replace(
            self,
            motion=motion.corrected_by_tip(tip),
            rest_position=rest_position,
            rest_covariance=rest_covariance,
            recent_evidence=(1.0 - weight) * self.recent_evidence + weight * sighting.evidence,
            earlier_evidence=_bounded(self.earlier_evidence + independent * self.recent_evidence),
            length_log_odds=(1.0 - weight) * self.length_log_odds + weight * length,
            motion_log_odds=_bounded(before + gain),
            sightings=self.sightings + 1,
            travel=0.0,
            misses=0,
        )

    def _surprise_at_rest(self, tip: SpatialTip) -> tuple[float, float]:
        """Return squared distance and log-density of a sighting if this object is at rest."""
        return gaussian(tip.position - self.rest_position, self.rest_covariance + tip.covariance)

    def _motion_to(self, tip: SpatialTip, settings: StereoTrackerParameters) -> NeedleMotion:
        """Return the state at a sighting; an unknown travel is the distance to the sighting."""
        if self.travel_sigma == 0.0:
            return self.motion
        travel = self._travel_in_sigmas(tip) * self.travel_sigma
        return self.motion.advanced(travel, settings.max_curvature)

    def _travel_in_sigmas(self, tip: SpatialTip) -> float:
        """Return the travel to a sighting in standard deviations; 0 if the insertion is known."""
        if self.travel_sigma == 0.0:
            return 0.0
        ahead = tip.position - self.motion.mean[POSITION]
        return float(ahead @ self.motion.mean[HEADING]) / self.travel_sigma

    def _log_density(self, tip: SpatialTip, motion: NeedleMotion, at_rest: float) -> float:
        """Return the log-density of a sighting if this is the needle [1/m^3]."""
        _, moved = motion.surprise(tip)
        if self.travel_sigma == 0.0:
            return moved
        # The travel was fitted to the sighting: along the heading, use the density of the travel.
        heading = motion.mean[HEADING]
        total = motion.covariance[POSITION, POSITION] + tip.covariance
        along = math.sqrt(float(heading @ total @ heading))
        moved += math.log(along / self.travel_sigma) - 0.5 * self._travel_in_sigmas(tip) ** 2
        # Rest and motion are equally probable.
        return _log_sum(moved, at_rest) + math.log(0.5)

    def missed(self) -> NeedleTrack:
        """Return the predicted track after a pair without a sighting."""
        return dataclasses.replace(self, misses=self.misses + 1)

    def log_odds(self) -> float:
        """Return the log-odds that this is the needle.

        The alternatives are the end of another object, which does not move like the needle; no end
        at all; and the shadow or the mirror image of the needle, which moves like it elsewhere. If
        the insertion is known, a line without an end is fitted where the stage predicts the end, so
        that its motion is no evidence.

        P(else) / P(needle) = (e^(-other - motion) + e^-end [e^-motion] + e^-shadow) e^-length
        """
        no_end = -_bounded(self.recent_evidence + self.earlier_evidence)
        if self.insertion is None:
            no_end -= self.motion_log_odds
        others = _log_sum(-FILTER.other_log_odds - self.motion_log_odds, no_end)
        shadow = -FILTER.shadow_log_odds
        if self.insertion is not None:
            # A shadow is about as long as its needle, other objects end at any distance.
            shadow += FILTER.shadow_length
        return self.length_log_odds - _log_sum(others, shadow)

    def rank(self) -> float:
        """Return the log-odds for comparison with other tracks, reduced by each miss."""
        return self.log_odds() - FILTER.miss_cost * self.misses

    @property
    def tip(self) -> tuple[Array, Array]:
        """Tip [m] and its covariance [m^2], including an unknown travel."""
        return self.motion.mean[POSITION], self.motion.spread(self.travel_sigma)

    @property
    def stage(self) -> tuple[float, float]:
        """Zero [m] and scale error [-] of the stage, as estimated."""
        return float(self.motion.mean[ZERO]), float(self.motion.mean[SCALE])


def length_log_odds(
    length: float | None, insertion: float | None, settings: StereoTrackerParameters
) -> float:
    """Return the log-odds that an end is that of the needle, from the length of its shaft [m].

    The needle is as long as the insertion, while other objects end at any distance. If one of the
    two is unknown, all lengths are equally likely.
    """
    if insertion is None or length is None:
        return 0.0
    sigma = math.hypot(
        settings.stage_zero_sigma,
        settings.stage_scale_sigma * insertion,
        FILTER.length_sigma,
    )
    off = (length - insertion) / sigma
    agreeing = math.log(settings.max_insertion / (math.sqrt(2.0 * math.pi) * sigma))
    return _bounded(agreeing - 0.5 * off * off)


def _merged(position: Array, covariance: Array, tip: SpatialTip) -> tuple[Array, Array]:
    """Return the covariance-weighted mean; a distant new position replaces the old one."""
    total = covariance + tip.covariance
    off = tip.position - position
    if squared_distance(off, total) > PAIRING.gate:
        return tip.position, tip.covariance
    gain = np.linalg.solve(total, covariance).T
    return position + gain @ off, covariance - gain @ covariance


def _bounded(log_odds: float) -> float:
    return min(max(log_odds, -FILTER.max_log_odds), FILTER.max_log_odds)


def _log_sum(one: float, other: float) -> float:
    return float(np.logaddexp(one, other))


def tip_at_entry(insertion: float, settings: StereoTrackerParameters) -> SpatialTip:
    """Return the tip of a needle that is not visible yet, on the z axis of `rig`."""
    hole, angle = settings.hole_tolerance, settings.entry_angle
    sideways = math.hypot(hole, insertion * math.sin(angle))
    along = math.hypot(hole, insertion * (1.0 - math.cos(angle)))
    return SpatialTip(
        np.array([0.0, 0.0, insertion]),
        np.diag([sideways**2, sideways**2, along**2]),
        np.array([0.0, 0.0, 1.0]),
        np.diag([angle**2, angle**2, 0.0]),
    )
