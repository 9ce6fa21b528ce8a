from __future__ import annotations

import numpy as np
import pytest

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import (
    Belief,
    ConsistencyTally,
    Outcomes,
    Tally,
    concatenate,
    figures,
    is_doubtful,
    undoubted_misses,
)


def outcomes(*paths: FloatArray, turns: float = 0.0) -> Outcomes:
    """Follow needles along given distances from the plane [m], one step of 1 mm apart."""
    x = np.array(paths)
    tally = Tally(x[:, 0], x.shape[1] - 1)
    for step in range(1, x.shape[1]):
        tally.add(x[:, step], 0.001 * step, np.full(len(x), turns))
    return tally.outcomes()


def path(*stretches: tuple[int, float]) -> FloatArray:
    """Return distances after 0 ... 50 steps: `(from, value)` holds from there on."""
    x = np.zeros(51)
    for first, value in stretches:
        x[first:] = value
    return x


def test_settled_is_the_last_entry_into_the_band_and_converged_has_two_readings() -> None:
    found = outcomes(
        path(),
        path((0, 0.003), (10, 0.0), (20, -0.002), (25, 0.001)),
        # Outside until step 30 of 50, until step 31, and at the very end.
        path((0, 0.003), (31, 0.0)),
        path((0, 0.003), (32, 0.0)),
        path((50, 0.0011)),
        path((0, -0.001)),
    )
    np.testing.assert_allclose(found.settled, [0.0, 0.025, 0.031, 0.032, np.inf, 0.0])
    at_end, last_steps = found.converged_at_end, found.converged_last_steps
    np.testing.assert_array_equal(at_end, [True, True, True, True, False, True])
    np.testing.assert_array_equal(last_steps, [True, True, True, False, False, True])


def test_figures_of_known_runs() -> None:
    known = [path((0, 0.003), (10, 0.0005)), path((0, -0.002))]
    seen = figures(outcomes(*known, turns=0.1))
    assert seen["converged_at_end"] == 0.5
    assert seen["rms_last_20_mm"] == pytest.approx(np.sqrt((0.25 + 4.0) / 2.0))
    assert seen["max_last_20_mm"] == pytest.approx(2.0)
    assert seen["settle_median_mm"] == pytest.approx(10.0)
    assert seen["rotation_mean_deg"] == pytest.approx(np.rad2deg(5.0))
    assert seen["inside_2_sigma"] is None
    assert figures(outcomes(known[1]))["settle_p95_mm"] is None
    parts = [outcomes(path((0, 0.001 * k))) for k in range(3)]
    np.testing.assert_allclose(concatenate(parts).x_end, [0.0, 0.001, 0.002])


def test_distant_ends_with_high_confidence_are_counted_on_both_sides() -> None:
    distance = np.array([0.0, 0.0049, 0.0051, -0.0051, -0.02])
    assert undoubted_misses(distance, np.zeros(5)) == 3.0
    assert undoubted_misses(distance, np.array([0.0, 0.0, 1.0, 0.0, 1.0])) == 1.0
    assert undoubted_misses(distance, np.full(5, np.nan)) is None


def test_shares_within_2_and_3_sigma_count_x_and_pitch_equally() -> None:
    # Errors of 1, 2.5 and 4 standard deviations in x; of 0, 0 and 2.5 in sin(pitch).
    tally = ConsistencyTally(3)
    truth = np.array([0.001, 0.0025, 0.004]), np.arcsin([0.0, 0.0, 0.025])
    level, std = np.zeros(3), np.full(3, 0.001)
    tally.add(None, *truth)
    assert np.all(np.isnan(tally.inside))
    tally.add(Belief(level, std, level, 10.0 * std), *truth)
    np.testing.assert_allclose(tally.inside, [[1.0, 0.5, 0.0], [1.0, 1.0, 0.5]])
    # Of x alone.
    np.testing.assert_allclose(tally.x_inside, [1.0, 1.0, 0.0])
    assert np.all(np.isnan(tally.missed))
    assert np.all(np.isnan(is_doubtful(tally.missed)))
    # A second step with exact estimates; the last miss probability counts.
    for missed in ([0.9, 0.0, 0.0], [0.05, 0.06, 0.0]):
        tally.add(Belief(level, std, level, std, np.array(missed)), level, level)
    np.testing.assert_allclose(tally.inside[0], [1.0, 2.5 / 3.0, 2.0 / 3.0])
    np.testing.assert_array_equal(is_doubtful(tally.missed), [0.0, 1.0, 0.0])
