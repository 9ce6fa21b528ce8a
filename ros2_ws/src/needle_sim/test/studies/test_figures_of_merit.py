from __future__ import annotations

import numpy as np
import pytest

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import (
    Outcomes,
    Tally,
    figures,
    joined,
    trusted_far_off,
)


def outcomes(paths: list[FloatArray], turns: float = 0.0) -> Outcomes:
    """Follow needles along given distances from the plane [m], one step of 1 mm apart."""
    x = np.array(paths)
    tally = Tally(x[:, 0], x.shape[1] - 1)
    for step in range(1, x.shape[1]):
        tally.add(x[:, step], 0.001 * step, np.full(len(x), turns))
    return tally.outcomes()


def path(steps: int, *stretches: tuple[int, float]) -> FloatArray:
    """Return distances after 0 ... steps: `(from, value)` holds from there on."""
    x = np.zeros(steps + 1)
    for first, value in stretches:
        x[first:] = value
    return x


def test_settled_is_the_last_entry_into_the_band() -> None:
    found = outcomes(
        [
            path(50),
            path(50, (0, 0.003), (10, 0.0)),
            path(50, (0, 0.003), (10, 0.0), (20, -0.002), (25, 0.001)),
            path(50, (49, 0.002)),
        ]
    )
    np.testing.assert_allclose(found.settled, [0.0, 0.010, 0.025, np.inf])


def test_both_readings_of_converged() -> None:
    # outside until step 30 of 50, until step 31, and at the very end
    found = outcomes(
        [
            path(50, (0, 0.003), (31, 0.0)),
            path(50, (0, 0.003), (32, 0.0)),
            path(50, (50, 0.0011)),
            path(50, (0, -0.001)),
        ]
    )
    np.testing.assert_array_equal(found.converged_at_end, [True, True, False, True])
    np.testing.assert_array_equal(found.converged_last_steps, [True, False, False, True])


def test_a_run_that_missed_diverged_only_if_it_is_farther_than_ever_and_moving_away() -> None:
    away = np.linspace(0.001, 0.010, 51)
    still_coming = np.linspace(0.012, 0.002, 51)
    found = outcomes([away, still_coming, path(50)])
    np.testing.assert_array_equal(found.diverged, [True, False, False])


def test_figures_of_known_runs() -> None:
    seen = figures(outcomes([path(50, (0, 0.003), (10, 0.0005)), path(50, (0, -0.002))], 0.1))
    assert seen["converged_at_end"] == 0.5
    assert seen["rms_last_20_mm"] == pytest.approx(np.sqrt((0.25 + 4.0) / 2.0))
    assert seen["max_last_20_mm"] == pytest.approx(2.0)
    assert seen["settle_median_mm"] == pytest.approx(10.0)
    assert seen["rotation_mean_deg"] == pytest.approx(np.rad2deg(5.0))


def test_no_run_settled_is_no_figure() -> None:
    seen = figures(outcomes([path(5, (0, 0.002))]))
    assert seen["settle_median_mm"] is None
    assert seen["settle_p95_mm"] is None


def test_parts_join_in_order() -> None:
    parts = [outcomes([path(30, (0, 0.001 * k))]) for k in range(3)]
    np.testing.assert_allclose(joined(parts).x_end, [0.0, 0.001, 0.002])


def test_ends_that_are_far_off_and_trusted_are_counted_on_both_sides() -> None:
    distance = np.array([0.0, 0.0049, 0.0051, -0.0051, -0.02])
    assert trusted_far_off(distance, np.zeros(5)) == 3.0
    assert trusted_far_off(distance, np.array([0.0, 0.0, 1.0, 0.0, 1.0])) == 1.0
    assert trusted_far_off(distance, np.full(5, np.nan)) is None
