from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.beliefs import Belief
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.point_study import PointOutcomes, point_figures, run_point_study
from needle_sim.studies.point_targets import CURVATURE_SHARE, FARTHEST, NEAREST, random_targets
from needle_sim.studies.start_grids import GRIDS, StartBounds
from needle_sim.studies.study import StudySettings
from needle_verification.studies.study_controllers import (
    CURVATURE,
    STEP_LENGTH,
    point_controller_factory,
)

STARTS = GRIDS["random"](StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0)), 1, 4)
SETTINGS = StudySettings(CURVATURE, 0.150, STEP_LENGTH, Disturbances(), seed=1)


def in_start_frame(starts: FloatArray, points: FloatArray) -> FloatArray:
    angles = np.column_stack([np.zeros(len(starts)), starts[:, 1:]])
    off = points - np.column_stack([starts[:, 0], np.zeros((len(starts), 2))])
    return np.asarray(Rotation.from_euler("XYZ", angles).inv().apply(off))


def test_targets_lie_where_an_arc_of_the_allowed_curvature_leads() -> None:
    local = in_start_frame(STARTS, random_targets(STARTS, CURVATURE, 3))
    ahead, across = local[:, 2], np.hypot(local[:, 0], local[:, 1])
    assert NEAREST <= ahead.min() < NEAREST + 0.001
    assert FARTHEST - 0.001 < ahead.max() <= FARTHEST
    # a circle that touches the heading and goes through the point has this curvature
    share = 2.0 * across / (ahead**2 + across**2) / CURVATURE
    assert 0.99 * CURVATURE_SHARE < share.max() <= CURVATURE_SHARE + 1e-9
    # uniform over the disc: half of them in the inner half of its area, five standard errors
    tightest = CURVATURE_SHARE * CURVATURE
    widest = 1.0 / tightest - np.sqrt(1.0 / tightest**2 - ahead**2)
    inner = np.mean(across < widest / np.sqrt(2.0))
    assert abs(inner - 0.5) < 5.0 * 0.5 / np.sqrt(len(across))
    around = np.arctan2(local[:, 1], local[:, 0])
    assert np.hypot(np.mean(np.cos(around)), np.mean(np.sin(around))) < 0.1


def test_targets_follow_the_seed() -> None:
    base = random_targets(STARTS, CURVATURE, 3)
    np.testing.assert_array_equal(random_targets(STARTS[:10], CURVATURE, 3), base[:10])
    assert not np.any(random_targets(STARTS, CURVATURE, 4) == base)


class Straight:
    """Does not turn; ends where the measured tip has come to a plane across the insertion."""

    def __init__(self, targets: FloatArray) -> None:
        self._targets = targets
        self._left = targets[:, 2]
        self.lengths: list[FloatArray] = []

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
    targets = np.array([[0.0, 0.0, 0.0105], [0.002, 0.0, 0.0203]])
    made: list[Straight] = []

    def new_controller(points: FloatArray) -> Straight:
        made.append(Straight(points))
        return made[-1]

    straight = StudySettings(1e-6, 0.150, STEP_LENGTH, Disturbances(), seed=1)
    found = run_point_study(np.zeros((2, 3)), targets, new_controller, straight)
    lengths = np.array(made[0].lengths)
    assert len(lengths) == 21
    np.testing.assert_allclose(lengths[:11, 0].sum(), 0.0105)
    np.testing.assert_allclose(lengths[:, 1].sum(), 0.0203)
    assert lengths[10, 0] == pytest.approx(0.0005, abs=1e-9)
    np.testing.assert_allclose(found.error, [0.0, 0.002], atol=1e-6)
    # 10 rad/m from the second step on
    np.testing.assert_allclose(found.rotation, 10.0 * np.array([0.0095, 0.0193]))
    np.testing.assert_array_equal(found.reached, [True, False])


def test_no_needle_goes_beyond_the_depth() -> None:
    shallow = StudySettings(1e-6, 0.0155, STEP_LENGTH, Disturbances(), seed=1)
    found = run_point_study(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.02]]), Straight, shallow)
    assert found.error[0] == pytest.approx(0.0045, abs=1e-9)


def test_figures_of_known_ends() -> None:
    nothing = np.full(2, np.nan)
    ends = PointOutcomes(
        np.array([0.0003, 0.0014]), np.array([1.0, 3.0]), nothing, nothing, nothing
    )
    seen = point_figures(ends)
    assert seen["within_1_mm_point"] == 0.5
    assert seen["rms_point_mm"] == pytest.approx(np.sqrt((0.09 + 1.96) / 2.0))
    assert seen["max_point_mm"] == pytest.approx(1.4)
    assert seen["rotation_mean_deg"] == pytest.approx(np.rad2deg(2.0))
    assert seen["doubtful_at_end"] is None


def test_best_comes_to_points_and_the_chunks_do_not_matter() -> None:
    noisy = StudySettings(CURVATURE, 0.150, STEP_LENGTH, Disturbances(noise=0.001), seed=7)
    starts = STARTS[:60]
    targets = random_targets(starts, CURVATURE, 7)
    found = run_point_study(starts, targets, point_controller_factory("best", 0.001), noisy)
    # of thousands 99.7 % are: one of 60 may not be
    assert np.mean(found.reached) >= 59 / 60
    assert np.rad2deg(np.mean(found.rotation)) < 1300.0
    again = run_point_study(
        starts, targets, point_controller_factory("best", 0.001), noisy, chunk=7
    )
    np.testing.assert_allclose(again.error, found.error, atol=1e-9)
