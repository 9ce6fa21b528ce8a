from __future__ import annotations

import math

import pytest

from needle_controller.protocol.joint_history import CONFIRMED_BY, Heard, JointHistory, JointSample

TICK = 20_000_000
HOUR = 3600 * 10**9


def history(*samples: tuple[int, float, float]) -> JointHistory:
    made = JointHistory()
    for sample in samples:
        assert made.add(JointSample(*sample)) is Heard.TAKEN
    return made


def test_nothing_before_two_sides_are_known() -> None:
    empty = JointHistory()
    assert empty.at(5) is None
    assert empty.latest is None
    assert empty.oldest is None
    one = history((100, 1.0, 2.0))
    assert one.at(99) is None
    assert one.at(101) is None
    assert one.at(100) == JointSample(100, 1.0, 2.0)


def test_linear_between_samples_and_exact_on_them() -> None:
    three = history((100, 1e-5, 0.0), (200, 2e-5, -0.04), (400, 2e-5, 0.0))
    assert three.at(200) == JointSample(200, 2e-5, -0.04)
    assert three.at(125) == JointSample(125, 1.25e-5, -0.01)
    assert three.at(300) == JointSample(300, 2e-5, -0.02)
    assert list(three.after(200)) == [JointSample(400, 2e-5, 0.0)]
    assert next(iter(three.after(199))).stamp_ns == 200


def test_stamps_of_a_real_clock_lose_nothing() -> None:
    start = 1_700_000_000_000_000_001
    two = history((start, 0.0, 0.0), (start + 2, 2e-6, 0.0))
    assert two.at(start + 1) == JointSample(start + 1, 1e-6, 0.0)


@pytest.mark.parametrize(
    "sample", [(200, 1.0, 1.0), (50, 1.0, 1.0), (300, math.nan, 0.0), (300, 0.0, math.inf)]
)
def test_old_or_broken_samples_are_not_taken(sample: tuple[int, float, float]) -> None:
    one = history((200, 1.0, 2.0))
    assert one.add(JointSample(*sample)) is not Heard.TAKEN
    assert one.latest == JointSample(200, 1.0, 2.0)


def test_memory_is_bounded() -> None:
    made = JointHistory(length=10)
    for i in range(1000):
        made.add(JointSample(i, 1e-6 * i, 0.0))
    assert made.oldest is not None
    assert 1000 - 20 <= made.oldest.stamp_ns <= 990
    assert made.at(995) == JointSample(995, 1e-6 * 995, 0.0)


SPIKES = {
    "insertion": (TICK, 0.0, 0.0),
    "rotation": (TICK, 0.05, 3.0),
    "an hour ahead": (HOUR, 0.05, 0.0),
    "an hour ago": (-HOUR, 0.05, 0.0),
}


@pytest.mark.parametrize("spike", SPIKES.values(), ids=SPIKES)
def test_a_spike_changes_nothing_but_a_count(spike: tuple[int, float, float]) -> None:
    start = 2 * HOUR
    made = history((start, 0.05, 0.0))
    stamp, insertion, rotation = spike
    assert made.add(JointSample(start + stamp, insertion, rotation)) is Heard.DOUBTED
    assert made.latest == JointSample(start, 0.05, 0.0)
    assert made.doubted == 1
    assert "do not follow from the last" in made.complaint
    for tick in range(1, CONFIRMED_BY):
        assert made.add(JointSample(start + tick * TICK, 0.05, 0.0)) is Heard.TAKEN
    assert made.complaint == ""


@pytest.mark.parametrize("spike", SPIKES.values(), ids=SPIKES)
def test_what_stays_is_the_new_truth(spike: tuple[int, float, float]) -> None:
    start = 2 * HOUR
    made = history((start, 0.05, 0.0))
    stamp, insertion, rotation = spike
    heard = [
        made.add(JointSample(start + stamp + tick * TICK, insertion, rotation))
        for tick in range(CONFIRMED_BY)
    ]
    assert heard == [Heard.DOUBTED] * (CONFIRMED_BY - 1) + [Heard.JUMPED]
    assert made.oldest == JointSample(start + stamp, insertion, rotation)
    assert made.complaint == ""


def test_two_truths_in_turn_leave_the_first() -> None:
    made = history((TICK, 0.05, 0.0))
    for tick in range(2, 40, 2):
        assert made.add(JointSample(tick * TICK, 0.0, 0.0)) is Heard.DOUBTED
        assert made.add(JointSample((tick + 1) * TICK, 0.05, 0.0)) is Heard.TAKEN
