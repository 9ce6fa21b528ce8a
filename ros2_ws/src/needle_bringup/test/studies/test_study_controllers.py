from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from needle_bringup.studies import study_controllers
from needle_bringup.studies.study_controllers import (
    SteeredNeedles,
    controller_factory,
    point_controller_factory,
)
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.presets.steering_settings import SteeringSettings

TIPS = np.array([[0.0005, 0.0, 0.001], [-0.0005, 0.0, 0.0012]])


class Recorder(HypothesisFilter):
    """Keeps with which covariance it is corrected."""

    given: list[Any]

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        self.given = [*getattr(self, "given", []), covariance]
        super().correct(tip, covariance, age)


def still(estimate: Any, insertion: float) -> Any:
    """Turn nothing."""
    rate = np.zeros(len(estimate.curvature))
    return SteeringCommand(rate, rate)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_controller_is_told_what_is_claimed(
    scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[SteeringSettings] = []
    recorder = Recorder(FilterSettings())

    def make(settings: SteeringSettings, *_: Array, **__: int) -> tuple[Recorder, Any]:
        made.append(settings)
        return recorder, still

    monkeypatch.setattr(study_controllers, "make_controller", make)
    needles = controller_factory("best", 0.002, sigma_scale=scale)()
    needles.start(TIPS)
    needles.step(0.001, np.zeros(2), TIPS, 0.0)
    assert made[0].tip_noise_bound == 0.002
    (given,) = recorder.given
    if scale == 1.0:
        assert given is None
    else:
        # uniform noise within 2 mm has a variance of (2 mm)^2 / 3; sigmas half as large
        np.testing.assert_allclose(given, np.eye(3) * 0.002**2 / 3.0 / 4.0)


def test_needles_say_what_their_estimate_says() -> None:
    estimator = HypothesisFilter(FilterSettings())
    needles = SteeredNeedles(estimator, still)
    assert needles.belief() is None
    needles.start(TIPS)
    needles.step(0.001, np.zeros(2), TIPS, 0.0)
    belief, estimate = needles.belief(), estimator.estimate()
    assert belief is not None
    np.testing.assert_allclose(belief.x, estimate.coordinates[:, 0])
    np.testing.assert_allclose(belief.sin_pitch, np.sin(estimate.coordinates[:, 4]), atol=1e-9)
    np.testing.assert_allclose(belief.x_std**2, estimate.covariance[:, 0, 0])
    # d sin(pitch) = cos(pitch) d pitch, to first order
    np.testing.assert_allclose(
        belief.sin_pitch_std,
        np.cos(estimate.coordinates[:, 4]) * np.sqrt(estimate.covariance[:, 4, 4]),
        rtol=0.02,
    )
    assert belief.doubtful is not None
    assert not np.any(belief.doubtful)


def test_needles_that_are_not_where_they_are_to_be_say_so() -> None:
    tips = np.array([[0.0005, 0.0, 0.0], [-0.003, 0.0, 0.0]])
    needles = SteeredNeedles(HypothesisFilter(FilterSettings()), still)
    needles.start(tips)
    belief = needles.belief()
    assert belief is not None
    np.testing.assert_array_equal(belief.doubtful, [False, True])
    # What counts is the point, not the plane x = 0.
    to_points = point_controller_factory("best", 0.001)()
    to_points.see_targets(0.0, tips[::-1] + np.array([[0.0, 0.0009, 0.0], [0.0, 0.0, 0.06]]))
    to_points.start(tips[::-1])
    belief = to_points.belief()
    assert belief is not None
    np.testing.assert_array_equal(belief.doubtful, [False, True])


@pytest.mark.parametrize(("name", "says"), [("best", True), ("paper", False)])
def test_only_the_paper_s_observer_says_nothing(name: str, says: bool) -> None:
    needles = controller_factory(name, 0.001)()
    needles.start(TIPS)
    needles.step(0.001, np.zeros(2), TIPS, 0.0)
    assert (needles.belief() is not None) == says
