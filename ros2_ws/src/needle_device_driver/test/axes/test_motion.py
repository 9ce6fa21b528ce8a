"""The coordinated motion, free of the supervisor around it."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from needle_device_driver.axes.motion import CoordinatedMotion, Leg

_metres = st.floats(-0.2, 0.2)
_radians = st.floats(-60.0, 60.0)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    start=st.tuples(_metres, _radians),
    end=st.tuples(_metres, _radians),
    duration=st.floats(0.02, 10.0),
)
def test_the_last_set_point_is_the_target_to_the_last_bit(
    start: tuple[float, float], end: tuple[float, float], duration: float
) -> None:
    motion = CoordinatedMotion(start, [Leg(*end, duration)])
    set_point = motion.advance(0.0, 1.0)
    while not motion.complete:
        set_point = motion.advance(0.02, 1.0)
    assert (set_point.insertion, set_point.rotation) == end


def test_a_period_at_half_speed_goes_half_as_far() -> None:
    fast, slow = (CoordinatedMotion((0.0, 0.0), [Leg(1.0, -2.0, 1.0)]) for _ in range(2))
    full, half = fast.advance(0.2, 1.0), slow.advance(0.2, 0.5)
    assert (half.insertion, half.rotation) == (full.insertion / 2, full.rotation / 2)
    assert (half.insertion_speed, half.rotation_speed) == (0.5, 1.0)
