from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from needle_bringup.studies.study_controllers import CURVATURE, STEP_LENGTH, controller_factory
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import BiasWalk, Disturbances, push_axes
from needle_sim.studies.figures_of_merit import Belief, Outcomes, figures
from needle_sim.studies.needles import DisturbedNeedles
from needle_sim.studies.study import GRIDS, StartBounds, StudySettings, run_study

LARGEST = np.array([0.003, np.deg2rad(10.0), np.deg2rad(30.0)])
BOUNDS = StartBounds(*LARGEST)
STARTS = GRIDS["random"](BOUNDS, 1, 4)[:20]
# Rolled by 90 deg, a needle bends within one plane.
LEVEL = np.array([[0.0, 0.0, np.deg2rad(90.0)]])
DISTURBED = Disturbances(
    noise=0.001,
    outliers=0.1,
    found=0.8,
    delay=2,
    curvature_scale=1.1,
    curvature_patches=0.2,
    play=0.2,
    lag_length=0.004,
    slip=0.02,
    bump=0.002,
    bias_walk=0.0003,
    layer=(0.8, 0.01),
    push=1.0,
    rotation_gain=0.9,
    roll_walk=1.0,
)


def settings(**changes: Any) -> StudySettings:
    base = StudySettings(CURVATURE, 0.120, STEP_LENGTH, Disturbances(), seed=1)
    return dataclasses.replace(base, **changes)


class Watching:
    """Does not steer; stores its inputs."""

    def __init__(self) -> None:
        self.lengths: list[float] = []
        self.tips: list[FloatArray] = []
        self.ages: list[float] = []

    def start(self, tips: FloatArray) -> FloatArray:
        return np.zeros(len(tips))

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        self.lengths.append(float(d_insertion))
        self.tips.append(tips)
        self.ages.append(float(age))
        return np.zeros(len(tips))

    def belief(self) -> Belief | None:
        return None


def watched(needle: FloatArray, **changes: Any) -> tuple[Watching, Outcomes]:
    watching = Watching()
    return watching, run_study(needle, lambda: watching, settings(**changes))


@pytest.mark.parametrize(("name", "share"), [("endpoint", 1.0), ("cell", 0.9)])
def test_a_grid_is_uniform_within_the_bounds_of_its_convention(name: str, share: float) -> None:
    points, counts = np.unique(GRIDS[name](BOUNDS, 3, 1), axis=0, return_counts=True)
    assert points.shape == (1000, 3)
    assert set(counts) == {3}
    for column, largest in zip(points.T, LARGEST, strict=True):
        values = np.unique(column)
        np.testing.assert_allclose(values, share * np.linspace(-largest, largest, 10))


def test_random_starts_are_uniform_within_the_bounds_and_follow_the_seed() -> None:
    starts = GRIDS["random"](BOUNDS, 2, 1)
    assert len(np.unique(starts, axis=0)) == len(starts) == 2000
    share = starts / LARGEST
    assert np.all(np.abs(share) <= 1.0)
    # The standard error of the mean is 0.013.
    assert np.all(np.abs(np.mean(share, axis=0)) < 0.06)
    np.testing.assert_allclose(np.std(share, axis=0), 1.0 / np.sqrt(3.0), rtol=0.05)
    assert np.all(np.abs(np.corrcoef(starts.T) - np.eye(3)) < 0.1)
    np.testing.assert_array_equal(starts, GRIDS["random"](BOUNDS, 2, 1))
    assert not np.any(np.all(starts == GRIDS["random"](BOUNDS, 2, 2), axis=1))


@pytest.mark.parametrize(
    ("wrong", "curvature", "length"),
    [
        ({"curvature_scale": 0.8}, 0.8 * CURVATURE, 0.12),
        # The needle is inserted less, or more, than the stage moves.
        ({"slip": 0.05}, CURVATURE, 0.12 / 1.05),
        ({"slip": -0.05}, CURVATURE, 0.12 / 0.95),
    ],
)
def test_curvature_and_slip_act_on_the_needle(
    wrong: dict[str, float], curvature: float, length: float
) -> None:
    watching, found = watched(LEVEL, disturbances=Disturbances(**wrong))  # type: ignore[arg-type]
    bend = curvature * length
    assert found.x_end[0] == pytest.approx((1.0 - np.cos(bend)) / curvature, abs=1e-9)
    assert (found.rotation[0], found.x_start[0]) == (0.0, 0.0)
    assert watching.tips[-1][0, 2] == pytest.approx(np.sin(bend) / curvature, abs=1e-9)
    assert np.sum(watching.lengths) == pytest.approx(0.120)


def cross(vector: FloatArray) -> FloatArray:
    return np.cross(vector, np.eye(3), axisb=0, axisc=0)


