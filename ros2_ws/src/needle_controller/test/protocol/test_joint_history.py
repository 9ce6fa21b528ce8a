"""Joint history: interpolation, and inconsistent samples."""

from __future__ import annotations

import math

from needle_controller.protocol.joint_history import JointHistory, JointSample, SampleResult

TICK = 20_000_000
SECOND = 10**9
HOUR = 3600 * SECOND
START = 2 * HOUR


def history(*samples: tuple[int, float, float]) -> JointHistory:
    made = JointHistory()
    for sample in samples:
        assert made.add(JointSample(*sample)) is SampleResult.ACCEPTED
    return made


def test_joints_are_interpolated_and_unknown_outside_the_history() -> None:
    assert JointHistory().at(5) is None
    first, last = JointSample(100, 1e-5, 0.0), JointSample(400, 2e-5, 0.0)
    three = history((100, 1e-5, 0.0), (200, 2e-5, -0.04), (400, 2e-5, 0.0))
    for stamp_ns, wanted in (
        (99, None),
        (100, first),
        (125, JointSample(125, 1.25e-5, -0.01)),
        (300, JointSample(300, 2e-5, -0.02)),
        (400, last),
        (401, None),
    ):
        assert three.at(stamp_ns) == wanted
    # Stamps of a real clock keep their precision.
    begin = 1_700_000_000_000_000_001
    two = history((begin, 0.0, 0.0), (begin + 2, 2e-6, 0.0))
    assert two.at(begin + 1) == JointSample(begin + 1, 1e-6, 0.0)


def test_samples_between_two_others_are_spaced() -> None:
    made = history(*((k * TICK, 1e-4 * k, 0.0) for k in range(12)))
    start, end = JointSample(TICK, 1e-4, 0.0), JointSample(10 * TICK, 1e-3, 0.0)
    for spacing, kept in ((2.9e-4, [4, 7]), (1e-5, list(range(2, 10)))):
        found = made.between(start, end, spacing)
        assert [sample.stamp_ns // TICK for sample in found] == kept


def test_memory_is_bounded() -> None:
    made = JointHistory(length=10)
    for number in range(1000):
        made.add(JointSample(number, 1e-6 * number, 0.0))
    assert made.oldest is not None
    assert 980 < made.oldest.stamp_ns <= 990


def test_consistent_samples_are_accepted() -> None:
    for gap_ns, insertion, rotation, result in (
        # Limits: the speed of a hand and of a motor, and the noise of both.
        (TICK, 1.199e-3, 0.699, SampleResult.ACCEPTED),
        (TICK, -1.199e-3, -0.699, SampleResult.ACCEPTED),
        (TICK, 1.201e-3, 0.0, SampleResult.REJECTED),
        (TICK, 0.0, -0.701, SampleResult.REJECTED),
        # A motion between samples lasts at most 40 ms.
        (SECOND, 2.199e-3, 1.299, SampleResult.ACCEPTED),
        (SECOND, 2.201e-3, 0.0, SampleResult.REJECTED),
        (SECOND, 0.0, 1.301, SampleResult.REJECTED),
        (SECOND + 1, 0.0, 0.0, SampleResult.REJECTED),
        (1, 0.0, 0.0, SampleResult.ACCEPTED),
        (0, 1e-4, 0.0, SampleResult.REPEATED),
        (-SECOND, 9.0, 9.0, SampleResult.REPEATED),
        (-SECOND - 1, 0.0, 0.0, SampleResult.REJECTED),
        (TICK, math.nan, 0.0, SampleResult.REJECTED),
        (TICK, 0.0, math.inf, SampleResult.REJECTED),
    ):
        made, row = history((START, 0.05, 1.0)), (gap_ns, insertion, rotation)
        sample = JointSample(START + gap_ns, 0.05 + insertion, 1.0 + rotation)
        is_counted = result is SampleResult.REJECTED
        assert made.add(sample) is result, row
        assert (made.latest == sample) is (result is SampleResult.ACCEPTED), row
        assert (made.rejected, bool(made.problem)) == (int(is_counted), is_counted), row


SPIKES = [(TICK, 0.0, 0.0), (TICK, 0.05, 3.0), (HOUR, 0.05, 0.0), (-HOUR, 0.05, 0.0)]


def test_a_spike_is_dropped_and_a_lasting_jump_is_accepted() -> None:
    for stamp, insertion, rotation in SPIKES:
        made = history((START, 0.05, 0.0))
        made.add(JointSample(START + stamp, insertion, rotation))
        # A sample that is inconsistent with the spike restarts the count.
        assert made.add(JointSample(START + 5 * HOUR, 1.0, 0.0)) is SampleResult.REJECTED
        result = [
            made.add(JointSample(START + stamp + tick * TICK, insertion, rotation))
            for tick in range(5)
        ]
        assert result == [SampleResult.REJECTED] * 4 + [SampleResult.JUMPED]
        assert made.oldest == JointSample(START + stamp, insertion, rotation)
        assert (made.problem, made.rejected) == ("", 7)


def test_two_alternating_positions_keep_the_first() -> None:
    made = history((TICK, 0.05, 0.0))
    for tick in range(2, 40, 2):
        assert made.add(JointSample(tick * TICK, 0.0, 0.0)) is SampleResult.REJECTED
        assert made.add(JointSample((tick + 1) * TICK, 0.05, 0.0)) is SampleResult.ACCEPTED
        assert made.problem == ""
    made.add(JointSample(43 * TICK, 0.06, 0.5))
    assert made.problem == (
        "joint_states are inconsistent with the last: 0.06 m, 0.5 rad after 0.05 m, 0 rad, "
        "0.08 s later"
    )
