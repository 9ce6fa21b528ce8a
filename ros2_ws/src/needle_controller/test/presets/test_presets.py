"""Invalid settings of presets."""

from __future__ import annotations

from typing import Any

import pytest

from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.errors import UserError

REFUSED: list[tuple[str, dict[str, Any]]] = [
    ("state_weights.*three numbers", {"state_weights": tuple(range(9))}),
    ("input_weight", {"preset": "paper", "input_weight": 0.0}),
    ("gain", {"preset": "paper", "process_noise": (0.0, 0.0, 0.0)}),
    ("gain", {"preset": "paper", "state_weights": (0.0, 0.0, 0.0)}),
    ("unstable", {"preset": "paper", "step_length": 0.005}),
    ("target plane at 0.09 m", {"target_offset": 0.09}),
    ("flip 1 = 0.2 m is outside", {"flip_depths": (0.2,)}),
    ("preset paper cannot steer", {"preset": "paper", "flip_depths": (0.05,)}),
    ("measured_heading", {"measured_heading": True, "tip_covariance": "configured"}),
    ("measured_heading", {"measured_heading": True, "preset": "paper"}),
    ("obstacles has 6 numbers", {"obstacles": (0.0,) * 6}),
    ("x, y and z", {"target_point": (0.0, 0.1)}),
    ("cannot be reached", {"target_point": (0.04, 0.0, 0.06)}),
    ("paper cannot steer to a point", {"preset": "paper", "target_point": (0.0, 0.0, 0.1)}),
    ("flip_depths do not go together", {"flip_depths": (0.05,), "target_point": (0.0, 0.0, 0.1)}),
]
"""Name in the error, and the values."""


def test_invalid_settings_are_rejected_by_name() -> None:
    for named, changes in REFUSED:
        with pytest.raises(UserError, match=named):
            SteeringSettings(**changes)


def test_gains_are_checked_only_for_presets_that_have_them() -> None:
    assert SteeringSettings(step_length=0.005).step_length == 0.005
