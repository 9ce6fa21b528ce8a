from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bringup.studies.study_controllers import (
    CURVATURE,
    STEP_LENGTH,
)
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.figures_of_merit import Belief
from needle_sim.studies.point_study import (
    BREATHING_RATE,
    CURVATURE_SHARE,
    FARTHEST,
    INSERTION_SPEED,
    NEAREST,
    MovingTargets,
    point_figures,
    random_targets,
    run_point_study,
)
from needle_sim.studies.study import GRIDS, StartBounds, StudySettings

STARTS = GRIDS["random"](StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0)), 1, 4)
STRAIGHT = StudySettings(1e-6, 0.150, STEP_LENGTH, Disturbances(), seed=1)


def test_targets_are_at_the_end_of_an_allowed_arc_and_follow_the_seed() -> None:
    targets = random_targets(STARTS, CURVATURE, 3)
    angles = np.column_stack([np.zeros(len(STARTS)), STARTS[:, 1:]])
    off = targets - np.column_stack([STARTS[:, 0], np.zeros((len(STARTS), 2))])
    local = Rotation.from_euler("XYZ", angles).inv().apply(off)
    ahead, across = local[:, 2], np.hypot(local[:, 0], local[:, 1])
    assert NEAREST <= ahead.min() < NEAREST + 0.001
    assert FARTHEST - 0.001 < ahead.max() <= FARTHEST
    # A circle that touches the heading and goes through the point has this curvature.
    share = 2.0 * across / (ahead**2 + across**2) / CURVATURE
    assert 0.99 * CURVATURE_SHARE < share.max() <= CURVATURE_SHARE + 1e-9
    # Uniform over the disc: half of them in the inner half of its area, five standard errors.
    tightest = CURVATURE_SHARE * CURVATURE
    widest = 1.0 / tightest - np.sqrt(1.0 / tightest**2 - ahead**2)
    inner = np.mean(across < widest / np.sqrt(2.0))
    assert abs(inner - 0.5) < 5.0 * 0.5 / np.sqrt(len(across))
    around = np.arctan2(local[:, 1], local[:, 0])
    assert np.hypot(np.mean(np.cos(around)), np.mean(np.sin(around))) < 0.1
    np.testing.assert_array_equal(random_targets(STARTS[:10], CURVATURE, 3), targets[:10])
    assert not np.any(random_targets(STARTS, CURVATURE, 4) == targets)


def test_targets_drift_and_breathe_independent_of_the_selection() -> None:
    places = random_targets(STARTS[:100], CURVATURE, 3)
    targets = MovingTargets(places, drift=0.002 / 60.0, breath=0.003, seed=5)
    period, whole = 1.0 / BREATHING_RATE, FARTHEST / INSERTION_SPEED
    assert whole % period == 0.0
    drifted = targets.at(whole) - targets.at(0.0)
    np.testing.assert_allclose(np.linalg.norm(drifted, axis=1), 0.002)
    swings = np.stack([targets.at(t) - drifted * t / whole for t in np.arange(0.0, period, 0.02)])
    widths = np.linalg.norm(swings - swings.mean(axis=0), axis=2).max(axis=0)
    np.testing.assert_allclose(widths, 0.003, rtol=1e-3)
    some = targets.part(50, 7)
    np.testing.assert_array_equal(some.at(3.3), targets.at(3.3)[50:57])
    each = np.linspace(0.0, 6.0, 7)
    for k, time in enumerate(each):
        np.testing.assert_allclose(some.at(each)[k], some.at(float(time))[k])


class Straight:
    """Does not turn; ends when the measured tip reaches a plane across the insertion."""

    def __init__(self) -> None:
        self._targets = self._left = np.zeros(0)
        self.lengths: list[FloatArray] = []

    def set_targets(self, time: float, targets: FloatArray) -> None:
        self._targets = targets
        if not self.lengths:
            self._left = targets[:, 2]

    def start(self, tips: FloatArray) -> FloatArray:
        return np.zeros(len(tips))

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        self.lengths.append(np.array(d_insertion))
        self._left = self._targets[:, 2] - tips[:, 2]
        return np.full(len(tips), 10.0)

    def insertion_left(self) -> FloatArray:
        return self._left

    def belief(self) -> Belief | None:
        return None


def test_each_needle_ends_at_its_own_point_with_a_short_last_step() -> None:
    targets = MovingTargets(np.array([[0.0, 0.0, 0.0105], [0.002, 0.0, 0.0203]]))
    straight = Straight()
    found = run_point_study(np.zeros((2, 3)), targets, lambda: straight, STRAIGHT)
    lengths = np.array(straight.lengths)
    assert len(lengths) == 21
    np.testing.assert_allclose(lengths[:11, 0].sum(), 0.0105)
    np.testing.assert_allclose(lengths[:, 1].sum(), 0.0203)
    assert lengths[10, 0] == pytest.approx(0.0005, abs=1e-9)
    np.testing.assert_allclose(found.error, [0.0, 0.002], atol=1e-6)
    # 10 rad/m from the second step on.
    np.testing.assert_allclose(found.rotation, 10.0 * np.array([0.0095, 0.0193]))
    np.testing.assert_array_equal(found.reached, [True, False])
    seen = point_figures(found)
    assert (seen["within_1_mm_point"], seen["doubtful_at_end"]) == (0.5, None)
    assert seen["max_point_mm"] == pytest.approx(2.0, abs=1e-3)
    apart = run_point_study(np.zeros((2, 3)), targets, Straight, STRAIGHT, chunk=1)
    np.testing.assert_allclose(apart.error, found.error, atol=1e-9)
    # No needle is inserted beyond the depth.
    shallow = dataclasses.replace(STRAIGHT, depth=0.0155)
    found = run_point_study(np.zeros((2, 3)), targets, Straight, shallow)
    assert found.error[1] == pytest.approx(np.hypot(0.002, 0.0048), abs=1e-6)
