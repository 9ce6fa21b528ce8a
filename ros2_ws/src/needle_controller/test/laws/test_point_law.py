"""The point law: direction, arcs, waiting, the end, winding, torsion, doubt."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy import integrate
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    T_AGREEMENT,
    T_CURVATURE,
    T_LAG,
    T_PLAY,
    T_ROLL,
    T_WEIGHT,
    Hypotheses,
    MixtureEstimate,
)
from needle_controller.laws.point_law import PointLaw
from needle_controller.laws.point_turns import (
    PointLawSettings,
    affordable_reserve,
    rest_after,
    way_as_bent,
    write_need,
)
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.observers.estimator import Estimate
from needle_core.errors import OutOfBoundsError

CURVATURE = 1.0 / 0.122
STEP = 0.001
CAP = np.deg2rad(30.0) / STEP


def estimate(pose: Array, std: float = 0.0) -> Estimate:
    """Return what an estimator says that knows the pose, (..., 4, 4), its pitch to `std` [rad]."""
    rotation = pose[..., :3, :3]
    coordinates = np.empty((*pose.shape[:-2], 6))
    coordinates[..., :3] = pose[..., :3, 3]
    angles = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_euler("XYZ")
    coordinates[..., 3:] = angles.reshape(*pose.shape[:-2], 3)
    curvature = np.full(pose.shape[:-2], CURVATURE)
    covariance = np.zeros((*coordinates.shape, 6))
    covariance[..., 4, 4] = std**2
    return Estimate(
        coordinates=coordinates,
        linearized=linearized_from_reduced(coordinates[..., [0, 4, 5]], curvature),
        curvature=curvature,
        warnings=(),
        covariance_of=lambda: covariance,
    )


def entry(roll_deg: float = 0.0) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    return pose


def moved(pose: Array, length: float, turn: float, curvature: float = CURVATURE) -> Array:
    """Move a pose by [KC09] (2), with scipy's exponential."""
    twist = np.zeros((4, 4))
    twist[1, 2], twist[2, 1] = -curvature * length, curvature * length
    twist[0, 1], twist[1, 0] = -turn, turn
    twist[2, 3] = length
    return np.asarray(pose @ expm(twist))


def law(**changes: float) -> PointLaw:
    return PointLaw(PointLawSettings(**changes))


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_the_need_of_a_point_on_an_arc_is_that_arc(share: float) -> None:
    curvature, length = share * CURVATURE, 0.08
    tip_in_start = moved(np.eye(4), length, 0.0, curvature)[:3, 3]
    need = np.empty(2)
    assert write_need(tip_in_start, need) == pytest.approx(length)
    # towards -y, where a needle bends whose bevel is not turned
    np.testing.assert_allclose(need, [0.0, -0.5 * curvature * length**2], atol=1e-12)


def test_a_point_beside_or_behind_needs_nothing_and_is_passed() -> None:
    need = np.ones(2)
    assert write_need(np.array([0.001, 0.0, -0.002]), need) == -0.002
    np.testing.assert_array_equal(need, 0.0)
    assert write_need(np.array([0.0, 0.0, 0.05]), need) == 0.05


@pytest.mark.parametrize(
    "target", [(0.0, -0.003, 0.005), (0.001, 0.002, 0.02), (0.06, 0.0, 0.03), (0.0, 0.0, 0.05)]
)
def test_what_no_arc_leads_to_is_nearest_after_what_is_said(target: tuple[float, ...]) -> None:
    """The oracle looks along the arcs of all curvatures up to the needle's."""
    aside, ahead = np.hypot(target[0], target[1]), target[2]
    lengths = np.linspace(0.0, 0.1, 5001)[:, None]
    bend = np.linspace(1e-6, CURVATURE, 101)
    x, z = (1.0 - np.cos(bend * lengths)) / bend, np.sin(bend * lengths) / bend
    nearest = np.argmin(np.hypot(x - aside, z - ahead)) // len(bend)
    found = way_as_bent(np.array(target), write_need(np.array(target), np.empty(2)), CURVATURE)
    assert found == pytest.approx(lengths[nearest, 0], abs=1e-4)


@pytest.mark.parametrize("rate", [0.0, 1e-7, 200.0, -523.0])
def test_what_is_left_of_a_need_is_the_integral_of_the_bending(rate: float) -> None:
    left, length, need = 0.03, 0.007, np.array([0.002, -0.001])

    def bent(along: float, axis: int) -> float:
        angle = rate * along - 0.5 * np.pi
        return CURVATURE * (left - along) * float((np.cos(angle), np.sin(angle))[axis])

    expected = [need[k] - integrate.quad(bent, 0.0, length, (k,))[0] for k in range(2)]
    np.testing.assert_allclose(
        rest_after(need, left, CURVATURE, rate, length), expected, atol=1e-10
    )


