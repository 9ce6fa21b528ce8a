"""Controllers of studies: their inputs, and the estimates of their needles."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from needle_bringup.studies import study_controllers
from needle_bringup.studies.study_controllers import (
    SteeredNeedles,
    controller_factory,
)
from needle_bringup.studies.study_estimators import BestEstimators, SeparateEstimators
from needle_bringup.studies.study_laws import each_rate
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import SteeringSettings

TIPS = np.array([[0.0005, 0.0, 0.001], [-0.0005, 0.0, 0.0012]])


class Recorder:
    """Estimators that record their advances and the covariances of their corrections."""

    def __init__(self) -> None:
        self.given: list[Any] = []
        self.advanced: list[tuple[Any, Any]] = []

    def start(self, tips: Array) -> None:
        pass

    def advance(self, lengths: Array, turns: Array) -> None:
        self.advanced.append((lengths.copy(), turns))

    def correct(self, tips: Array, covariance: Array | None, ages: Array) -> None:
        self.given.append(covariance)


def still(estimate: Any, insertion: float) -> SteeringCommand:
    """Do not turn the needle."""
    return SteeringCommand(0.0, 0.0)


def test_the_controller_gets_the_claimed_noise_and_turns_after_the_delay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recorder = Recorder()
    monkeypatch.setattr(study_controllers, "new_estimators", lambda *_: lambda _: recorder)
    monkeypatch.setattr(study_controllers, "best_rates", lambda _: lambda *_: np.zeros(2))
    for scale in (1.0, 2.0):
        needles = controller_factory("best", 0.002, sigma_scale=scale, turn_delay=0.0004)()
        needles.start(TIPS)
        needles.step(0.001, np.ones(2), TIPS, 0.0)
    # Uniform noise within 2 mm has a variance of (2 mm)^2 / 3; sigmas half as large.
    assert recorder.given[0] is None
    np.testing.assert_allclose(recorder.given[1], np.eye(3) * 0.002**2 / 3.0 / 4.0)
    np.testing.assert_allclose(
        recorder.advanced[:2], [([0.0004] * 2, [0.0] * 2), ([0.0006] * 2, [1.0] * 2)]
    )


@pytest.mark.parametrize(
    ("source", "sigma_scale", "covariance"),
    [
        ("configured", 1.0, None),
        ("from_tip_pose", 2.0, np.eye(3) * (0.002 / math.sqrt(3.0) / 2.0) ** 2),
    ],
)
def test_python_and_compiled_loops_give_the_same_bits(
    source: str, sigma_scale: float, covariance: Array | None
) -> None:
    settings = SteeringSettings(tip_covariance=source, tip_noise="bounded", tip_noise_bound=0.002)
    one_by_one = SteeredNeedles(
        lambda _: SeparateEstimators(
            lambda n: make_controller(settings, np.eye(3), np.zeros(3))[0]
        ),
        each_rate(lambda _: make_controller(settings, np.eye(3))[1]),
        covariance,
    )
    compiled = controller_factory("best", 0.002, sigma_scale=sigma_scale)()
    rng = np.random.default_rng(2)
    rates = compiled.start(TIPS)
    np.testing.assert_array_equal(one_by_one.start(TIPS), rates)
    for k in range(1, 30):
        tips = TIPS + np.array([0.0, 0.0, k * 0.001]) + rng.uniform(-0.001, 0.001, (2, 3))
        turned = rates * 0.001
        rates = compiled.step(0.001, turned, tips, 0.0)
        np.testing.assert_array_equal(one_by_one.step(0.001, turned, tips, 0.0), rates)
    one, other = one_by_one.belief(), compiled.belief()
    assert one is not None
    assert other is not None
    for name in ("x", "x_std", "sin_pitch", "sin_pitch_std", "missed"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_the_belief_follows_from_the_estimates() -> None:
    needles = SteeredNeedles(
        lambda count: BestEstimators(FilterSettings(), count, 0.001), each_rate(lambda _: still)
    )
    assert needles.belief() is None
    needles.start(TIPS)
    needles.step(0.001, np.zeros(2), TIPS, 0.0)
    belief = needles.belief()
    assert belief is not None
    assert isinstance(needles._estimators, BestEstimators)
    for n, estimate in enumerate(needles._estimators.each()):
        pitch, covariance = estimate.coordinates[4], estimate.covariance
        assert belief.x[n] == pytest.approx(estimate.coordinates[0])
        assert belief.sin_pitch[n] == pytest.approx(np.sin(pitch), abs=1e-9)
        assert belief.x_std[n] ** 2 == pytest.approx(covariance[0, 0])
        # d sin(pitch) = cos(pitch) d pitch, to first order
        to_first_order = np.cos(pitch) * np.sqrt(covariance[4, 4])
        assert belief.sin_pitch_std[n] == pytest.approx(to_first_order, rel=0.02)
    # The paper's observer uses no covariance.
    paper = controller_factory("paper", 0.001)()
    paper.start(TIPS)
    assert paper.belief() is None


def test_needles_off_their_target_report_a_miss() -> None:
    tips = np.array([[0.0005, 0.0, 0.0], [-0.003, 0.0, 0.0]])
    needles = SteeredNeedles(
        lambda _: SeparateEstimators(lambda _: HypothesisFilter(FilterSettings())),
        each_rate(lambda _: still),
    )
    needles.start(tips)
    belief = needles.belief()
    assert belief is not None
    assert belief.missed is not None
    assert belief.missed[0] < 0.8 < 0.95 < belief.missed[1]
