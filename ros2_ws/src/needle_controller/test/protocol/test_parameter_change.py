"""Parameters that change while the needle is steered."""

from __future__ import annotations

import dataclasses

from needle_controller.model.target_plane import offset_plane
from needle_controller.ros.parameters import PlaneControllerParameters

BEFORE = PlaneControllerParameters(target_offset=0.003)


def test_a_given_plane_stays_unless_the_offset_is_another() -> None:
    steering = BEFORE.make_steering()
    assert steering.control.plane.offset == 0.003
    steering.control.plane = offset_plane(0.005)
    shallower = dataclasses.replace(BEFORE, depth=0.1)
    shallower.change_steering(steering, BEFORE)
    assert steering.control.plane.offset == 0.005
    dataclasses.replace(shallower, target_offset=0.002).change_steering(steering, shallower)
    assert steering.control.plane.offset == 0.002


def test_the_protocol_takes_its_numbers() -> None:
    steering = BEFORE.make_steering()
    dataclasses.replace(BEFORE, depth=0.1, tip_timeout=3.0).change_steering(steering, BEFORE)
    assert (steering.settings.depth, steering.settings.tip_timeout) == (0.1, 3.0)


def test_estimator_and_law_take_theirs() -> None:
    steering = BEFORE.make_steering()
    law = steering.control._law
    dataclasses.replace(BEFORE, preset="open_loop").change_steering(steering, BEFORE)
    assert steering.control._settings.preset == "open_loop"
    assert steering.control._law is not law
