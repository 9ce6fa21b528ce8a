"""The parameters of plane_controller."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_common.errors import UserError
from needle_common.settings.parameter_fields import check_fields, parameter
from needle_controller.laws.flip_plan import FlipPlan
from needle_controller.model.target_plane import TargetPlane, check_within_reach, offset_plane
from needle_controller.presets.control_settings import PRESETS, TIP_NOISES, ControlSettings
from needle_controller.presets.presets import make_controller
from needle_controller.protocol.plane_control import PlaneControl
from needle_controller.protocol.steering import Steering
from needle_controller.protocol.steering_types import TIP_COVARIANCES, SteeringSettings


@dataclasses.dataclass(frozen=True)
class PlaneControllerParameters:
    """All of them; a change is taken as a whole or refused.

    Raises
    ------
    UserError
        A value out of its bounds, or weights that give no stable gains.
    """

    preset: str = parameter(
        ControlSettings.preset,
        unit="-",
        description="best = hypothesis filter and roll law, paper = observer and law of [KC09], "
        "open_loop = no rotation; for comparison: kalman = time-varying gain and that law, "
        "measured_pitch = reduced-order observer (wants tip_covariance from_tip_pose), "
        "extended_kalman and orientation_fit = estimators of the full pose and roll law.",
        choices=PRESETS,
    )
    curvature: float = parameter(
        ControlSettings.curvature,
        unit="1/m",
        description="Curvature of the needle's path in the tissue.",
        lower=0.1,
        upper=100.0,
    )
    target_offset: float = parameter(
        0.0,
        unit="m",
        description="x of the wanted plane in rig, until a target_plane is given.",
        lower=-0.1,
        upper=0.1,
    )
    depth: float = parameter(
        0.12,
        unit="m",
        description="Insertion at which steering is done.",
        lower=0.0,
        upper=1.0,
    )
    step_length: float = parameter(
        ControlSettings.step_length,
        unit="m",
        description="Insertion of one step; the last one ends at the depth.",
        lower=1e-4,
        upper=0.01,
    )
    nominal_speed: float = parameter(
        0.002,
        unit="m/s",
        description="Insertion speed at speed scale 1.",
        lower=1e-5,
        upper=0.05,
    )
    max_rotation_per_length: float = parameter(
        ControlSettings.max_rotation_per_length,
        unit="rad/m",
        description="Most the base is turned per inserted length.",
        lower=0.0,
        upper=1000.0,
    )
    max_winding: float = parameter(
        ControlSettings.max_winding,
        unit="rad",
        description="The roll law keeps rotation_joint within +- this: beyond, it turns the other "
        "way round. (The law of [KC09] never winds up.)",
        lower=2.0 * math.pi,
        upper=1000.0,
    )
    tip_timeout: float = parameter(
        2.0,
        unit="s",
        description="Time without a good tip (steady clock) until WAITING_FOR_TIP.",
        lower=0.01,
        upper=60.0,
    )
    tip_covariance: str = parameter(
        "from_tip_pose",
        unit="-",
        description="from_tip_pose = a tip has the covariance of the needle/tip_pose with its "
        "stamp plus measurement_std squared, and is refused without one; configured = every tip "
        "has the noise of tip_noise: for a source of needle/tip alone.",
        choices=TIP_COVARIANCES,
    )
    result_timeout: float = parameter(
        10.0,
        unit="s",
        description="Time without device/result (steady clock) until FAULT, the device at rest.",
        lower=0.1,
        upper=600.0,
    )
    tip_margin: float = parameter(
        0.004,
        unit="m",
        description="What noise may add to a tip's distance from where the needle can be.",
        lower=0.0,
        upper=0.1,
    )
    needle_out_insertion: float = parameter(
        0.002,
        unit="m",
        description="Insertion up to which the needle counts as out.",
        lower=0.0,
        upper=0.01,
    )
    retraction_tolerance: float = parameter(
        0.0002,
        unit="m",
        description="Backward motion that counts as a retraction.",
        lower=1e-6,
        upper=0.01,
    )
    tip_noise: str = parameter(
        "normal",
        unit="-",
        description="Where tip_covariance is configured: a coordinate is off by up to "
        "tip_noise_bound (bounded, used as such by best), or "
        "with standard deviation measurement_std (normal).",
        choices=TIP_NOISES,
    )
    tip_noise_bound: float = parameter(
        ControlSettings.tip_noise_bound,
        unit="m",
        description="Largest error of one measured tip coordinate, where tip_noise is bounded.",
        lower=1e-6,
        upper=0.1,
    )
    flip_depths: tuple[float, ...] = parameter(
        ControlSettings.flip_depths,
        unit="m",
        description="Insertions at which the bevel is flipped within the plane, increasing; not "
        "with presets paper and open_loop.",
        lower=0.0,
        upper=1.0,
    )
    wait_for_recorder: bool = parameter(
        False,
        unit="-",
        read_only=True,
        description="Steering starts only when a node named recorder listens to everything and all "
        "partners know this node.",
    )
    state_weights: tuple[float, ...] = parameter(
        ControlSettings.state_weights,
        unit="1/m^2, -, m^2",
        description="Cost of s1^2, s2^2, s3^2 per inserted length.",
        lower=0.0,
    )
    input_weight: float = parameter(
        ControlSettings.input_weight,
        unit="m^4",
        description="Cost of v^2 per inserted length.",
        lower=0.0,
    )
    process_noise: tuple[float, ...] = parameter(
        ControlSettings.process_noise,
        unit="m, 1/m, 1/m^3",
        description="Variance per metre of white noise on the derivatives of s, for the observer.",
        lower=0.0,
    )
    measurement_std: float = parameter(
        1e-4,
        unit="m",
        description="Standard deviation of one measured tip coordinate; with tip_covariance "
        "from_tip_pose of what its covariance leaves out.",
        lower=1e-7,
        upper=0.1,
    )
    saturation_margin: float = parameter(
        ControlSettings.saturation_margin,
        unit="-",
        description="The estimate is kept within s2^2 + (s3/curvature)^2 <= 1 - this.",
        lower=1e-6,
        upper=0.9,
    )
    demand_margin: float = parameter(
        ControlSettings.demand_margin,
        unit="-",
        description="The state the law demands is kept within s2^2 + (s3/curvature)^2 <= 1 - this.",
        lower=1e-6,
        upper=0.9,
    )
    initial_yaw_std: float = parameter(
        ControlSettings.initial_yaw_std,
        unit="rad",
        description="How well the yaw at the entry is known (covariance only).",
        lower=0.0,
        upper=math.pi,
    )
    initial_pitch_std: float = parameter(
        ControlSettings.initial_pitch_std,
        unit="rad",
        description="How well the pitch at the entry is known (covariance only).",
        lower=0.0,
        upper=math.pi,
    )
    initial_roll_std: float = parameter(
        ControlSettings.initial_roll_std,
        unit="rad",
        description="How well the roll at the entry is known (covariance only).",
        lower=0.0,
        upper=math.pi,
    )

    def __post_init__(self) -> None:
        """Check the whole, gains included."""
        check_fields(self)
        for name in ("state_weights", "process_noise"):
            numbers = getattr(self, name)
            if len(numbers) != 3:
                raise UserError(f"{name} = {list(numbers)}, wants three numbers, for s1, s2, s3")
        if self.preset == "measured_pitch" and self.tip_covariance != "from_tip_pose":
            raise UserError(
                "preset measured_pitch takes the pitch from needle/tip_pose: wants tip_covariance "
                f"from_tip_pose, is {self.tip_covariance}"
            )
        self.check_plane(self.plane())
        FlipPlan(self.flip_depths).check_within(self.depth)
        self.control().gains()
        make_controller(self.control(), np.eye(3))

    def control(self) -> ControlSettings:
        """Return what estimator and law are made of."""
        return ControlSettings(
            **{f.name: getattr(self, f.name) for f in dataclasses.fields(ControlSettings)}
        )

    def plane(self) -> TargetPlane:
        """Return the wanted plane, until another one is given."""
        return offset_plane(self.target_offset)

    def check_plane(self, plane: TargetPlane) -> None:
        """Refuse a wanted plane that is out of reach; raises UserError."""
        check_within_reach(plane, self.curvature, self.depth)

    def steering(self) -> SteeringSettings:
        """Return the step protocol's numbers."""
        return SteeringSettings(
            **{f.name: getattr(self, f.name) for f in dataclasses.fields(SteeringSettings)}
        )

    def make_steering(self) -> Steering:
        """Return a step protocol with its estimator and law."""
        return Steering(self.steering(), PlaneControl(self.control(), self.plane()))

    def change_steering(self, steering: Steering, before: PlaneControllerParameters) -> None:
        """Have a step protocol that was made or changed by `before` go on with these parameters.

        A plane that was given meanwhile stays, unless `target_offset` is another.
        """
        steering.settings = self.steering()
        steering.control.configure(self.control())
        if self.target_offset != before.target_offset:
            steering.control.plane = self.plane()
