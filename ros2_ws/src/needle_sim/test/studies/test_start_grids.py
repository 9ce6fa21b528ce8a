from __future__ import annotations

import numpy as np
import pytest

from needle_sim.studies.start_grids import GRIDS, StartBounds

BOUNDS = StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0))
LARGEST = np.array([0.003, np.deg2rad(10.0), np.deg2rad(30.0)])


@pytest.mark.parametrize(("name", "share"), [("endpoint", 1.0), ("cell", 0.9)])
def test_a_grid_reaches_its_convention_s_bounds_and_no_farther(name: str, share: float) -> None:
    starts = GRIDS[name](BOUNDS, 10, 1)
    assert starts.shape == (10_000, 3)
    np.testing.assert_allclose(starts.max(axis=0), share * LARGEST)
    np.testing.assert_allclose(starts.min(axis=0), -share * LARGEST)


@pytest.mark.parametrize("name", ["endpoint", "cell"])
def test_a_grid_is_uniform_and_each_start_comes_as_often_as_drawn(name: str) -> None:
    points, counts = np.unique(GRIDS[name](BOUNDS, 3, 1), axis=0, return_counts=True)
    assert points.shape == (1000, 3)
    assert set(counts) == {3}
    for column in range(3):
        values = np.unique(points[:, column])
        assert len(values) == 10
        np.testing.assert_allclose(np.diff(values), values[1] - values[0])


def test_random_starts_are_uniform_within_the_bounds_and_follow_the_seed() -> None:
    starts = GRIDS["random"](BOUNDS, 10, 1)
    assert starts.shape == (10_000, 3)
    assert len(np.unique(starts, axis=0)) == 10_000
    assert np.all(np.abs(starts) <= LARGEST)
    # standard error of the mean: 1/sqrt(3)/100
    assert np.all(np.abs(np.mean(starts / LARGEST, axis=0)) < 0.03)
    np.testing.assert_allclose(np.std(starts / LARGEST, axis=0), 1.0 / np.sqrt(3.0), rtol=0.03)
    assert np.all(np.abs(np.corrcoef(starts.T) - np.eye(3)) < 0.05)
    np.testing.assert_array_equal(starts, GRIDS["random"](BOUNDS, 10, 1))
    other = GRIDS["random"](BOUNDS, 10, 2)
    assert not np.any(np.all(starts == other, axis=1))
