"""Reachability against brute force: rolls that switch anywhere, integrated in small steps."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.random import default_rng

from needle_controller.model.arrays import Array
from needle_controller.model.reachability import (
    LARGEST_PITCH,
    check_offset,
    farthest_offsets,
    least_insertion,
    reachability,
)
from needle_core.errors import UserError
from needle_sim.needle.plant import NeedlePlant, initial_pose

CURVATURE = 1.0 / 0.122


def follow(
    x: Array, pitch: Array, legs: list[tuple[Array, Array | float]]
) -> tuple[Array, Array, Array]:
    """Return x, pitch and the steepest pitch after legs of (length, sine of roll)."""
    x, pitch = x + 0.0, pitch + 0.0
    steepest = np.abs(pitch)
    parts = 40
    for length, sine in legs:
        h = length / parts
        for _ in range(parts):
            middle = pitch + 0.5 * h * CURVATURE * sine
            x = x + h * np.sin(middle)
            pitch = pitch + h * CURVATURE * sine
            steepest = np.maximum(steepest, np.abs(pitch))
    return x, pitch, steepest


@pytest.mark.parametrize(
    ("x", "pitch"),
    [(-0.003, 0.03), (-0.01, 0.2), (0.002, 0.3), (0.004, -0.1), (-0.001, -0.3), (0.0, 0.2)],
)
def test_no_switching_rolls_reach_the_plane_sooner(x: float, pitch: float) -> None:
    """Three arcs of roll +-90 or 0 deg with all switching points on a grid."""
    best = math.inf
    grid = np.linspace(0.0, 0.12, 121)
    first, second = (a.ravel() for a in np.meshgrid(grid, grid, indexing="ij"))
    for one, two in itertools.product((-1.0, 0.0, 1.0), repeat=2):
        for three in (-1.0, 1.0):
            start = np.full(first.shape, x), np.full(first.shape, pitch)
            _, before, _ = follow(*start, [(first, one), (second, two)])
            # The last leg levels out.
            third = np.asarray(-before / (three * CURVATURE), dtype=float)
            legs: list[tuple[Array, Array | float]] = [
                (first, one),
                (second, two),
                (np.maximum(third, 0.0), three),
            ]
            end, _, _ = follow(*start, legs)
            there = (np.abs(end) < 0.4e-3) & (third >= 0.0)
            if np.any(there):
                best = min(best, float(np.min((first + second + third)[there])))
    least = float(least_insertion([x, pitch, 0.0], CURVATURE))
    # The grid of 1 mm and the band of 0.4 mm both cost.
    band = float(least_insertion([x, pitch, 0.0], CURVATURE, tolerance=0.5e-3))
    assert band - 1e-3 <= best <= least + 2.5e-3


def test_the_plant_gets_there_in_the_least_insertion_and_no_sooner() -> None:
    """On SE(3), rolls of +-90 deg: the closed form is exact."""
    x, pitch = -0.004, 0.05
    least = float(least_insertion([x, pitch, 0.0], CURVATURE))
    top = math.acos(0.5 * (1.0 + math.cos(pitch) + CURVATURE * x))
    plant = NeedlePlant(initial_pose(pitch, 0.5 * math.pi), curvature=CURVATURE)
    plant.advance((top - pitch) / CURVATURE, 0.0)
    plant.advance(0.0, math.pi)
    plant.advance(top / CURVATURE, 0.0)
    assert plant.T_rig_tip[0, 3] + x == pytest.approx(0.0, abs=1e-12)
    assert plant.T_rig_tip[0, 2] == pytest.approx(0.0, abs=1e-12)
    assert float(plant.insertion) == pytest.approx(least, abs=1e-12)


def test_random_rolls_never_beat_the_bounds() -> None:
    rng, count, length = default_rng(1), 20_000, 0.06
    pitch0 = 0.1
    x, pitch = np.zeros(count), np.full(count, pitch0, dtype=float)
    for _ in range(6):
        x, pitch, _ = follow(x, pitch, [(np.full(count, 0.01), rng.uniform(-1, 1, count))])
    level = np.abs(pitch) < 0.02
    lowest, highest = farthest_offsets(pitch0, CURVATURE, length + 0.02 / CURVATURE)
    assert np.sum(level) > 100
    assert np.all((x[level] > lowest) & (x[level] < highest))


def test_farthest_offset_takes_all_of_the_insertion() -> None:
    for pitch, length in ((0.0, 0.12), (0.2, 0.05), (-0.3, 0.1), (0.0, 0.6)):
        for offset in farthest_offsets(pitch, CURVATURE, length):
            least = least_insertion([-float(offset), pitch, 0.0], CURVATURE)
            assert float(least) == pytest.approx(length, rel=1e-9)


def test_small_offsets_are_the_double_integrators() -> None:
    """From rest over a distance d: 2 sqrt(d / kappa)."""
    least = least_insertion([1e-5, 0.0, 0.0], CURVATURE)
    assert float(least) == pytest.approx(2.0 * math.sqrt(1e-5 / CURVATURE), rel=1e-3)


def test_a_pitch_limit_adds_a_straight_stretch() -> None:
    limit = math.radians(20.0)
    least = float(least_insertion([-0.05, 0.0, 0.0], CURVATURE, pitch_limit=limit))
    arcs = 2.0 * (1.0 - math.cos(limit)) / CURVATURE
    expected = 2.0 * limit / CURVATURE + (0.05 - arcs) / math.sin(limit)
    assert least == pytest.approx(expected, rel=1e-12)
    assert least > float(least_insertion([-0.05, 0.0, 0.0], CURVATURE))


def test_up_and_down_are_alike_and_needles_are_judged_one_by_one() -> None:
    rng = default_rng(2)
    reduced = rng.uniform(-1, 1, (50, 3)) * [0.02, 1.2, 3.0]
    whole = least_insertion(reduced, CURVATURE, tolerance=1e-3)
    np.testing.assert_allclose(least_insertion(-reduced, CURVATURE, tolerance=1e-3), whole)
    alone = [float(least_insertion(r, CURVATURE, tolerance=1e-3)) for r in reduced]
    np.testing.assert_allclose(whole, alone, rtol=1e-14)
    assert np.all(whole <= least_insertion(reduced, CURVATURE) + 1e-12)
    assert np.isnan(least_insertion([np.nan, 0.0, 0.0], CURVATURE))


def test_what_is_left_decides() -> None:
    reduced = [-0.003, 0.0, 0.3]
    needed = float(least_insertion(reduced, CURVATURE))
    for spare, expected in ((1e-6, True), (-1e-6, False)):
        answer = reachability(reduced, CURVATURE, insertion=0.05, end=0.05 + needed + spare)
        assert bool(answer.reachable) is expected
        assert float(answer.depth) == pytest.approx(0.05 + needed)


def test_a_plane_too_far_is_refused_with_what_and_why() -> None:
    check_offset(0.028, CURVATURE, 0.12)
    with pytest.raises(UserError, match=r"0\.03 m cannot be reached.*-0\.0289.* to 0\.0289"):
        check_offset(0.03, CURVATURE, 0.12)
    with pytest.raises(UserError, match="no plane"):
        check_offset(0.0, CURVATURE, 0.01, pitch=0.5)


@pytest.mark.parametrize("curvature", [0.0, -1.0, math.nan, math.inf])
def test_bad_curvature_is_refused(curvature: float) -> None:
    with pytest.raises(UserError, match="curvature"):
        least_insertion([0.0, 0.0, 0.0], curvature)


def test_bad_bounds_are_refused() -> None:
    for limit in (0.0, 0.5 * math.pi):
        with pytest.raises(UserError, match="pitch_limit"):
            least_insertion([0.0, 0.0, 0.0], CURVATURE, pitch_limit=limit)
    with pytest.raises(UserError, match="pitch"):
        least_insertion([0.0, 1.6, 0.0], CURVATURE)
    with pytest.raises(UserError, match="tolerance"):
        least_insertion([0.0, 0.0, 0.0], CURVATURE, tolerance=-1.0)
    assert 0.5 * math.pi > LARGEST_PITCH
