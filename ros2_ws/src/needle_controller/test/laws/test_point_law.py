"""The point law: arcs, waiting, the end, winding, torsion, doubt."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from exact_needle import moved
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.laws.point_law import PointLaw
from needle_controller.laws.point_turns import (
    PointLawSettings,
    affordable_reserve,
    insertion_to_closest_point,
    rest_after,
    write_lateral_offset,
)
from needle_controller.many_needles import ManyFilters
from needle_controller.model.arrays import Array
from needle_controller.observers.estimator import Estimate

from .estimates import CAP, CURVATURE, STEP, known, mixture

ASIDE, AHEAD = [0.035, 0.0, 0.1], [0.0, 0.0, 0.1]


def estimate(pose: Array, std: float = 0.0) -> Estimate:
    """Return the estimate of an estimator that knows a pose, (4, 4)."""
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("XYZ")
    return known(np.concatenate([pose[:3, 3], angles]), std)


def entry(roll_deg: float = 0.0) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    return pose


def law(**changes: float) -> PointLaw:
    return PointLaw(PointLawSettings(**changes))


def free() -> PointLaw:
    return law(max_rotation_per_length=1e5, largest_turn=100.0)


def test_the_need_of_a_point_is_the_bending_of_its_arc() -> None:
    need, length = np.empty(2), 0.08
    for share in (0.1, 0.9):
        curvature = share * CURVATURE
        tip_in_start = moved(np.eye(4), length, 0.0, curvature)[:3, 3].copy()
        assert write_lateral_offset(tip_in_start, need) == pytest.approx(length)
        # Towards -y, the direction in which an unturned bevel bends.
        np.testing.assert_allclose(need, [0.0, -0.5 * curvature * length**2], atol=1e-12)
    # A point next to or behind the tip needs no bending and is passed.
    assert write_lateral_offset(np.array([0.001, 0.0, -0.002]), need) == -0.002
    np.testing.assert_array_equal(need, 0.0)
    assert write_lateral_offset(np.array([0.0, 0.0, 0.05]), need) == 0.05


def test_an_unreachable_point_is_nearest_at_the_returned_length() -> None:
    """The oracle searches the arcs of all curvatures up to the needle's."""
    lengths, bend = np.linspace(0.0, 0.1, 2001)[:, None], np.linspace(1e-6, CURVATURE, 51)
    x, z = (1.0 - np.cos(bend * lengths)) / bend, np.sin(bend * lengths) / bend
    for target in ((0.0, -0.003, 0.005), (0.06, 0.0, 0.03), (0.0, 0.0, 0.05)):
        aside, ahead = np.hypot(target[0], target[1]), target[2]
        nearest = np.argmin(np.hypot(x - aside, z - ahead)) // len(bend)
        found = insertion_to_closest_point(
            np.array(target), write_lateral_offset(np.array(target), np.empty(2)), CURVATURE
        )
        assert found == pytest.approx(lengths[nearest, 0], abs=1e-4)


def test_the_rest_of_a_need_follows_from_the_integral_of_the_bending() -> None:
    left, length, need = 0.03, 0.007, np.array([0.002, -0.001])
    for rate in (0.0, 1e-7, 200.0, -523.0):

        def bent(along: float, axis: int, rate: float = rate) -> float:
            angle = rate * along - 0.5 * np.pi
            return CURVATURE * (left - along) * float((np.cos(angle), np.sin(angle))[axis])

        expected = [need[k] - integrate.quad(bent, 0.0, length, (k,))[0] for k in range(2)]
        rest = rest_after(need, left, CURVATURE, rate, length)
        np.testing.assert_allclose(rest, expected, atol=1e-10)


def test_the_bevel_takes_the_shorter_turn_towards_the_point() -> None:
    for around in np.deg2rad([10.0, 100.0, -60.0, 170.0]):
        # Near the edge of the reachable region: no waiting; without roll it bends towards -y.
        target = [0.035 * np.cos(around), 0.035 * np.sin(around), 0.10]
        turn = float(free()(estimate(entry()), target).rotation_rate) * STEP
        turned = Rotation.from_euler("z", turn).as_matrix() @ [0.0, -1.0, 0.0]
        np.testing.assert_allclose(turned, [np.cos(around), np.sin(around), 0.0], atol=1e-9)
        assert abs(turn) <= np.pi + 1e-9


@pytest.mark.parametrize("budget_deg", [0.0, 100.0, 360.0, 1e9])
def test_the_turn_budget_is_kept_and_two_half_turns_reach_the_point(budget_deg: float) -> None:
    pose, target, budget = entry(), [0.01, -0.003, 0.09], np.deg2rad(budget_deg)
    point_law, rotation = law(), 0.0
    for _ in range(200):
        command = point_law(estimate(pose), target, budget - rotation)
        assert command.insertion_left is not None
        length = min(float(command.insertion_left), STEP)
        if length <= 1e-6:
            break
        turn = float(command.rotation_rate) * length
        rotation += abs(turn)
        pose = moved(pose, length, turn, CURVATURE)
    assert rotation <= min(budget, np.deg2rad(800.0)) + 1e-9
    miss = np.linalg.norm(pose[:3, 3] - target)
    assert (miss < 0.0002) == (budget_deg >= 360.0)


