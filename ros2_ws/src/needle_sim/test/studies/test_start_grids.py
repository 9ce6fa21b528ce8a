from __future__ import annotations

import numpy as np
import pytest

from needle_sim.studies.study import GRIDS, StartBounds

LARGEST = np.array([0.003, np.deg2rad(10.0), np.deg2rad(30.0)])
BOUNDS = StartBounds(*LARGEST)


@pytest.mark.parametrize(("name", "share"), [("endpoint", 1.0), ("cell", 0.9)])
def test_a_grid_is_uniform_within_its_convention_s_bounds(name: str, share: float) -> None:
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
