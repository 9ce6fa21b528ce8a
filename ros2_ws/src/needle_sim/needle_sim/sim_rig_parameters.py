"""Parameters of sim_rig."""

from __future__ import annotations

import dataclasses
import math

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_device_driver.supervisor.limits import (
    SafetyLimits,
    limit_parameter,
)
from needle_sim.camera.scenarios import CLEAN, SCENARIOS
from needle_sim.needle.needle_shape import NeedleShape

LEVELS = ("tip", "camera", "drive")


@dataclasses.dataclass(frozen=True)
class SimRigParameters:
    """Parameters of sim_rig, fixed at the start."""

    level: str = fixed_parameter(
        "camera",
        "-",
        "tip: measured tips; camera: stereo images; drive: stereo images and emulated drives.",
        choices=LEVELS,
    )
    seed: int = fixed_parameter(
        0, "-", "Seed of all random numbers; the same seed gives the same run.", 0, 2**31 - 1
    )
    curvature: float = fixed_parameter(
        1.0 / 0.122, "1/m", "Curvature of the needle's path in this tissue.", 0.0, 100.0
    )
    needle_diameter: float = fixed_parameter(
        NeedleShape.diameter, "m", "Diameter of the needle in the images.", 0.2e-3, 3e-3
    )
    pre_bend: float = fixed_parameter(
        NeedleShape.bend_angle,
        "rad",
        "Angle between the shaft and the pre-bent end; 0: straight needle.",
        0.0,
        0.5,
    )
    pre_bend_distance: float = fixed_parameter(
        NeedleShape.bend_distance, "m", "Distance from the bend to the tip.", 1e-3, 0.05
    )
    pre_bend_lean: float = fixed_parameter(
        NeedleShape.lean,
        "rad",
        "Angle of the pre-bent end to the heading, below pre_bend; the shaft takes the rest.",
        0.0,
        0.5,
    )
    initial_pitch: float = fixed_parameter(
        0.0, "rad", "Pitch of the needle at its entry point.", -math.pi / 2, math.pi / 2
    )
    initial_roll: float = fixed_parameter(
        0.0, "rad", "Roll of the bevel at the entry point.", -math.pi, math.pi
    )
    tip_noise: float = fixed_parameter(
        0.001, "m", "Level tip: maximum error of each measured coordinate (uniform).", 0.0, 0.1
    )
    torsion_play: float = fixed_parameter(
        0.0, "rad", "Dead band between base and tip angle, in either direction.", 0.0, math.pi
    )
    torsion_lag: float = fixed_parameter(
        0.0, "m", "First-order lag of the tip angle, as inserted length.", 0.0, 1.0
    )
    camera_rate: float = fixed_parameter(
        10.0,
        "Hz",
        "Exposure rate while the controller waits for a tip or inserts continuously.",
        0.1,
        50.0,
    )
    calibration_file: str = fixed_parameter(
        "", "-", "Calibration file of the simulated cameras; empty: that of needle_tracker."
    )
    scenario: str = fixed_parameter(
        CLEAN.name, "-", "Disturbances of the images.", choices=tuple(SCENARIOS)
    )
    images: str = fixed_parameter(
        "", "-", "New folder for all images, calibration, insertions and true tips; empty: none."
    )
    max_depth: float = limit_parameter("max_depth")
    max_step_length: float = limit_parameter("max_step_length")
    max_speed: float = limit_parameter("max_speed")
    max_rotation_step: float = limit_parameter("max_rotation_step")
    max_rotation_rate: float = limit_parameter("max_rotation_rate")
    max_turns: float = limit_parameter("max_turns")
    hold_timeout: float = limit_parameter("hold_timeout")
    tip_age_limit: float = limit_parameter("tip_age_limit")
    retraction_speed: float = limit_parameter("retraction_speed")

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises
        ------
        UserError
            If a parameter is out of bounds, the needle's bend is invalid, or a level without
            images has image parameters.
        """
        check_fields(self)
        _ = self.needle
        if self.level == "tip" and self.scenario != CLEAN.name:
            raise UserError(f"scenario = {self.scenario!r}: level tip has no images")
        if self.level == "tip" and self.images:
            raise UserError(f"images = {self.images!r}: level tip has no images")

    @property
    def needle(self) -> NeedleShape:
        """Shape of the needle."""
        return NeedleShape(
            self.needle_diameter, self.pre_bend, self.pre_bend_distance, self.pre_bend_lean
        )

    @property
    def limits(self) -> SafetyLimits:
        """Limits of the motion supervisor."""
        return SafetyLimits.of(self)
