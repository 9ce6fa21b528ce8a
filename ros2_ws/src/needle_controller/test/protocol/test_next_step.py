"""The next step, the confidence in the estimate, and the reception log."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from needle_controller.controller_status import received_messages
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import next_step
from needle_controller.protocol.confidence import (
    Confidence,
    assess_confidence,
    point_miss_probability,
)
from needle_controller.protocol.joint_history import JointSample

SETTINGS = SteeringSettings(depth=0.12)


def test_a_step_has_its_length_or_ends_at_depth_or_point() -> None:
    rows: list[tuple[float, float | None, float | None]] = [
        (0.05, None, 0.051),
        (0.05, 0.0004, 0.0504),
        (0.05, 1.01e-4, 0.050101),
        (0.05, 1e-4, None),
        (0.05, -0.01, None),
        # The depth is before the point; the last step may be longer by a thousandth.
        (0.1195, 0.005, 0.12),
        (0.12 - 1.0009e-3, None, 0.12),
        (0.12 - 1.0011e-3, None, 0.12 - 1.1e-6),
        (0.12 - 1.1e-6, None, 0.12),
        (0.12 - 0.9e-6, None, None),
    ]
    for insertion, left, end in rows:
        command = SteeringCommand(0.0, 100.0, left)
        step = next_step(JointSample(7, insertion, 1.0), command, SETTINGS, slowly=True)
        if end is None:
            assert step is None, (insertion, left)
            continue
        length = end - insertion
        assert step is not None, (insertion, left)
        assert step.stamp_ns == 7
        assert step.insertion == pytest.approx(end, rel=0, abs=1e-12)
        assert step.rotation == pytest.approx(1.0 + 100.0 * length, rel=0, abs=1e-9)
        # At half of the nominal speed
        assert step.duration == pytest.approx(length / 0.001)


def test_confidence_follows_from_covariance_and_miss_probability() -> None:
    estimator = HypothesisFilter(FilterSettings())
    estimator.reset([-0.002, 0.0, 0.0], np.zeros(2))
    estimate = estimator.estimate()
    found = assess_confidence(estimate)
    half = 1.96 * math.sqrt(estimate.covariance[0, 0])
    interval = found.r1, found.low, found.high
    assert interval == pytest.approx((-0.002, -0.002 - half, -0.002 + half), rel=1e-4)
    wide = np.diag([1.1e-6, 0.0, 0.0, 0.0, 0.0, 0.0])
    uncertain = dataclasses.replace(estimate, covariance=wide)
    # An estimator without a probability gives no verdict.
    without = dataclasses.replace(estimate, miss=None)
    for one, miss_probability, verdict in (
        (estimate, None, "trusted"),
        (estimate, 0.049, "trusted"),
        (estimate, 0.72, "doubtful: 72 % probability of a miss by 1 mm or more"),
        (uncertain, None, "doubtful: the uncertainty of x exceeds 1 mm"),
        (without, 0.72, ""),
    ):
        found = assess_confidence(one, miss_probability)
        assert (found.verdict, found.is_doubtful) == (verdict, "doubtful" in verdict)
    found = Confidence("trusted", False, -0.002, -0.0031, -0.0009)
    assert found.summary == "r1 = -0.00200 m +- 0.00110 m (95 %), trusted"


def test_the_miss_probability_of_a_point_is_its_frequency() -> None:
    rng = np.random.default_rng(2)
    for spread in (0.0002, 0.0005, 0.0009):
        off = rng.normal(0.0, 0.0005, 3)
        root = rng.normal(0.0, spread, (3, 3))
        drawn = off + rng.normal(size=(40_000, 3)) @ root.T
        share = float(np.mean(np.linalg.norm(drawn, axis=1) > 1e-3))
        assert float(point_miss_probability(off, root @ root.T)) == pytest.approx(share, abs=0.03)


def test_malformed_entries_of_the_reception_log_are_ignored() -> None:
    assert received_messages("") == []
    found = received_messages("joint_states soon, needle/tip -1, device/result 7, x 8 9")
    assert found == [("device/result", 7)]
