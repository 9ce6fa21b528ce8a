"""Reach of points: closed forms against paths that are integrated step by step."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.random import default_rng

from needle_controller.model.arrays import Array
from needle_controller.model.point_reach import (
    check_point,
    least_insertion_to_point,
    point_from_message,
    point_reachability,
    widest_at,
)
from needle_core.errors import UserError

CURVATURE = 1.0 / 0.122


def path(curvatures: Array, length: float) -> Array:
    """Return the end (x, 0, z) of a plane path from the origin along z, by small chords [m]."""
    part = length / len(curvatures)
    heading = np.cumsum(curvatures * part) - 0.5 * curvatures * part
    return np.array([np.sum(np.sin(heading)), 0.0, np.sum(np.cos(heading))]) * part


@pytest.mark.parametrize(("bend_deg", "straight"), [(0.0, 0.05), (20.0, 0.03), (60.0, 0.0)])
def test_the_soonest_way_is_an_arc_and_a_straight(bend_deg: float, straight: float) -> None:
    arc = np.deg2rad(bend_deg) / CURVATURE
    parts = 100_000
    on_arc = round(parts * arc / (arc + straight))
    end = path(np.where(np.arange(parts) < on_arc, CURVATURE, 0.0), arc + straight)
    turned = np.array([end[0] * 0.6, -end[0] * 0.8, end[2]])
    assert float(least_insertion_to_point(turned, CURVATURE)) == pytest.approx(
        arc + straight, abs=2e-6
    )


def test_no_path_ends_where_none_can_or_sooner_than_it_may() -> None:
    rng = default_rng(3)
    for _ in range(300):
        length = rng.uniform(0.02, 0.15)
        pieces = rng.uniform(-1.0, 1.0, rng.integers(1, 6))
        extreme = np.where(rng.random(len(pieces)) < 0.5, np.sign(pieces), pieces)
        end = path(np.repeat(extreme * CURVATURE, 2000), length)
        least = float(least_insertion_to_point(end, CURVATURE))
        assert least <= length + 1e-6


def test_points_inside_the_circles_are_out_of_reach_but_for_the_tolerance() -> None:
    radius = 1.0 / CURVATURE
    inside = np.array([radius - np.sqrt((radius - 0.0005) ** 2 - 0.06**2), 0.0, 0.06])
    assert np.isnan(least_insertion_to_point(inside, CURVATURE))
    assert least_insertion_to_point(inside, CURVATURE, tolerance=0.001) == pytest.approx(
        radius * np.arcsin(0.06 / (radius - 0.0005)), rel=1e-6
    )


def test_beside_or_behind_is_out_of_reach_unless_it_is_there() -> None:
    assert np.all(np.isnan(least_insertion_to_point([[0.01, 0.0, 0.0], [0.0, 0.0, -0.01]], 8.0)))
    there = point_reachability(
        [0.0, 0.0005, -0.0005], CURVATURE, insertion=0.1, end=0.1, tolerance=0.001
    )
    assert bool(there.reachable)
    assert there.depth == pytest.approx(0.1)


def test_what_is_left_of_the_depth_decides() -> None:
    for end, answer in ((0.099, False), (0.101, True)):
        found = point_reachability([0.0, 0.0, 0.05], CURVATURE, insertion=0.05, end=end)
        assert bool(found.reachable) is answer
        assert found.depth == pytest.approx(0.1)


@pytest.mark.parametrize("ahead", [0.03, 0.1, 0.3])
def test_the_widest_place_is_the_last_that_can_be_reached(ahead: float) -> None:
    widest = widest_at(ahead, CURVATURE)
    assert not np.isnan(least_insertion_to_point([0.0, widest - 1e-6, ahead], CURVATURE))
    assert np.isnan(least_insertion_to_point([0.0, widest + 1e-6, ahead], CURVATURE))


def test_refusals_say_why_and_from_where_it_would_go() -> None:
    check_point([0.01, 0.005, 0.09], CURVATURE, 0.12)
    with pytest.raises(UserError, match="ahead of the entry"):
        check_point([0.0, 0.0, 0.0], CURVATURE, 0.12)
    with pytest.raises(UserError, match=r"takes 0\.1\d* m of insertion, depth is 0\.1 m"):
        check_point([0.005, 0.0, 0.11], CURVATURE, 0.1)
    with pytest.raises(UserError, match="in place of") as refusal:
        check_point([0.03, -0.04, 0.06], CURVATURE, 0.15)
    # from that entry it can be reached, from a little less far not
    (place,) = re.findall(r"entering at \((.*?)\)", str(refusal.value))
    x, y = (float(part) for part in place.split(","))
    check_point(np.array([0.03, -0.04, 0.06]) - 1.001 * np.array([x, y, 0.0]), CURVATURE, 0.15)
    with pytest.raises(UserError):
        check_point(np.array([0.03, -0.04, 0.06]) - 0.999 * np.array([x, y, 0.0]), CURVATURE, 0.15)


def test_a_point_in_another_frame_or_without_numbers_is_refused() -> None:
    np.testing.assert_array_equal(point_from_message("rig", [1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])
    with pytest.raises(UserError, match="'world'"):
        point_from_message("world", [0.0, 0.0, 0.1])
    with pytest.raises(UserError, match="not finite"):
        point_from_message("rig", [0.0, float("nan"), 0.1])
