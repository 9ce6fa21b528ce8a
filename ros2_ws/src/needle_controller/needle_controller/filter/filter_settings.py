"""Settings of the hypothesis filter: prior hypotheses, noise, drifts and limits."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from needle_controller.filter.records import (
    ASSUMPTIONS,
    E_KAPPA,
    E_SCALE,
    E_TORSION,
    E_TURN,
    ESTIMATE,
    EVENT,
    HYPOTHESIS,
    NEEDLE,
    NOISES,
    TORSION,
    Bank,
)
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles

# Read by compiled code.
PLAY, LAG, GAIN = range(3)
"""Parameters of the torsion model; each hypothesis estimates one of them."""


class TorsionHypothesis(NamedTuple):
    """Model of how the tip's roll follows the base; one parameter is estimated.

    Attributes
    ----------
    play : float
        Half width of the dead band between base and tip [rad].
    lag_length : float
        Inserted length over which the tip follows [m]; 0 for no lag.
    parameter_std : float
        Prior standard deviation of the estimated parameter: of the lag length [m] if there is one,
        otherwise of the play [rad]; without either, of the share of the base's rotation that
        reaches the tip, about 1.
    weight : float
        Prior weight, relative to the others'.
    heading_drift, roll_drift : float
        Growth of the standard deviations of pitch and yaw, and of the roll, over a metre, for a tip
        that turns by itself [rad/sqrt(m)].
    """

    play: float
    lag_length: float
    parameter_std: float
    weight: float
    heading_drift: float = 0.05
    roll_drift: float = 0.05

    @property
    def kind(self) -> int:
        """Estimated parameter: `PLAY`, `LAG` or `GAIN`."""
        if self.lag_length > 0.0:
            return LAG
        return PLAY if self.play > 0.0 else GAIN


class RollHypothesis(NamedTuple):
    """Possible roll of the tip at the entry, relative to the base.

    Attributes
    ----------
    roll : float
        Mean [rad].
    std : float
        Standard deviation [rad].
    weight : float
        Prior weight, relative to the others'.
    """

    roll: float
    std: float
    weight: float


# Read by compiled code.
NORMAL, UNIFORM, CORRELATED = range(3)
"""Noise shapes: normal, or uniform within a bound, both equal in all coordinates and independent
between tips; or normal with a size for each coordinate and correlated between tips."""


class NoiseHypothesis(NamedTuple):
    """Possible noise of a measured coordinate, relative to the claimed noise.

    Attributes
    ----------
    shape : int
        `NORMAL`, `UNIFORM` or `CORRELATED`.
    multiples : tuple of float
        Possible sizes: bounds relative to the claimed bound, or standard deviations relative to the
        claimed one (for a bound, bound / sqrt(3)); at most 6.
    shares : tuple of float
        Prior probability of each size; the sum is 1.
    weight : float
        Prior weight, relative to the others'.
    correlations : tuple of float
        For `CORRELATED` noise, the correlation of an error with that of the previous tip, for each
        size, in [0, 1); empty for the others.
    """

    shape: int
    multiples: tuple[float, ...]
    shares: tuple[float, ...]
    weight: float
    correlations: tuple[float, ...] = ()


TORSION_HYPOTHESES = (
    TorsionHypothesis(0.0, 0.0, 0.015, 0.55),
    TorsionHypothesis(math.radians(35.0), 0.0, 0.25, 0.3),
    TorsionHypothesis(0.0, 0.006, 0.003, 0.11),
    TorsionHypothesis(0.0, 0.0, 0.15, 0.1, heading_drift=0.15, roll_drift=1.2),
)
"""No torsion, play, lag, and a tip that turns by itself, because tissue pushes it aside, it rolls,
or it follows only a part of the base's rotation."""
ROLL_HYPOTHESES = tuple(
    RollHypothesis(math.radians(roll), math.radians(std), weight)
    for roll, std, weight in (
        (0.0, 16.0, 0.24),
        *((roll, 16.0, 0.21) for roll in (30.0, -30.0)),
        *((roll, 19.0, 0.057) for roll in (65.0, -65.0)),
        *((roll, 21.0, 0.057) for roll in (107.0, -107.0)),
        *((roll, 22.0, 0.057) for roll in (153.0, -153.0)),
    )
)
"""Most likely within 30 deg of the base's rotation, otherwise anywhere. Each is narrow, because a
filter that is linear in the roll is overconfident if the roll is uncertain."""
CORRELATED_NOISE = NoiseHypothesis(
    CORRELATED, (1.0, 2.0, 1.0, 1.0), (0.25,) * 4, 0.1, (0.0, 0.0, 0.7, 0.95)
)
"""Independent of the claim: some coordinates are worse than others, or errors persist for some
tips, or for so many that they act as a slowly changing bias."""
NORMAL_NOISE = (
    NoiseHypothesis(
        NORMAL, (1.0, 0.5, 0.25, 2.0, 4.0, 8.0), (0.4, 0.15, 0.15, 0.15, 0.1, 0.05), 1.0
    ),
    CORRELATED_NOISE,
)
"""For a claimed covariance: normal noise that is smaller than claimed, as claimed, or larger."""
BOUNDED_NOISE = (
    NoiseHypothesis(UNIFORM, (1.0, 1.3, 1.7, 2.2), (0.85, 0.05, 0.05, 0.05), 0.8),
    NoiseHypothesis(NORMAL, (1.0, 0.5, 0.25, 1.6, 2.6), (0.4, 0.15, 0.15, 0.15, 0.15), 0.2),
    CORRELATED_NOISE,
)
"""For a claimed bound: most likely it holds; otherwise a larger one, or none. Without hypotheses of
small normal noise, small errors would look like correlated ones."""

