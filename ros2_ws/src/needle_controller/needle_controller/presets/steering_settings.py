"""Settings of steering, which are the parameters of plane_controller."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.laws.roll_law import check_flips
from needle_controller.model.arrays import Array
from needle_controller.model.gains import Gains, design_gains
from needle_controller.model.reachability import check_plane, check_point
from needle_controller.model.target_plane import TargetPlane, offset_plane
from needle_controller.presets.own_parts import GROUPS, check_registered, own_part
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter, parameter

ONE_SIDED_PRESETS = ("paper", "open_loop")
"""Presets whose coordinates are limited to roll +-90 deg: they cannot steer to a point."""
PRESETS = ("best", *ONE_SIDED_PRESETS)
_HEADING_NEEDS = "tip_covariance from_tip_pose, and preset best or an own estimator"
PAPER_NOISE: dict[str, Any] = {
    "tip_covariance": "configured",
    "tip_noise": "bounded",
    "tip_noise_bound": 0.001,
    "measurement_std": 0.001 / math.sqrt(3.0),
}
"""Uniform errors of the coordinates up to 1 mm, as in the simulations of [KC09]."""


@dataclasses.dataclass(frozen=True)
class SteeringSettings:
    """Settings of estimator, law and step protocol.

    Raises
    ------
    UserError
        A value out of its bounds, weights without stable gains, or mutually exclusive settings.
    """

    preset: str = parameter(
        "best",
        "-",
        "best: hypothesis filter and roll law; paper: observer and law of [KC09]; open_loop: no "
        "rotation.",
        choices=PRESETS,
    )
    estimator: str = fixed_parameter(
        "",
        "-",
        "Estimator of another package (entry point group needle_controller.estimators; "
        "docs/own_controllers.md); empty: the preset's.",
    )
    law: str = fixed_parameter("", "-", "Control law, likewise (group needle_controller.laws).")
    planner: str = fixed_parameter(
        "", "-", "Planner of paths to a point, likewise (group needle_controller.planners)."
    )
    seed: int = fixed_parameter(0, "-", "Seed of another package's estimator.", 0, 2**31 - 1)
    curvature: float = parameter(1 / 0.122, "1/m", "Curvature of the needle's path.", 0.1, 100.0)
    needle_diameter: float = fixed_parameter(
        0.0007, "m", "Diameter of the needle, for the distance to obstacles.", 0.2e-3, 3e-3
    )
    goal_tolerance: float = parameter(
        0.001, "m", "Accepted distance of a path around obstacles from its target point.", 0.0, 0.01
    )
    target_offset: float = parameter(
        0.0, "m", "x of the target plane in rig, until a target_plane is received.", -0.1, 0.1
    )
    target_point: tuple[float, ...] = parameter(
        (),
        "m",
        "x, y, z in rig of the target point, until a target_point or target_plane is received; "
        "empty: steer to the plane. Not with flip_depths; only with presets that estimate the "
        "whole pose.",
        -1.0,
        1.0,
    )
    obstacles: tuple[float, ...] = parameter(
        (),
        "m",
        "Obstacles on the way to a point, until obstacles are received: 7 numbers each, x, y, z in "
        "rig of both ends of the axis, and the radius.",
        -1.0,
        1.0,
    )
    depth: float = parameter(
        0.12, "m", "Insertion at which steering ends; to a point: the maximum.", 0.0, 1.0
    )
    step_length: float = parameter(
        0.001, "m", "Insertion per step; the last step ends at the depth.", 1e-4, 0.01
    )
    insertion: str = fixed_parameter(
        "stepwise",
        "-",
        "stepwise: the needle rests after each step until its tip is measured; continuous: it "
        "advances during the hold, and every tip updates the path ahead.",
        choices=("stepwise", "continuous"),
    )
    horizon: float = parameter(
        0.002,
        "m",
        "Continuous insertion: length of the path beyond the newest tip, and so the maximum "
        "advance; at most the device's max_step_length.",
        2e-4,
        0.005,
    )
    nominal_speed: float = parameter(0.002, "m/s", "Insertion speed at speed scale 1.", 1e-5, 0.05)
    max_rotation_per_length: float = parameter(
        math.radians(30.0) / 0.001, "rad/m", "Maximum base rotation per inserted length.", 0.0, 1e3
    )
    max_winding: float = parameter(
        6.0 * math.pi,
        "rad",
        "The roll law keeps rotation_joint within +- this value: it then turns the other way. (The "
        "law of [KC09] never winds up.)",
        2.0 * math.pi,
        1000.0,
    )
    rotation_budget: float = parameter(
        1e6,
        "rad",
        "Maximum total rotation of the base, in both directions, on the way to a point; a lower "
        "value means fewer corrections. Not used with obstacles.",
        0.0,
        1e6,
    )
    tip_timeout: float = parameter(
        2.0, "s", "Time without a valid tip until WAITING_FOR_TIP (monotonic clock).", 0.01, 60.0
    )
    tip_covariance: str = parameter(
        "from_tip_pose",
        "-",
        "from_tip_pose: the covariance of the needle/tip_pose with the tip's stamp, plus "
        "measurement_std squared; a tip without one is rejected. configured: the noise of "
        "tip_noise, for a source that only publishes needle/tip.",
        choices=("configured", "from_tip_pose"),
    )
    measured_heading: bool = fixed_parameter(
        False,
        "-",
        "Also use the heading of needle/tip_pose: of a sensor in the tip, not of stereo_tracker, "
        f"whose heading is that of the pre-bent end. Needs {_HEADING_NEEDS}.",
    )
    result_timeout: float = parameter(
        10.0, "s", "Time at rest without device/result until FAULT (monotonic clock).", 0.1, 600.0
    )
    tip_margin: float = parameter(
        0.004, "m", "Accepted distance of a measured tip from the needle's reach.", 0.0, 0.1
    )
    needle_out_insertion: float = parameter(
        0.002, "m", "Up to this insertion the needle counts as out of the phantom.", 0.0, 0.01
    )
    retraction_tolerance: float = parameter(
        0.0002, "m", "Minimum backward motion that counts as a retraction.", 1e-6, 0.01
    )
    tip_noise: str = parameter(
        "normal",
        "-",
        "Noise of each coordinate if tip_covariance is configured. bounded: errors up to "
        "tip_noise_bound (best uses this bound); normal: standard deviation measurement_std.",
        choices=("bounded", "normal"),
    )
    tip_noise_bound: float = parameter(
        0.001, "m", "Maximum error of a measured tip coordinate if tip_noise is bounded.", 1e-6, 0.1
    )
    flip_depths: tuple[float, ...] = parameter(
        (),
        "m",
        "Insertions at which the bevel is flipped within the plane, in increasing order; not with "
        "presets paper and open_loop.",
        0.0,
        1.0,
    )
    state_weights: tuple[float, ...] = parameter(
        (1.0e6, 280.0, 0.0), "1/m^2, -, m^2", "Cost of s1^2, s2^2, s3^2 per inserted length.", 0.0
    )
    input_weight: float = parameter(2.9e-10, "m^4", "Cost of v^2 per inserted length.", 0.0)
    process_noise: tuple[float, ...] = parameter(
        (5.0e-7, 0.13, 24.0),
        "m, 1/m, 1/m^3",
        "Observer: variance per metre of white noise on the derivatives of s1, s2, s3.",
        0.0,
    )
    measurement_std: float = parameter(
        1e-4,
        "m",
        "Standard deviation of a measured tip coordinate; with tip_covariance from_tip_pose, of "
        "the errors that its covariance does not contain.",
        1e-7,
        0.1,
    )
    saturation_margin: float = parameter(
        0.11, "-", "Limits the estimate to s2^2 + (s3/curvature)^2 <= 1 - this value.", 1e-6, 0.9
    )
    demand_margin: float = parameter(
        0.26, "-", "Limits the demanded state, as saturation_margin the estimate.", 1e-6, 0.9
    )
    entry_angle_std: float = parameter(
        math.radians(8.0),
        "rad",
        "Standard deviation of pitch and yaw at the entry, for preset best and for paths.",
        1e-3,
        math.pi,
    )

    def __post_init__(self) -> None:
        """Check all settings, and the gains of presets that have any."""
        check_fields(self)
        for name in ("state_weights", "process_noise"):
            numbers = getattr(self, name)
            if len(numbers) != 3:
                raise UserError(f"{name} = {list(numbers)}, expected three numbers, for s1, s2, s3")
        for kind in GROUPS:
            if name := getattr(self, kind):
                check_registered(kind, name)
        self.check_plane(self.plane())
        if self.target_point:
            if len(self.target_point) != 3:
                raise UserError(f"target_point = {list(self.target_point)}, expected x, y and z")
            self.check_point(self.target_point)
        if len(self.obstacles) % 7:
            raise UserError(f"obstacles has {len(self.obstacles)} numbers, expected 7 for each")
        check_flips(self.flip_depths, self.depth)
        if self.flip_depths and self.law:
            raise UserError(f"flip_depths apply to the law of best only, not to law {self.law}")
        if self.flip_depths and self.preset in ONE_SIDED_PRESETS:
            raise UserError(
                f"flip_depths: preset {self.preset} cannot steer with the bevel flipped (its "
                "coordinates end at roll +-90 deg); best can"
            )
        uses_heading = self.estimator or self.preset not in ONE_SIDED_PRESETS
        if self.measured_heading and not (uses_heading and self.tip_covariance == "from_tip_pose"):
            raise UserError(f"measured_heading needs {_HEADING_NEEDS}")
        if self.preset in ONE_SIDED_PRESETS:
            self.gains()

    def gains(self) -> Gains:
        """Return the gains that follow from the weights; see `design_gains`."""
        return design_gains(
            state_weights=self.state_weights,
            input_weight=self.input_weight,
            process_noise=self.process_noise,
            measurement_std=self.measurement_std,
            step_length=self.step_length,
        )

    @property
    def controller(self) -> str:
        """Name of the controller: the preset, and parts of other packages."""
        own = [f"{kind} {getattr(self, kind)}" for kind in GROUPS if getattr(self, kind)]
        return f"{self.preset} with {', '.join(own)}" if own else self.preset

    @property
    def turning(self) -> dict[str, float]:
        """Settings common to all laws that turn the bevel."""
        names = ("step_length", "max_rotation_per_length", "max_winding")
        return {name: getattr(self, name) for name in names}

    def configured_covariance(self) -> Array | None:
        """Return the configured covariance [m^2], shape (3, 3); None for bounded noise."""
        if self.tip_noise == "bounded":
            return None
        return np.asarray(np.eye(3) * self.measurement_std**2)

    def plane(self) -> TargetPlane:
        """Return the configured target plane."""
        return offset_plane(self.target_offset)

    def check_point(self, point: npt.ArrayLike) -> None:
        """Check that a point, (3,) in `rig` [m], can be reached; raises UserError."""
        self.check_steers_to_points()
        check_point(point, self.curvature, self.depth)

    def check_steers_to_points(self) -> None:
        """Check that preset, law and plan allow target points; raises UserError."""
        if self.law and not self.steers_to_points:
            raise own_part("law", self.law).error(
                "cannot steer to a point: it lacks to_point(estimate, target)"
            )
        if not self.steers_to_points:
            raise UserError(
                f"preset {self.preset} cannot steer to a point (it does not estimate the whole "
                "pose); best can"
            )
        if self.flip_depths:
            raise UserError("a target point and flip_depths do not go together")

    @property
    def steers_to_points(self) -> bool:
        """Whether the law can steer to points."""
        if self.law:
            return callable(getattr(own_part("law", self.law).cls, "to_point", None))
        return self.preset not in ONE_SIDED_PRESETS

    def check_plane(self, plane: TargetPlane) -> None:
        """Check that a target plane can be reached; raises UserError."""
        check_plane(plane, self.curvature, self.depth)
