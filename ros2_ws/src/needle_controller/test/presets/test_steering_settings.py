"""What the controller's parameters must not be."""

from __future__ import annotations

import math
from typing import Any

import pytest

from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.errors import UserError

REFUSED: dict[str, dict[str, Any]] = {
    "curvature": {"curvature": 0.0},
    "curvature = -8": {"curvature": -8.0},
    "curvature = nan": {"curvature": math.nan},
    "state_weights": {"state_weights": (1.0e6, math.inf, 0.0)},
    "state_weights.* -1": {"state_weights": (1.0e6, -1.0, 0.0)},
    "three numbers": {"state_weights": tuple(float(k) for k in range(9))},
    "input_weight": {"input_weight": 0.0},
    "gain": {"preset": "paper", "process_noise": (0.0, 0.0, 0.0)},
    "target plane at 0.09 m": {"target_offset": 0.09},
    "flip": {"depth": 0.02, "flip_depths": (0.05,)},
    "paper": {"preset": "paper", "flip_depths": (0.05,)},
    "best_of_all": {"tip_margin": 0.005, "preset": "best_of_all"},
}
"""What the refusal names, and the values."""


@pytest.mark.parametrize("named", REFUSED)
def test_what_cannot_be_steered_with_is_refused_by_name(named: str) -> None:
    with pytest.raises(UserError, match=named):
        SteeringSettings(**REFUSED[named])
