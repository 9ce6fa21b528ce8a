"""Closed loop of preset `best` with independently simulated needles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from needle_bringup.studies.study_controllers import controller_factory
from needle_controller.model.arrays import Array
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.study import GRIDS, StartBounds, StudySettings, run_study

from .needles import CURVATURE, STEP

STARTS = GRIDS["random"](StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0)), 1, 4)[:40]


def steered(noise: float, *, flips: int = 0, sigma_scale: float = 1.0, **others: Any) -> Array:
    """Return true x over the last 20 mm, shape (40, 20) [m]; other arguments are disturbances."""
    depths = tuple(np.linspace(0.0, 0.12, flips + 2)[1:-1].tolist())
    study = StudySettings(CURVATURE, 0.12, STEP, Disturbances(noise=noise, **others), seed=11)
    controller = controller_factory("best", noise, depths, sigma_scale=sigma_scale)
    return np.asarray(run_study(STARTS, controller, study).x_last[:, -20:])


@pytest.mark.parametrize(
    "others",
    [{"curvature_scale": 0.8}, {"delay": 1}, {"outliers": 0.05, "found": 0.8}, {"flips": 11}],
)
def test_converges(others: dict[str, Any]) -> None:
    x = steered(0.001, **others)
    assert np.mean(np.abs(x[:, -1]) <= 0.001) >= 0.97
    assert np.sqrt(np.mean(x**2)) <= 0.0005


def test_converges_with_play() -> None:
    x = steered(0.001, play=np.deg2rad(40.0))
    assert np.mean(np.abs(x[:, -1]) <= 0.001) >= 0.92
    assert np.sqrt(np.mean(x**2)) <= 0.0007


@pytest.mark.parametrize(
    ("noise", "sigma_scale", "play_deg"), [(1e-5, 1.0, 10.0), (1e-5, 6.0, 0.0), (1e-4, 10.0, 10.0)]
)
def test_an_accurate_sensor_does_not_cause_overconfidence(
    noise: float, sigma_scale: float, play_deg: float
) -> None:
    """With tips this accurate, a linear filter would be certain of a wrong roll."""
    x = steered(noise, sigma_scale=sigma_scale, play=np.deg2rad(play_deg))
    assert np.mean(np.abs(x) <= 0.001) >= 0.995
    assert np.sqrt(np.mean(x**2)) <= 0.00025
