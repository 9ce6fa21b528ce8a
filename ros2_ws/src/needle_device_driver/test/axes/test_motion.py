"""Coordinated motion without a supervisor."""

from __future__ import annotations

import copy

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needle_device_driver.axes.motion import CoordinatedMotion, Leg

_places = st.tuples(st.floats(-0.2, 0.2), st.floats(-60.0, 60.0))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(start=_places, end=_places, duration=st.floats(0.02, 1.0))
def test_last_set_point_is_exactly_the_target(
    start: tuple[float, float], end: tuple[float, float], duration: float
) -> None:
    motion = CoordinatedMotion(start, [Leg(*end, duration)])
    while not motion.complete:
        set_point = motion.advance(0.02, 1.0)
    assert (set_point.insertion, set_point.rotation) == end


def test_rest_of_a_period_uses_the_speed_of_the_next_leg() -> None:
    motion = CoordinatedMotion((0.0, 0.0), [Leg(1.0, -2.0, 0.5), Leg(2.0, -2.0, 1.0)])
    motion.advance(0.4, 1.0)
    # The last fifth of the first leg takes 0.1 s, at half speed 0.2 s.
    for scale, reached in ((1.0, 1.2), (0.5, 1.05)):
        at = copy.deepcopy(motion).advance(0.3, scale)
        assert (at.insertion, at.rotation) == pytest.approx((reached, -2.0))


def test_rotation_follows_a_pushed_needle_at_its_rate() -> None:
    motion = CoordinatedMotion((1.0, 0.0), [Leg(2.0, 1.0, 1.0), Leg(3.0, 0.0, 1.0)])
    for hand, rotation in ((0.5, 0.0), (1.25, 0.25), (1.1, 0.25), (2.5, 0.75), (2.5, 0.75)):
        assert motion.follow(hand, 1.0, 0.5).rotation == pytest.approx(rotation)
        assert not motion.complete
    assert CoordinatedMotion((1.0, 0.0), [Leg(1.0, 1.0, 1.0)]).follow(1.0, 1.0, 0.5).rotation == 0.5
    wanted = ((0.0, 1.0), (2.25, 0.75), (9.0, 0.0))
    assert [motion.rotation_at(hand) for hand, _ in wanted] == [rotation for _, rotation in wanted]
    assert motion.follow(3.0, 10.0, 0.5).rotation == 0.0
    assert motion.complete
