"""Reachability of planes and points: closed forms against integrated paths."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from numpy.random import default_rng

from needle_controller.model.arrays import Array
from needle_controller.model.reachability import (
    LARGEST_PITCH,
    check_point,
    least_insertion,
    least_insertion_to_point,
    widest_at,
)
from needle_core.errors import UserError
from needle_sim.needle.plant import NeedlePlant, initial_pose

CURVATURE = 1.0 / 0.122


def test_the_plant_reaches_the_plane_in_the_least_insertion() -> None:
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


def test_no_path_of_random_rolls_is_shorter_than_the_least_insertion() -> None:
    rng, count, h = default_rng(1), 5_000, 0.06 / 240
    x, pitch, sine = np.zeros(count), np.full(count, 0.1), np.zeros(count)
    for k in range(240):
        sine = rng.uniform(-1, 1, count) if k % 40 == 0 else sine
        x = x + h * np.sin(pitch + 0.5 * h * CURVATURE * sine)
        pitch = pitch + h * CURVATURE * sine
    level = np.abs(pitch) < 0.02
    assert np.sum(level) > 100
    start = np.stack([-x[level], np.full(level.sum(), 0.1), np.zeros(level.sum())], axis=-1)
    assert np.all(least_insertion(start, CURVATURE) < 0.06 + 0.02 / CURVATURE)


def test_the_largest_pitch_adds_a_straight_part() -> None:
    least = float(least_insertion([-0.5, 0.0, 0.0], CURVATURE))
    arcs = 2.0 * (1.0 - math.cos(LARGEST_PITCH)) / CURVATURE
    expected = 2.0 * LARGEST_PITCH / CURVATURE + (0.5 - arcs) / math.sin(LARGEST_PITCH)
    assert least == pytest.approx(expected, rel=1e-12)


def test_reach_is_symmetric_and_broadcasts() -> None:
    reduced = default_rng(2).uniform(-1, 1, (50, 3)) * [0.02, 1.2, 3.0]
    whole = least_insertion(reduced, CURVATURE, tolerance=1e-3)
    alone = [float(least_insertion(-r, CURVATURE, tolerance=1e-3)) for r in reduced]
    np.testing.assert_allclose(whole, alone, rtol=1e-14)
    assert np.all(whole <= least_insertion(reduced, CURVATURE) + 1e-12)
    assert np.isnan(least_insertion([np.nan, 0.0, 0.0], CURVATURE))


def path(curvatures: Array, length: float) -> Array:
    """Return the end (x, 0, z) of a plane path from the origin along z, by small chords [m]."""
    part = length / len(curvatures)
    heading = np.cumsum(curvatures * part) - 0.5 * curvatures * part
    return np.array([np.sum(np.sin(heading)), 0.0, np.sum(np.cos(heading))]) * part


def test_the_shortest_path_to_a_point_is_an_arc_and_a_straight_line() -> None:
    for bend_deg, straight in ((0.0, 0.05), (20.0, 0.03), (60.0, 0.0)):
        arc, parts = np.deg2rad(bend_deg) / CURVATURE, 20_000
        on_arc = round(parts * arc / (arc + straight))
        end = path(np.where(np.arange(parts) < on_arc, CURVATURE, 0.0), arc + straight)
        turned = np.array([end[0] * 0.6, -end[0] * 0.8, end[2]])
        least = float(least_insertion_to_point(turned, CURVATURE))
        assert least == pytest.approx(arc + straight, abs=1e-5)


def test_no_path_is_shorter_than_the_least_insertion_or_beyond_the_widest_offset() -> None:
    rng = default_rng(3)
    for _ in range(100):
        length = rng.uniform(0.02, 0.15)
        pieces = rng.uniform(-1.0, 1.0, rng.integers(1, 6))
        extreme = np.where(rng.random(len(pieces)) < 0.5, np.sign(pieces), pieces)
        end = path(np.repeat(extreme * CURVATURE, 1000), length)
        assert float(least_insertion_to_point(end, CURVATURE)) <= length + 1e-6
    for ahead in (0.03, 0.3):
        widest = widest_at(ahead, CURVATURE)
        assert not np.isnan(least_insertion_to_point([0.0, widest - 1e-6, ahead], CURVATURE))
        assert np.isnan(least_insertion_to_point([0.0, widest + 1e-6, ahead], CURVATURE))
    # Within the circle a tolerance may help; a target next to or behind the tip may be reached
    # already.
    radius = 1.0 / CURVATURE
    inside = np.array([radius - np.sqrt((radius - 0.0005) ** 2 - 0.06**2), 0.0, 0.06])
    assert least_insertion_to_point(inside, CURVATURE, tolerance=0.001) == pytest.approx(
        radius * np.arcsin(0.06 / (radius - 0.0005)), rel=1e-6
    )
    assert np.all(np.isnan(least_insertion_to_point([[0.01, 0.0, 0.0], [0.0, 0.0, -0.01]], 8.0)))
    there = least_insertion_to_point([0.0, 0.0005, -0.0005], CURVATURE, tolerance=0.001)
    assert float(there) == 0.0


def test_rejections_of_a_point_give_the_reason_and_a_better_entry() -> None:
    check_point([0.01, 0.005, 0.09], CURVATURE, 0.12)
    with pytest.raises(UserError, match="ahead of the entry"):
        check_point([0.0, 0.0, 0.0], CURVATURE, 0.12)
    with pytest.raises(UserError, match=r"takes 0\.1\d* m of insertion, depth is 0\.1 m"):
        check_point([0.005, 0.0, 0.11], CURVATURE, 0.1)
    aside = np.array([0.03, -0.04, 0.06])
    with pytest.raises(UserError, match="instead of") as refusal:
        check_point(aside, CURVATURE, 0.15)
    # The point can be reached from that entry, but not from a slightly nearer one.
    (place,) = re.findall(r"entry at \((.*?)\)", str(refusal.value))
    entry = np.array([*(float(part) for part in place.split(",")), 0.0])
    check_point(aside - 1.001 * entry, CURVATURE, 0.15)
    with pytest.raises(UserError):
        check_point(aside - 0.999 * entry, CURVATURE, 0.15)
