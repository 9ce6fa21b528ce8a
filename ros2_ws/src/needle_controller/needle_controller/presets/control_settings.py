"""What estimator and law are made of."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.gains import Gains, design_gains

OTHER_PRESETS = ("kalman", "measured_pitch", "extended_kalman", "orientation_fit")
"""The other estimators, for comparison; see `other_presets`."""
PRESETS = ("best", "paper", "open_loop", *OTHER_PRESETS)
TIP_NOISES = ("bounded", "normal")


@dataclasses.dataclass(frozen=True)
class ControlSettings:
    """What estimator and law are made of; the node's parameters describe them and their units.

    The values here are the defaults, of the node and of studies alike.
    """

    preset: str = "best"
    curvature: float = 1.0 / 0.122
    step_length: float = 0.001
    max_rotation_per_length: float = math.radians(30.0) / 0.001
    max_winding: float = 6.0 * math.pi
    tip_noise: str = "bounded"
    tip_noise_bound: float = 0.001
    flip_depths: tuple[float, ...] = ()
    state_weights: tuple[float, ...] = (1.0e6, 280.0, 0.0)
    input_weight: float = 2.9e-10
    process_noise: tuple[float, ...] = (5.0e-7, 0.13, 24.0)
    measurement_std: float = 0.001 / math.sqrt(3.0)
    saturation_margin: float = 0.11
    demand_margin: float = 0.26
    initial_yaw_std: float = math.radians(10.0)
    initial_pitch_std: float = math.radians(10.0)
    initial_roll_std: float = math.radians(30.0)

    def gains(self) -> Gains:
        """Return the gains the weights give; raises UserError as `gains.design_gains` does."""
        return design_gains(
            state_weights=np.diag(self.state_weights),
            input_weight=self.input_weight,
            process_noise=np.diag(self.process_noise),
            measurement_std=self.measurement_std,
            step_length=self.step_length,
        )

    def tip_covariance(self) -> Array | None:
        """Return a tip's covariance [m^2], shape (3, 3); None where the noise is bounded."""
        if self.tip_noise == "bounded":
            return None
        return np.asarray(np.eye(3) * self.measurement_std**2)
