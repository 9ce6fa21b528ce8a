from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from needle_controller.model.feedback_linearization import reduced_from_linearized
from needle_controller.observers.saturation import saturate

CURVATURE = 1.0 / 0.122


def test_the_papers_example_as_the_margin_vanishes() -> None:
    for margin in (1e-2, 1e-6, 1e-12, 0.0):
        saturated, changed = saturate([0.0, 1.5, 0.0], CURVATURE, margin)
        np.testing.assert_allclose(saturated, [0.0, np.sqrt(1.0 - margin), 0.0], rtol=1e-12)
        assert changed
    np.testing.assert_array_equal(saturated, [0.0, 1.0, 0.0])


def test_inside_nothing_changes() -> None:
    s = np.array([[5.0, 0.3, -0.4 * CURVATURE], [0.0, 0.0, 0.0]])
    saturated, changed = saturate(s, CURVATURE, 0.1)
    np.testing.assert_array_equal(saturated, s)
    assert not np.any(changed)


def test_outside_it_is_the_closest_point_and_keeps_signs() -> None:
    s = default_rng(3).normal(0.0, 3.0, (200, 3)) * [1.0, 1.0, CURVATURE]
    margin = 0.2
    saturated, changed = saturate(s, CURVATURE, margin)
    scaled, before = saturated[:, 1:] / [1.0, CURVATURE], s[:, 1:] / [1.0, CURVATURE]
    assert np.all(np.hypot(*scaled.T) <= np.sqrt(1.0 - margin) * (1 + 1e-12))
    np.testing.assert_array_equal(saturated[:, 0], s[:, 0])
    np.testing.assert_array_equal(np.sign(saturated), np.sign(s))
    np.testing.assert_array_equal(changed, np.hypot(*before.T) > np.sqrt(1.0 - margin))
    angles = np.linspace(0.0, 2 * np.pi, 2001)
    border = np.sqrt(1.0 - margin) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for i in np.flatnonzero(changed):
        closest = np.min(np.linalg.norm(border - before[i], axis=1))
        assert np.linalg.norm(scaled[i] - before[i]) <= closest + 1e-9


@pytest.mark.parametrize("margin", [1e-6, 0.1, 0.5])
def test_the_margin_bounds_what_7_divides_by(margin: float) -> None:
    s = default_rng(4).normal(0.0, 9.0, (500, 3)) * [1.0, 1.0, CURVATURE]
    saturated, _ = saturate(s, CURVATURE, margin)
    _, pitch, roll = reduced_from_linearized(saturated, CURVATURE).T
    assert np.all(np.cos(pitch) * np.cos(roll) >= np.sqrt(margin) * (1.0 - 1e-6))


def test_broadcasting_equals_looping() -> None:
    s = default_rng(5).normal(0.0, 2.0, (3, 4, 3)) * [1.0, 1.0, CURVATURE]
    saturated, changed = saturate(s, CURVATURE, 0.3)
    for i in np.ndindex(3, 4):
        one, one_changed = saturate(s[i], CURVATURE, 0.3)
        np.testing.assert_array_equal(saturated[i], one)
        assert changed[i] == one_changed
