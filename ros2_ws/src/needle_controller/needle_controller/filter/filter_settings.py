"""Assumptions of the hypothesis filter: noise, entry, torsion, and when a hypothesis is dropped."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, cast

import numpy as np
import numpy.typing as npt

from needle_controller.filter.hypotheses import (
    LASTING,
    NORMAL,
    UNIFORM,
    NoiseHypothesis,
    RollHypothesis,
    TorsionHypothesis,
)
from needle_controller.filter.records import (
    ASSUMPTIONS,
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    E_TURN,
    HYPOTHESIS,
    NOISES,
)
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_core.errors import UserError
from needle_core.settings.bounds import Bounds, check_bounded_fields

TORSION_HYPOTHESES = (
    TorsionHypothesis(0.0, 0.0, 0.015, 0.55),
    TorsionHypothesis(math.radians(35.0), 0.0, 0.25, 0.3),
    TorsionHypothesis(0.0, 0.006, 0.003, 0.11),
    TorsionHypothesis(0.0, 0.0, 0.15, 0.1, heading_drift=0.15, roll_drift=1.2),
)
"""None, play, lag, and a tip that turns by itself: tissue pushes it aside, it
rolls, or it follows part of the base's rotation only. Each one's size is estimated."""
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
"""Most likely as the base puts it, to some 30 deg; else anywhere. Narrow ones, for a filter that is
linear in the roll knows less than it thinks when its roll is wide."""
LASTING_NOISE = NoiseHypothesis(
    LASTING, (1.0, 2.0, 1.0, 1.0), (0.25,) * 4, 0.1, (0.0, 0.0, 0.7, 0.95)
)
"""Whatever is claimed: some coordinates are worse than others, or errors last for some tips, or for
so many that they are as good as a bias that wanders."""
NORMAL_NOISE = (
    NoiseHypothesis(
        NORMAL, (1.0, 0.5, 0.25, 2.0, 4.0, 8.0), (0.4, 0.15, 0.15, 0.15, 0.1, 0.05), 1.0
    ),
    LASTING_NOISE,
)
"""Where a covariance is claimed: normal, smaller than claimed, as claimed or larger."""
BOUNDED_NOISE = (
    NoiseHypothesis(UNIFORM, (1.0, 1.3, 1.7, 2.2), (0.85, 0.05, 0.05, 0.05), 0.8),
    NoiseHypothesis(NORMAL, (1.0, 0.5, 0.25, 1.6, 2.6), (0.4, 0.15, 0.15, 0.15, 0.15), 0.2),
    LASTING_NOISE,
)
"""Where a bound is claimed: most likely it holds; else a larger one, or none. Were no small normal
noise thought possible, small errors would look like errors that last."""


@dataclasses.dataclass(frozen=True)
class FilterSettings:
    """Assumptions of the filter.

    Attributes
    ----------
    curvature : float
        Curvature of the needle's path, kappa [1/m].
    curvature_spread : float
        Its standard deviation at the start, as a share of it.
    curvature_range : tuple of float
        Least and most that is believed, as shares of it.
    curvature_drift : float
        Growth of its standard deviation over a metre, as a share of it [1/sqrt(m)].
    scale_spread : float
        Standard deviation of the insertion scale at the start: how far the needle goes in for each
        unit that the stage moves, about 1.
    scale_drift : float
        Growth of it over a metre [1/sqrt(m)].
    tip_noise_bound : float
        Largest error claimed of a measured coordinate where a tip comes without covariance [m].
    outlier_share : float
        Share of tips that have nothing to do with the needle.
    outlier_reach : float
        Size of where these are found, as a multiple of the claimed bound (of sqrt(3) standard
        deviations).
    model_error : float
        What the model leaves out of a tip's position [m]. A better sensor is not believed beyond
        it: a filter that is linear in the roll would hold a wrong one for certain. Its square is
        added to a tip's covariance, and a bound is taken as at least twice as large.
    jump_share : float
        How likely a tip that looks like an outlier shows that phantom or tracker were displaced,
        against that it is one.
    jump_turn_std : float
        How far they may be turned at once [rad].
    initial_angle_std : float
        How well pitch and yaw at the entry are known [rad].
    entry_std : float
        How far from the entry point, along the needle, its tip may be with the stage at 0 [m].
    play_drift, lag_drift : float
        Growth of the standard deviations of play [rad/sqrt(m)] and lag length [sqrt(m)] over a
        metre, where they are estimated: what keeps them open for what the model does not know.
    prune_ratio : float
        A hypothesis ends when it is less likely than the likeliest one by this factor.
    merge_angle : float
        Hypotheses of the same torsion whose rolls are nearer than this become one [rad].
    longest_step : float
        Longer advances are divided [m].
    play_limit : float
        Most that play is believed to be [rad].
    lag_range : tuple of float
        Least and most that a lag length is believed to be [m].
    torsion_hypotheses, roll_hypotheses, noise_hypotheses : tuple
        Every torsion is tried with every roll and every noise, of each shape at most one.
    """

    curvature: Annotated[float, Bounds(0.1, 100.0, "1/m")] = 1.0 / 0.122
    curvature_spread: Annotated[float, Bounds(0.0, 1.0, "-")] = 0.22
    curvature_range: tuple[float, float] = (0.2, 1.6)
    curvature_drift: Annotated[float, Bounds(0.0, 100.0, "1/sqrt(m)")] = 0.02 * math.sqrt(1000.0)
    scale_spread: Annotated[float, Bounds(0.0, 0.3, "-")] = 0.04
    scale_drift: Annotated[float, Bounds(0.0, 10.0, "1/sqrt(m)")] = 0.01
    tip_noise_bound: Annotated[float, Bounds(1e-6, 0.1, "m")] = 0.001
    outlier_share: Annotated[float, Bounds(1e-6, 0.5, "-")] = 0.1
    outlier_reach: Annotated[float, Bounds(1.0, 1000.0, "-")] = 4.0
    model_error: Annotated[float, Bounds(0.0, 0.1, "m")] = 0.0001
    jump_share: Annotated[float, Bounds(1e-6, 1.0, "-")] = 0.2
    jump_turn_std: Annotated[float, Bounds(0.0, 1.0, "rad")] = math.radians(2.0)
    initial_angle_std: Annotated[float, Bounds(1e-6, math.pi, "rad")] = math.radians(8.0)
    entry_std: Annotated[float, Bounds(1e-6, 0.1, "m")] = 0.0005
    play_drift: Annotated[float, Bounds(0.0, 100.0, "rad/sqrt(m)")] = 0.2
    lag_drift: Annotated[float, Bounds(0.0, 1.0, "sqrt(m)")] = 0.003
    prune_ratio: Annotated[float, Bounds(1.0, 1e30, "-")] = 1000.0
    merge_angle: Annotated[float, Bounds(0.0, math.pi, "rad")] = 0.35
    longest_step: Annotated[float, Bounds(1e-5, 1.0, "m")] = 0.002
    play_limit: Annotated[float, Bounds(0.0, math.pi, "rad")] = 1.0
    lag_range: tuple[float, float] = (0.001, 0.016)
    torsion_hypotheses: tuple[TorsionHypothesis, ...] = TORSION_HYPOTHESES
    roll_hypotheses: tuple[RollHypothesis, ...] = ROLL_HYPOTHESES
    noise_hypotheses: tuple[NoiseHypothesis, ...] = BOUNDED_NOISE

    def __post_init__(self) -> None:
        """Check every field.

        Raises
        ------
        UserError
            A value out of bounds, a range that is none, or no hypotheses.
        """
        check_bounded_fields(self)
        for name, (least, most) in (
            ("curvature_range", self.curvature_range),
            ("lag_range", self.lag_range),
        ):
            if not (0.0 < least <= most < math.inf):
                raise UserError(f"{name} = ({least:g}, {most:g}), wants 0 < least <= most")
        for name in ("torsion_hypotheses", "roll_hypotheses", "noise_hypotheses"):
            if not getattr(self, name):
                raise UserError(f"{name} = (), wants at least one")

    @property
    def believed_bound(self) -> float:
        """Largest error of a measured coordinate that is reckoned with [m]."""
        return max(self.tip_noise_bound, 2.0 * self.model_error)

    def assumptions(self) -> np.void:
        """Return what the compiled code needs of this."""
        known = np.zeros(1, ASSUMPTIONS)[0]
        known["noises"] = self.noises()
        known["curvature"] = self.curvature
        known["smallest_curvature"] = self.curvature_range[0] * self.curvature
        known["largest_curvature"] = self.curvature_range[1] * self.curvature
        known["curvature_drift"] = (self.curvature_drift * self.curvature) ** 2
        known["scale_spread"] = self.scale_spread
        known["scale_drift"] = self.scale_drift**2
        known["size_drift"] = self.play_drift**2, self.lag_drift**2, 0.0
        known["largest_play"] = self.play_limit
        known["smallest_lag"] = self.lag_range[0]
        known["largest_lag"] = self.lag_range[1]
        known["longest_step"] = self.longest_step
        known["believed_bound"] = self.believed_bound
        known["entry_std"] = self.entry_std
        known["model_error"] = self.model_error**2
        known["outlier_share"] = self.outlier_share
        known["outlier_density"] = self.outlier_reach**-3
        known["jump_share"] = self.jump_share
        known["jump_turn_variance"] = self.jump_turn_std**2
        known["smallest_weight"] = 1.0 / self.prune_ratio
        known["merge_angle"] = self.merge_angle
        return cast(np.void, known)

    def noises(self) -> Array:
        """Return multiples, shares and correlations of each shape, (3, 3, NOISES)."""
        numbers = np.zeros((3, 3, NOISES))
        for noise in self.noise_hypotheses:
            count = len(noise.shares)
            numbers[noise.shape, :2, :count] = noise.multiples, noise.shares
            numbers[noise.shape, 2, : len(noise.lasting)] = noise.lasting
        return numbers

    def prior(self) -> npt.NDArray[np.void]:
        """Return all hypotheses of a needle that enters along z with its base at 0, shape (H,)."""
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
            h["sized"] = torsion.sized
            h["heading_drift"], h["roll_drift"] = torsion.heading_drift**2, torsion.roll_drift**2
            h["rotation"] = rotation_from_angles([0.0, 0.0, roll.roll])
            covariance = h["covariance"]
            for k in range(2):
                covariance[E_TURN + k, E_TURN + k] = self.initial_angle_std**2
            covariance[E_TURN + 2, E_TURN + 2] = roll.std**2
            covariance[E_KAPPA, E_KAPPA] = (self.curvature_spread * self.curvature) ** 2
            covariance[E_SIZE, E_SIZE] = torsion.size_std**2
            covariance[E_SCALE, E_SCALE] = self.scale_spread**2
        prior["weight"] /= np.max(prior["weight"])
        return prior
