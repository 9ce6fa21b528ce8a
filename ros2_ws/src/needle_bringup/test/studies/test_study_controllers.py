"""Controllers of studies: what they are told, and what their needles say of themselves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from needle_bringup.studies import study_controllers
from needle_bringup.studies.study_controllers import (
    SteeredNeedles,
    controller_factory,
    needles_at_a_time,
    planned_law,
    point_controller_factory,
)
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.target_motion import TargetMotion
from needle_controller.presets.steering_settings import SteeringSettings

pytestmark = pytest.mark.usefixtures("compiled")
TIPS = np.array([[0.0005, 0.0, 0.001], [-0.0005, 0.0, 0.0012]])


class Recorder(HypothesisFilter):
    """Keeps how far it was advanced, and with which covariances it is corrected."""

    def __init__(self) -> None:
        super().__init__(FilterSettings())
        self.given: list[Any] = []
        self.advanced: list[tuple[float, float]] = []

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        self.advanced.append((np.max(d_insertion), np.max(d_rotation)))
        super().advance(d_insertion, d_rotation)

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        self.given.append(covariance)
        super().correct(tip, covariance, age)


def still(estimate: Any, insertion: float) -> Any:
    """Turn nothing."""
    rate = np.zeros(len(estimate.curvature))
    return SteeringCommand(rate, rate)


def test_the_controller_is_told_what_is_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[SteeringSettings] = []
    recorder = Recorder()

    def make(settings: SteeringSettings, *_: Array, **__: int) -> tuple[Recorder, Any]:
        made.append(settings)
        return recorder, still

    monkeypatch.setattr(study_controllers, "make_controller", make)
    for scale in (1.0, 2.0):
        needles = controller_factory("best", 0.002, sigma_scale=scale, turn_delay=0.0004)()
        needles.start(TIPS)
        needles.step(0.001, np.ones(2), TIPS, 0.0)
        assert made[-1].tip_noise_bound == 0.002
    told, given = recorder.given
    assert told is None
    # uniform noise within 2 mm has a variance of (2 mm)^2 / 3; sigmas half as large
    np.testing.assert_allclose(given, np.eye(3) * 0.002**2 / 3.0 / 4.0)
    # The base turns by an answer that comes late after it has gone on.
    np.testing.assert_allclose(recorder.advanced[:2], [(0.0004, 0.0), (0.0006, 1.0)])


def test_needles_say_what_their_estimate_says() -> None:
    estimator = HypothesisFilter(FilterSettings())
    needles = SteeredNeedles(estimator, still)
    assert needles.belief() is None
    needles.start(TIPS)
    needles.step(0.001, np.zeros(2), TIPS, 0.0)
    belief, estimate = needles.belief(), estimator.estimate()
    assert belief is not None
    pitch, covariance = estimate.coordinates[:, 4], estimate.covariance
    np.testing.assert_allclose(belief.x, estimate.coordinates[:, 0])
    np.testing.assert_allclose(belief.sin_pitch, np.sin(pitch), atol=1e-9)
    np.testing.assert_allclose(belief.x_std**2, covariance[:, 0, 0])
    # d sin(pitch) = cos(pitch) d pitch, to first order
    to_first_order = np.cos(pitch) * np.sqrt(covariance[:, 4, 4])
    np.testing.assert_allclose(belief.sin_pitch_std, to_first_order, rtol=0.02)
    assert belief.doubtful is not None
    assert not np.any(belief.doubtful)
    # The paper's observer makes no use of a covariance.
    paper = controller_factory("paper", 0.001)()
    paper.start(TIPS)
    assert paper.belief() is None
    assert needles_at_a_time("paper") > needles_at_a_time("best")


def test_needles_that_are_not_where_they_are_to_be_say_so() -> None:
    tips = np.array([[0.0005, 0.0, 0.0], [-0.003, 0.0, 0.0]])
    needles = SteeredNeedles(HypothesisFilter(FilterSettings()), still)
    needles.start(tips)
    # What counts is the point, not the plane x = 0.
    to_points = point_controller_factory("best", 0.001)()
    to_points.see_targets(0.0, tips[::-1] + np.array([[0.0, 0.0009, 0.0], [0.0, 0.0, 0.06]]))
    to_points.start(tips[::-1])
    for belief in (needles.belief(), to_points.belief()):
        assert belief is not None
        np.testing.assert_array_equal(belief.doubtful, [False, True])


def test_a_planner_s_way_leads_where_there_is_one_and_nowhere_else() -> None:
    motion = TargetMotion()
    motion.see(0.0, np.array([[0.004, 0.0, 0.08], [0.05, 0.0, 0.02]]))
    needles = HypothesisFilter(FilterSettings())
    needles.reset(np.zeros((2, 3)), np.zeros((2, 2)))
    settings = SteeringSettings(depth=0.2, entry_angle_std=math.radians(2.0))
    command = planned_law(motion, settings)(needles.estimate(), *np.zeros((3, 2)))
    assert command.insertion_left is not None
    assert command.insertion_left[0] > 0.079
    assert command.insertion_left[1] == -math.inf
