"""Settings of the tracker beside the calibration."""

from __future__ import annotations

import dataclasses

from needle_tracker.image.detection import Image
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
    bevel_length : float
        Of its ground face, along the shaft [m]; 0 where unknown.
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
    reference : pair of ndarray of uint8, shape (height, width), or None
        Left and right image of the phantom without needle; None: taken as they come.
    """

    gates: GateSettings
    needle_width: float
    bevel_length: float
    bright: bool | None
    min_contrast: float
    noise_factor: float
    entry_zone: float
    hole_clearance: float
    reference: tuple[Image, Image] | None = dataclasses.field(default=None, compare=False)
