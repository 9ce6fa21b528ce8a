"""Merging of equal hypotheses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from needle_controller.filter.merging import merge
from needle_controller.filter.records import ERROR, HYPOTHESIS, NEEDLE
from needle_controller.model.arrays import Array

Records = npt.NDArray[np.void]


def hypotheses(rolls: Array) -> Records:
    """Hypotheses of given rolls."""
    h = np.zeros(len(rolls), HYPOTHESIS)
    h["rotation"] = Rotation.from_rotvec(np.outer(rolls, [0.0, 0.0, 1.0])).as_matrix()
    h["covariance"], h["weight"] = np.eye(ERROR) * 1e-4, 1.0
    return h


def merged(h: Records) -> Records:
    needle = np.zeros(1, NEEDLE)[0]
    needle["count"] = len(h)
    merge(needle, h)
    return h[: needle["count"]]


def test_only_equal_hypotheses_are_merged() -> None:
    h = hypotheses(np.array([0.0, 0.2, 1.0, 3.1, -3.1, 0.1, 0.1, 0.1, 0.1]))
    h["torsion"][5], h["play"][6], h["shape"][7], h["position"][8, 0] = 1, 0.35, 1, 0.02
    # 0 and 0.2 are merged, and 3.1 and -3.1, across the border.
    np.testing.assert_array_equal(merged(h)["weight"], [2.0, 1.0, 2.0, 1.0, 1.0, 1.0, 1.0])


def test_the_joined_estimate_has_the_mixtures_moments() -> None:
    """Against samples of both Gaussians."""
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(2, ERROR, ERROR)) * 0.02
    both = factor @ np.swapaxes(factor, -1, -2)
    difference = np.array([0.03, -0.02, 0.01, 0.03, -0.05, 0.1, 0.04, 0.05, 0.02])
    h = hypotheses(np.zeros(2))
    h["covariance"] = both
    h["position"][1] = difference[:3]
    h["rotation"][1] = Rotation.from_rotvec(difference[3:6]).as_matrix()
    h["curvature"][1], h["play"][1], h["scale"][1] = difference[6:]
    h["weight"], h["tip_angle"] = [1.0, 3.0], [1.0, 2.0]
    h["noise_weights"][:, 0, 0] = [0.2, 0.6]
    (joined,) = merged(h)
    first = rng.multivariate_normal(np.zeros(ERROR), both[0], 100_000)
    samples = np.concatenate([first, rng.multivariate_normal(difference, both[1], 300_000)])
    mean, wanted = samples.mean(axis=0), np.cov(samples.T)
    deviation = np.sqrt(np.diag(wanted))
    turn = Rotation.from_matrix(joined["rotation"]).as_rotvec()
    other = [joined[name] for name in ("curvature", "play", "scale")]
    found = np.concatenate([joined["position"], turn, other])
    np.testing.assert_allclose(found / deviation, mean / deviation, atol=0.01)
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(joined["covariance"] / scale, wanted / scale, atol=0.02)
    assert joined["tip_angle"] == 1.75
    assert joined["noise_weights"][0, 0] == pytest.approx(0.5)
    assert joined["weight"] == 4.0
