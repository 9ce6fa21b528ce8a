from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from needle_controller.laws.law import LinearizingLaw
from needle_controller.many_needles import ManyObservers
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import virtual_input
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.observers.luenberger import (
    INITIAL_PITCH_STD,
    INITIAL_ROLL_STD,
    INITIAL_YAW_STD,
    OBSERVER,
    LuenbergerObserver,
    saturate,
)
from needle_controller.presets.presets import make_law, observer_settings
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_sim.needle.plant import NeedlePlant, initial_pose

SETTINGS = SteeringSettings(**PAPER_NOISE)
CURVATURE = SETTINGS.curvature
STEP = 0.001


def observer(**changes: Any) -> LuenbergerObserver:
    settings = dataclasses.replace(SETTINGS, **changes)
    return LuenbergerObserver(observer_settings(settings))


def law(**changes: Any) -> LinearizingLaw:
    settings = dataclasses.replace(SETTINGS, **changes)
    made = make_law(settings)
    assert isinstance(made, LinearizingLaw)
    return made


def plant_at(x: float, pitch: float, roll: float) -> NeedlePlant:
    pose = initial_pose(pitch, roll)
    pose[0, 3] = x
    return NeedlePlant(pose, curvature=CURVATURE)


def true_reduced(plant: NeedlePlant) -> Array:
    _, pitch, roll = Rotation.from_matrix(plant.T_rig_tip[:3, :3]).as_euler("XYZ")
    return np.array([plant.T_rig_tip[0, 3], pitch, roll])


def test_starts_at_the_measurement_with_the_roll_of_the_base() -> None:
    one = observer()
    one.reset([-0.003, 0.0004, 0.0001], [0.0, 0.3])
    np.testing.assert_allclose(one.estimate().reduced, [-0.003, 0.0, 0.3], atol=1e-12)
    np.testing.assert_allclose(one.estimate().position, [-0.003, 0.0004, 0.0001])
    # Without insertion, only the roll turns.
    one.advance(0.0, 0.2)
    np.testing.assert_allclose(one.estimate().reduced, [-0.003, 0.0, 0.5], atol=1e-12)


def test_prediction_follows_the_plant_from_a_known_state() -> None:
    """Prediction alone against SE(3): its error is that of a constant v in a step."""
    plant, one = plant_at(0.0, 0.0, 0.0), observer()
    one.reset(np.zeros(3), [0.0, 0.0])
    rng = default_rng(7)
    for _ in range(60):
        d_insertion, rate = rng.uniform(0.2e-3, 1e-3), rng.uniform(-60, 60)
        plant.advance(d_insertion, rate * d_insertion)
        one.advance(d_insertion, rate * d_insertion)
    off = np.abs(one.estimate().reduced - true_reduced(plant))
    np.testing.assert_array_less(off, [2e-6, 1e-4, 2e-3])
    heading = plant.T_rig_tip[:3, 2]
    yaw = one.estimate().coordinates[3]
    assert yaw == pytest.approx(np.arctan2(-heading[1], heading[2]), abs=2e-3)


def test_converges_without_noise_to_the_whole_reduced_state() -> None:
    plant, one, steer = plant_at(-0.003, 0.05, 0.3), observer(), law()
    one.reset(plant.T_rig_tip[:3, 3], [0.0, 0.0])
    for _ in range(500):
        turn = float(steer(one.estimate()).rotation_rate) * STEP
        plant.advance(STEP, turn)
        one.advance(STEP, turn)
        one.correct(plant.T_rig_tip[:3, 3])
    off = np.abs(one.estimate().reduced - true_reduced(plant))
    np.testing.assert_array_less(off, [1e-6, 1e-4, 1e-3])


def test_law_is_7_for_short_steps() -> None:
    one = observer()
    one.initial_rotation = rotation_from_angles([0.0, 0.5, 0.0])
    one.reset([1e-6, 0.0, 0.0], [0.0, 0.1])
    estimate = one.estimate()
    # With this pitch the roll drifts by 4.5 rad/m.
    assert abs(CURVATURE * np.tan(estimate.reduced[1])) > 1.0
    gains = law().gains._replace(step_length=1e-9, demand_margin=0.0, max_rotation_per_length=1e9)
    short = LinearizingLaw(gains)
    command = short(estimate)
    caused = virtual_input(estimate.reduced, command.rotation_rate, CURVATURE)
    assert float(caused) == pytest.approx(command.virtual_input, rel=1e-5)
    assert float(command.virtual_input) == pytest.approx(-estimate.linearized @ gains.feedback)


def test_law_limits_the_rotation() -> None:
    one, slow = observer(), law(max_rotation_per_length=10.0)
    for x, rate in ((0.02, -10.0), (-0.02, 10.0)):
        one.reset([x, 0.0, 0.0], [0.0, 0.0])
        assert slow(one.estimate()).rotation_rate == rate


