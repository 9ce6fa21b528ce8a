"""Parameters of stereo_tracker, as a node and in `track_images`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_tracker.sources.image_files import Image, Sizes, mean_pair

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class StereoTrackerParameters:
    """Parameters of the node, fixed at start."""

    calibration_file: str = fixed_parameter(
        "", "-", "Calibration file of the stereo rig; empty: the simulated bench's."
    )
    reference_folder: str = fixed_parameter(
        "",
        "-",
        "Folder with left/ and right/, images of the phantom without needle from just before the "
        "recording; empty: use the pairs before each insertion.",
    )
    reliable_images: bool = fixed_parameter(
        True, "-", "Subscribe to images reliably (simulation); false: best effort (hardware)."
    )
    pair_tolerance: float = fixed_parameter(
        0.0, "s", "Maximum difference of the stamps of a pair's images.", 0.0, 0.1
    )
    free_running: bool = fixed_parameter(
        False,
        "-",
        "The cameras are not synchronized: pair images whose stamps differ by up to half a frame, "
        "and ignore pair_tolerance.",
    )
    joint_timeout: float = fixed_parameter(
        1.0, "s", "Maximum wait of a pair for the joint state after it.", 0.0, 60.0
    )
    needle_width: float = fixed_parameter(
        0.7e-3, "m", "Diameter of the needle, within 30 %.", 0.2e-3, 3e-3
    )
    entry_zone: float = fixed_parameter(
        8e-3,
        "m",
        "Below this insertion, the tip of an invisible needle is computed from the insertion.",
        0.0,
        0.05,
    )
    hole_clearance: float = fixed_parameter(
        2.0e-3, "m", "Radius around the entry point that is not searched (hole, rim).", 0.5e-3, 0.02
    )
    hole_tolerance: float = fixed_parameter(
        0.5e-3, "m", "Maximum distance of the needle from the entry point.", 0.01e-3, 5e-3
    )
    entry_angle: float = fixed_parameter(
        0.1745, "rad", "Maximum angle between needle and rig's z axis at the entry.", 0.0, 0.7
    )
    max_curvature: float = fixed_parameter(
        9.0, "1/m", "Maximum curvature of the needle's path.", 0.1, 50.0
    )
    max_insertion: float = fixed_parameter(
        0.15, "m", "Maximum insertion; the search ends at this distance from the entry.", 0.01, 1.0
    )
    stage_zero_sigma: float = fixed_parameter(
        0.5e-3, "m", "Standard deviation of the stage's zero from the entry.", 0.01e-3, 5e-3
    )
    stage_scale_sigma: float = fixed_parameter(
        0.01, "-", "Standard deviation of the insertion's scale.", 1e-4, 0.1
    )
    tip_lean: float = fixed_parameter(
        0.21, "rad", "Maximum angle between visible end and path (pre-bend).", 0.0, 0.8
    )
    annotated_rate: float = fixed_parameter(
        2.0, "Hz", "Maximum rate of annotated images, if subscribed to; 0: none.", 0.0, 100.0
    )

    def __post_init__(self) -> None:
        """Check the fields and their relations."""
        check_fields(self)
        if self.hole_clearance >= self.max_insertion:
            raise UserError(
                f"hole_clearance = {self.hole_clearance:g} m is not below "
                f"max_insertion = {self.max_insertion:g} m"
            )

    @property
    def pair_tolerance_ns(self) -> int | None:
        """Largest difference of the stamps of a pair [ns]; None for free-running cameras."""
        return None if self.free_running else round(self.pair_tolerance * 1e9)

    def reference(self, sizes: Sizes) -> tuple[Image, Image] | None:
        """Return the images of the phantom without needle in `reference_folder`, if any.

        Parameters
        ----------
        sizes : dict of str to (int, int)
            Width and height of the images of each side [px].

        Raises
        ------
        UserError
            Images that are missing or unusable.
        """
        folder = Path(self.reference_folder)
        return (
            mean_pair(folder / "left", folder / "right", sizes) if self.reference_folder else None
        )

    def shortest_chord(self, insertion: float) -> float:
        """Return the least distance of tip and entry [m] after `insertion` [m] along one arc."""
        half_turn = min(0.5 * self.max_curvature * insertion, math.pi / 2)
        return 2.0 * math.sin(half_turn) / self.max_curvature

    def chord_angle(self, distance: Array) -> Array:
        """Return the largest angle to z [rad] of a point of the needle at `distance` [m]."""
        turned = np.arcsin(np.clip(0.5 * self.max_curvature * distance, 0.0, 1.0))
        hole = np.arctan2(self.hole_tolerance, distance)
        return np.asarray(self.entry_angle + turned + hole)
