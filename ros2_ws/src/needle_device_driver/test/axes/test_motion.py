"""Coordinated motion without a supervisor."""

from __future__ import annotations

import copy

import pytest

from needle_device_driver.axes.motion import CoordinatedMotion, Leg, slowed_legs


def test_rest_of_a_period_uses_the_speed_of_the_next_leg() -> None:
    motion = CoordinatedMotion((0.0, 0.0), [Leg(1.0, -2.0, 0.5), Leg(2.0, -2.0, 1.0)])
    motion.advance(0.4, 1.0)
    # The last fifth of the first leg takes 0.1 s, at half speed 0.2 s.
    for scale, reached in ((1.0, 1.2), (0.5, 1.05)):
        at = copy.deepcopy(motion).advance(0.3, scale)
        assert (at.insertion, at.rotation) == pytest.approx((reached, -2.0))


def test_rotation_follows_a_push_over_a_corner_at_its_bounded_rate() -> None:
    motion = CoordinatedMotion((1.0, 0.5), [Leg(2.0, 1.5, 0.1), Leg(4.0, 0.5, 0.1)])
    assert motion.rotation_at(0.9) == 0.5
    # Of 0.85 rad in a period, 0.1 rad are beyond the corner.
    for insertion, rate, rotation in (
        (1.25, 3.0, 0.75),
        (1.125, 3.0, 0.75),
        (2.5, 1.7, 1.4),
        (2.5, 2.4, 1.25),
        (9.0, 0.4, 1.05),
        (3.0, 2.4, 1.0),
        (9.0, 2.4, 0.5),
    ):
        set_point = motion.follow(insertion, rate, 0.5)
        assert set_point.rotation == pytest.approx(rotation)
    assert motion.complete
    assert (set_point.insertion, set_point.insertion_speed) == (4.0, 2.0)
    assert set_point.rotation_speed == pytest.approx(1.0)
    # The needle may be at the end of the leg already.
    motion = CoordinatedMotion((2.0, 0.5), [Leg(2.0, 1.5, 0.1)])
    assert motion.follow(2.0, 1.0, 0.5).rotation == 1.0


def test_legs_take_at_least_the_time_of_both_bounds() -> None:
    legs = [Leg(2.0, 1.0, 0.1), Leg(3.0, -5.0, 0.1), Leg(4.0, -5.0, 9.0)]
    slowed = slowed_legs((0.5, 0.5), legs, 0.5, 2.0)
    assert [leg.duration for leg in slowed] == [3.0, 3.0, 9.0]


def test_last_set_point_is_exactly_the_target() -> None:
    # In floating point, 0.7 + (0.1 - 0.7) is not 0.1.
    set_point = CoordinatedMotion((0.0, 0.7), [Leg(0.1, 0.1, 0.5)]).advance(0.5, 1.0)
    assert (set_point.insertion, set_point.rotation) == (0.1, 0.1)
