"""Constants of the filter over time."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class FilterSettings:
    """Constants of the filter over time; odds are natural logarithms.

    Attributes
    ----------
    slip_sigma : float
        Standard deviation of the ratio of tip travel to base travel [-]: needle and gel yield.
    drift_sigma : float
        Standard deviation of the motion of the tip between two pairs at rest [m].
    free_step : float
        Standard deviation of the travel between two pairs if the insertion is unknown [m].
    chance_density : float
        Density of the next end of an object other than the needle, if it ends elsewhere in the next
        pair [1/m^3]: once per metre along the needle, within 0.3 mm across.
    other_log_odds : float
        Log-odds of the needle against the end of another object, before it moves: in 57 path-traced
        pairs without a needle, half of them with earlier paths, no end has evidence above 0.2.
    shadow_log_odds : float
        Log-odds of a needle against its own shadow or mirror image.
    shadow_length : float
        Log-odds of the length of a shadow, within 10 % of that of its needle, against any distance.
    length_sigma : float
        Standard deviation of the length of the shaft [m], from path-traced pairs.
    evidence_length : float
        Travel of the tip over which the images become independent [m]: a repeated image is no
        further evidence.
    miss_cost : float
        Log-odds that a track loses in a pair that does not show it.
    max_log_odds : float
        Largest absolute log-odds of a track.
    accepted : float
        Probability above which a track is accepted as the needle: in 2,250 pairs of the quick
        renderer and 50 path-traced ones, no additional wrong tip has a probability above 0.55.
    end_sigma : float
        Standard deviation of the end along the needle that both views and all pairs share, since a
        bevel and its lighting hide part of it [needle widths]: from errors in path-traced pairs.
    max_sigma : float
        Largest standard deviation of a published tip, in any direction [m].
    lost_after : int
        Consecutive pairs without a sighting after which a track is lost.
    """

    slip_sigma: float = 0.05
    drift_sigma: float = 0.02e-3
    free_step: float = 4.0e-3
    chance_density: float = 1.8e6
    other_log_odds: float = 2.0
    shadow_log_odds: float = 3.0
    shadow_length: float = 2.5
    length_sigma: float = 0.4e-3
    evidence_length: float = 10e-3
    miss_cost: float = 0.5
    max_log_odds: float = 8.0
    accepted: float = 0.7
    end_sigma: float = 0.3
    max_sigma: float = 0.8e-3
    lost_after: int = 10

    @property
    def forgotten_after(self) -> float:
        """Consecutive misses that outweigh any evidence, after which a track is dropped."""
        return 2.0 * self.max_log_odds / self.miss_cost


FILTER = FilterSettings()