@pytest.mark.parametrize("around", np.deg2rad([10.0, 100.0, -60.0, 170.0]))
def test_turns_the_shorter_way_to_where_the_needle_bends_to_the_point(around: float) -> None:
    # near the edge of what can be reached: no waiting; a needle without roll bends towards -y
    target = [0.035 * np.cos(around), 0.035 * np.sin(around), 0.10]
    command = law(max_rotation_per_length=1e5, largest_turn=100.0)(estimate(entry()), target)
    turned = Rotation.from_euler("z", float(command.rotation_rate) * STEP).as_matrix()
    np.testing.assert_allclose(
        turned @ [0.0, -1.0, 0.0], [np.cos(around), np.sin(around), 0.0], atol=1e-9
    )
    assert abs(float(command.rotation_rate) * STEP) <= np.pi + 1e-9


def steered(pose: Array, target: npt.ArrayLike, budget: float = math.inf) -> tuple[float, float]:
    """Steer an exact needle whose pose is known; return its miss [m] and rotation [rad]."""
    point_law, rotation = law(), 0.0
    for _ in range(200):
        command = point_law(estimate(pose), target, budget - rotation)
        assert command.insertion_left is not None
        length = min(float(command.insertion_left), STEP)
        if length <= 1e-6:
            break
        turn = float(command.rotation_rate) * length
        rotation += abs(turn)
        pose = moved(pose, length, turn)
    return float(np.linalg.norm(pose[:3, 3] - np.asarray(target))), rotation


@pytest.mark.parametrize("roll_deg", [-150.0, 20.0])
@pytest.mark.parametrize(
    "target_mm", [[0.0, 0.0, 60.0], [10.0, 0.0, 60.0], [-15.0, 20.0, 100.0], [0.0, -3.0, 120.0]]
)
def test_an_exact_needle_comes_to_the_point_with_few_turns(
    target_mm: list[float], roll_deg: float
) -> None:
    miss, rotation = steered(entry(roll_deg), np.array(target_mm) * 1e-3)
    assert miss < 0.0002
    assert rotation < np.deg2rad(800.0)


@pytest.mark.parametrize("budget_deg", [0.0, 100.0, 360.0, 450.0])
def test_a_budget_is_kept_and_two_half_turns_lead_to_the_point(budget_deg: float) -> None:
    target = [0.01, -0.003, 0.09]
    miss, rotation = steered(entry(), target, np.deg2rad(budget_deg))
    assert rotation <= np.deg2rad(budget_deg) + 1e-9
    assert (miss < 0.0002) == (budget_deg >= 360.0)


def next_turn(left: float, kept: float) -> float:
    """Return what is left after bending from 1 - kept of the curvature to as much across [m]."""
    need = (1.0 - kept) * left**2

    def beyond(end: float) -> float:
        return need - (left**2 - end**2) + (1.0 - kept) * end**2

    return float(brentq(beyond, 0.0, left))


@pytest.mark.parametrize("half_turns", [1, 2, 5])
def test_what_is_kept_back_takes_all_half_turns_to_the_last_turn(half_turns: int) -> None:
    last_turn, left = 0.008, 0.1
    for turns_left in range(half_turns, 0, -1):
        kept = affordable_reserve(left, turns_left * np.pi, last_turn)
        left = next_turn(left, kept)
    assert left == pytest.approx(last_turn)
    assert affordable_reserve(0.1, 0.0, last_turn) == 0.0
    assert affordable_reserve(0.1, math.inf, last_turn) == 1.0


def test_a_needle_that_bends_to_the_point_is_left_alone() -> None:
    arc = moved(entry(70.0), 0.08, 0.0)
    command = law()(estimate(entry(70.0)), arc[:3, 3])
    assert command.rotation_rate == 0.0
    assert command.insertion_left == pytest.approx(0.08)


def test_waits_while_a_later_turn_will_do_and_no_longer() -> None:
    # straight ahead, far away: a needle may bend anywhere for a while
    ahead = [0.0, 0.0, 0.1]
    assert law()(estimate(entry()), ahead).rotation_rate == 0.0
    assert abs(float(law(reserve=1.0)(estimate(entry()), ahead).rotation_rate)) == pytest.approx(
        CAP
    )
    # the less is known, the earlier it turns
    unsure = estimate(entry(), std=np.deg2rad(10.0))
    eager = law()(unsure, ahead)
    assert abs(float(eager.rotation_rate)) == pytest.approx(CAP)