def next_turn(left: float, kept: float) -> float:
    """Return the length left after bending by 1 - kept of the curvature and back [m]."""
    need = (1.0 - kept) * left**2

    def beyond(end: float) -> float:
        return need - (left**2 - end**2) + (1.0 - kept) * end**2

    return float(brentq(beyond, 0.0, left))


def test_the_reserve_lets_all_half_turns_end_at_the_last_turn() -> None:
    last_turn = 0.008
    for half_turns in (1, 2, 5):
        left = 0.1
        for turns_left in range(half_turns, 0, -1):
            left = next_turn(left, affordable_reserve(left, turns_left * np.pi, last_turn))
        assert left == pytest.approx(last_turn)
    assert affordable_reserve(0.1, 0.0, last_turn) == 0.0
    assert affordable_reserve(0.1, math.inf, last_turn) == 1.0


def test_a_turn_waits_as_long_as_a_later_one_suffices() -> None:
    # While it bends towards the point, it is not turned.
    arc = moved(entry(70.0), 0.08, 0.0, CURVATURE)
    command = law()(estimate(entry(70.0)), arc[:3, 3])
    assert command.rotation_rate == 0.0
    assert command.insertion_left == pytest.approx(0.08)
    # With a distant point straight ahead, it may bend anywhere for a while.
    assert law()(estimate(entry()), AHEAD).rotation_rate == 0.0
    eager = law(reserve=1.0)(estimate(entry()), AHEAD).rotation_rate
    assert abs(float(eager)) == pytest.approx(CAP)
    # With more uncertainty it turns earlier.
    unsure = law()(estimate(entry(), std=np.deg2rad(10.0)), AHEAD).rotation_rate
    assert abs(float(unsure)) == pytest.approx(CAP)
    # Half a turn takes 6 mm: 3 mm before the point, turn only if it ends nearer.
    assert float(law()(estimate(entry()), [0.00006, 0.00005, 0.003]).rotation_rate) > 0.0
    near = law(close_enough=0.0001)(estimate(entry()), [0.0, 0.00002, 0.003])
    assert near.rotation_rate == 0.0


def test_each_hypothesis_turns_from_its_own_roll_through_its_play_and_may_unwind() -> None:
    def turn(needle: Estimate) -> float:
        return float(free()(needle, ASIDE).rotation_rate) * STEP

    quarter = 0.5 * np.pi
    assert turn(mixture([0.0])) == pytest.approx(quarter)
    assert turn(mixture([0.3, -0.1])) == pytest.approx(quarter - 0.1)
    assert turn(mixture([0.0], play=0.4)) == pytest.approx(quarter + 0.4)
    # At the winding limit it turns the other way round.
    wound = mixture([0.0], wound=6.0 * np.pi - 0.5)
    assert float(law()(mixture([0.0]), ASIDE).rotation_rate) == pytest.approx(CAP)
    assert float(law()(wound, ASIDE).rotation_rate) == pytest.approx(-CAP)
    # If the rolls disagree, the needle is not turned.
    scattered = mixture([0.0], agreement=0.1)
    assert law(scatter_dead_band=3.0)(scattered, ASIDE).rotation_rate == 0.0


def test_torsion_makes_the_turn_start_earlier() -> None:
    def waits_until(needle: Estimate) -> float:
        """Return the distance of a point straight ahead at which the bevel is turned [m]."""
        ahead = np.arange(0.1, 0.0, -0.001)
        return float(next(z for z in ahead if law()(needle, [0.0, 0.0, z]).rotation_rate != 0.0))

    # Turning through the play takes 1.3 mm at 30 deg/mm; a lag takes its 8 mm.
    for columns in ({"lag": 0.008}, {"play": 0.7}):
        assert waits_until(mixture([0.0], **columns)) > waits_until(mixture([0.0])) + 0.001


def test_many_needles_equal_single_ones() -> None:
    filters = ManyFilters(FilterSettings(), 3, STEP)
    filters.start(np.array([[0.001, 0.0, 0.0], [0.0, 0.0005, 0.0], [-0.001, 0.0, 0.0]]))
    filters.advance(np.full(3, STEP), np.array([0.1, -0.4, 1.0]))
    targets = np.array([[0.01, 0.0, 0.07], [0.0, 0.03, 0.1], [-0.01, 0.01, 0.09]])
    filters.correct(targets * 0.01, None, np.zeros(3))
    rates, left = filters.point_rates(PointLawSettings(), targets, np.full(3, math.inf))
    for k, one in enumerate(filters.each()):
        alone = law()(one, targets[k])
        assert alone.rotation_rate == rates[k]
        assert alone.insertion_left == left[k]
