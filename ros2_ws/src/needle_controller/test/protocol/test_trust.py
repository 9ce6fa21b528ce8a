"""What is said of how sure the controller is, and what it does when it is not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.next_step import next_step
from needle_controller.protocol.steering_types import SteeringState
from needle_controller.protocol.trust import trust_of

from .rig import Rig, sent


def test_the_interval_holds_what_the_covariance_says() -> None:
    estimator = HypothesisFilter(FilterSettings())
    estimator.reset([0.002, 0.0, 0.0], np.zeros(2))
    estimate = estimator.estimate()
    trust = trust_of(estimate)
    half = 1.96 * np.sqrt(estimate.covariance[0, 0])
    assert (trust.r1, trust.high - trust.r1) == pytest.approx((0.002, half), rel=1e-4)
    assert trust.r1 - trust.low == pytest.approx(half, rel=1e-4)
    assert trust.verdict == "trusted"
    doubted = dataclasses.replace(estimate, doubtful=np.array(True), doubts=("a", "b"))
    assert trust_of(doubted).verdict == "doubtful: a; b"
    unjudged = dataclasses.replace(estimate, doubtful=None, doubts=())
    assert not trust_of(unjudged).verdict


def test_an_end_that_is_elsewhere_is_not_trusted_however_well_it_is_known() -> None:
    estimator = HypothesisFilter(FilterSettings())
    estimator.reset([0.002, 0.0, 0.0], np.zeros(2))
    estimate = estimator.estimate()
    there, elsewhere = trust_of(estimate, 0.00099), trust_of(estimate, 0.0072)
    assert (there.verdict, there.is_doubtful) == ("trusted", False)
    assert elsewhere.verdict == "doubtful: the needle ends 0.0072 m from its target"
    assert elsewhere.is_doubtful
    unjudged = dataclasses.replace(estimate, doubtful=None, doubts=())
    assert not trust_of(unjudged, 0.0072).verdict


def test_in_doubt_it_goes_on_at_half_the_speed() -> None:
    joints, settings = JointSample(0, 0.01, 0.0), SteeringSettings()
    still = SteeringCommand(np.zeros(()), np.zeros(()))
    usual, slow = (next_step(1, joints, still, settings, slowly=slowly) for slowly in (False, True))
    assert usual is not None
    assert slow == dataclasses.replace(usual, duration=2.0 * usual.duration)


def test_the_end_says_how_sure_it_is() -> None:
    rig = Rig()
    while rig.steering.state is SteeringState.STEERING and rig.steering.step < 119:
        rig.run(sent(rig.expose()))
    rig.run(sent(rig.expose()))
    rig.expose()
    assert rig.steering.state is SteeringState.DONE
    # This needle does not bend at all.
    assert "m (95 %), doubtful: the curvature is at its limit" in rig.steering.reason
    assert rig.steering.reason.endswith("m from its target")
    assert rig.steering.trust.low < rig.steering.trust.r1 < rig.steering.trust.high
