"""Updates by a measured heading: Jacobian, outliers, late tips, frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.heading_update import update_by_heading
from needle_controller.filter.hypothesis_filter import LATE, HypothesisFilter
from needle_controller.filter.records import E_TURN, ERROR, HYPOTHESIS
from needle_controller.filter.tip_update import new_workspace
from needle_controller.model.arc_motion import rotation_exp
from needle_controller.model.arrays import Array

from .needles import STEP, noisy, path, turns_for

PLAIN = FilterSettings(outlier_share=1e-6, curvature_range=(0.01, 100.0))
STD = 0.01


def hypothesis(seed: int) -> Any:
    """Return a hypothesis with a correlated error, and a gain that is estimated."""
    h, rng = np.zeros(1, HYPOTHESIS)[0], np.random.default_rng(seed)
    scales = np.array([3e-4, 3e-4, 3e-4, 0.05, 0.05, 0.1, 1.0, 0.1, 0.05])
    factor = rng.normal(size=(ERROR, ERROR)) * scales[:, None]
    h["covariance"] = factor @ factor.T
    h["rotation"] = Rotation.random(random_state=seed).as_matrix()
    h["curvature"], h["scale"], h["gain"], h["torsion_kind"] = 8.0, 1.0, 1.0, 2
    return h


def across(rotation: Array, heading: Array) -> Array:
    """Return the turn from the z axis of a rotation to a heading, along its x and y axes."""
    turn, _ = Rotation.align_vectors(heading[None], rotation[:, 2][None])
    vector: Array = turn.as_rotvec() @ rotation[:, :2]
    return vector


@pytest.mark.parametrize("seed", range(4))
def test_the_update_is_that_of_a_kalman_filter_with_a_numerical_jacobian(seed: int) -> None:
    h, before = hypothesis(seed), hypothesis(seed)
    rotation, p = np.array(before["rotation"]), np.array(before["covariance"])
    heading = rotation @ rotation_exp([0.03, -0.02, 0.0])[:, 2]
    jacobian = np.zeros((2, ERROR))
    for i in range(2):
        jacobian[i, E_TURN : E_TURN + 3] = approx_fprime(
            np.zeros(3), lambda w, i=i: across(rotation, rotation_exp(w) @ rotation[:, 2])[i], 1e-6
        )
    total = jacobian @ p @ jacobian.T + STD**2 * np.eye(2)
    gain = p @ jacobian.T @ np.linalg.inv(total)
    change = gain @ across(rotation, heading)
    seen = update_by_heading(h, np.array([*heading, STD**2]), PLAIN.assumptions(), new_workspace())
    turned = Rotation.from_matrix(h["rotation"] @ rotation.T).as_rotvec()
    scale = np.sqrt(np.diag(p))
    np.testing.assert_allclose(h["position"] / scale[:3], change[:3] / scale[:3], atol=1e-4)
    np.testing.assert_allclose(turned / scale[3:6], change[3:6] / scale[3:6], atol=1e-4)
    np.testing.assert_allclose(h["curvature"], 8.0 + change[6], atol=1e-4)
    after = (p - gain @ jacobian @ p) / np.outer(scale, scale)
    np.testing.assert_allclose(h["covariance"] / np.outer(scale, scale), after, atol=1e-4)
    # The likelihood is relative to noise within the bound, a density of 1 / (12 STD^2).
    off = across(rotation, heading)
    density = np.exp(-0.5 * off @ np.linalg.solve(total, off)) / (2.0 * np.pi)
    density /= np.sqrt(np.linalg.det(total))
    np.testing.assert_allclose(seen, 12.0 * STD**2 * density, rtol=1e-3)


def test_a_heading_that_cannot_be_true_changes_nothing() -> None:
    h, before = hypothesis(1), hypothesis(1)
    opposite, settings = -np.array(h["rotation"])[:, 2], FilterSettings()
    heading = np.array([*opposite, STD**2])
    seen = update_by_heading(h, heading, settings.assumptions(), new_workspace())
    assert 0.0 < seen < settings.outlier_share
    for name in ("position", "rotation", "covariance"):
        np.testing.assert_allclose(h[name], before[name], atol=1e-12)


def test_late_headings_are_replayed_and_the_frame_may_change() -> None:
    """Tips, covariances and headings of the first centimetres are replayed in the new axes."""
    turns = turns_for(24, size=0.1)
    poses, at = path(turns, np.deg2rad(3.0)), np.eye(4)
    at[:3] = [[0.0, 1.0, 0.0, 0.01], [-1.0, 0.0, 0.0, -0.02], [0.0, 0.0, 1.0, 0.03]]
    tips, known, estimates = noisy(poses, bound=2e-4), np.diag([1e-7, 2e-7, 3e-7]), []
    for has_heading, frame in ((True, np.eye(4)), (True, at), (False, np.eye(4))):
        estimator = HypothesisFilter(FilterSettings(), None, np.zeros(3))
        estimator.reset(tips[0], np.zeros(2))
        for k in range(1, 21):
            if k == 10:
                estimator.change_frame(frame)
            now = frame if k >= 10 else np.eye(4)
            turn, shift = now[:3, :3], now[:3, 3]
            exposed = max(k - 3, 0)
            estimator.advance(STEP, turns[k - 1])
            if has_heading:
                estimator.correct_heading(turn @ poses[exposed, :3, 2], 1e-4)
            estimator.correct(turn @ tips[exposed] + shift, turn @ known @ turn.T)
        estimates.append((estimator.estimate(), frame[:3, :3] @ poses[20, :3, 2]))
    here, there = estimates[0][0], estimates[1][0]
    assert LATE in here.warnings
    assert LATE in there.warnings
    wanted = at[:3, :3] @ here.position + at[:3, 3]
    np.testing.assert_allclose(there.position, wanted, atol=2e-4)
    off = [float(np.linalg.norm(found.rotation[:, 2] - true)) for found, true in estimates]
    assert max(off[:2]) < 0.01
    assert off[2] > 2.0 * max(off[:2])