_CURVATURE_SPREAD = 0.22
"""Initial standard deviation of the curvature, relative to it."""
SCALE_SPREAD = 0.04
"""Initial standard deviation of the insertion scale, the needle's insertion per insertion of the
stage, about 1."""


@dataclasses.dataclass(frozen=True)
class FilterSettings:
    """Assumptions of the filter.

    Attributes
    ----------
    curvature : float
        Curvature of the needle's path, kappa [1/m].
    curvature_range : tuple of float
        Smallest and largest estimated curvature, relative to `curvature`.
    curvature_drift : float
        Growth of the relative standard deviation over a metre [1/sqrt(m)].
    scale_drift : float
        Growth of the standard deviation of the insertion scale over a metre [1/sqrt(m)].
    tip_noise_bound : float
        Claimed largest error of a measured coordinate of tips without covariance [m].
    outlier_share : float
        Share of tips that are outliers.
    model_error : float
        Error of the model's tip position [m]. Its square is added to a tip's covariance, and a
        bound is at least twice as large: with a more accurate sensor, a filter that is linear in
        the roll would be certain of a wrong one.
    jump_share : float
        Probability that an apparent outlier is a displacement of phantom or tracker, relative to
        that of an outlier.
    initial_angle_std : float
        Standard deviation of pitch and yaw at the entry [rad].
    play_drift, lag_drift : float
        Growth of the standard deviations of play [rad/sqrt(m)] and lag length [sqrt(m)] over a
        metre if they are estimated, which allows for effects beyond the model.
    torsion_hypotheses, roll_hypotheses, noise_hypotheses : tuple
        Hypotheses, tried in all combinations; at most one noise hypothesis of each shape.
    """

    curvature: float = 1.0 / 0.122
    curvature_range: tuple[float, float] = (0.2, 1.6)
    curvature_drift: float = 0.02 * math.sqrt(1000.0)
    scale_drift: float = 0.01
    tip_noise_bound: float = 0.001
    outlier_share: float = 0.1
    model_error: float = 0.0001
    jump_share: float = 0.2
    initial_angle_std: float = math.radians(8.0)
    play_drift: float = 0.2
    lag_drift: float = 0.003
    torsion_hypotheses: tuple[TorsionHypothesis, ...] = TORSION_HYPOTHESES
    roll_hypotheses: tuple[RollHypothesis, ...] = ROLL_HYPOTHESES
    noise_hypotheses: tuple[NoiseHypothesis, ...] = BOUNDED_NOISE

    @property
    def effective_bound(self) -> float:
        """Assumed largest error of a measured coordinate [m]."""
        return max(self.tip_noise_bound, 2.0 * self.model_error)

    def tip_covariance(self, measured: npt.ArrayLike | None) -> Array:
        """Return the covariance of a tip, (3, 3) [m^2]: the measured one with the model's error.

        Without one, it is that of the assumed bound.
        """
        if measured is None:
            return np.asarray(np.eye(3) * (self.effective_bound * self.effective_bound / 3.0))
        return np.asarray(measured, dtype=float) + np.eye(3) * self.model_error**2

    def assumptions(self) -> np.void:
        """Return the settings for compiled code."""
        assumed = np.zeros(1, ASSUMPTIONS)[0]
        assumed["noises"] = self.noises()
        assumed["curvature"] = self.curvature
        assumed["smallest_curvature"] = self.curvature_range[0] * self.curvature
        assumed["largest_curvature"] = self.curvature_range[1] * self.curvature
        assumed["curvature_drift"] = (self.curvature_drift * self.curvature) ** 2
        assumed["scale_drift"] = self.scale_drift**2
        assumed["torsion_drift"] = self.play_drift**2, self.lag_drift**2, 0.0
        assumed["effective_bound"] = self.effective_bound
        assumed["model_error"] = self.model_error**2
        assumed["outlier_share"] = self.outlier_share
        assumed["jump_share"] = self.jump_share
        return cast(np.void, assumed)

    def bank(self, count: int, events: int) -> Bank:
        """Return the filters of `count` needles, with storage for `events` events each."""
        prior, torsions = self.prior(), len(self.torsion_hypotheses)
        return Bank(
            np.zeros(count, NEEDLE),
            np.empty((count, prior.size + 1), HYPOTHESIS),
            np.zeros((count, events), EVENT),
            prior,
            np.array([self.assumptions()]),
            np.zeros(count, ESTIMATE),
            np.zeros((count, torsions), TORSION),
        )

    def noises(self) -> Array:
        """Return multiples, shares and correlations of each shape, (3, 3, NOISES)."""
        numbers = np.zeros((3, 3, NOISES))
        for noise in self.noise_hypotheses:
            count = len(noise.shares)
            numbers[noise.shape, :2, :count] = noise.multiples, noise.shares
            numbers[noise.shape, 2, : len(noise.correlations)] = noise.correlations
        return numbers

    def prior(self) -> npt.NDArray[np.void]:
        """Return the hypotheses of a needle that enters along z with its base at 0, shape (H,)."""
        noises = self.noises()
        every = [
            (noise, number, torsion, roll)
            for noise in self.noise_hypotheses
            for number, torsion in enumerate(self.torsion_hypotheses)
            for roll in self.roll_hypotheses
        ]
        prior = np.zeros(len(every), HYPOTHESIS)
        for h, (noise, number, torsion, roll) in zip(prior, every, strict=True):
            h["weight"] = torsion.weight * roll.weight * noise.weight
            h["torsion"], h["shape"] = number, noise.shape
            h["noise_weights"] = noises[noise.shape, 1]
            h["curvature"], h["scale"] = self.curvature, 1.0
            h["play"], h["lag"], h["gain"] = torsion.play, torsion.lag_length, 1.0
            h["torsion_kind"] = torsion.kind
            h["heading_drift"], h["roll_drift"] = torsion.heading_drift**2, torsion.roll_drift**2
            h["rotation"] = rotation_from_angles([0.0, 0.0, roll.roll])
            covariance = h["covariance"]
            for k in range(2):
                covariance[E_TURN + k, E_TURN + k] = self.initial_angle_std**2
            covariance[E_TURN + 2, E_TURN + 2] = roll.std**2
            covariance[E_KAPPA, E_KAPPA] = (_CURVATURE_SPREAD * self.curvature) ** 2
            covariance[E_TORSION, E_TORSION] = torsion.parameter_std**2
            covariance[E_SCALE, E_SCALE] = SCALE_SPREAD**2
        prior["weight"] /= np.max(prior["weight"])
        return prior