def test_many_needles_equal_single_ones() -> None:
    rng, count = default_rng(8), 5
    tips = rng.normal(0.0, 2e-3, (20, count, 3))
    turns = rng.normal(0.0, 0.1, (20, count))
    tips[3, 2] = np.nan
    many = ManyObservers(observer_settings(SETTINGS), count)
    every = [observer() for _ in range(count)]
    many.start(tips[0].copy())
    for n, one in enumerate(every):
        one.reset(tips[0, n], np.zeros(2))
    for tip, turn in zip(tips[1:], turns[1:], strict=True):
        many.advance(np.full(count, STEP), turn)
        many.correct(tip, None, np.zeros(count))
        rates = many.rates(law().gains)
        for n, one in enumerate(every):
            one.advance(STEP, turn[n])
            one.correct(tip[n])
            assert rates[n] == law()(one.estimate()).rotation_rate


def saturated(s: list[float], margin: float = 0.0) -> tuple[Array, bool]:
    needle = np.zeros(1, OBSERVER)[0]
    needle["linearized"] = s
    settings = observer_settings(SETTINGS)
    saturate(needle, settings._replace(saturation_margin=margin))
    return needle["linearized"], bool(needle["saturated"])


def test_saturation_is_the_nearest_point_of_the_region() -> None:
    """The paper's example: [0, 1.5, 0] becomes [0, 1, 0]."""
    np.testing.assert_allclose(saturated([0.0, 1.5, 0.0])[0], [0.0, 1.0, 0.0])
    inside = [0.002, 0.3, 0.2 * CURVATURE]
    np.testing.assert_array_equal(saturated(inside)[0], inside)
    assert not saturated(inside)[1]
    s, changed = saturated([0.001, 0.9, -0.9 * CURVATURE], 0.1)
    assert changed
    assert s[0] == 0.001
    assert s[1] ** 2 + (s[2] / CURVATURE) ** 2 == pytest.approx(0.9)
    assert s[2] / CURVATURE == pytest.approx(-s[1])
    one = observer()
    one.reset([0.0, 0.0, 0.0], [0.0, 1.5])
    assert any("saturated" in warning for warning in one.estimate().warnings)


def test_a_missing_tip_changes_nothing_but_time() -> None:
    estimates = []
    for tip in ([np.nan, 0.0, 0.0], None):
        one = observer()
        one.reset([0.001, 0.0, 0.0], [0.0, 0.1])
        one.advance(STEP, 0.02)
        if tip is not None:
            one.correct(tip)
        one.advance(STEP, 0.02)
        one.correct([0.0, 0.0, 0.0])
        estimates.append(one.estimate())
    for name in ("coordinates", "covariance"):
        np.testing.assert_array_equal(*(getattr(estimate, name) for estimate in estimates))


def test_a_late_tip_is_compared_with_where_the_tip_was() -> None:
    one = observer()
    one.reset([0.0, 0.0, 0.0], [0.0, 0.5])
    for _ in range(20):
        one.advance(STEP, 0.0)
    before = one.estimate()
    late = 5 * STEP
    s = before.linearized
    was = s[0] - late * s[1] + late**2 / 2 * s[2]
    one.correct([was, 0.0, 0.015], age=late)
    np.testing.assert_allclose(one.estimate().linearized, s, atol=1e-12)


def test_covariance_is_honest() -> None:
    """Over many noisy runs the errors agree with the covariance."""
    rng, count = default_rng(9), 60
    squares = []
    for _ in range(count):
        pitch = rng.normal(0.0, INITIAL_PITCH_STD / 2)
        roll = rng.normal(0.0, INITIAL_ROLL_STD / 2)
        plant, one = plant_at(0.0, pitch, roll), observer()
        one.reset(plant.T_rig_tip[:3, 3] + rng.uniform(-1e-3, 1e-3, 3), np.zeros(2))
        for _ in range(20):
            plant.advance(STEP, 0.0)
            one.advance(STEP, 0.0)
            one.correct(plant.T_rig_tip[:3, 3] + rng.uniform(-1e-3, 1e-3, 3))
        known = one.estimate()
        error = known.reduced - true_reduced(plant)
        squares.append(error**2 / np.diag(known.covariance)[[0, 4, 5]])
    assert np.all(np.sqrt(np.mean(squares, axis=0)) < 1.3)
    assert np.all(np.linalg.eigvalsh(known.covariance) > 0.0)
    # y and z are measured; the yaw is not observed.
    assert known.covariance[1, 1] == pytest.approx(SETTINGS.measurement_std**2)
    assert known.covariance[3, 3] >= INITIAL_YAW_STD**2


def test_a_new_frame_keeps_the_needle() -> None:
    one = observer()
    one.reset([0.001, 0.002, 0.003], [0.0, 0.4])
    for _ in range(10):
        one.advance(STEP, 0.02)
    before = one.estimate()
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_angles([0.3, -0.2, 0.4])
    transform[:3, 3] = [0.001, -0.002, 0.003]
    one.change_frame(transform)
    after = one.estimate()
    np.testing.assert_allclose(after.rotation, transform[:3, :3] @ before.rotation, atol=1e-9)
    # y and z of the estimate are the measured tip's, x the observer's.
    x = transform[0, :3] @ before.position + transform[0, 3]
    assert after.position[0] == pytest.approx(x, abs=1e-9)


@pytest.mark.parametrize("length", [-1e-6, np.nan, np.inf])
def test_only_forward_insertion_is_modelled(length: float) -> None:
    one = observer()
    one.reset([0.0, 0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="d_insertion"):
        one.advance(length, 0.0)
