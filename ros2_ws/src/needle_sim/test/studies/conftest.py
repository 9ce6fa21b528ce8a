"""Loads compiled code before any test is measured."""

from __future__ import annotations

import numpy as np
import pytest

from needle_bringup.studies.study_controllers import controller_factory
from needle_sim.studies.disturbances import Disturbances, measured
from needle_sim.studies.needles import NeedleBatch
from needle_sim.studies.reference_laws import plan


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    NeedleBatch(np.zeros((1, 3))).advance(0.001, np.zeros(1), 8.0)
    measured(np.zeros((1, 3)), Disturbances(), 1, 1, 0)
    ahead, chance, arc = np.array([0.0, 0.0, 0.1]), np.zeros((1, 4)), np.zeros(3)
    controller = controller_factory("best", 0.001)()
    controller.step(0.001, controller.start(np.zeros((1, 3))), np.zeros((1, 3)), 0.0)
    plan(np.zeros(3), np.eye(3), ahead, np.zeros((0, 7)), 8.0, 0.001, chance, arc)
