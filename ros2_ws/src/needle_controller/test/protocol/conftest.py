"""Compiled code is loaded once, before the first test."""

from __future__ import annotations

import pytest

from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.plane_control import PlaneControl


@pytest.fixture(scope="session", autouse=True)
def _loaded() -> None:
    for preset in ("best", "paper"):
        PlaneControl(SteeringSettings(preset=preset))
