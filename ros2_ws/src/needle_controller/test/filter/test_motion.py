"""One insertion of a hypothesis and its covariance, against scipy's expm, finite differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import exact_needle
from needle_controller.filter.filter_settings import GAIN, LAG, PLAY, FilterSettings
from needle_controller.filter.motion import LARGEST_TURN, advance_hypothesis, rotate
from needle_controller.filter.records import E_KAPPA, E_SCALE, E_TORSION, ERROR, HYPOTHESIS
from needle_controller.model.arrays import Array

CASES = [(0.001, 0.2), (0.001, -0.5), (0.002, 0.0), (0.001, LARGEST_TURN), (0.0, 0.4), (0.01, 0.7)]
SIZES = ("play", "lag", "gain")
SCALES = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 1.0, 0.1, 0.05])
NO_DRIFT = FilterSettings(curvature_drift=0.0, scale_drift=0.0, play_drift=0.0, lag_drift=0.0)


def hypothesis(play: float = 0.0, lag: float = 0.0) -> Any:
    rng, h = np.random.default_rng(1), np.zeros(1, HYPOTHESIS)[0]
    h["position"] = rng.normal(0.0, 0.01, 3)
    h["rotation"] = Rotation.random(random_state=1).as_matrix()
    h["curvature"], h["scale"] = rng.uniform(5.0, 11.0), rng.uniform(0.9, 1.1)
    factor = rng.normal(size=(ERROR, ERROR)) * SCALES[:, None]
    h["covariance"] = factor @ factor.T
    h["play"], h["lag"] = play, lag
    h["torsion_kind"] = LAG if lag else PLAY if play else GAIN
    h["gain"] = 1.0 if play or lag else 0.9
    return h


def moved(h: Any, length: float, turn: float, settings: FilterSettings = NO_DRIFT) -> Any:
    after = h.copy()
    advance_hypothesis(after, 0.0, turn, length, settings.assumptions(), np.zeros((6, 6)))
    return after


@pytest.mark.parametrize(("length", "turn"), CASES)
def test_the_step_is_the_exponential_of_the_twist(length: float, turn: float) -> None:
    before = hypothesis()
    after = moved(before, length, turn)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = before["rotation"], before["position"]
    gone, tip_turn = before["scale"] * length, before["gain"] * turn
    wanted = exact_needle.moved(pose, gone, tip_turn, before["curvature"])
    np.testing.assert_allclose(after["position"], wanted[:3, 3], atol=1e-12)
    np.testing.assert_allclose(after["rotation"], wanted[:3, :3], atol=1e-9)


@pytest.mark.parametrize(("length", "turn"), CASES)
@pytest.mark.parametrize(("play", "lag"), [(0.1, 0.0), (0.0, 0.004), (0.1, 0.002), (0.0, 0.0)])
def test_the_covariance_follows_the_steps_derivative(
    length: float, turn: float, play: float, lag: float
) -> None:
    """F by central differences of the step, in the coordinates of the error."""
    before = hypothesis(play, lag)

    def end(error: Array) -> Any:
        start = before.copy()
        start["position"] += error[:3]
        start["rotation"] = Rotation.from_rotvec(error[3:6]).as_matrix() @ before["rotation"]
        start["curvature"] += error[E_KAPPA]
        start["scale"] += error[E_SCALE]
        start[SIZES[before["torsion_kind"]]] += error[E_TORSION]
        return moved(start, length, turn)

    transition = np.eye(ERROR)
    for i in range(ERROR):
        error = np.zeros(ERROR)
        error[i] = 1e-4 if i == E_KAPPA else 1e-6
        ahead, behind = end(error), end(-error)
        transition[:3, i] = (ahead["position"] - behind["position"]) / (2.0 * error[i])
        turned = ahead["rotation"] @ behind["rotation"].T
        transition[3:6, i] = Rotation.from_matrix(turned).as_rotvec() / (2.0 * error[i])
    # The filter neglects the shift of the path by the torsion, of order curvature length^2.
    transition[:3, E_TORSION] = 0.0
    wanted = transition @ before["covariance"] @ transition.T
    found = moved(before, length, turn)["covariance"]
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(found / scale, wanted / scale, atol=2e-3)
    np.testing.assert_array_equal(found, found.T)


@pytest.mark.parametrize(("play", "lag"), [(0.1, 0.0), (0.0, 0.004), (0.0, 0.0)])
def test_process_noise_is_added_where_it_belongs(play: float, lag: float) -> None:
    drifts: dict[str, Any] = {"scale_drift": 2.0, "lag_drift": 1.0}
    drifts |= {"curvature_drift": 3.0**0.5, "play_drift": 5.0**0.5}
    settings = FilterSettings(curvature=1.0, **drifts)
    before = hypothesis(play, lag)
    before["covariance"] = 0.0
    before["covariance"][E_TORSION, E_TORSION] = 1e-30
    before["heading_drift"], before["roll_drift"] = 2.0, 6.0
    added = moved(before, 0.001, 0.0, settings)
    covariance = 1000.0 * added["covariance"]
    wanted = [0.0, 0.0, 0.0, 3.0, (5.0, 1.0, 0.0)[before["torsion_kind"]], 4.0]
    np.testing.assert_allclose(np.diag(covariance)[[0, 1, 2, 6, 7, 8]], wanted, atol=1e-9)
    # The roll drifts about the heading, the last column.
    axes = added["rotation"]
    drift = axes.T @ covariance[3:6, 3:6] @ axes
    np.testing.assert_allclose(drift, np.diag([2.0, 2.0, 6.0]), atol=1e-9)
    # A torsion parameter without variance stays exact.
    before["covariance"][E_TORSION, E_TORSION] = 0.0
    assert moved(before, 0.001, 0.0, settings)["covariance"][E_TORSION, E_TORSION] == 0.0


def test_rotate_turns_about_the_frames_axes_but_not_too_far() -> None:
    for vector, turned in (([0.3, -0.2, 0.5], 1.0), ([0.0, 3.0, 0.0], 0.5)):
        before = Rotation.random(random_state=2).as_matrix()
        after = before.copy()
        rotate(after, *vector)
        wanted = Rotation.from_rotvec(np.array(vector) * turned).as_matrix()
        np.testing.assert_allclose(after, wanted @ before, atol=1e-8)