def test_a_pushed_needle_follows_its_linear_equations_of_motion() -> None:
    """R' = W R + R B and p' = R e3 are linear in (R, p): one matrix exponential solves them."""
    push, gain, turn, length = 2.0, 0.8, 20.0, 0.120
    wrong = Disturbances(push=push, rotation_gain=gain)
    needles = DisturbedNeedles(STARTS, wrong, curvature=CURVATURE, bump_at=1.0, seed=3, first=0)
    begun = needles.true.T_rig_tip
    for step in range(120):
        needles.insert(step * 1e-3, (step + 1) * 1e-3, 1e-3, np.full(len(STARTS), turn * 1e-3))
    body = cross(np.array([CURVATURE, 0.0, gain * turn]))
    for pose, axis, found in zip(
        begun, push_axes(push, 3, 0, len(STARTS)), needles.true.T_rig_tip, strict=True
    ):
        motion = np.zeros((12, 12))
        # vec(W R + R B), row by row
        motion[:9, :9] = np.kron(cross(axis), np.eye(3)) + np.kron(np.eye(3), body.T)
        motion[9:, 2:9:3] = np.eye(3)
        state = np.concatenate([pose[:3, :3].ravel(), pose[:3, 3]])
        end = scipy.linalg.expm(motion * length) @ state
        np.testing.assert_allclose(found[:3, :3].ravel(), end[:9], atol=1e-12)
        np.testing.assert_allclose(found[:3, 3], end[9:], atol=1e-6)
    # The push alone bends a needle without a bevel into a circle about its axis.
    alone = DisturbedNeedles(0.0 * STARTS, wrong, curvature=0.0, bump_at=1.0, seed=3, first=0)
    alone.insert(0.0, length, length, np.zeros(len(STARTS)))
    np.testing.assert_allclose(alone.true.T_rig_tip[:, 2, 2], np.cos(push * length), atol=1e-12)


def test_a_layer_changes_the_curvature_from_its_beginning() -> None:
    _, found = watched(LEVEL, depth=0.100, disturbances=Disturbances(layer=(0.3, 0.06)))
    first, second = CURVATURE * 0.06, 0.3 * CURVATURE * 0.04
    expected = (1.0 - np.cos(first)) / CURVATURE
    expected += (np.cos(first) - np.cos(first + second)) / (0.3 * CURVATURE)
    assert found.x_end[0] == pytest.approx(expected, abs=1e-9)


def test_the_roll_drifts_by_the_root_of_the_insertion_and_a_bias_is_only_measured() -> None:
    count = 4000
    wrong = Disturbances(roll_walk=1.0, bias_walk=0.0003, slip=0.25)
    needles = DisturbedNeedles(
        np.zeros((count, 3)), wrong, curvature=0.0, bump_at=1.0, seed=3, first=0
    )
    bias = BiasWalk(0.0003, 3, 0, count)
    np.testing.assert_allclose(needles.measured() - needles.true.tips, bias.at(0), atol=1e-15)
    for step in range(20):
        needles.insert(step * 1e-3, (step + 1) * 1e-3, 1e-3, np.zeros(count))
        seen, _ = needles.measure((step + 1) * 1e-3)
        off = seen - needles.true.tips
        np.testing.assert_allclose(off, bias.at(step + 1), atol=1e-15)
    turned = np.arctan2(needles.true.T_rig_tip[:, 1, 0], needles.true.T_rig_tip[:, 0, 0])
    # 1 rad/sqrt(m) over 20 mm of the stage, of which 16 mm cut tissue; five standard errors.
    wanted = np.sqrt(0.016)
    assert abs(np.std(turned) / wanted - 1.0) < 5.0 / np.sqrt(2.0 * count)
    assert abs(np.mean(turned)) < 5.0 * wanted / np.sqrt(count)


def test_outcomes_follow_the_seed_and_not_the_chunks() -> None:
    disturbed = settings(disturbances=DISTURBED, depth=0.021)

    def values(study: StudySettings = disturbed, chunk: int = 500) -> FloatArray:
        found = run_study(STARTS, controller_factory("best", 0.001), study, chunk=chunk)
        return np.column_stack([found.x_last, found.settled, found.rotation])

    whole = values()
    # Vectorised sums depend on the number of needles in the last digits.
    np.testing.assert_allclose(values(chunk=7), whole, atol=1e-9)
    assert not np.any(values(dataclasses.replace(disturbed, seed=2))[:, 0] == whole[:, 0])


def test_a_bump_moves_the_needle_once_at_half_the_depth_and_not_the_plane() -> None:
    still, calm = watched(STARTS, depth=0.030)
    watching, found = watched(STARTS, depth=0.030, disturbances=Disturbances(bump=0.002))
    moved = np.array(watching.tips) - np.array(still.tips)
    np.testing.assert_allclose(moved[:14], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(moved[14:], axis=-1), 0.002)
    np.testing.assert_allclose(moved[14:], np.broadcast_to(moved[14], moved[14:].shape))
    np.testing.assert_allclose(found.x_last - calm.x_last, moved[10:, :, 0].T, atol=1e-12)


def test_tips_with_a_hidden_delay_appear_to_be_new() -> None:
    prompt, _ = watched(STARTS[:3], depth=0.010)
    both, _ = watched(STARTS[:3], depth=0.010, disturbances=Disturbances(delay=2, hidden_delay=1))
    assert np.all(np.isnan(both.tips[:3]))
    np.testing.assert_array_equal(both.tips[3:], prompt.tips[:-3])
    np.testing.assert_allclose(both.ages, [0.0] * 2 + [0.002] * 8)


def test_estimates_are_compared_with_the_truth_of_their_step() -> None:
    class Knowing(Watching):
        """Estimates the tip of a needle in a plane, with its roll of 0."""

        def belief(self) -> Belief | None:
            x = self.tips[-1][:, 0]
            some = np.full_like(x, 1e-9)
            return Belief(x, some, np.zeros_like(x), some, np.array([True, False, False, False]))

    flat = np.array([[x, 0.0, 0.0] for x in (0.0, 0.001, 0.002, 0.003)])
    found = run_study(flat, Knowing, settings(depth=0.030))
    np.testing.assert_array_equal(found.inside_2_sigma, 1.0)
    assert figures(found)["doubtful_at_end"] == 0.25
    # x is known, the pitch is not.
    pitched = run_study(flat + np.array([0.0, 0.1, 0.0]), Knowing, settings(depth=0.030))
    np.testing.assert_array_equal(pitched.inside_3_sigma, 0.5)
