"""Parameters that change while the needle is steered."""

from __future__ import annotations

import dataclasses

from needle_controller.model.target_plane import offset_plane
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.steering import Steering

BEFORE = SteeringSettings(target_offset=0.003)


def test_a_given_plane_stays_unless_the_offset_is_another() -> None:
    steering = Steering(BEFORE)
    assert steering.control.plane.offset == 0.003
    steering.control.plane = offset_plane(0.005)
    shallower = dataclasses.replace(BEFORE, depth=0.1)
    steering.configure(shallower)
    assert steering.control.plane.offset == 0.005
    steering.configure(dataclasses.replace(shallower, target_offset=0.002))
    assert steering.control.plane.offset == 0.002


def test_the_protocol_takes_its_numbers() -> None:
    steering = Steering(BEFORE)
    steering.configure(dataclasses.replace(BEFORE, depth=0.1, tip_timeout=3.0))
    assert (steering.settings.depth, steering.settings.tip_timeout) == (0.1, 3.0)


def test_estimator_and_law_take_theirs() -> None:
    steering = Steering(BEFORE)
    law = steering.control._law
    steering.configure(dataclasses.replace(BEFORE, preset="open_loop"))
    assert steering.control._settings.preset == "open_loop"
    assert steering.control._law is not law