def test_where_a_whole_turn_is_too_long_it_turns_only_if_that_is_nearer() -> None:
    # 3 mm before the point, which lies a little beside where the needle will come: half a turn
    # takes 6 mm
    beside = [0.0, 0.00002, 0.003]
    turning = law()(estimate(entry()), [0.00006, 0.00005, 0.003])
    assert float(turning.rotation_rate) > 0.0
    assert law(close_enough=0.0001)(estimate(entry()), beside).rotation_rate == 0.0


def test_the_way_that_unwinds_is_taken_at_the_limit_of_winding() -> None:
    aside = [0.035, 0.0, 0.1]
    free = mixture([0.0], wound=0.0)
    tight = mixture([0.0], wound=6.0 * np.pi - 0.5)
    assert float(law()(free, aside).rotation_rate) == pytest.approx(CAP)
    assert float(law()(tight, aside).rotation_rate) == pytest.approx(-CAP)


def mixture(rolls: list[float], *, wound: float = 0.0, **columns: float) -> MixtureEstimate:
    """Return hypotheses of these rolls [rad], equally likely, of a needle at its entry."""
    known = estimate(entry())
    table = np.zeros((len(rolls), COLUMNS))
    table[:, T_ROLL] = rolls
    table[:, T_AGREEMENT], table[:, T_CURVATURE] = 1.0, CURVATURE
    table[:, T_WEIGHT] = 1.0 / len(rolls)
    for name, value in columns.items():
        table[0, int(name[1:])] = value
    hypotheses = Hypotheses(table, np.zeros(()), np.asarray(wound), np.zeros(3))
    fields = {field.name: getattr(known, field.name) for field in dataclasses.fields(Estimate)}
    return MixtureEstimate(**fields, hypotheses=hypotheses)


def test_each_hypothesis_turns_from_its_own_roll_and_through_its_own_play() -> None:
    aside = [0.035, 0.0, 0.1]
    free = law(max_rotation_per_length=1e5, largest_turn=100.0)
    (quarter,) = [float(free(mixture([0.0]), aside).rotation_rate) * STEP]
    assert quarter == pytest.approx(0.5 * np.pi)
    both = float(free(mixture([0.3, -0.1]), aside).rotation_rate) * STEP
    assert both == pytest.approx(quarter - 0.1)
    play = mixture([0.0], **{f"c{T_PLAY}": 0.4})
    assert float(free(play, aside).rotation_rate) * STEP == pytest.approx(quarter + 0.4)


@pytest.mark.parametrize("columns", [{f"c{T_LAG}": 0.008}, {f"c{T_PLAY}": 0.7}])
def test_torsion_makes_it_turn_in_time(columns: dict[str, float]) -> None:
    def waits_until(needle: MixtureEstimate) -> float:
        """Return how near a point straight ahead comes before the bevel is turned [m]."""
        ahead = np.arange(0.1, 0.0, -0.001)
        return float(next(z for z in ahead if law()(needle, [0.0, 0.0, z]).rotation_rate != 0.0))

    # a play takes 1.3 mm to turn through at 30 deg/mm, a lag its 8 mm
    assert waits_until(mixture([0.0], **columns)) > waits_until(mixture([0.0])) + 0.001


def test_rolls_that_disagree_leave_the_needle_alone() -> None:
    scattered = mixture([0.0], **{f"c{T_AGREEMENT}": 0.1})
    assert law(scatter_dead_band=3.0)(scattered, [0.035, 0.0, 0.1]).rotation_rate == 0.0


def test_many_needles_are_steered_as_each_alone() -> None:
    poses = np.stack([entry(0.0), entry(100.0), moved(entry(-30.0), 0.03, 0.2)])
    targets = np.array([[0.01, 0.0, 0.07], [0.0, 0.03, 0.1], [-0.01, 0.01, 0.09]])
    together = law()(estimate(poses), targets)
    for k in range(3):
        alone = law()(estimate(poses[k]), targets[k])
        assert alone.rotation_rate == together.rotation_rate[k]
        assert together.insertion_left is not None
        assert alone.insertion_left == together.insertion_left[k]
        assert alone.virtual_input == together.virtual_input[k]


def test_settings_out_of_bounds_are_refused() -> None:
    with pytest.raises(OutOfBoundsError, match="reserve"):
        law(reserve=1.5)
    with pytest.raises(OutOfBoundsError, match="last_turns_from"):
        law(last_turn=0.01, last_turns_from=0.01)
