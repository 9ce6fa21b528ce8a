"""What the hypothesis filter assumes: noise, the entry, torsion, and when it gives up an idea."""

from __future__ import annotations

import dataclasses
import math

from needle_common.errors import UserError
from needle_controller.bank.hypotheses import (
    RollHypothesis,
    TorsionHypothesis,
    bounded,
    check_bounded_fields,
)
from needle_controller.bank.hypothesis_bank import Limits

TORSION_HYPOTHESES = (
    TorsionHypothesis(0.0, 0.0, 0.0, 0.52),
    TorsionHypothesis(math.radians(20.0), 0.0, 0.15, 0.12),
    TorsionHypothesis(math.radians(40.0), 0.0, 0.15, 0.25),
    TorsionHypothesis(0.0, 0.006, 0.003, 0.11),
)
"""None, a small and a large play, lag. Each one's size is estimated."""
ROLL_HYPOTHESES = tuple(
    RollHypothesis(math.radians(roll), math.radians(16.0), weight)
    for roll, weight in (
        (0.0, 0.24),
        (30.0, 0.21),
        (-30.0, 0.21),
        *((float(roll), 0.038) for roll in (60, -60, 90, -90, 120, -120, 150, -150, 180)),
    )
)
"""Most likely as the base puts it, to some 30 deg; else anywhere. Narrow ones, for a filter that is
linear in the roll knows less than it thinks when its roll is wide."""


@dataclasses.dataclass(frozen=True)
class FilterSettings:
    """What the filter assumes.

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
    tip_noise_bound : float
        Largest error of a measured coordinate where a tip comes without covariance [m].
    tip_noise_softness : float
        Standard deviation by which that bound is blurred [m].
    model_error : float
        What the model leaves out of a tip's position [m]. A better sensor is not believed beyond
        it: a filter that is linear in the roll would hold a wrong one for certain. Its square is
        added to a tip's covariance, and a bound is taken as at least twice as large.
    surprise : float
        Probability of a measured coordinate that a hypothesis does not explain: a single tip is no
        proof against it, for its distribution is not as Gaussian as it is taken to be.
    initial_angle_std : float
        How well pitch and yaw at the entry are known [rad].
    orientation_drift : float
        Growth of the orientation's standard deviation over a metre [rad/sqrt(m)].
    play_drift, lag_drift : float
        Growth of the standard deviations of play [rad/sqrt(m)] and lag length [sqrt(m)] over a
        metre, where they are estimated: what keeps them open for what the model does not know.
    gate : float
        A tip is refused whose squared Mahalanobis distance is above this for every hypothesis.
    tips_until_reacceptance : int
        After so many refused tips in a row the next one is taken all the same.
    lost_below : float
        When the running mean of the tips' log likelihood falls below this, no hypothesis is right
        and all of them start over.
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
    torsion_hypotheses, roll_hypotheses : tuple
        Every torsion is tried with every roll.
    """

    curvature: float = bounded(1.0 / 0.122, 0.1, 100.0, "1/m")
    curvature_spread: float = bounded(0.22, 0.0, 1.0, "-")
    curvature_range: tuple[float, float] = (0.5, 1.6)
    curvature_drift: float = bounded(0.02 * math.sqrt(1000.0), 0.0, 100.0, "1/sqrt(m)")
    tip_noise_bound: float = bounded(0.001, 1e-6, 0.1, "m")
    tip_noise_softness: float = bounded(0.00003, 0.0, 0.1, "m")
    model_error: float = bounded(0.0001, 0.0, 0.1, "m")
    surprise: float = bounded(0.02, 1e-9, 1.0, "-")
    initial_angle_std: float = bounded(math.radians(8.0), 1e-6, math.pi, "rad")
    orientation_drift: float = bounded(math.sqrt(0.001), 0.0, 100.0, "rad/sqrt(m)")
    play_drift: float = bounded(0.2, 0.0, 100.0, "rad/sqrt(m)")
    lag_drift: float = bounded(0.003, 0.0, 1.0, "sqrt(m)")
    gate: float = bounded(30.0, 1.0, 1e9, "-")
    tips_until_reacceptance: int = bounded(4, 1, 1000, "-")
    lost_below: float = bounded(-2.2, -1e9, -0.1, "-")
    prune_ratio: float = bounded(math.exp(6.0), 1.0, 1e30, "-")
    merge_angle: float = bounded(0.35, 0.0, math.pi, "rad")
    longest_step: float = bounded(0.002, 1e-5, 1.0, "m")
    play_limit: float = bounded(1.0, 0.0, math.pi, "rad")
    lag_range: tuple[float, float] = (0.001, 0.016)
    torsion_hypotheses: tuple[TorsionHypothesis, ...] = TORSION_HYPOTHESES
    roll_hypotheses: tuple[RollHypothesis, ...] = ROLL_HYPOTHESES

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
        if not (self.torsion_hypotheses and self.roll_hypotheses):
            raise UserError("torsion_hypotheses and roll_hypotheses want at least one each")

    @property
    def believed_bound(self) -> float:
        """Largest error of a measured coordinate that is reckoned with [m]."""
        return max(self.tip_noise_bound, 2.0 * self.model_error)

    def limits(self) -> Limits:
        """Return what the compiled code needs of this."""
        return Limits(
            orientation_noise=self.orientation_drift**2,
            curvature_noise=(self.curvature_drift * self.curvature) ** 2,
            play_noise=self.play_drift**2,
            lag_noise=self.lag_drift**2,
            smallest_curvature=self.curvature_range[0] * self.curvature,
            largest_curvature=self.curvature_range[1] * self.curvature,
            largest_play=self.play_limit,
            smallest_lag=self.lag_range[0],
            largest_lag=self.lag_range[1],
            smallest_weight=1.0 / self.prune_ratio,
            merge_angle=self.merge_angle,
            gate=self.gate,
            tips_until_reacceptance=self.tips_until_reacceptance,
            surprise=self.surprise,
            longest_step=self.longest_step,
        )
