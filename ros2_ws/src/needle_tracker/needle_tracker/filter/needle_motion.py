"""Tip, heading and stage as one Gaussian state: how it moves, and how sightings correct it.

The tip goes along its heading by the way of the stage; the heading turns by at most the needle's
curvature. The stage's zero and scale are part of the state, since a stage that is read 1 mm off
must not move the tip.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.filter.settings import FilterSettings, TrackerSettings
from needle_tracker.stereo.triangulation import SpatialTip

Array = NDArray[np.float64]

POSITION, HEADING, ZERO, SCALE = slice(0, 3), slice(3, 6), 6, 7
"""Places in the state: tip [m] and heading in `rig`, the stage's zero [m] and scale error [-]."""
SIZE = 8


@dataclasses.dataclass(frozen=True, eq=False)
class NeedleMotion:
    """A Gaussian of tip, heading and stage.

    Attributes
    ----------
    mean : ndarray, shape (8,)
        As the places above say.
    covariance : ndarray, shape (8, 8)
        Of it.
    """

    mean: Array
    covariance: Array

    @staticmethod
    def begin(tip: SpatialTip, settings: TrackerSettings) -> NeedleMotion:
        """Return what a first sighting says.

        The path's heading is that of the visible end, give or take the lean.
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

    def advanced(self, way: float, curvature: float, settings: FilterSettings) -> NeedleMotion:
        """Return where the tip is after a way of the needle's base.

        p_{k+1} = p_k + (1 + scale) way h_k,  h_{k+1} = h_k + turn across h_k

        Parameters
        ----------
        way : float
            Of the base; negative where it is drawn back [m].
        curvature : float
            Largest of the needle's path [1/m].
        settings : FilterSettings
            Noise of the motion.
        """
        heading = self.mean[HEADING] / np.linalg.norm(self.mean[HEADING])
        mean, transition = self.mean.copy(), np.eye(SIZE)
        gone = (1.0 + mean[SCALE]) * way
        mean[POSITION] += gone * heading
        mean[HEADING] = heading
        transition[POSITION, HEADING] = gone * np.eye(3)
        transition[POSITION, SCALE] = way * heading
        turn = curvature * way
        noise = np.zeros((SIZE, SIZE))
        noise[POSITION, POSITION] = (
            (settings.slip_sigma * way) ** 2 * np.outer(heading, heading)
            + (0.5 * turn * way) ** 2 * _across(heading)
            + settings.drift_sigma**2 * np.eye(3)
        )
        noise[HEADING, HEADING] = turn**2 * _across(heading)
        return NeedleMotion(mean, transition @ self.covariance @ transition.T + noise)

    def spread(self, way_sigma: float) -> Array:
        """Return the covariance of a tip that goes a further way of zero mean [m^2].

        Cov(p + w h) = Cov(p) + sigma_w^2 (h h^T + Cov(h))
        """
        heading = self.mean[HEADING]
        ways = np.outer(heading, heading) + self.covariance[HEADING, HEADING]
        return np.asarray(self.covariance[POSITION, POSITION] + way_sigma**2 * ways)

    def surprise(self, tip: SpatialTip) -> tuple[float, float]:
        """Return a sighting's squared distance over both covariances, and its log-density."""
        return gaussian(
            tip.position - self.mean[POSITION],
            self.covariance[POSITION, POSITION] + tip.covariance,
        )

    def corrected(self, rows: Array, residuals: Array, variances: Array) -> NeedleMotion:
        """Return the state after independent linear measurements (Kalman's equations).

        Parameters
        ----------
        rows : ndarray, shape (n, 8)
            Derivatives of the measurements by the state.
        residuals, variances : ndarray, shape (n,)
            Measured less expected, and the variances of the measurements.
        """
        spread = self.covariance @ rows.T
        gain = np.linalg.solve(rows @ spread + np.diag(variances), spread.T).T
        mean = self.mean + gain @ residuals
        # Joseph's form keeps the covariance symmetric and positive.
        left = np.eye(SIZE) - gain @ rows
        covariance = left @ self.covariance @ left.T + (gain * variances) @ gain.T
        return NeedleMotion(mean, covariance)

    def seen(self, tip: SpatialTip) -> NeedleMotion:
        """Return the state after a sighting of the tip."""
        values, axes = np.linalg.eigh(tip.covariance)
        rows = np.zeros((3, SIZE))
        rows[:, POSITION] = axes.T
        return self.corrected(rows, axes.T @ (tip.position - self.mean[POSITION]), values)

    def measured(self, length: float, insertion: float, sigma: float) -> NeedleMotion:
        """Return the state after the shaft's length was compared with the insertion.

        length = (1 + scale) insertion + zero, and a tip that is farther makes the shaft longer.
        """
        rows = np.zeros((1, SIZE))
        rows[0, POSITION] = -self.mean[HEADING]
        rows[0, ZERO], rows[0, SCALE] = 1.0, insertion
        expected = self.mean[ZERO] + (1.0 + self.mean[SCALE]) * insertion
        return self.corrected(rows, np.array([length - expected]), np.array([sigma**2]))


def gaussian(off: Array, covariance: Array) -> tuple[float, float]:
    """Return the squared distance over the covariance, and the log-density."""
    square = float(off @ np.linalg.solve(covariance, off))
    _, log_determinant = np.linalg.slogdet(2.0 * math.pi * covariance)
    return square, -0.5 * (square + float(log_determinant))


def _across(unit: Array) -> Array:
    return np.asarray(np.eye(3) - np.outer(unit, unit))
