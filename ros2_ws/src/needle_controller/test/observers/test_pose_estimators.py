"""Full-pose estimators on an exact plant: the extended Kalman filter and the orientation fit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator, default_rng
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from needle_common.errors import UserError
from needle_controller.model.arc_motion import (
    InputHistory,
    RelativeMotion,
    arc,
    left_jacobian,
    no_motion,
    rotation_exp,
)
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import angles_from_rotation
from needle_controller.observers.estimator import Estimator
from needle_controller.observers.extended_kalman import ExtendedKalmanFilter, ExtendedKalmanSettings
from needle_controller.observers.orientation_fit import OrientationFit, OrientationFitSettings
from needle_controller.observers.pose_settings import PoseSettings
from needle_sim.needle.plant import NeedlePlant

STEP = 0.001
CURVATURE = 1.0 / 0.122
NOISE = 0.5e-3
ANGLE = math.radians(5.0)
ROLL = math.radians(20.0)


def kalman(**changes: Any) -> ExtendedKalmanFilter:
    settings = ExtendedKalmanSettings(
        measurement_std=NOISE,
        initial_angle_std=ANGLE,
        initial_roll_std=ROLL,
        orientation_drift=0.0,
        curvature_drift=0.0,
    )
    return ExtendedKalmanFilter(dataclasses.replace(settings, **changes))


def fit(**changes: Any) -> OrientationFit:
    settings = OrientationFitSettings(
        measurement_std=NOISE, entry_std=NOISE, initial_angle_std=ANGLE, initial_roll_std=ROLL
    )
    return OrientationFit(dataclasses.replace(settings, **changes))


def grid_fit(**changes: Any) -> OrientationFit:
    return fit(**{"curvatures": 15, **changes})


MAKERS = pytest.mark.parametrize("make", [kalman, fit, grid_fit])
Maker = Callable[..., Estimator]


def start_poses(count: int, rng: Generator, spread: float = 1.0) -> Array:
    """Return poses whose body rotation vectors are normal about the identity."""
    vectors = rng.normal(0.0, spread, (count, 3)) * [ANGLE, ANGLE, ROLL]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    poses[:, :3, 3] = rng.normal(0.0, 1e-3, (count, 3))
    return poses


def truth(plant: NeedlePlant) -> Array:
    pose = plant.T_rig_tip
    angles = angles_from_rotation(pose[..., :3, :3])
    return np.concatenate([pose[..., :3, 3], angles], axis=-1)


def position(plant: NeedlePlant) -> Array:
    return np.asarray(plant.T_rig_tip[..., :3, 3])


def run(
    plant: NeedlePlant,
    one: Estimator,
    steps: int,
    rng: Generator,
    noise: float,
    spoil: Callable[[int, Array], Array] = lambda _, tips: tips,
) -> None:
    """Insert step by step, turning at random, and let the estimator follow."""

    def tips() -> Array:
        exact = position(plant)
        return np.asarray(exact + rng.normal(0.0, 1.0, exact.shape) * noise)

    one.reset(tips(), np.zeros(2))
    for i in range(steps):
        turn = rng.normal(0.0, 0.3, plant.insertion.shape)
        plant.advance(STEP, turn)
        one.advance(STEP, turn)
        one.correct(spoil(i, tips()))


def error_of(one: Estimator, plant: NeedlePlant) -> Array:
    error = one.estimate().coordinates - truth(plant)
    error[..., 3:] = (error[..., 3:] + np.pi) % (2.0 * np.pi) - np.pi
    return error


# The motion.


@pytest.mark.parametrize(
    ("length", "turn"), [(0.001, 0.3), (0.1, 2.0), (0.0, 1.0), (0.05, 0.0), (-0.02, -1.0)]
)
def test_arc_is_the_matrix_exponential(length: float, turn: float) -> None:
    twist = np.zeros((4, 4))
    x, z = CURVATURE * length, turn
    twist[:3, :3] = [[0, -z, 0], [z, 0, -x], [0, x, 0]]
    twist[:3, 3] = [0, 0, length]
    expected, motion = expm(twist), arc(length, turn, CURVATURE)
    np.testing.assert_allclose(motion.rotation, expected[:3, :3], atol=1e-14)
    np.testing.assert_allclose(motion.shift, expected[:3, 3], atol=1e-15)


@pytest.mark.parametrize(("length", "turn"), [(0.001, 0.3), (0.1, 2.0), (0.05, 0.0), (0.04, 0.02)])
def test_motion_slopes_are_finite_differences(length: float, turn: float) -> None:
    def chain(curvature: float) -> RelativeMotion:
        return arc(length, turn, curvature).then(arc(0.5 * length, -0.4, curvature))

    h = 1e-5
    low, high, here = (chain(CURVATURE + d) for d in (-h, h, 0.0))
    np.testing.assert_allclose(
        here.shift_slope, (high.shift - low.shift) / (2 * h), rtol=1e-6, atol=1e-11
    )
    turned = Rotation.from_matrix(low.rotation.T @ high.rotation).as_rotvec()
    np.testing.assert_allclose(here.rotation_slope, turned / (2 * h), rtol=1e-6, atol=1e-10)


def test_left_jacobian_is_finite_differences() -> None:
    v, h = np.array([0.3, -0.5, 0.8]), 1e-6
    for i in range(3):
        dv = np.eye(3)[i] * h
        turn = rotation_exp(v + dv) @ rotation_exp(v - dv).T
        expected = Rotation.from_matrix(turn).as_rotvec() / (2 * h)
        np.testing.assert_allclose(left_jacobian(v)[:, i], expected, atol=1e-8)


def test_history_leads_back_along_the_path() -> None:
    rng, history, motion = default_rng(1), InputHistory(), no_motion()
    poses = [motion]
    for _ in range(10):
        length, turn = np.asarray(rng.uniform(0.0, 2e-3)), np.asarray(rng.normal(0.0, 0.5))
        history.add(length, turn)
        motion = motion.then(arc(length, turn, CURVATURE))
        poses.append(motion)
    lengths = [float(length) for length, _ in history._inputs]
    age = np.asarray(sum(lengths[4:]))
    back = motion.then(history.motion_back(age, np.asarray(CURVATURE)))
    np.testing.assert_allclose(back.shift, poses[4].shift, atol=1e-14)
    np.testing.assert_allclose(back.rotation, poses[4].rotation, atol=1e-12)
    half = motion.then(history.motion_back(age - 0.5 * lengths[4], np.asarray(CURVATURE)))
    assert np.linalg.norm(half.shift - poses[4].shift) == pytest.approx(0.5 * lengths[4], rel=1e-3)


# What both estimators must do.


@MAKERS
def test_converges_to_the_whole_pose_without_noise(make: Maker) -> None:
    rng = default_rng(2)
    plant = NeedlePlant(start_poses(1, rng, 2.0)[0], curvature=CURVATURE)
    one = make()
    run(plant, one, 60, rng, 0.0)
    # The prior is outweighed, not gone.
    assert np.all(np.abs(error_of(one, plant)) < [2e-4, 2e-4, 2e-4, 0.02, 0.02, 0.08])


def mean_squared_errors(one: Estimator, rng: Generator, spread: float) -> list[float]:
    """Return the mean normalised squared error of 400 needles at three depths."""
    count, means = 400, []
    plant = NeedlePlant(start_poses(count, rng, spread), curvature=CURVATURE)
    one.reset(position(plant) + rng.normal(0.0, NOISE, (count, 3)), np.zeros(2))
    for i in range(60):
        turn = rng.normal(0.0, 0.3, count)
        plant.advance(STEP, turn)
        one.advance(STEP, turn)
        one.correct(position(plant) + rng.normal(0.0, NOISE, (count, 3)))
        if i in (9, 29, 59):
            error, covariance = error_of(one, plant), one.estimate().covariance
            nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
            means.append(float(np.mean(nees)))
    return means


# chi2 with 6 degrees of freedom: mean 6, standard error of 400's mean 3.46 / 20 = 0.17.


def test_fit_errors_are_what_its_covariance_says() -> None:
    means = mean_squared_errors(fit(gate=math.inf), default_rng(3), 1.0)
    assert all(5.2 < mean < 6.8 for mean in means), means


def test_filter_errors_are_what_its_covariance_says_where_it_is_linear() -> None:
    one = kalman(
        curvature_spread=0.0,
        gate=math.inf,
        initial_angle_std=0.2 * ANGLE,
        initial_roll_std=0.2 * ROLL,
    )
    means = mean_squared_errors(one, default_rng(3), 0.2)
    assert all(5.2 < mean < 6.8 for mean in means), means


def test_filter_is_not_overconfident_with_its_usual_drift() -> None:
    drift = ExtendedKalmanSettings.orientation_drift
    one = kalman(curvature_spread=0.0, gate=math.inf, orientation_drift=drift)
    means = mean_squared_errors(one, default_rng(3), 1.0)
    assert all(3.5 < mean < 7.2 for mean in means), means


def test_curvature_is_estimated_with_its_uncertainty() -> None:
    rng, count = default_rng(4), 300
    true = CURVATURE * rng.normal(1.0, 0.1, count)
    plant = NeedlePlant(start_poses(count, rng), curvature=true)
    one = kalman(curvature_spread=0.1, gate=math.inf)
    run(plant, one, 100, rng, NOISE)
    error = one.estimate().curvature - true
    sigma = np.sqrt(one.error_covariance()[:, 6, 6])
    assert np.std(error) < 0.05 * CURVATURE
    assert 0.8 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.25


def test_a_grid_of_curvatures_finds_the_right_one() -> None:
    rng, count = default_rng(5), 100
    plant = NeedlePlant(start_poses(count, rng), curvature=1.2 * CURVATURE)
    one = grid_fit()
    run(plant, one, 100, rng, NOISE)
    assert np.mean(one.estimate().curvature) == pytest.approx(1.2 * CURVATURE, rel=0.03)


@MAKERS
def test_broadcasting_equals_looping(make: Maker) -> None:
    rng, count = default_rng(6), 4
    tips = np.cumsum(rng.normal(0.0, 2e-4, (15, count, 3)) + np.array([0, 0, STEP]), axis=0)
    tips[3, 2] = np.nan
    turns = rng.normal(0.0, 0.2, (15, count))
    ages = rng.choice([0.0, STEP, 2.5e-3], (15, count))
    many, single = make(), [make() for _ in range(count)]
    many.reset(tips[0], np.zeros(2))
    for i, one in enumerate(single):
        one.reset(tips[0, i], np.zeros(2))
    for k in range(1, 15):
        many.advance(STEP, turns[k])
        many.correct(tips[k], age=ages[k])
        for i, one in enumerate(single):
            one.advance(STEP, turns[k, i])
            one.correct(tips[k, i], age=ages[k, i])
    whole = many.estimate()
    for i, one in enumerate(single):
        alone = one.estimate()
        np.testing.assert_allclose(whole.coordinates[i], alone.coordinates, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(whole.curvature[i], alone.curvature, rtol=1e-9)
        np.testing.assert_allclose(whole.covariance[i], alone.covariance, rtol=1e-6, atol=1e-16)


@MAKERS
def test_a_late_tip_counts_like_one_in_time(make: Maker) -> None:
    rng = default_rng(7)
    poses = start_poses(50, rng)
    plant, late, timely = NeedlePlant(poses, curvature=CURVATURE), make(), make()
    waiting: list[Array] = []
    for each in (late, timely):
        each.reset(position(plant), np.zeros(2))
    for _ in range(60):
        turn = rng.normal(0.0, 0.3, 50)
        plant.advance(STEP, turn)
        tips = position(plant) + rng.normal(0.0, NOISE, (50, 3))
        for each in (late, timely):
            each.advance(STEP, turn)
        timely.correct(tips)
        waiting.append(tips)
        if len(waiting) > 2:
            late.correct(waiting.pop(0), age=2 * STEP)
    spread_late = np.sqrt(np.mean(error_of(late, plant) ** 2, axis=0))
    spread = np.sqrt(np.mean(error_of(timely, plant) ** 2, axis=0))
    assert np.all(spread_late < 1.25 * spread)


@MAKERS
def test_a_missing_tip_changes_nothing(make: Maker) -> None:
    one, other = make(), make()
    for each in (one, other):
        each.reset([0.001, 0.0, 0.0], [0.0, 0.1])
        each.advance(STEP, 0.02)
    one.correct([0.0, np.nan, 0.0])
    one.correct([0.0, 0.0, 0.001], covariance=np.diag([1e-6, np.inf, 1e-6]))
    np.testing.assert_allclose(
        one.estimate().coordinates, other.estimate().coordinates, rtol=1e-13, atol=1e-16
    )
    np.testing.assert_allclose(one.estimate().covariance, other.estimate().covariance, rtol=1e-9)


@MAKERS
def test_outliers_are_refused_said_and_taken_in_the_end(make: Maker) -> None:
    rng = default_rng(8)
    plant, one = NeedlePlant(start_poses(1, rng, 0.5)[0], curvature=CURVATURE), make()
    run(plant, one, 30, rng, NOISE)
    before = one.estimate().coordinates
    off = position(plant) + np.array([0.008, 0.0, 0.0])
    one.correct(off)
    np.testing.assert_allclose(one.estimate().coordinates, before, rtol=1e-12, atol=1e-15)
    assert any("refused" in text for text in one.estimate().warnings)
    for _ in range(4):
        one.correct(off)
    assert one.estimate().coordinates[0] > before[0] + 1e-6
    assert one.estimate().warnings == ()


@MAKERS
def test_outliers_do_little_harm(make: Maker) -> None:
    rng, count = default_rng(9), 100
    plant = NeedlePlant(start_poses(count, rng), curvature=CURVATURE)

    def spoil(_: int, tips: Array) -> Array:
        away = rng.normal(0.0, 1.0, (count, 3))
        away *= rng.uniform(5e-3, 1e-2, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
        return np.asarray(np.where(rng.random((count, 1)) < 0.05, tips + away, tips))

    one = make()
    run(plant, one, 60, rng, NOISE, spoil)
    assert np.sqrt(np.mean(error_of(one, plant)[:, 0] ** 2)) < 0.4e-3


@MAKERS
def test_a_new_frame_keeps_the_needle(make: Maker) -> None:
    rng = default_rng(10)
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()
    transform[:3, 3] = [0.001, -0.002, 0.003]
    pose = start_poses(1, rng)[0]
    turned, moved = make(), make()
    plant = NeedlePlant(pose, curvature=CURVATURE)
    tips, turns = [], rng.normal(0.0, 0.3, 20)
    for turn in turns:
        plant.advance(STEP, turn)
        tips.append(position(plant) + rng.normal(0.0, NOISE, 3))
    # One changes the frame half-way, the other was in the new one from the start.
    moved.change_frame(transform)
    turned.reset(pose[:3, 3], [0.0, 0.1])
    moved.reset(transform[:3, :3] @ pose[:3, 3] + transform[:3, 3], [0.0, 0.1])
    for i, (turn, tip) in enumerate(zip(turns, tips, strict=True)):
        if i == 10:
            turned.change_frame(transform)
        new = transform[:3, :3] @ tip + transform[:3, 3]
        for each in (turned, moved):
            each.advance(STEP, turn)
        turned.correct(new if i >= 10 else tip)
        moved.correct(new)
    a, b = turned.estimate(), moved.estimate()
    np.testing.assert_allclose(a.coordinates, b.coordinates, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-14)


@MAKERS
@pytest.mark.parametrize("length", [-1e-6, np.nan, np.inf])
def test_only_forward_insertion_is_modelled(make: Maker, length: float) -> None:
    one = make()
    with pytest.raises(ValueError, match="d_insertion"):
        one.advance(length, 0.0)
    with pytest.raises(ValueError, match="d_rotation"):
        one.advance(STEP, np.nan)


# The closed form.


def test_fit_is_the_minimum_of_the_sum_of_squares() -> None:
    """Against scipy's least squares on all tips and priors, history and all."""
    rng = default_rng(11)
    plant, one = NeedlePlant(start_poses(1, rng)[0], curvature=CURVATURE), fit(gate=math.inf)
    first = position(plant) + rng.normal(0.0, NOISE, 3)
    one.reset(first, [0.0, 0.0])
    tips, arms, motion = [first], [np.zeros(3)], no_motion()
    for _ in range(25):
        turn = rng.normal(0.0, 0.4)
        plant.advance(STEP, turn)
        motion = motion.then(arc(STEP, turn, CURVATURE))
        tips.append(position(plant) + rng.normal(0.0, NOISE, 3))
        arms.append(motion.shift)
        one.advance(STEP, turn)
        one.correct(tips[-1])
    a = np.array([ANGLE**-2, ANGLE**-2, ROLL**-2])
    # The prior as the module states it: directions with weights, which may be negative.
    weights = 0.5 * np.sum(a) - a

    def cost(unknowns: Array) -> float:
        rotation = Rotation.from_rotvec(unknowns[3:]).as_matrix()
        off = np.array(tips) - unknowns[:3] - np.array(arms) @ rotation.T
        directions = np.sum(weights * np.sum((rotation - np.eye(3)) ** 2, axis=0))
        return float(np.sum(off**2) / NOISE**2 + directions)

    estimate = one.estimate()
    start = estimate.rotation @ motion.rotation.T
    here = np.concatenate(
        [estimate.position - start @ motion.shift, Rotation.from_matrix(start).as_rotvec()]
    )
    steps = [*np.eye(6)[:3] * 1e-6, *np.eye(6)[3:] * 1e-4]
    for step in steps:
        assert cost(here) < cost(here + step)
        assert cost(here) < cost(here - step)

    def residuals(unknowns: Array) -> Array:
        rotation = Rotation.from_rotvec(unknowns[3:]).as_matrix()
        off = np.array(tips) - unknowns[:3] - np.array(arms) @ rotation.T
        prior = np.sqrt(weights) * (rotation - np.eye(3))
        return np.concatenate([off.ravel() / NOISE, prior.ravel()])

    assert np.all(weights > 0.0)
    scale = [1e-3] * 3 + [0.1] * 3
    exact: dict[str, Any] = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "jac": "3-point"}
    best = least_squares(residuals, np.zeros(6), x_scale=scale, **exact)
    np.testing.assert_allclose(here, best.x, rtol=1e-5, atol=1e-8)


def test_fit_has_constant_memory() -> None:
    one = fit()
    one.reset(np.zeros((3, 3)), np.zeros(2))
    for _ in range(200):
        one.advance(STEP, 0.1)
        one.correct(np.full((3, 3), np.nan))
    assert len(one._history._inputs) <= 64
    assert one._sums.cross.shape == (3, 1, 3, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("curvature", 0.0),
        ("curvature", -1.0),
        ("curvature", math.inf),
        ("measurement_std", 0.0),
        ("initial_roll_std", math.nan),
        ("gate", -1.0),
        ("curvature_range", (0.0, 1.0)),
    ],
)
def test_bad_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(UserError, match=name):
        dataclasses.replace(PoseSettings(), **{name: value})


@pytest.mark.parametrize(("name", "value"), [("curvatures", 0), ("entry_std", 0.0)])
def test_bad_fit_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(UserError, match=name):
        dataclasses.replace(OrientationFitSettings(), **{name: value})


@pytest.mark.parametrize("name", ["orientation_drift", "curvature_drift"])
def test_bad_filter_settings_are_named(name: str) -> None:
    bad: Any = {name: -1.0}
    with pytest.raises(UserError, match=name):
        dataclasses.replace(ExtendedKalmanSettings(), **bad)
