"""The filter bank: consistency, torsion, noise shapes, bad settings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.filter.bank import advance_needle, correct_needle
from needle_controller.filter.filter_settings import (
    CORRELATED,
    NORMAL,
    ROLL_HYPOTHESES,
    FilterSettings,
    NoiseHypothesis,
    RollHypothesis,
)
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.filter.mixture import estimate_needle
from needle_controller.laws.roll_law import RollLaw, RollLawSettings
from needle_controller.many_needles import ManyFilters
from needle_controller.model.kinematics import rotation_from_angles

from .needles import (
    CURVATURE,
    RIGID,
    ROLL_AS_SET,
    STEP,
    drive,
    noisy,
    path,
    rotation_error,
    turns_for,
)


def test_finds_the_pose_from_positions() -> None:
    turns = turns_for(100)
    poses = path(turns, np.deg2rad(8.0), np.deg2rad(25.0), start=(-0.003, 0.0, 0.0))
    estimate = drive(HypothesisFilter(FilterSettings()), turns, noisy(poses))
    assert np.linalg.norm(estimate.position - poses[-1, :3, 3]) < 0.0006
    assert rotation_error(estimate, poses[-1]) < 12.0
    assert np.abs(estimate.coordinates[4] - np.arcsin(poses[-1, 0, 2])) < np.deg2rad(2.0)


@pytest.mark.parametrize("roll", [-150.0, -75.0, 90.0, 180.0])
def test_finds_an_unexpected_roll(roll: float) -> None:
    turns = turns_for(80)
    poses = path(turns, 0.0, np.deg2rad(roll))
    estimate = drive(HypothesisFilter(FilterSettings()), turns, noisy(poses))
    assert rotation_error(estimate, poses[-1]) < 25.0


def test_estimates_the_curvature() -> None:
    turns = turns_for(120)
    poses = path(turns, curvature=1.2 * CURVATURE)
    estimate = drive(HypothesisFilter(FilterSettings()), turns, noisy(poses))
    assert estimate.curvature == pytest.approx(1.2 * CURVATURE, rel=0.06)


@pytest.mark.parametrize(
    ("play_deg", "lag", "column", "other", "tolerance"),
    [(30.0, 0.0, "play", "lag", np.deg2rad(8.0)), (0.0, 0.006, "lag", "play", 0.002)],
)
def test_recovers_the_torsion(
    play_deg: float, lag: float, column: str, other: str, tolerance: float
) -> None:
    turns = turns_for(160, size=0.5)
    poses = path(turns, play=np.deg2rad(play_deg), lag=lag)
    estimate = drive(HypothesisFilter(FilterSettings()), turns, noisy(poses, bound=0.0003))
    assert estimate.hypotheses is not None
    torsions = estimate.hypotheses.torsions
    best = torsions[np.argmax(torsions["weight"])]
    assert best[column] == pytest.approx(np.deg2rad(play_deg) + lag, abs=tolerance)
    assert best[other] == 0.0


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
        true = poses[-1]
        angles = np.array([np.arctan2(-true[1, 2], true[2, 2]), np.arcsin(true[0, 2])])
        roll = np.arctan2(-true[0, 1], true[0, 0])
        error = estimate.coordinates - [*true[:3, 3], *angles, roll]
        error[5] = (error[5] + np.pi) % (2.0 * np.pi) - np.pi
        squares.append(error @ np.linalg.solve(estimate.covariance, error))
    assert 4.5 < np.mean(squares) < 7.5


def test_learns_that_the_needle_lags_behind_the_stage() -> None:
    turns = turns_for(120)
    tips = noisy(path(turns))
    estimator = HypothesisFilter(FilterSettings())
    estimator.reset(tips[0], np.zeros(2))
    for turn, tip in zip(turns, tips[1:], strict=True):
        estimator.advance(STEP * 1.08, turn)
        estimator.correct(tip)
    scale = estimator.hypotheses["scale"][0]
    assert scale == pytest.approx(1.0 / 1.08, abs=0.015)
    assert not estimator.estimate().warnings


def test_warns_of_many_outliers() -> None:
    rng = np.random.default_rng(3)
    turns = turns_for(40)
    tips = path(turns)[:, :3, 3]
    estimator = HypothesisFilter(FilterSettings(tip_noise_bound=0.0002))
    assert not drive(estimator, turns, noisy(path(turns), bound=0.0002)).warnings
    lost = drive(estimator, turns, tips + rng.uniform(-0.02, 0.02, tips.shape))
    assert any("outliers" in why for why in lost.warnings)


@pytest.mark.parametrize("with_covariance", [False, True])
def test_many_needles_equal_single_ones(with_covariance: bool) -> None:
    """Bit for bit, with late and missing tips."""
    rng, count = np.random.default_rng(8), 6
    covariance = np.eye(3) * 1e-7 if with_covariance else None
    turns = np.stack([turns_for(30, seed) for seed in range(count)], axis=1)
    tips = np.stack([noisy(path(turns[:, n], 0.05 * n), n) for n in range(count)], axis=1)
    tips[rng.random(tips.shape[:2]) < 0.2] = np.nan
    tips[0] = 0.0
    ages = np.array([0.0, 0.0013, 0.003, 0.0, 0.0, 0.001])
    settings = FilterSettings()
    together = ManyFilters(settings, count, STEP)
    every = [HypothesisFilter(settings, None, np.zeros(3)) for _ in range(count)]
    together.start(tips[0].copy())
    for n, alone in enumerate(every):
        alone.reset(tips[0, n], np.zeros(2))
    for turn, tip in zip(turns, tips[1:], strict=True):
        together.advance(np.full(count, STEP), turn)
        together.correct(tip.copy(), covariance, ages)
        for n, alone in enumerate(every):
            alone.advance(STEP, turn[n])
            alone.correct(tip[n], covariance, ages[n])
    law = RollLaw(RollLawSettings())
    rates = together.roll_rates(RollLawSettings(), 0.0)
    for n, (alone, known) in enumerate(zip(every, together.each(), strict=True)):
        expected = alone.estimate()
        for name in ("coordinates", "linearized", "covariance", "curvature"):
            np.testing.assert_array_equal(getattr(known, name), getattr(expected, name))
        assert rates[n] == law(expected).rotation_rate


@pytest.mark.parametrize(
    "noise",
    [
        NoiseHypothesis(NORMAL, (1.0,), (1.0,), 1.0),
        NoiseHypothesis(CORRELATED, (1.0,), (1.0,), 1.0, (0.5,)),
    ],
)
def test_a_change_of_frame_keeps_the_needle(noise: NoiseHypothesis) -> None:
    turn = rotation_from_angles([0.2, -0.1, 0.4])
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn, [0.002, 0.001, -0.003]
    turns = turns_for(30)
    tips = noisy(path(turns))
    # A single normal noise: a box or a mixture would depend on the axes of the plane.
    settings = FilterSettings(noise_hypotheses=(noise,), outlier_share=1e-6)
    old, new = HypothesisFilter(settings), HypothesisFilter(settings, turn)
    # Correlated noise has a separate size for each axis.
    spread = np.diag([2e-7, 3e-7, 4e-7]) if noise.shape == NORMAL else np.eye(3) * 1e-6
    drive(old, turns[:20], tips[:21], spread)
    old.change_frame(transform)
    seen, turned = tips @ turn.T + transform[:3, 3], turn @ spread @ turn.T
    for d_rotation, tip in zip(turns[20:], seen[21:], strict=True):
        old.advance(STEP, d_rotation)
        old.correct(tip, turned)
    moved = drive(new, turns, seen, turned)
    np.testing.assert_allclose(old.estimate().coordinates, moved.coordinates, atol=1e-7)
    scale = np.sqrt(np.diag(moved.covariance))
    np.testing.assert_allclose(
        old.estimate().covariance / np.outer(scale, scale),
        moved.covariance / np.outer(scale, scale),
        atol=1e-4,
    )
    np.testing.assert_allclose(old.needle["initial_rotation"], new.needle["initial_rotation"])


@pytest.mark.parametrize(
    ("lasting", "each"),
    [
        (0.0, (1.0, 1.0, 1.0)),
        (0.5, (1.0, 1.0, 1.0)),
        (0.8, (1.0, 1.0, 1.0)),
        (0.0, (2.0, 0.3, 0.3)),
    ],
)
def test_covariance_is_honest_for_any_noise(
    lasting: float, each: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(8)
    needles, steps = 24, 60
    turns = turns_for(steps)
    poses = path(turns, np.deg2rad(5.0), np.deg2rad(10.0))
    errors = rng.normal(size=(steps + 1, needles, 3))
    for k in range(1, steps + 1):
        errors[k] = lasting * errors[k - 1] + np.sqrt(1.0 - lasting**2) * errors[k]
    tips = poses[:, None, :3, 3] + errors * each * 0.001 / np.sqrt(3.0)
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


def test_starts_as_the_base_is_turned() -> None:
    estimator = HypothesisFilter(
        FilterSettings(torsion_hypotheses=RIGID, roll_hypotheses=ROLL_AS_SET),
        rotation_from_angles([0.1, 0.2, 0.0]),
    )
    estimator.reset(np.zeros(3), np.array([0.0, 0.7]))
    np.testing.assert_allclose(estimator.estimate().coordinates[3:], [0.1, 0.2, 0.7], atol=1e-9)


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


def test_nothing_is_compiled_twice() -> None:
    """The same machine code runs with and without covariance."""
    for covariance in (None, np.eye(3) * 1e-6):
        estimator = HypothesisFilter(FilterSettings())
        estimator.reset(np.zeros(3), np.zeros(2))
        estimator.advance(STEP, 0.1)
        estimator.correct(np.zeros(3), covariance)
        estimator.estimate()
    functions: list[Any] = [advance_needle, correct_needle, estimate_needle]
    assert [len(function.signatures) for function in functions] == [1, 1, 1]
