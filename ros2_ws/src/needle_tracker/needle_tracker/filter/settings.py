"""Settings of the tracker beside the calibration, and the numbers of its filter."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.reach import Reach
from needle_tracker.optics.window import Window

Image = NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class FilterSettings:
    """Numbers of the filter over time.

    Attributes
    ----------
    slip_sigma : float
        Of the way the tip goes per way of the base: needle and gel give [-].
    drift_sigma : float
        Of the tip between two pairs at rest [m].
    free_step : float
        Way between two pairs where the insertion is unknown [m], standard deviation.
    rest_probability : float
        That the needle rests between two pairs where the insertion is unknown.
    jump_density : float
        Probability per metre that what is no needle ends elsewhere in the next pair [1/m].
    prior_log_odds : float
        Of a pair of ends that meet to be an end, before the network is asked: from 231 sightings in
        path-traced pairs (logistic regression, which gave the evidence a weight of 1).
    repeat_weight : float
        Share of a look's evidence that is new, since looks in a row show much the same.
    miss_cost : float
        Log-odds that a track loses by a pair that does not show it.
    max_log_odds : float
        Largest size of a track's log-odds: no evidence is beyond doubt.
    accepted : float
        Probability from which on a track is believed.
    end_sigma : float
        Of the needle's end along it, alike in both views and from pair to pair: what a bevel and
        its light hide [needle widths], from errors in path-traced pairs.
    max_sigma : float
        A tip known worse than that in any direction is not told [m].
    lost_after, forgotten_after : int
        Pairs in a row without a sighting until a track is lost, and forgotten.
    """

    slip_sigma: float = 0.05
    drift_sigma: float = 0.02e-3
    free_step: float = 4.0e-3
    rest_probability: float = 0.5
    jump_density: float = 10.0
    prior_log_odds: float = -1.0
    repeat_weight: float = 0.1
    miss_cost: float = 0.5
    max_log_odds: float = 8.0
    accepted: float = 0.85
    end_sigma: float = 0.3
    max_sigma: float = 0.8e-3
    lost_after: int = 10
    forgotten_after: int = 30


@dataclasses.dataclass(frozen=True)
class TrackerSettings:
    """Everything that the tracker is told beside the calibration.

    Attributes
    ----------
    reach : Reach
        What the needle can do.
    windows : tuple of Window
        What the cameras look through.
    needle_width : float
        Diameter of the needle, good to 30 % [m].
    tip_lean : float
        Largest angle between the visible end and the needle's path (pre-bend) [rad].
    entry_zone : float
        Insertion below which the tip of a needle that is not seen follows from the insertion [m].
    hole_clearance : float
        Radius around the entry that is not looked at [m].
    stage_zero_sigma : float
        Standard deviation of the insertion at which the tip is at the entry [m].
    stage_scale_sigma : float
        Standard deviation of the insertion's scale [-].
    filter : FilterSettings
        Numbers of the filter.
    reference : pair of ndarray of uint8, shape (height, width), or None
        Left and right image of the phantom without needle.
    """

    reach: Reach
    windows: tuple[Window, ...]
    needle_width: float
    tip_lean: float
    entry_zone: float
    hole_clearance: float
    stage_zero_sigma: float
    stage_scale_sigma: float
    filter: FilterSettings = dataclasses.field(default_factory=FilterSettings)
    reference: tuple[Image, Image] | None = dataclasses.field(default=None, compare=False)
