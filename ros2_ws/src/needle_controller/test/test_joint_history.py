from __future__ import annotations

import math

import pytest

from needle_controller.joint_history import JointHistory, JointSample


def history(*samples: tuple[int, float, float]) -> JointHistory:
    made = JointHistory()
    for sample in samples:
        assert made.add(JointSample(*sample))
    return made


def test_nothing_before_two_sides_are_known() -> None:
    empty = JointHistory()
    assert empty.at(5) is None
    assert empty.latest is None
    assert empty.oldest is None
    assert empty.motion_end_ns(1e-6, 1e-6) is None
    one = history((100, 1.0, 2.0))
    assert one.at(99) is None
    assert one.at(101) is None
    assert one.at(100) == JointSample(100, 1.0, 2.0)


def test_linear_between_samples_and_exact_on_them() -> None:
    three = history((100, 1.0, 0.0), (200, 2.0, -4.0), (400, 2.0, 0.0))
    assert three.at(200) == JointSample(200, 2.0, -4.0)
    assert three.at(125) == JointSample(125, 1.25, -1.0)
    assert three.at(300) == JointSample(300, 2.0, -2.0)


def test_stamps_of_a_real_clock_lose_nothing() -> None:
    start = 1_700_000_000_000_000_001
    two = history((start, 0.0, 0.0), (start + 2, 2.0, 0.0))
    assert two.at(start + 1) == JointSample(start + 1, 1.0, 0.0)


@pytest.mark.parametrize(
    "sample", [(200, 1.0, 1.0), (50, 1.0, 1.0), (300, math.nan, 0.0), (300, 0.0, math.inf)]
)
def test_old_or_broken_samples_are_not_taken(sample: tuple[int, float, float]) -> None:
    one = history((200, 1.0, 2.0))
    assert not one.add(JointSample(*sample))
    assert one.latest == JointSample(200, 1.0, 2.0)


def test_memory_is_bounded() -> None:
    made = JointHistory(length=10)
    for i in range(1000):
        made.add(JointSample(i, float(i), 0.0))
    assert made.oldest is not None
    assert 1000 - 20 <= made.oldest.stamp_ns <= 990
    assert made.at(995) == JointSample(995, 995.0, 0.0)


def test_motion_end_does_not_depend_on_when_it_is_asked() -> None:
    moving = [(0, 0.0, 0.0), (10, 0.5, 0.1), (20, 1.0, 0.2)]
    for resting in range(1, 5):
        rest = [(20 + 10 * i, 1.0, 0.2) for i in range(1, resting)]
        assert history(*moving, *rest).motion_end_ns(1e-6, 1e-6) == 20
    turned = history(*moving, (30, 1.0, 0.3), (40, 1.0, 0.3))
    assert turned.motion_end_ns(1e-6, 1e-6) == 30
