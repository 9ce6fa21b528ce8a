"""Invalid settings of presets, and a sample of the study of [KC09] section IV."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from needle_controller.laws.law import LinearizingLaw
from needle_controller.many_needles import ManyObservers
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.presets.presets import make_law, observer_settings
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_core.errors import UserError
from needle_sim.needle.plant import NeedlePlant

STEP = 0.001
REFUSED: list[tuple[str, dict[str, Any]]] = [
    ("curvature = 0", {"curvature": 0.0}),
    ("curvature = nan", {"curvature": math.nan}),
    ("state_weights.* -1", {"state_weights": (1.0e6, -1.0, 0.0)}),
    ("state_weights.*three numbers", {"state_weights": tuple(range(9))}),
    ("process_noise.*three numbers", {"process_noise": (1.0, 1.0)}),
    ("input_weight", {"preset": "paper", "input_weight": 0.0}),
    ("gain", {"preset": "paper", "process_noise": (0.0, 0.0, 0.0)}),
    ("target plane at 0.09 m", {"target_offset": 0.09}),
    ("flip 1 = 0.2 m is outside", {"flip_depths": (0.2,)}),
    ("preset paper cannot steer", {"preset": "paper", "flip_depths": (0.05,)}),
    ("best_of_all", {"preset": "best_of_all"}),
    ("'pink'", {"tip_noise": "pink"}),
    ("'none'", {"tip_covariance": "none"}),
    ("measured_heading", {"measured_heading": True, "tip_covariance": "configured"}),
    ("measured_heading", {"measured_heading": True, "preset": "paper"}),
    ("tip_noise_bound", {"tip_noise_bound": 0.0}),
    ("obstacles has 6 numbers", {"obstacles": (0.0,) * 6}),
    ("x, y and z", {"target_point": (0.0, 0.1)}),
    ("cannot be reached", {"target_point": (0.04, 0.0, 0.06)}),
    ("target_point", {"target_point": (0.0, 0.0, 2.0)}),
    ("paper cannot steer to a point", {"preset": "paper", "target_point": (0.0, 0.0, 0.1)}),
    ("flip_depths do not go together", {"flip_depths": (0.05,), "target_point": (0.0, 0.0, 0.1)}),
]
"""Name in the error, and the values."""


def test_invalid_settings_are_rejected_by_name() -> None:
    for named, changes in REFUSED:
        with pytest.raises(UserError, match=named):
            SteeringSettings(**changes)


def test_only_what_a_preset_uses_is_checked() -> None:
    """Only the paper's law has gains, and it is unstable over long steps."""
    assert SteeringSettings(step_length=0.005).step_length == 0.005
    with pytest.raises(UserError, match="unstable"):
        SteeringSettings(preset="paper", step_length=0.005)


def final_x(preset: str, seed: int) -> Array:
    """Return x of a grid of needles at the end: +-3 mm, +-10 deg, +-30 deg, the ends included."""
    settings = SteeringSettings(preset=preset, **PAPER_NOISE)
    gains = settings.gains()
    law = make_law(settings, gains)
    part = np.linspace(-1.0, 1.0, 8)
    scaled = (part * 0.003, np.deg2rad(10.0) * part, np.deg2rad(30.0) * part)
    start = np.stack(np.meshgrid(*scaled, indexing="ij"), axis=-1).reshape(-1, 3)
    count = len(start)
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, :3] = rotation_from_angles(start * [0.0, 1.0, 1.0])
    pose[:, 0, 3] = start[:, 0]
    plant, rng = NeedlePlant(pose, curvature=settings.curvature), default_rng(seed)
    feedback = law.gains if isinstance(law, LinearizingLaw) else None
    needles = ManyObservers(observer_settings(settings, gains).model, feedback, count)

    def measured() -> Array:
        return np.asarray(plant.T_rig_tip[:, :3, 3] + rng.uniform(-1e-3, 1e-3, (count, 3)))

    rates = needles.start(measured())
    for _ in range(120):
        plant.advance(STEP, rates * STEP)
        tips, turns = measured(), rates * STEP
        rates = needles.step(np.full(count, STEP), np.zeros(count), turns, tips, np.zeros(count))
    return np.asarray(plant.T_rig_tip[:, 0, 3])


def test_most_starts_of_the_paper_end_in_the_plane_and_none_diverges() -> None:
    x = final_x("paper", seed=0)
    # 0.962 of 10,000; this is a sample of 512.
    assert np.mean(np.abs(x) <= 1e-3) >= 0.94
    assert np.max(np.abs(x)) < 0.010
    assert np.mean(np.abs(final_x("open_loop", seed=0)) <= 1e-3) < 0.1
