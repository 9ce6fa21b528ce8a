"""The filter bank: consistency, torsion, noise shapes, bad settings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.filter.filter_settings import (
    CORRELATED,
    NORMAL,
    ROLL_HYPOTHESES,
    FilterSettings,
    NoiseHypothesis,
    RollHypothesis,
)
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.laws.roll_law import RollLaw, RollLawSettings
from needle_controller.many_needles import ManyFilters
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles

from .needles import (
    CURVATURE,
    RIGID,
    STEP,
    drive,
    noisy,
    path,
    rotation_error,
    turns_for,
)


@pytest.mark.parametrize(("roll", "bound_deg"), [(25.0, 12.0), (-75.0, 25.0), (180.0, 25.0)])
def test_finds_pose_and_curvature_from_positions(roll: float, bound_deg: float) -> None:
    turns, start, curvature = turns_for(120), (-0.003, 0.0, 0.0), 1.2 * CURVATURE
    poses = path(turns, np.deg2rad(8.0), np.deg2rad(roll), curvature, start=start)
    estimate = drive(HypothesisFilter(FilterSettings()), turns, noisy(poses))
    assert np.linalg.norm(estimate.position - poses[-1, :3, 3]) < 0.0006
    assert rotation_error(estimate, poses[-1]) < bound_deg
    assert np.abs(estimate.coordinates[4] - np.arcsin(poses[-1, 0, 2])) < np.deg2rad(2.0)
    assert estimate.curvature == pytest.approx(curvature, rel=0.06)


@pytest.mark.parametrize(("play", "lag"), [(np.deg2rad(30.0), 0.0), (0.0, 0.006)])
def test_recovers_the_torsion(play: float, lag: float) -> None:
    turns = turns_for(160, size=0.5)
    tips = noisy(path(turns, play=play, lag=lag), bound=0.0003)
    estimate = drive(HypothesisFilter(FilterSettings()), turns, tips)
    assert estimate.hypotheses is not None
    torsions = estimate.hypotheses.torsions
    best = torsions[np.argmax(torsions["weight"])]
    assert best["play"] == pytest.approx(play, abs=np.deg2rad(8.0) if play else 0.0)
    assert best["lag"] == pytest.approx(lag, abs=0.002 if lag else 0.0)


def test_learns_that_the_needle_lags_behind_the_stage() -> None:
    turns, estimator = turns_for(120), HypothesisFilter(FilterSettings())
    estimate = drive(estimator, turns, noisy(path(turns)), step=1.08 * STEP)
    assert estimator.hypotheses["scale"][0] == pytest.approx(1.0 / 1.08, abs=0.015)
    assert not estimate.warnings


def test_covariance_is_honest_for_gaussian_noise() -> None:
    """Normalised estimation error squared of position and orientation near its 6 dimensions."""
    roll_std = np.deg2rad(10.0)
    settings = FilterSettings(
        torsion_hypotheses=RIGID,
        roll_hypotheses=(RollHypothesis(0.0, roll_std, 1.0),),
        noise_hypotheses=(NoiseHypothesis(NORMAL, (1.0,), (1.0,), 1.0),),
        model_error=0.0,
    )
    rng = np.random.default_rng(7)
    std, count = 0.0005, 40
    squares = []
    for _ in range(18):
        yaw, pitch = rng.normal(0.0, settings.initial_angle_std, 2)
        roll = rng.normal(0.0, roll_std)
        turns = turns_for(count, seed=int(rng.integers(1 << 30)))
        # The needle's curvature varies as the estimator assumes.
        poses = path(turns, pitch, roll, CURVATURE * (1.0 + rng.normal(0.0, 0.15)))
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_rotvec([yaw, 0.0, 0.0]).as_matrix()
        poses = turned @ poses
        tips = poses[:, :3, 3] + rng.normal(0.0, std, (count + 1, 3))
        estimate = drive(HypothesisFilter(settings), turns, tips, np.eye(3) * std**2)
        angles = Rotation.from_matrix(poses[-1, :3, :3]).as_euler("XYZ")
        error = estimate.coordinates - [*poses[-1, :3, 3], *angles]
        error[5] = (error[5] + np.pi) % (2.0 * np.pi) - np.pi
        squares.append(error @ np.linalg.solve(estimate.covariance, error))
    assert 4.5 < np.mean(squares) < 7.5


def test_warns_of_many_outliers() -> None:
    rng = np.random.default_rng(3)
    turns = turns_for(40)
    tips = path(turns)[:, :3, 3]
    estimator = HypothesisFilter(FilterSettings(tip_noise_bound=0.0002))
    assert not drive(estimator, turns, noisy(path(turns), bound=0.0002)).warnings
    lost = drive(estimator, turns, tips + rng.uniform(-0.02, 0.02, tips.shape))
    assert any("outliers" in why for why in lost.warnings)


@pytest.mark.parametrize("covariance", [None, np.eye(3) * 1e-7])
def test_many_needles_equal_single_ones(covariance: Array | None) -> None:
    """Bit for bit, with late and missing tips."""
    rng, ages = np.random.default_rng(8), np.array([0.0, 0.0013, 0.003])
    count = len(ages)
    turns = np.stack([turns_for(30, seed) for seed in range(count)], axis=1)
    tips = np.stack([noisy(path(turns[:, n], 0.05 * n), n) for n in range(count)], axis=1)
    tips[1:][rng.random((30, count)) < 0.2] = np.nan
    together = ManyFilters(FilterSettings(), count, STEP)
    together.start(tips[0].copy())
    for turn, tip in zip(turns, tips[1:], strict=True):
        together.advance(np.full(count, STEP), turn)
        together.correct(tip.copy(), covariance, ages)
    rates = together.roll_rates(RollLawSettings(), 0.0)
    for n, known in enumerate(together.each()):
        alone = HypothesisFilter(FilterSettings(), None, np.zeros(3))
        expected = drive(alone, turns[:, n], tips[:, n], covariance, age=ages[n])
        for name in ("coordinates", "linearized", "covariance", "curvature"):
            np.testing.assert_array_equal(getattr(known, name), getattr(expected, name))
        assert rates[n] == RollLaw(RollLawSettings())(expected).rotation_rate


@pytest.mark.parametrize(("shape", "correlations"), [(NORMAL, ()), (CORRELATED, (0.5,))])
def test_a_change_of_frame_keeps_the_needle(shape: int, correlations: tuple[float, ...]) -> None:
    turn = rotation_from_angles([0.2, -0.1, 0.4])
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn, [0.002, 0.001, -0.003]
    turns = turns_for(30)
    tips = noisy(path(turns))
    # A single normal noise: a box or a mixture would depend on the axes of the plane.
    noise = NoiseHypothesis(shape, (1.0,), (1.0,), 1.0, correlations)
    settings = FilterSettings(noise_hypotheses=(noise,), outlier_share=1e-6)
    old, new = HypothesisFilter(settings), HypothesisFilter(settings, turn)
    # Correlated noise has a separate size for each axis.
    spread = np.diag([2e-7, 3e-7, 4e-7]) if shape == NORMAL else np.eye(3) * 1e-6
    drive(old, turns[:20], tips[:21], spread)
    old.change_frame(transform)
    seen, turned = tips @ turn.T + transform[:3, 3], turn @ spread @ turn.T
    for d_rotation, tip in zip(turns[20:], seen[21:], strict=True):
        old.advance(STEP, d_rotation)
        old.correct(tip, turned)
    moved = drive(new, turns, seen, turned)
    np.testing.assert_allclose(old.estimate().coordinates, moved.coordinates, atol=1e-7)
    scale = np.sqrt(np.outer(np.diag(moved.covariance), np.diag(moved.covariance)))
    found = old.estimate().covariance
    np.testing.assert_allclose(found / scale, moved.covariance / scale, atol=1e-4)


@pytest.mark.parametrize(
    ("lasting", "sizes"), [(0.0, 1.0), (0.5, 1.0), (0.8, 1.0), (0.0, [2.0, 0.3, 0.3])]
)
def test_covariance_is_honest_for_any_noise(lasting: float, sizes: npt.ArrayLike) -> None:
    rng, needles, steps = np.random.default_rng(8), 24, 60
    turns = turns_for(steps)
    poses = path(turns, np.deg2rad(5.0), np.deg2rad(10.0))
    errors = rng.normal(size=(steps + 1, needles, 3))
    for k in range(1, steps + 1):
        errors[k] = lasting * errors[k - 1] + np.sqrt(1.0 - lasting**2) * errors[k]
    tips = poses[:, None, :3, 3] + errors * np.asarray(sizes) * 0.001 / np.sqrt(3.0)
    filters = ManyFilters(FilterSettings(), needles, STEP)
    filters.start(tips[0].copy())
    inside = []
    for turn, tip, pose in zip(turns, tips[1:], poses[1:], strict=True):
        filters.advance(np.full(needles, STEP), np.full(needles, turn))
        filters.correct(tip.copy(), None, np.zeros(needles))
        spread = np.sqrt(filters.estimates["uncertainty"][:, 0])
        off = np.abs(filters.estimates["coordinates"][:, 0] - pose[0, 3])
        inside.append(off < 2.0 * spread)
    assert np.mean(inside[20:]) > 0.93


def test_a_start_without_a_tip_takes_the_next_one() -> None:
    estimator = HypothesisFilter(FilterSettings())
    estimator.reset(np.full(3, np.nan), np.zeros(2))
    estimator.advance(STEP, 0.0)
    estimator.correct(np.array([-0.003, 0.001, 0.001]))
    np.testing.assert_allclose(estimator.estimate().position, [-0.003, 0.001, 0.001], atol=1e-4)


def test_warns_of_an_ambiguous_roll() -> None:
    estimator = HypothesisFilter(FilterSettings(roll_hypotheses=ROLL_HYPOTHESES))
    estimator.reset(np.zeros(3), np.zeros(2))
    assert any("roll" in warning for warning in estimator.estimate().warnings)


@pytest.mark.parametrize(("length", "turn"), [(-1e-6, 0.0), (np.nan, 0.0), (0.001, np.inf)])
def test_invalid_advances_raise_errors(length: float, turn: float) -> None:
    with pytest.raises(ValueError, match="expected finite"):
        HypothesisFilter(FilterSettings()).advance(length, turn)
