"""Coordinated motion without a supervisor."""

from __future__ import annotations

import copy

import pytest

from needle_device_driver.axes.motion import CoordinatedMotion, Leg


def test_rest_of_a_period_uses_the_speed_of_the_next_leg() -> None:
    motion = CoordinatedMotion((0.0, 0.0), [Leg(1.0, -2.0, 0.5), Leg(2.0, -2.0, 1.0)])
    motion.advance(0.4, 1.0)
    # The last fifth of the first leg takes 0.1 s, at half speed 0.2 s.
    for scale, reached in ((1.0, 1.2), (0.5, 1.05)):
        at = copy.deepcopy(motion).advance(0.3, scale)
        assert (at.insertion, at.rotation) == pytest.approx((reached, -2.0))


def test_last_set_point_is_exactly_the_target() -> None:
    # In floating point, 0.7 + (0.1 - 0.7) is not 0.1.
    set_point = CoordinatedMotion((0.0, 0.7), [Leg(0.1, 0.1, 0.5)]).advance(0.5, 1.0)
    assert (set_point.insertion, set_point.rotation) == (0.1, 0.1)
