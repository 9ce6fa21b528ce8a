"""The next step, the confidence in the estimate, and the reception log."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from needle_controller.controller_status import ReceptionLog, received_messages
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import next_step
from needle_controller.protocol.confidence import assess_confidence, point_miss_probability
from needle_controller.protocol.joint_history import JointSample

SETTINGS = SteeringSettings(depth=0.12)


def test_a_step_has_its_length_or_ends_at_depth_or_point() -> None:
    rows: list[tuple[float, float | None, float | None]] = [
        (0.05, None, 0.051),
        (0.05, 0.005, 0.051),
        (0.05, 0.0004, 0.0504),
        (0.05, 1.01e-4, 0.050101),
        (0.05, 0.99e-4, None),
        (0.05, 1e-4, None),
        (0.05, -0.01, None),
        # The depth is before the point; the last step may be longer by a thousandth.
        (0.1195, 0.005, 0.12),
        (0.12 - 1.0009e-3, None, 0.12),
        (0.12 - 1.0011e-3, None, 0.12 - 1.1e-6),
        (0.12 - 1.1e-6, None, 0.12),
        (0.12 - 0.9e-6, None, None),
        (0.13, None, None),
    ]
    for insertion, left, end in rows:
        joints = JointSample(7, insertion, 1.0)
        command = SteeringCommand(0.0, 100.0, left)
        step = next_step(7, joints, command, SETTINGS, slowly=False)
        assert (step is None) is (end is None), (insertion, left)
        if step is None or end is None:
            continue
        length = end - insertion
        assert step.stamp_ns == 7
        assert step.insertion == pytest.approx(end, rel=0, abs=1e-12)
        assert step.rotation == pytest.approx(1.0 + 100.0 * length, rel=0, abs=1e-9)
        assert step.duration == pytest.approx(length / 0.002)
        slow = next_step(7, joints, command, SETTINGS, slowly=True)
        assert slow == dataclasses.replace(step, duration=2.0 * step.duration)


def test_confidence_follows_from_covariance_and_miss_probability() -> None:
    estimator = HypothesisFilter(FilterSettings())
    for r1 in (-0.002, 0.002):
        estimator.reset([r1, 0.0, 0.0], np.zeros(2))
        estimate = estimator.estimate()
        trust = assess_confidence(estimate)
        half = 1.96 * math.sqrt(estimate.covariance[0, 0])
        assert trust.r1 == pytest.approx(r1, rel=1e-12)
        ends = trust.r1 - trust.low, trust.high - trust.r1
        assert ends == pytest.approx((half, half), rel=1e-4)
        assert (trust.verdict, trust.is_doubtful) == ("trusted", False)
    there, elsewhere = assess_confidence(estimate, 0.049), assess_confidence(estimate, 0.72)
    assert (there.verdict, there.is_doubtful) == ("trusted", False)
    assert elsewhere.verdict.startswith("doubtful: 72 %")
    assert elsewhere.is_doubtful
    wide = np.diag([1.1e-6, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert assess_confidence(dataclasses.replace(estimate, covariance=wide)).is_doubtful
    # No miss probability: no verdict.
    without_probability = assess_confidence(dataclasses.replace(estimate, miss=None), 0.72)
    assert (without_probability.verdict, without_probability.is_doubtful) == ("", False)


def test_the_miss_probability_of_a_point_is_its_frequency() -> None:
    rng = np.random.default_rng(2)
    for spread in (0.0002, 0.0005, 0.0009):
        off = rng.normal(0.0, 0.0005, 3)
        root = rng.normal(0.0, spread, (3, 3))
        drawn = off + rng.normal(size=(40_000, 3)) @ root.T
        share = float(np.mean(np.linalg.norm(drawn, axis=1) > 1e-3))
        assert float(point_miss_probability(off, root @ root.T)) == pytest.approx(share, abs=0.03)


def test_the_reception_log_round_trips_once_in_order() -> None:
    log = ReceptionLog()
    assert received_messages(log.pop_text()) == []
    messages = [("joint_states", 1_700_000_000_000_000_000), ("needle/tip", 5), ("joint_states", 7)]
    for message in messages:
        log.add(*message)
    assert received_messages(log.pop_text()) == messages
    assert log.pop_text() == ""
    # The log is full until it is published.
    for number in range(103):
        assert log.is_full is (number >= 100)
        log.add("joint_states", number)
    assert len(received_messages(log.pop_text())) == 103
    assert not log.is_full
    # Malformed entries are ignored.
    found = received_messages("joint_states soon, needle/tip -1, device/result 7, x 8 9")
    assert found == [("device/result", 7)]
