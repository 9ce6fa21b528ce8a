"""What the tracker is told beside the calibration, and the defaults."""

from __future__ import annotations

import dataclasses

from needle_tracker.image.search_grid import Reach
from needle_tracker.optics.calibration import Phantom
from needle_tracker.tracking.gates import GateSettings


@dataclasses.dataclass(frozen=True)
class TrackerSettings:
    """Everything that the tracker is told beside the calibration.

    Attributes
    ----------
    gates : GateSettings
        Bounds that a believed tip keeps.
    needle_width : float
        Diameter of the needle [m].
    bright : bool or None
        Whether it is brighter than its surroundings; None: found out.
    min_contrast : float
        Least contrast [grey levels].
    noise_factor : float
        Ridge threshold in standard deviations of the noise.
    entry_zone : float
        Insertion below which the needle is not looked for [m].
    hole_clearance : float
        Radius around the entry that is not looked at [m].
    """

    gates: GateSettings
    needle_width: float
    bright: bool | None
    min_contrast: float
    noise_factor: float
    entry_zone: float
    hole_clearance: float


def default_settings(phantom: Phantom) -> TrackerSettings:
    """Return the settings for the needle of [KC09] section II (0.7 mm, 10 deg pre-bend).

    Parameters
    ----------
    phantom : Phantom
        From the calibration.

    Returns
    -------
    TrackerSettings
        The same as the node's defaults.
    """
    hole_clearance = 2.0e-3
    gates = GateSettings(
        reach=Reach(curvature=9.0, entry_angle=0.1745, hole_tolerance=0.5e-3, length=0.15),
        surface_height=phantom.surface_height,
        least_distance=hole_clearance + 1.5e-3,
        tip_lean=0.21,
        insertion_margin=2.0e-3,
        step_margin=1.0e-3,
        free_step=5.0e-3,
        max_disagreement=1.5e-3,
        max_miss_px=1.0,
        max_depth_sigma=0.5e-3,
        confirm_pairs=3,
        lost_after=10,
        forget_after=30,
    )
    return TrackerSettings(
        gates=gates,
        needle_width=0.7e-3,
        bright=None,
        min_contrast=10.0,
        noise_factor=5.0,
        entry_zone=4.5e-3,
        hole_clearance=hole_clearance,
    )
